"""The motion solver: the pose of every frame that best agrees with markers, a prior on poses, and the frames around it.

`solve_body` solves a take in windows, and again only where it changed. Limbs that no marker shows are interpolated at first,
which is all that detection needs. `complete_body` infers them, once, when the faults are known: as leaves of the body they cost
nothing that a marker shows, so the other joints keep their poses.

Each frame of a window is solved on its own first. The joints' smooth trajectories through these solutions, weighted by their
uncertainty, then enter a second solve as tracking terms, which couple the frames.

Limbs that this leaves although their markers are visible are recovered. A solve goes to the nearest minimum: from a start with a
limb far away, the narrow robust scale makes outliers of all the limb's markers. So frames in which a limb is lost although its
markers keep their distances (`lost_in_sight`), and those that fit their markers worse than the frame's own solution did, are
solved again from other starts, from wide robust scales to narrow ones; the solution of least marker cost is kept.

`compute_pose_sd` gives the standard deviations of joints and markers, from the posterior covariance of the poses. The solver
weights its terms for robustness; the error of its result is computed from the same curvature with the actual uncertainty of each
term, and that of the calibration and of joints that are not solved.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.kernels import lie
from mocapfix.model.body_fit import BodyFit, RememberedGap, SubjectInTake
from mocapfix.model.motion import FrameStatus, Motion, PoseEvidence, PoseUncertainty
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.model.subject import Subject
from mocapfix.options import PRIOR_EVERY_FRAME, CleanOptions, SolveOptions
from mocapfix.solve import kinematics, occluded_joints, smoothing
from mocapfix.solve.initial_motion import PoseStart, register_poses
from mocapfix.solve.kinematics import Poses, predict_markers
from mocapfix.solve.lost_in_sight import find_lost_parts
from mocapfix.solve.mean_pose import MeanPosePrior, load_joint_limits, load_mean_pose_prior
from mocapfix.solve.measured_segments import yield_to_markers
from mocapfix.solve.motion_prior import combine_rotations
from mocapfix.solve.occluded_joints import KnownMotion
from mocapfix.solve.parallel import order_from_gap_ends, order_independently
from mocapfix.solve.person_memory import PersonMemory
from mocapfix.solve.pose_problem import (
    POSE_RATE_HZ,
    FrameChanges,
    MotionProblem,
    PoseProblem,
    build_motion_problem,
    find_key_frames,
    list_posed_frames,
    list_window_frames,
    select_windows,
)
from mocapfix.solve.prior_conditioner import PriorConditioner, apply_pose_prior
from mocapfix.solve.terms import TrackingTerm, build_pose_prior_term, compute_robust_costs
from mocapfix.stats.gaussian_process import CHI2_MEDIAN_3_DOF
from mocapfix.stats.rigid_alignment import build_cross_matrices, compute_lengths
from mocapfix.stats.sequences import find_runs, group_gaps, interpolate_rows

MIN_ESTIMATED_MARKER_SD_M = 0.001  # smallest estimate of the marker error per axis
MAX_ABSORBED_SHARE = 0.9  # share of its squared error that the pose absorbs above which a marker does not enter the estimate
MIN_TRACKING_SD_RAD = 0.01  # smallest standard deviation of a joint's smooth trajectory in the uncertainty of the result
LOCKED_INFORMATION_RATIO = 4.0
"""Information about locked axes in the uncertainty of joints, over that in the solve, which yields to markers. With 1, hands of
CMU's training subjects, whose skeletons lock such axes, were predicted to vary twice as much as they do."""
GAP_VARIANCE_INFLATION = 3.0
"""Variance with which the solve tracks a joint's trajectory across a gap, over the mean squared error of the result, measured on
CMU's training subjects: the solve must not trust a trajectory too much."""


