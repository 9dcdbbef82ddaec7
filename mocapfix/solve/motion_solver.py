"""The motion solver: the pose of every frame that best agrees with markers, a prior on poses, and the frames around it.

Each frame is solved on its own first. The joints' smooth trajectories through these solutions, weighted by their uncertainty,
then enter a second solve as tracking terms, which couple the frames.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.kernels.forward_kinematics import KinematicTree
from mocapfix.motion import FrameStatus, Motion
from mocapfix.options import CleanOptions, SolveOptions
from mocapfix.pose_prior.mean_pose import JointLimits, MeanPosePrior, load_joint_limits, load_mean_pose_prior
from mocapfix.skeleton import BodyModel, load_cmu31_body
from mocapfix.solve import kinematics, limb_recovery, observability, occluded_joints, smoothing
from mocapfix.solve.observability import compute_pose_sd
from mocapfix.solve.occluded_joints import PriorConditioner
from mocapfix.solve.pose_problem import (
    MarkerAttachment,
    PoseProblem,
    PoseUncertainty,
    build_joint_limit_term,
    build_no_tracking,
    build_pose_prior_term,
)
from mocapfix.state import BodyFit, CleaningState
from mocapfix.subject import Subject
from mocapfix.take import Take

MAX_MEAN_MARKER_DISTANCE_M = 0.03
"""Mean distance of a frame's markers from the body above which the frame's status is POOR_FIT."""
MIN_FRAME_MARKERS = 3
"""Visible markers below which the status of a frame is GUESSED."""
MIN_TRACKING_SD_RAD = 0.01
"""Smallest standard deviation of a joint's smooth trajectory in the uncertainty of the result."""
PRIOR_HUBER_SCALE_SD = 1.0
"""Deviation of a joint from the mean pose, in standard deviations, beyond which the prior's force no longer grows: a forearm that
follows its markers may then turn across the elbow's hinge, as skin and a wrong marker offset make it appear to."""

GAP_VARIANCE_INFLATION = 3.0
"""Variance with which the solve tracks a joint's trajectory across a gap, over the mean squared error of the result, measured on
CMU's training subjects: the solve must not trust a trajectory too much."""


class IndependentSolution(NamedTuple):
    """What remains of the independent solves of T frames besides their poses.

    iterations    (T,) iterations of each frame
    uncertainty   uncertainty of the poses
    gap_variance  (T, J) rad^2: variance of the interpolated rotations of uncertain joints
    """

    iterations: np.ndarray
    uncertainty: PoseUncertainty
    gap_variance: np.ndarray


def solve_motion(
    take: Take,
    subject: Subject,
    body: BodyModel,
    prior: MeanPosePrior,
    limits: JointLimits,
    initial_motion: Motion,
    options: SolveOptions,
    *,
    conditioner: PriorConditioner | None = None,
) -> Motion:
    """Return the poses of all frames, with the standard deviations of every joint and of every marker as the body places it.

    take             the markers in the subject's order, NaN if not visible or an outlier
    prior            the mean pose of independent joints, which makes every frame determinate
    initial_motion   the start of each frame's first solve; NaN where it starts from the frame before
    conditioner      a trained pose model; used only if a limb is occluded for so long that the take itself does not determine it
    """
    rate, robust_scale_m = take.rate, options.robust_scales_m[-1]
    problem = build_pose_problem(take, subject, body, prior, limits, options)
    is_unobserved = observability.find_unobserved_joints(problem.solver_mask, subject, body.free_joints)
    is_uncertain = (observability.find_partly_observed_joints(problem.solver_mask, subject) | is_unobserved) & body.free_joints

    root_position, local_rotations = initial_motion.root_position.copy(), initial_motion.local_rotations.copy()
    alone = solve_frames_independently(problem, root_position, local_rotations, is_uncertain, is_unobserved, rate, options)
    known = alone.uncertainty
    occluded_joints.infer_occluded_joints(
        root_position,
        local_rotations,
        known.rotation_variance,
        is_unobserved,
        body.free_joints,
        rate,
        conditioner=conditioner,
    )
    own_pose = root_position.copy(), local_rotations.copy()
    tracking = smoothing.smooth_poses(root_position, local_rotations, known, is_uncertain, body.free_joints, rate, options)
    root_position, local_rotations = own_pose[0].copy(), own_pose[1].copy()
    local_rotations[is_unobserved] = tracking.rotations[is_unobserved]
    status, iterations = problem.solve(root_position, local_rotations, tracking, (robust_scale_m,))
    pose = root_position, local_rotations
    limb_recovery.recover_lost_limbs(
        problem, subject, prior, pose, own_pose=own_pose, tracking=tracking, is_uncertain=is_uncertain, options=options
    )
    gap_variance = np.where(is_unobserved, known.rotation_variance, alone.gap_variance)
    actual_variance = np.maximum(gap_variance / GAP_VARIANCE_INFLATION, MIN_TRACKING_SD_RAD**2)
    tracking = tracking._replace(weight=is_uncertain / actual_variance)
    root_position = smoothing.remove_pose_jitter(
        root_position, local_rotations, is_uncertain, is_unobserved, problem.tree, rate, options
    )
    motion = Motion(root_position, local_rotations, status, alone.iterations + iterations, known.marker_sd, known.joint_sd)
    marker_sd, joint_sd = compute_pose_sd(problem, motion, subject, prior, known.marker_sd, tracking, robust_scale_m)
    motion = replace(motion, marker_sd=marker_sd, joint_sd=joint_sd)
    return replace(motion, status=classify_frames(motion, subject, take.markers))


