"""Motion uncertainty: the standard deviations of the joints and markers of a solved motion.

It is the posterior covariance of the poses, computed from the root to the leaves. The solver weights its terms for
robustness: it assumes a large marker error, and applies the prior only once in a while, since neighbouring frames are correlated.
The error of its result is a different question. It is computed from the same curvature and factorisation, with the actual
uncertainty of each term:

- markers: estimated from their distances to the solved body, corrected for the part of the error that the poses absorbed, as in
  the a posteriori variance of least squares;
- the pose prior: applied in every frame, since it constrains one frame's pose no less if it is applied to its neighbours too
  (joint limits stay as in the solve; inside them they have no effect);
- joints that lost a marker: the variance of their interpolated trajectory at this distance from the edge of the gap;
- joints that are not solved, as in the fingers: the variation of people's poses;
- the calibration error, which no frame shows: taken from the subject.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.kernels.terms import TrackingTerm
from mocapfix.motion import Motion, PoseEvidence
from mocapfix.pose_prior.mean_pose import MeanPosePrior
from mocapfix.skeleton import load_cmu31_body
from mocapfix.solve import kinematics
from mocapfix.solve.kinematics import Poses
from mocapfix.solve.pose_problem import MotionProblem, PoseProblem, build_pose_prior_term
from mocapfix.stats.residual_process import CHI2_MEDIAN_3_DOF
from mocapfix.subject import Subject

MIN_ESTIMATED_MARKER_SD_M = 0.001
"""Smallest estimate of the marker error per axis."""
MAX_ABSORBED_SHARE = 0.9
"""Share of its squared error that the pose absorbs above which a marker does not enter the estimate."""
UNCERTAINTY_BLOCK_FRAMES = 4096
"""Frames whose problem is held at a time."""
MIN_TRACKING_SD_RAD = 0.01
"""Smallest standard deviation of a joint's smooth trajectory in the uncertainty of the result."""
GAP_VARIANCE_INFLATION = 3.0
"""Variance with which the solve tracks a joint's trajectory across a gap, over the mean squared error of the result, measured on
CMU's training subjects: the solve must not trust a trajectory too much."""


def update_motion_sd(problem: MotionProblem, motion: Motion, evidence: PoseEvidence, frames: Int[np.ndarray, " N"]) -> Motion:
    """Return the motion with the standard deviations of its joints and markers computed for some frames.

    motion  its deviations in the other frames are kept, unless markers were added
    """
    if not len(frames):
        return motion
    gap_variance = np.where(problem.is_unobserved, evidence.rotation_variance, evidence.gap_variance)
    actual_variance = np.maximum(gap_variance / GAP_VARIANCE_INFLATION, MIN_TRACKING_SD_RAD**2)
    actual_marker_sd = estimate_actual_marker_sd(
        problem.pose_problem, (motion.root_position, motion.local_rotations), problem.subject, evidence.marker_sd
    )
    marker_sd, joint_sd = motion.marker_sd.copy(), motion.joint_sd.copy()
    if marker_sd.shape != evidence.marker_sd.shape:
        frames, marker_sd = np.arange(motion.frame_count), np.empty(evidence.marker_sd.shape)
    for block in np.array_split(frames, -(-len(frames) // UNCERTAINTY_BLOCK_FRAMES)):
        pose = motion.root_position[block], motion.local_rotations[block]
        weight = problem.is_uncertain[block] / actual_variance[block]
        marker_sd[block], joint_sd[block] = compute_pose_sd(
            problem.pose_problem.select_frames(block),
            pose,
            problem.subject,
            problem.prior,
            actual_marker_sd,
            TrackingTerm(pose[1], weight, pose[0], evidence.root_weight[block]),
            problem.options.robust_scales_m[-1],
        )
    return replace(motion, marker_sd=marker_sd, joint_sd=joint_sd)


def compute_pose_sd(
    problem: PoseProblem,
    pose: Poses,
    subject: Subject,
    prior: MeanPosePrior,
    actual_marker_sd: float,
    tracking: TrackingTerm,
    robust_scale_m: float,
) -> tuple[Float[np.ndarray, "T K"], Float[np.ndarray, "T J"]]:
    """Return the standard deviations per axis, in metres, of the markers as the body places them, and of the joints.

    That of a joint that the subject's markers do not show is NaN.

    problem           as it was solved
    actual_marker_sd  standard deviation of a measured marker about its place, see `estimate_actual_marker_sd`, in metres
    tracking          the trajectories of the root and of joints that lack a marker, weighted by their actual uncertainty
    robust_scale_m    the last robust scale of the solve
    """
    actual = replace(problem, marker_sd=actual_marker_sd, pose_prior=build_pose_prior_term(prior))
    uncertainty = actual.compute_uncertainty(*pose, tracking, robust_scale_m)
    constant_variance = subject.joint_sd**2 + compute_unsolved_joint_variance(subject, prior, load_cmu31_body().free_joints)
    joint_sd = np.where(subject.solved_joints, np.sqrt(uncertainty.joint_sd**2 + constant_variance), np.nan)
    return np.hypot(uncertainty.marker_sd, subject.marker_sd), joint_sd


def estimate_actual_marker_sd(
    problem: PoseProblem, pose: Poses, subject: Subject, nominal_marker_sd: Float[np.ndarray, "T K"]
) -> float:
    """Return the standard deviation per axis, in metres, of a measured marker about its place on the solved body.

    problem            as it was solved
    nominal_marker_sd  standard deviation of the markers predicted with the weights of the solve, in metres
    """
    absorbed_share = (nominal_marker_sd / problem.marker_sd) ** 2
    distance = kinematics.compute_marker_distances(subject, pose, problem.marker_positions)
    is_usable = problem.solver_mask & (absorbed_share < MAX_ABSORBED_SHARE)
    return estimate_marker_sd(distance, absorbed_share, is_usable, problem.marker_sd)


def compute_unsolved_joint_variance(
    subject: Subject, prior: MeanPosePrior, free_joints: Bool[np.ndarray, " J"]
) -> Float[np.ndarray, " J"]:
    """Return the variance per axis, in square metres, of joints whose parent rotates in people but not in the solve.

    No marker shows the rotation of a finger's base, so that it varies as in the prior. Axes about which the skeleton does not
    rotate do not count.
    """
    variance = np.zeros(len(free_joints))
    for j, parent in enumerate(subject.skeleton.parents):
        if parent < 1 or free_joints[parent]:
            continue
        rotated = np.eye(3) - np.linalg.pinv(prior.locked_information[parent]) @ prior.locked_information[parent]
        covariance = rotated @ np.linalg.inv(prior.information[parent]) @ rotated
        x, y, z = subject.skeleton.offsets[j]
        lever = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        variance[j] = variance[parent] + np.trace(lever @ covariance @ lever.T) / 3
    return variance


def estimate_marker_sd(
    distance: Float[np.ndarray, "T K"],
    absorbed_share: Float[np.ndarray, "T K"],
    is_usable: Bool[np.ndarray, "T K"],
    default_sd: float,
) -> float:
    """Return the error of markers in metres per axis, from their distances to the body that was fitted to them.

    absorbed_share  part of a marker's squared error that the pose absorbed: 0 none, 1 all
    is_usable       samples that enter the estimate; without any, `default_sd` is returned
    """
    if not is_usable.any():
        return default_sd
    corrected = distance[is_usable] ** 2 / (1 - absorbed_share[is_usable])
    return max(float(np.sqrt(np.median(corrected) / CHI2_MEDIAN_3_DOF)), MIN_ESTIMATED_MARKER_SD_M)