def update_motion_sd(problem: MotionProblem, motion: Motion, evidence: PoseEvidence, frames: Int[np.ndarray, " N"]) -> Motion:
    """Return the motion with the deviations of some frames computed; others are kept, unless markers were added."""
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
    known = frames[find_key_frames(frames, problem.pose_problem.solver_mask[frames], problem.rate)]
    pose = motion.root_position[known], motion.local_rotations[known]
    tracking = TrackingTerm(pose[1], problem.is_uncertain[known] / actual_variance[known], pose[0], evidence.root_weight[known])
    part = problem.pose_problem.select_frames(known)
    of_body, scale_m = (problem.subject, problem.prior, actual_marker_sd), problem.options.robust_scales_m[-1]
    found = compute_pose_sd(part, pose, *of_body, tracking, scale_m)
    marker_sd[frames], joint_sd[frames] = (interpolate_rows(each, known, frames) for each in found)
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

    Args:
        actual_marker_sd: Standard deviation of a measured marker about its place, see `estimate_actual_marker_sd`, in metres.
        tracking: The trajectories of the root and of joints that lack a marker, weighted by their actual uncertainty.
        robust_scale_m: The last robust scale of the solve.
    """
    firm = replace(prior, information=prior.information + (LOCKED_INFORMATION_RATIO - 1) * prior.locked_information)
    of_markers, of_joints = (
        replace(problem, marker_sd=actual_marker_sd, pose_prior=build_pose_prior_term(each)).compute_uncertainty(
            pose, robust_scale_m, tracking
        )
        for each in (prior, firm)
    )
    constant_variance = subject.joint_sd**2 + compute_unsolved_joint_variance(subject, prior, load_cmu31_body().free_joints)
    joint_sd = np.where(subject.solved_joints, np.sqrt(of_joints.joint_sd**2 + constant_variance), np.nan)
    return np.hypot(of_markers.marker_sd, subject.marker_sd), joint_sd


def estimate_actual_marker_sd(
    problem: PoseProblem, pose: Poses, subject: Subject, nominal_marker_sd: Float[np.ndarray, "T K"]
) -> float:
    """Return the standard deviation per axis, in metres, of a measured marker about its place on the solved body.

    Args:
        nominal_marker_sd: Standard deviation of the markers predicted with the weights of the solve, in metres.
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
        lever = build_cross_matrices(subject.skeleton.offsets[j])
        variance[j] = variance[parent] + np.trace(lever @ covariance @ lever.T) / 3
    return variance


def estimate_marker_sd(
    distance: Float[np.ndarray, "T K"],
    absorbed_share: Float[np.ndarray, "T K"],
    is_usable: Bool[np.ndarray, "T K"],
    default_sd: float,
) -> float:
    """Return the error of markers in metres per axis, from their distances to the body that was fitted to them.

    Args:
        absorbed_share: Part of a marker's squared error that the pose absorbed: 0 none, 1 all.
        is_usable: Samples that enter the estimate; without any, `default_sd` is returned.
    """
    if not is_usable.any():
        return default_sd
    corrected = distance[is_usable] ** 2 / (1 - absorbed_share[is_usable])
    return max(float(np.sqrt(np.median(corrected) / CHI2_MEDIAN_3_DOF)), MIN_ESTIMATED_MARKER_SD_M)


FIXED_JOINT_WEIGHT = 1e5  # in 1/rad^2 or 1/m^2, keeps solved joints and the root where they are against prior and limits


def _solve_inferred_joints(
    problem: MotionProblem, pose: Poses, variance: Float[np.ndarray, "T J"], frames: Int[np.ndarray, " N"]
) -> Float[np.ndarray, "N J 3 3"]:
    """Return local rotations in which unobserved joints track smooth paths through `pose`, whose `variance` is in rad^2."""
    root_position, start = pose[0][frames], pose[1][frames]
    weight = np.full(start.shape[:2], FIXED_JOINT_WEIGHT)
    for j in np.flatnonzero(problem.is_unobserved.any(0)).tolist():
        is_gap = problem.is_unobserved[:, j]
        trajectory = smoothing.smooth_joint_rotations(pose[1], j, variance[:, j], problem.is_uncertain[:, j], problem.rate)
        rotations = np.empty((int(is_gap.sum()), 1, 3, 3))
        lie.store_joint_quaternions(trajectory[is_gap], 0, rotations)
        start[is_gap[frames], j] = rotations[:, 0]
        weight[is_gap[frames], j] = smoothing.compute_tracking_weight(variance[is_gap, j])
    tracking = TrackingTerm(start, weight, root_position, np.full(len(frames), FIXED_JOINT_WEIGHT))
    part = problem.pose_problem.select_frames(frames)
    unmarked = replace(part, solver_mask=np.zeros_like(part.solver_mask))
    return unmarked.minimise((root_position, start), problem.options.robust_scales_m[-1:], tracking).local_rotations


