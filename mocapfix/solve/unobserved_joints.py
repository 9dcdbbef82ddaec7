"""Unobserved joints: the poses of limbs that no marker shows, in a motion whose other joints are solved.

The cost of such joints depends on nothing that a marker shows: they are leaves of the body, and prior, joint limits and tracking
hold for each joint by itself. So they are inferred last, once, from the solved rest of the take (`occluded_joints`), and the
other joints keep their poses.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from mocapfix.kernels import quaternions
from mocapfix.kernels.terms import TrackingTerm
from mocapfix.motion import Motion, PoseEvidence
from mocapfix.solve import occluded_joints, smoothing
from mocapfix.solve.kinematics import Poses
from mocapfix.solve.pose_problem import MotionProblem
from mocapfix.solve.prior_conditioner import PriorConditioner

FIXED_JOINT_WEIGHT = 1e5
"""Weight, in 1/rad^2 or 1/m^2, that keeps solved joints and the root where they are, compared with those of prior and limits."""


def infer_unobserved_joints(
    problem: MotionProblem, motion: Motion, evidence: PoseEvidence, conditioner: PriorConditioner | None
) -> tuple[Motion, PoseEvidence]:
    """Return the motion with the unobserved joints inferred from the rest of the take, and the evidence with their variance."""
    frames = np.flatnonzero(problem.is_unobserved.any(1))
    local_rotations, variance = motion.local_rotations.copy(), evidence.rotation_variance.copy()
    occluded_joints.infer_occluded_joints(
        motion.root_position,
        local_rotations,
        variance,
        problem.is_unobserved,
        problem.pose_problem.tree.free,
        problem.rate,
        conditioner=conditioner,
        solved=motion.local_rotations,
    )
    inferred = _solve_inferred_joints(problem, (motion.root_position, local_rotations), variance, frames)
    is_unobserved = problem.is_unobserved[frames]
    local_rotations[:] = motion.local_rotations
    rows, joints = np.nonzero(is_unobserved)
    local_rotations[frames[rows], joints] = inferred[rows, joints]
    return replace(motion, local_rotations=local_rotations), replace(evidence, rotation_variance=variance)


def _solve_inferred_joints(
    problem: MotionProblem, pose: Poses, variance: Float[np.ndarray, "T J"], frames: Int[np.ndarray, " N"]
) -> Float[np.ndarray, "N J 3 3"]:
    """Return the local rotations of some frames in which the unobserved joints track smooth trajectories through `pose`.

    variance  of the rotations in `pose`, in rad^2
    """
    root_position, start = pose[0][frames], pose[1][frames]
    weight = np.full(start.shape[:2], FIXED_JOINT_WEIGHT)
    for j in np.flatnonzero(problem.is_unobserved.any(0)).tolist():
        is_gap = problem.is_unobserved[:, j]
        trajectory = smoothing.smooth_joint_rotations(pose[1], j, variance[:, j], problem.is_uncertain[:, j], problem.rate)
        rotations = np.empty((int(is_gap.sum()), 1, 3, 3))
        quaternions.store_joint_quaternions(trajectory[is_gap], 0, rotations)
        start[is_gap[frames], j] = rotations[:, 0]
        weight[is_gap[frames], j] = smoothing.compute_tracking_weight(variance[is_gap, j], problem.options)
    tracking = TrackingTerm(start.copy(), weight, root_position.copy(), np.full(len(frames), FIXED_JOINT_WEIGHT))
    part = problem.pose_problem.select_frames(frames)
    unmarked = replace(part, solver_mask=np.zeros_like(part.solver_mask))
    unmarked.solve(root_position, start, tracking, problem.options.robust_scales_m[-1:])
    return start
