"""The window solver: the poses of consecutive frames, without the inference of limbs that no marker shows.

Each frame is solved on its own first. The joints' smooth trajectories through these solutions, weighted by their uncertainty,
then enter a second solve as tracking terms, which couple the frames.

Limbs that this leaves although their markers are visible are recovered. A solve goes to the nearest minimum: from a start with a
limb far away, the narrow robust scale makes outliers of all the limb's markers. So frames in which a limb is lost although its
markers keep their distances (`lost_in_sight`), and those that fit their markers worse than the frame's own solution did, are
solved again from other starts, from wide robust scales to narrow ones; the solution of least marker cost is kept.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.model.motion import PoseEvidence, PoseUncertainty
from mocapfix.model.subject import Subject
from mocapfix.options import SolveOptions
from mocapfix.solve import kinematics, smoothing
from mocapfix.solve.initial_motion import register_poses
from mocapfix.solve.kinematics import Poses, predict_markers
from mocapfix.solve.lost_in_sight import find_lost_parts
from mocapfix.solve.mean_pose import MeanPosePrior
from mocapfix.solve.parallel import order_from_gap_ends, order_independently
from mocapfix.solve.pose_problem import MotionProblem, PoseProblem, find_key_frames, list_posed_frames
from mocapfix.solve.terms import TrackingTerm, compute_robust_costs
from mocapfix.stats.rigid_alignment import compute_lengths
from mocapfix.stats.sequences import find_runs, interpolate_rows

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