MAX_MEAN_MARKER_DISTANCE_M = 0.03  # mean distance of a frame's markers from the body above which the frame's status is POOR_FIT
PLACED_JOINT_SD_M = 0.015  # per axis, of joints and markers of poses that were not solved: measured on composed takes
UNSEEN_JOINT_SD_M = 0.05  # the same on segments that no visible marker shows
MIN_FRAME_MARKERS = 3  # visible markers below which the status of a frame is GUESSED


def complete_motion(
    problem: MotionProblem,
    motion: Motion,
    evidence: PoseEvidence,
    conditioner: PriorConditioner | None,
    memory: PersonMemory | None = None,
) -> tuple[Motion, PoseEvidence, list[RememberedGap]]:
    """Return the motion with the unobserved joints inferred from the rest of the take and the memory of the person, the evidence
    with their variance, and the gaps that are inferred from the memory.
    """
    frames = np.flatnonzero(problem.is_unobserved.any(1))
    if not len(frames):
        return motion, evidence, []
    local_rotations, variance = motion.local_rotations.copy(), evidence.rotation_variance.copy()
    joints = np.flatnonzero(problem.pose_problem.tree.free)[1:]
    known = KnownMotion(motion.root_position, local_rotations, variance, problem.is_unobserved, joints, problem.rate, memory)
    remembered = occluded_joints.infer_occluded_joints(known, conditioner)
    solved = _solve_inferred_joints(problem, (motion.root_position, local_rotations), variance, frames)
    local_rotations[:] = motion.local_rotations
    rows, joints = np.nonzero(problem.is_unobserved[frames])
    local_rotations[frames[rows], joints] = solved[rows, joints]
    inferred, evidence = replace(motion, local_rotations=local_rotations), replace(evidence, rotation_variance=variance)
    inferred = yield_to_markers(problem.subject, problem.pose_problem.marker_positions, motion, inferred, problem.rate)
    return update_motion_sd(problem, inferred, evidence, frames), evidence, remembered


def solve_changed_frames(
    problem: MotionProblem, start: Motion, changes: FrameChanges, evidence: PoseEvidence | None = None
) -> tuple[Motion, PoseEvidence]:
    """Solve the frames that changes affect, from the poses in `start`; the others keep these.

    Unobserved joints follow interpolations, until `complete_motion` finds better poses for them.

    Args:
        start: The solution before, except for the poses of restarted frames; its poses are overwritten with the new solution.
        evidence: Of the solution before; without it all frames are solved.
    """
    frame_count, joint_count = start.local_rotations.shape[:2]
    marker_count = len(problem.subject.joints)
    root_position, local_rotations = start.root_position, start.local_rotations
    status, iterations = start.status.copy(), start.iterations.copy()
    if evidence is None:
        of_markers, of_joints = (frame_count, marker_count), (frame_count, joint_count)
        evidence = PoseEvidence(np.zeros(of_markers), np.zeros(of_joints), np.zeros(of_joints), np.zeros(frame_count))
    else:
        evidence = evidence.copy(marker_count)
    windows = select_windows(changes.is_affected, problem.rate)
    for window in windows:
        outer, inner, frames = window.outer_frames, window.inner_frames, window.frames
        pose = root_position[outer], local_rotations[outer]
        solution = solve_window(problem.select_frames(outer), pose, changes.is_restarted[outer])
        root_position[frames], local_rotations[frames] = solution.poses[0][inner], solution.poses[1][inner]
        status[frames], iterations[frames] = solution.status[inner], solution.iterations[inner]
        for values, new_values in zip(vars(evidence).values(), vars(solution.evidence).values(), strict=True):
            values[frames] = new_values[inner]
    solved = list_window_frames(windows)
    motion = Motion(root_position, local_rotations, status, iterations, start.marker_sd, start.joint_sd)
    motion = update_motion_sd(problem, motion, evidence, solved)
    status[solved] = classify_frames(motion, problem.subject, problem.pose_problem.marker_positions)[solved]
    return motion, evidence


def classify_frames(motion: Motion, subject: Subject, markers: Float[np.ndarray, "T K 3"]) -> Int[np.ndarray, " T"]:
    """Return the FrameStatus of every frame: that of the solve, unless too few markers are visible or they lie off the body.

    Args:
        markers: In metres in the subject's order, NaN if not visible or an outlier.
    """
    distance = kinematics.compute_marker_distances(subject, (motion.root_position, motion.local_rotations), markers)
    visible_count = (~np.isnan(distance)).sum(1)
    mean_distance = np.nansum(distance, axis=1) / np.maximum(visible_count, 1)
    is_guessed, is_poor = visible_count < MIN_FRAME_MARKERS, mean_distance > MAX_MEAN_MARKER_DISTANCE_M
    return np.where(is_guessed, int(FrameStatus.GUESSED), np.where(is_poor, int(FrameStatus.POOR_FIT), motion.status))


