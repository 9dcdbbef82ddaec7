"""Motion uncertainty: the standard deviations of the joints and markers of a solved motion.

They are computed from the curvature of the poses' cost with the actual uncertainty of each term (see `observability`).
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Int

from mocapfix.kernels.terms import TrackingTerm
from mocapfix.motion import Motion
from mocapfix.solve import observability
from mocapfix.solve.motion_problem import MotionProblem, PoseEvidence

MIN_TRACKING_SD_RAD = 0.01
"""Smallest standard deviation of a joint's smooth trajectory in the uncertainty of the result."""
GAP_VARIANCE_INFLATION = 3.0
"""Variance with which the solve tracks a joint's trajectory across a gap, over the mean squared error of the result, measured on
CMU's training subjects: the solve must not trust a trajectory too much."""


def update_motion_sd(problem: MotionProblem, motion: Motion, evidence: PoseEvidence, frames: Int[np.ndarray, " N"]) -> Motion:
    """Return the motion with the standard deviations of its joints and markers computed for some frames.

    motion  its deviations in the other frames are kept; (T, 0) arrays if there are none yet
    """
    gap_variance = np.where(problem.is_unobserved, evidence.rotation_variance, evidence.gap_variance)
    actual_variance = np.maximum(gap_variance / GAP_VARIANCE_INFLATION, MIN_TRACKING_SD_RAD**2)
    actual_marker_sd = observability.estimate_actual_marker_sd(
        problem.pose_problem, (motion.root_position, motion.local_rotations), problem.subject, evidence.marker_sd
    )
    is_complete = motion.marker_sd.shape != evidence.marker_sd.shape or len(frames) == motion.frame_count
    selected = slice(None) if is_complete else frames
    pose = motion.root_position[selected], motion.local_rotations[selected]
    weight = problem.is_uncertain[selected] / actual_variance[selected]
    marker_sd, joint_sd = observability.compute_pose_sd(
        problem.pose_problem.select_frames(selected),
        pose,
        problem.subject,
        problem.prior,
        actual_marker_sd,
        TrackingTerm(pose[1], weight, pose[0], evidence.root_weight[selected]),
        problem.options.robust_scales_m[-1],
    )
    if is_complete:
        return replace(motion, marker_sd=marker_sd, joint_sd=joint_sd)
    all_marker_sd, all_joint_sd = motion.marker_sd.copy(), motion.joint_sd.copy()
    all_marker_sd[frames], all_joint_sd[frames] = marker_sd, joint_sd
    return replace(motion, marker_sd=all_marker_sd, joint_sd=all_joint_sd)
