"""The window solver: the poses of consecutive frames, without the inference of limbs that no marker shows.

Each frame is solved on its own first. The joints' smooth trajectories through these solutions, weighted by their uncertainty,
then enter a second solve as tracking terms, which couple the frames. Limbs that this leaves although their markers are visible
are solved again.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from mocapfix.motion import PoseEvidence, PoseUncertainty
from mocapfix.solve import frame_prior, kinematics, limb_recovery, smoothing
from mocapfix.solve.kinematics import Poses
from mocapfix.solve.pose_problem import MotionProblem, build_no_tracking
from mocapfix.solve.prior_conditioner import PriorConditioner
from mocapfix.stats.sequences import sample_evenly


class WindowSolution(NamedTuple):
    """The solution of T consecutive frames besides their poses: status and iterations (T,), and the evidence."""

    status: np.ndarray
    iterations: np.ndarray
    evidence: PoseEvidence


class IndependentSolution(NamedTuple):
    """What remains of the independent solves of T frames besides their poses.

    uncertainty   uncertainty of the poses
    gap_variance  (T, J) rad^2: variance of the interpolated rotations of uncertain joints
    """

    uncertainty: PoseUncertainty
    gap_variance: np.ndarray


def solve_window(window: MotionProblem, pose: Poses, is_restarted: Bool[np.ndarray, " T"]) -> WindowSolution:
    """Solve all frames of a window, from the poses given, which are overwritten.

    is_restarted  frames whose start may be far from the solution
    """
    root_position, local_rotations = pose
    iterations = solve_from_starts(window, pose, is_restarted)
    if window.conditioner is not None:
        window = set_frame_prior(window, window.conditioner, pose)
        every_frame = np.zeros(len(root_position), bool)
        iterations += solve_from_starts(window, pose, every_frame)
    problem, options, rate = window.pose_problem, window.options, window.rate
    alone = solve_uncertain_frames(window, pose)
    known, own_pose = alone.uncertainty, (root_position.copy(), local_rotations.copy())
    tracking = smoothing.smooth_poses(
        root_position, local_rotations.copy(), known, window.is_uncertain, problem.tree.free, rate, options
    )
    local_rotations[window.is_unobserved] = tracking.rotations[window.is_unobserved]
    status, second_iterations = problem.solve(root_position, local_rotations, tracking, options.robust_scales_m[-1:])
    limb_recovery.recover_lost_limbs(
        problem,
        window.subject,
        window.prior,
        pose,
        own_pose=own_pose,
        tracking=tracking,
        is_uncertain=window.is_uncertain,
        options=options,
    )
    anchor_position = root_position + kinematics.compute_anchor_offset(problem.tree, local_rotations)
    anchor_position = smoothing.remove_pose_jitter(
        anchor_position, local_rotations, window.is_uncertain, window.is_unobserved, problem.tree, rate, options
    )
    root_position[:] = anchor_position - kinematics.compute_anchor_offset(problem.tree, local_rotations)
    evidence = PoseEvidence(known.marker_sd, known.rotation_variance, alone.gap_variance, tracking.root_weight)
    return WindowSolution(status, iterations + second_iterations, evidence)


def set_frame_prior(window: MotionProblem, conditioner: PriorConditioner, pose: Poses) -> MotionProblem:
    """Return the window with the trained prior in every frame, from the poses of each frame's own solution."""
    frame_count, rate, options = len(pose[0]), window.rate, window.options
    sample_count = 1 + math.ceil((frame_count - 1) / (frame_prior.MAX_SAMPLE_INTERVAL_S * rate))
    term = frame_prior.build_frame_prior_term(
        conditioner.load_pose_model(),
        conditioner.prior_scale**-2,
        window.pose_problem,
        window.prior,
        pose,
        window.is_unobserved,
        frames=sample_evenly(frame_count, sample_count),
        robust_scale_m=options.robust_scales_m[-1],
    )
    return window.set_pose_prior(term)


def solve_uncertain_frames(window: MotionProblem, pose: Poses) -> IndependentSolution:
    """Solve frames with uncertain joints again from their neighbours, tracking an interpolation of each frame's own solution.

    The poses are overwritten with the solution.
    """
    problem, options, is_uncertain = window.pose_problem, window.options, window.is_uncertain
    no_tracking, robust_scale_m = build_no_tracking(pose[1].shape[1]), options.robust_scales_m[-1]
    uncertainty = problem.compute_uncertainty(*pose, no_tracking, robust_scale_m)
    tracking, gap_variance = smoothing.track_across_gaps(
        pose[1], uncertainty.rotation_variance, is_uncertain, window.rate, options
    )
    frames = np.flatnonzero(is_uncertain.any(1))
    if len(frames):  # only these are solved again, and have another uncertainty
        problem.solve_from_neighbours(*pose, tracking, is_uncertain, robust_scale_m)
        solved_again = problem.select_frames(frames).compute_uncertainty(
            pose[0][frames], pose[1][frames], no_tracking, robust_scale_m
        )
        for values, new_values in zip(uncertainty, solved_again, strict=True):
            values[frames] = new_values
    tracked_variance = gap_variance + options.rotation_tracking_sd_rad**2
    rotation_variance = np.where(
        window.is_unobserved, np.minimum(uncertainty.rotation_variance, tracked_variance), uncertainty.rotation_variance
    )
    return IndependentSolution(uncertainty._replace(rotation_variance=rotation_variance), gap_variance)


def solve_from_starts(window: MotionProblem, pose: Poses, is_restarted: Bool[np.ndarray, " T"]) -> Int[np.ndarray, " T"]:
    """Solve each frame on its own. Restarted frames pass through all robust scales; the others are near their solution.

    A frame without a pose starts from the solution of the frame before; then all frames must be restarted.
    """
    problem, scales_m, no_tracking = window.pose_problem, window.options.robust_scales_m, build_no_tracking(pose[1].shape[1])
    if is_restarted.all():
        return problem.solve(*pose, no_tracking, scales_m)[1]
    restarted, others = np.flatnonzero(is_restarted), np.flatnonzero(~is_restarted)
    iterations = problem.solve_each(restarted, *pose, no_tracking, scales_m)[1]
    return iterations + problem.solve_each(others, *pose, no_tracking, scales_m[-1:])[1]