MIN_RECOVERED_DISTANCE_M = 0.04  # mean, of a limb's markers, above which its frame is solved again
MAX_COST_INCREASE = 10.0
"""Increase of a frame's marker cost over that of its own solution above which it is solved again. The tracking of smooth
trajectories increases it by up to 3."""
MIN_COST_IMPROVEMENT = 1.0  # decrease of the marker cost that another solution needs to replace the present one
RECOVERY_ROBUST_SCALES_M = (0.4, 0.2)  # robust scales before those of the options
COMPARED_ROBUST_SCALE_M = 0.2  # of marker costs: wide, so that a limb's markers count when they are far away


def recover_lost_limbs(
    problem: PoseProblem,
    subject: Subject,
    prior: MeanPosePrior,
    pose: Poses,
    *,
    own_pose: Poses,
    tracking: TrackingTerm,
    is_uncertain: Bool[np.ndarray, "T J"],
    options: SolveOptions,
) -> None:
    """Overwrite the poses of frames in which a limb was lost, where another start gives a better one.

    Args:
        pose: The solution with tracking; overwritten.
        own_pose: The solution of each frame on its own.
        is_uncertain: Joints that lack a marker; only these keep following their smooth trajectories.
    """
    predicted = predict_markers(subject, pose)
    cost = compute_marker_cost(problem, predicted)
    is_worse = cost > compute_marker_cost(problem, predict_markers(subject, own_pose)) + MAX_COST_INCREASE
    measured, limit_m = (problem.marker_positions, problem.solver_mask), MIN_RECOVERED_DISTANCE_M
    lost_parts = find_lost_parts(*measured, subject, predicted, min_distance_m=limit_m, min_off_share=0.0)
    is_lost = np.logical_or.reduce([is_worse, *(part.frames for part in lost_parts)])
    frames = np.flatnonzero(is_lost)
    if not len(frames):
        return
    part = problem.select_frames(frames)
    rows = np.minimum(frames, len(tracking.root) - 1)  # the tracked pose is one for each frame, or one for all
    weight = np.where(is_uncertain[frames], tracking.weight[rows], 0.0)
    part_tracking = TrackingTerm(tracking.rotations[rows], weight, tracking.root[rows], np.zeros(len(frames)))
    registered = register_poses(subject, problem.tree.free, prior, part.marker_positions)
    starts = [
        (own_pose[0][frames], own_pose[1][frames]),
        (registered.root_position, registered.local_rotations),
        *((pose[0][neighbours], pose[1][neighbours]) for neighbours in find_neighbours(is_lost, frames)),
    ]
    least_cost = cost[frames] - MIN_COST_IMPROVEMENT
    for start in starts:
        found = part.minimise(start, RECOVERY_ROBUST_SCALES_M + options.robust_scales_m, part_tracking)
        new_cost = compute_marker_cost(part, predict_markers(subject, found.poses))
        is_better = new_cost < least_cost
        for values, new_values in zip(pose, found.poses, strict=True):
            values[frames[is_better]] = new_values[is_better]
        least_cost = np.minimum(least_cost, new_cost)


def find_neighbours(is_lost: Bool[np.ndarray, " T"], frames: Int[np.ndarray, " N"]) -> list[Int[np.ndarray, " N"]]:
    """Return for each of some frames the last frame before it and the first after it in which no limb is lost.

    At an end of the take both are on the same side. If a limb is lost in all frames, there are none.
    """
    sound = np.flatnonzero(~is_lost)
    if not len(sound):
        return []
    position = np.searchsorted(sound, frames)
    return [sound[np.maximum(position - 1, 0)], sound[np.minimum(position, len(sound) - 1)]]


def compute_marker_cost(problem: PoseProblem, predicted: Float[np.ndarray, "T K 3"]) -> Float[np.ndarray, " T"]:
    """Return the cost of each frame's visible markers, half the sum of squares in standard deviations, at a wide robust scale."""
    square = (compute_lengths(problem.marker_positions - predicted) / problem.marker_sd) ** 2
    scale2 = (COMPARED_ROBUST_SCALE_M / problem.marker_sd) ** 2
    return np.where(problem.solver_mask, compute_robust_costs(square, scale2), 0.0).sum(1)