def build_pose_problem(
    take: Take, subject: Subject, body: BodyModel, prior: MeanPosePrior, limits: JointLimits, options: SolveOptions
) -> PoseProblem:
    """Return the pose problem of a take: markers, prior and joint limits, with the arguments of `solve_motion`."""
    is_unobserved = observability.find_unobserved_joints(take.visible, subject, body.free_joints)
    is_border = observability.find_gap_borders(take.visible, is_unobserved[:, subject.joints], take.rate, options.gap_border_s)
    # neighbouring frames show the same pose, so the prior applies once in `pose_persistence_s`, not in every frame
    frames_per_pose = options.pose_persistence_s * take.rate
    return PoseProblem(
        KinematicTree(subject.skeleton.parents, subject.skeleton.offsets, body.free_joints),
        MarkerAttachment(subject.joints, subject.marker_offsets),
        take.markers,
        take.visible & ~is_border,
        options.marker_sd_m,
        build_pose_prior_term(prior.scale_information(1 / frames_per_pose), PRIOR_HUBER_SCALE_SD),
        build_joint_limit_term(limits, options.limit_sd_rad * np.sqrt(frames_per_pose)),
    )


def solve_frames_independently(
    problem: PoseProblem,
    root_position: np.ndarray,
    local_rotations: np.ndarray,
    is_uncertain: np.ndarray,
    is_unobserved: np.ndarray,
    rate: float,
    options: SolveOptions,
) -> IndependentSolution:
    """Solve each frame on its own, then frames with uncertain joints again from their neighbours, tracking an interpolation.

    root_position (T, 3) in metres and local_rotations (T, J, 3, 3) are overwritten with the solution; is_uncertain and
    is_unobserved are (T, J).
    """
    no_tracking, robust_scale_m = build_no_tracking(local_rotations.shape[1]), options.robust_scales_m[-1]
    _, iterations = problem.solve(root_position, local_rotations, no_tracking, options.robust_scales_m)
    uncertainty = problem.compute_uncertainty(root_position, local_rotations, no_tracking, robust_scale_m)
    variance = uncertainty.rotation_variance
    tracking, gap_variance = smoothing.track_across_gaps(local_rotations, variance, is_uncertain, rate, options)
    frames = np.flatnonzero(is_uncertain.any(1))
    if len(frames):  # only these are solved again, and have another uncertainty
        problem.solve_from_neighbours(root_position, local_rotations, tracking, is_uncertain, robust_scale_m)
        solved_again = problem.select_frames(frames).compute_uncertainty(
            root_position[frames], local_rotations[frames], no_tracking, robust_scale_m
        )
        for values, new_values in zip(uncertainty, solved_again, strict=True):
            values[frames] = new_values
    tracked_variance = gap_variance + options.rotation_tracking_sd_rad**2
    rotation_variance = np.where(
        is_unobserved, np.minimum(uncertainty.rotation_variance, tracked_variance), uncertainty.rotation_variance
    )
    return IndependentSolution(iterations, uncertainty._replace(rotation_variance=rotation_variance), gap_variance)


def classify_frames(motion: Motion, subject: Subject, markers: Float[np.ndarray, "T K 3"]) -> Int[np.ndarray, " T"]:
    """Return the FrameStatus of every frame: that of the solve, unless too few markers are visible or they lie off the body.

    markers  in metres in the subject's order, NaN if not visible or an outlier
    """
    _, predicted = kinematics.compute_joint_and_marker_positions(subject, motion)
    distance = np.linalg.norm(markers - predicted, axis=-1)
    visible_count = (~np.isnan(distance)).sum(1)
    mean_distance = np.nansum(distance, axis=1) / np.maximum(visible_count, 1)
    is_guessed: Bool[np.ndarray, " T"] = visible_count < MIN_FRAME_MARKERS
    is_poor = mean_distance > MAX_MEAN_MARKER_DISTANCE_M
    return np.where(is_guessed, int(FrameStatus.GUESSED), np.where(is_poor, int(FrameStatus.POOR_FIT), motion.status))


def solve_body(state: CleaningState, options: CleanOptions) -> CleaningState:
    """Solve the motion from the initial poses. Sets `body` of the state."""
    assert state.subject is not None
    assert state.extended_subject is not None
    assert state.initial_motion is not None
    assert state.marker_columns is not None
    take, extended_subject = state.solver_take, state.extended_subject
    body = load_cmu31_body()
    prior = load_mean_pose_prior("mean-pose", body.skeleton)
    limits = load_joint_limits(body.skeleton)
    motion = solve_motion(
        take,
        extended_subject,
        body,
        prior,
        limits,
        state.initial_motion,
        options.solve,
        conditioner=state.prior_conditioner,
    )
    joints, markers = kinematics.compute_joint_and_marker_positions(extended_subject, motion)
    return replace(state, body=BodyFit(state.subject, extended_subject, motion, state.marker_columns, joints, markers))