class WindowSolution(NamedTuple):
    """The solution of T consecutive frames: poses, status and iterations (T,), and the evidence."""

    poses: Poses
    status: np.ndarray
    iterations: np.ndarray
    evidence: PoseEvidence


def solve_window(window: MotionProblem, start: Poses, is_restarted: Bool[np.ndarray, " T"]) -> WindowSolution:
    """Return the solution of all frames of a window; `is_restarted` are those whose start may be far from it."""
    poses, iterations = solve_from_starts(window, start, is_restarted)
    problem, options, rate = window.pose_problem, window.options, window.rate
    own_pose, known, gap_variance = solve_uncertain_frames(window, poses)
    root_position, local_rotations = own_pose
    tracking = smoothing.smooth_poses(root_position, local_rotations.copy(), known, window.is_uncertain, problem.tree.free, rate)
    tracked = np.where(window.is_unobserved[..., None, None], tracking.rotations, local_rotations)
    solution = problem.minimise((root_position, tracked), options.robust_scales_m[-1:], tracking)
    body, is_uncertain = (window.subject, window.prior), window.is_uncertain
    recover_lost_limbs(
        problem, *body, solution.poses, own_pose=own_pose, tracking=tracking, is_uncertain=is_uncertain, options=options
    )
    root_position, local_rotations = solution.poses
    anchor_position = root_position + kinematics.compute_anchor_offset(problem.tree, local_rotations)
    anchor_position = smoothing.remove_pose_jitter(
        anchor_position, local_rotations, window.is_uncertain, window.is_unobserved, problem.tree, rate
    )
    root_position[:] = anchor_position - kinematics.compute_anchor_offset(problem.tree, local_rotations)
    evidence = PoseEvidence(known.marker_sd, known.rotation_variance, gap_variance, tracking.root_weight)
    return WindowSolution(solution.poses, solution.status, iterations + solution.iterations, evidence)


def solve_uncertain_frames(window: MotionProblem, poses: Poses) -> tuple[Poses, PoseUncertainty, np.ndarray]:
    """Solve frames with uncertain joints again from their neighbours, tracking an interpolation of each frame's own solution.

    Return poses, their uncertainty, and the variance (T, J) in rad^2 of the interpolated rotations of uncertain joints.
    """
    problem, is_uncertain, robust_scale_m = window.pose_problem, window.is_uncertain, window.options.robust_scales_m[-1]
    tracking, gap_variance = smoothing.track_across_gaps(poses[1], is_uncertain, window.rate)
    gaps = find_runs(np.any(is_uncertain, axis=1))
    if gaps:
        poses = problem.minimise(poses, (robust_scale_m,), tracking, order=order_from_gap_ends(gaps, is_uncertain)).poses
    frames = np.arange(len(poses[0]))
    known = np.flatnonzero(find_key_frames(frames, problem.solver_mask, window.rate))
    found = problem.select_frames(known).compute_uncertainty((poses[0][known], poses[1][known]), robust_scale_m)
    uncertainty = PoseUncertainty(*(interpolate_rows(each, known, frames) for each in found))
    tracked_variance = gap_variance + smoothing.ROTATION_TRACKING_SD_RAD**2
    rotation_variance = np.where(
        window.is_unobserved, np.minimum(uncertainty.rotation_variance, tracked_variance), uncertainty.rotation_variance
    )
    return poses, uncertainty._replace(rotation_variance=rotation_variance), gap_variance


def solve_from_starts(
    window: MotionProblem, start: Poses, is_restarted: Bool[np.ndarray, " T"]
) -> tuple[Poses, Int[np.ndarray, " T"]]:
    """Solve each frame on its own. Restarted frames whose markers are far from the body pass through all robust scales.

    Of a take whose frames are all restarted, those at POSE_RATE_HZ are solved first. The others start from the interpolation of
    these, or from their own start if that is nearer to their markers. Return poses and iterations.
    """
    problem, subject, scales_m = window.pose_problem, window.subject, window.options.robust_scales_m
    posed = list_posed_frames(len(start[0]), window.rate)
    if len(posed) == len(start[0]) or not is_restarted.all():
        return solve_independently(problem, subject, scales_m, is_restarted, start)
    between, iterations = np.delete(np.arange(len(start[0])), posed), np.empty(len(start[0]), int)
    parts = [(problem.select_frames(each), subject, scales_m, is_restarted[each]) for each in (posed, between)]
    known, iterations[posed] = solve_independently(*parts[0], (start[0][posed], start[1][posed]))
    poses = kinematics.interpolate_poses(known, posed, len(start[0]))
    start_cost, cost = (compute_marker_cost(problem, predict_markers(subject, each)) for each in (start, poses))
    nearer = between[(start_cost < cost)[between]]
    poses[0][nearer], poses[1][nearer] = start[0][nearer], start[1][nearer]
    found, iterations[between] = solve_independently(*parts[1], (poses[0][between], poses[1][between]))
    poses[0][between], poses[1][between] = found
    return poses, iterations


def solve_independently(
    problem: PoseProblem, subject: Subject, scales_m: tuple[float, ...], is_restarted: Bool[np.ndarray, " T"], start: Poses
) -> tuple[Poses, Int[np.ndarray, " T"]]:
    """Solve each frame from its start; return poses and iterations (see `solve_from_starts`)."""
    distance = compute_lengths(problem.marker_positions - predict_markers(subject, start))
    is_far = is_restarted & (distance > scales_m[-1]).any(1, where=problem.solver_mask)
    poses, iterations = start, np.zeros(len(is_far), int)
    for is_chosen, chosen_scales_m in ((is_far, scales_m), (~is_far, scales_m[-1:])):
        if is_chosen.any():
            order = order_independently(np.flatnonzero(is_chosen), start[1].shape[1])
            solution = problem.minimise(poses, chosen_scales_m, order=order)
            poses, iterations = solution.poses, iterations + solution.iterations
    return poses, iterations


PREVIEW_NOTE = (
    "Preview: first estimates of poses and gaps. On composed takes short gaps are 10 mm off (after a full clean 1.5 mm), joints "
    "14 mm (11 mm); faults that only the body shows are missed. For the final result, clean without --fast."
)


def solve_body(subject: SubjectInTake, start: PoseStart, solved: BodyFit | None, options: CleanOptions) -> BodyFit:
    """Solve the motion in the frames that changed, from the initial poses.

    Unobserved joints follow interpolations, until `complete_body` finds better poses for them.

    Args:
        subject: The subject and the samples that the solver uses.
        start: The initial poses.
        solved: The body as it was solved before, if it was.
        options: Those of the solve.
    """
    problem = _build_body_problem(subject, options)
    motion, evidence = solve_changed_frames(problem, start.motion, start.changes, solved.evidence if solved else None)
    return _build_body_fit(subject, motion, evidence)


def place_body(subject: SubjectInTake, initial: Motion) -> BodyFit:
    """Return the body with the initial poses as its motion, without a solve. Their uncertainty is a usual one."""
    extended, visible = subject.extended_subject, subject.take.visible
    joints = np.arange(len(extended.skeleton.names))
    shown = np.stack([visible[:, extended.joints == joint].sum(1) for joint in joints], axis=1)
    of_parent = shown[:, np.maximum(extended.skeleton.parents, 0)]  # two markers on a foot show its toes, which need none
    is_seen = np.where(np.isin(joints, extended.joints), shown > 0, of_parent > 1)
    joint_sd = np.where(is_seen, PLACED_JOINT_SD_M, UNSEEN_JOINT_SD_M)
    motion = replace(initial, marker_sd=np.ascontiguousarray(joint_sd[:, extended.joints]), joint_sd=joint_sd)
    motion = replace(motion, status=classify_frames(motion, extended, subject.take.markers))
    return _build_body_fit(subject, motion, None)


def complete_body(
    body: BodyFit, conditioner: PriorConditioner | None, options: CleanOptions, memory: PersonMemory | None = None
) -> BodyFit:
    """Infer the joints that no marker shows: from the solved motion, the memory of the person, and the motion prior."""
    if body.evidence is None:
        return body
    problem = _build_body_problem(body, options)
    motion, evidence, remembered = complete_motion(problem, body.motion, body.evidence, conditioner, memory)
    if motion is body.motion:
        return body
    if conditioner:
        motion = add_motion_prior(problem, motion, evidence)
    status = classify_frames(motion, body.extended_subject, problem.pose_problem.marker_positions)
    completed = _build_body_fit(body, replace(motion, status=status), evidence)
    return replace(completed, remembered=tuple(remembered), has_motion_prior=conditioner is not None)


def add_motion_prior(problem: MotionProblem, motion: Motion, evidence: PoseEvidence) -> Motion:
    """Return the motion with the lost limbs, whose variances are in the evidence, combined with the motion prior's predictions.

    It yields to visible markers. The standard deviations are those without it.
    """
    parts, rate, size_ratio = (motion.root_position, motion.local_rotations), problem.rate, problem.subject.skeleton.size_ratio
    joints = np.flatnonzero(problem.pose_problem.tree.free)[1:]
    known = KnownMotion(*parts, evidence.rotation_variance, problem.is_unobserved, joints, rate)
    local_rotations = motion.local_rotations.copy()
    for (first, last), lost in group_gaps(problem.is_unobserved & known.has_body[:, None]).items():
        frames = np.arange(first, last + 1)
        if prediction := occluded_joints.predict_hidden_joints(known, frames, lost, size_ratio):
            samples = np.ix_(frames, lost)
            estimate = motion.local_rotations[samples], evidence.rotation_variance[samples]
            local_rotations[samples] = combine_rotations(*estimate, prediction)[0]
    if (local_rotations == motion.local_rotations).all():
        return motion
    inferred = replace(motion, local_rotations=local_rotations)
    return yield_to_markers(problem.subject, problem.pose_problem.marker_positions, motion, inferred, rate)


def apply_prior(body: BodyFit, held_joints: Sequence[str], conditioner: PriorConditioner, options: CleanOptions) -> BodyFit:
    """Return the body under the pose prior in every frame, which yields to visible markers. Standard deviations are those before.

    What it changes is computed at POSE_RATE_HZ, and interpolated in between. It is weighed against the actual errors of markers:
    the solve assumes larger ones, to be robust.

    Args:
        body: The solved body; without evidence it is returned as it is, and so it is without this prior in its options.
        held_joints: Names of joints that keep their positions, if markers show them.
    """
    if body.evidence is None or options.prior.prior_scope != PRIOR_EVERY_FRAME:
        return body
    problem, held = _build_body_problem(body, options), [body.subject.skeleton.find_joint(name) for name in held_joints]
    subject, motion, poses = problem.subject, body.motion, (body.motion.root_position, body.motion.local_rotations)
    frames, rate = list_posed_frames(motion.frame_count, problem.rate), min(problem.rate, POSE_RATE_HZ)
    marker_sd = estimate_actual_marker_sd(problem.pose_problem, poses, subject, body.evidence.marker_sd)
    pose_problem = replace(problem.pose_problem, marker_sd=marker_sd)
    known = motion.select_frames(frames)
    before, held = (known.root_position, known.local_rotations), np.array([j for j in held if body.subject.solved_joints[j]], int)
    found = apply_pose_prior(pose_problem, problem.prior, conditioner, before, held, rate)
    inferred = replace(known, root_position=found[0], local_rotations=found[1])
    inferred = yield_to_markers(subject, pose_problem.marker_positions[frames], known, inferred, rate)
    changes = inferred.root_position - before[0], before[1].swapaxes(-1, -2) @ inferred.local_rotations
    step, turn = kinematics.interpolate_poses(changes, frames, motion.frame_count)
    motion = replace(motion, root_position=poses[0] + step, local_rotations=poses[1] @ turn)
    result = _build_body_fit(body, motion, body.evidence)
    return replace(result, remembered=body.remembered, has_motion_prior=body.has_motion_prior)


def _build_body_fit(subject: SubjectInTake, motion: Motion, evidence: PoseEvidence | None) -> BodyFit:
    joints, markers = kinematics.compute_joint_and_marker_positions(subject.extended_subject, motion)
    in_take = subject.subject, subject.extended_subject, subject.marker_columns, subject.take
    return BodyFit(*in_take, motion, joints, markers, evidence)


def _build_body_problem(subject: SubjectInTake, options: CleanOptions) -> MotionProblem:
    """Return the motion problem of the samples that the solver uses."""
    body = subject.extended_subject.body_model
    prior, limits = load_mean_pose_prior("mean-pose", body.skeleton), load_joint_limits(body.skeleton)
    return build_motion_problem(subject.take, subject.extended_subject, body, prior, limits, options.solve)
