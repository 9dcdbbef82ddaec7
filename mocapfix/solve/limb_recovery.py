"""Recovery of lost limbs: frames whose visible markers the solve left are solved again from other starts.

A solve goes to the nearest minimum. From a start with a limb far away, the narrow robust scale makes outliers of all the limb's
markers, and the limb stays where it is. So after the last solve two kinds of frames are solved again, from wide robust scales to
narrow ones: those in which a limb is lost although its markers are visible and keep their distances (`lost_in_sight`), and those
that fit their markers worse than the frame's own solution did. The starts are the frame's own solution, the registration of the
segments to their own markers, and the poses of the nearest frames without a lost limb. The solution of least marker cost is kept.
"""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.initialise.segment_registration import register_poses
from mocapfix.kernels.terms import TrackingTerm
from mocapfix.options import SolveOptions
from mocapfix.pose_prior.mean_pose import MeanPosePrior
from mocapfix.solve.kinematics import Poses, predict_markers
from mocapfix.solve.lost_in_sight import find_lost_parts
from mocapfix.subject import Subject

if TYPE_CHECKING:  # to keep the import layers few
    from mocapfix.solve.pose_problem import PoseProblem

MIN_RECOVERED_DISTANCE_M = 0.04
"""Mean distance of a limb's markers from the body above which its frame is solved again; less than what is reported as lost."""
MAX_COST_INCREASE = 10.0
"""Increase of a frame's marker cost over that of its own solution above which it is solved again. The tracking of smooth
trajectories increases it by up to 3."""
MIN_COST_IMPROVEMENT = 1.0
"""Decrease of the marker cost that another solution needs to replace the present one."""
RECOVERY_ROBUST_SCALES_M = (0.4, 0.2)
"""Robust scales before those of the options."""
COMPARED_ROBUST_SCALE_M = 0.2
"""Robust scale of the compared marker costs: wide, so that a limb's markers count when they are far away."""


def recover_lost_limbs(
    problem: "PoseProblem",
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

    pose          the solution with tracking; overwritten
    own_pose      the solution of each frame on its own
    is_uncertain  joints that lack a marker; only these keep following their smooth trajectories
    """
    predicted = predict_markers(subject, pose)
    cost = compute_marker_cost(problem, predicted)
    is_worse = cost > compute_marker_cost(problem, predict_markers(subject, own_pose)) + MAX_COST_INCREASE
    lost_parts = find_lost_parts(
        problem.marker_positions,
        problem.solver_mask,
        subject,
        predicted,
        min_distance_m=MIN_RECOVERED_DISTANCE_M,
        min_off_share=0.0,
    )
    is_lost = np.logical_or.reduce([is_worse, *(part.frames for part in lost_parts)])
    frames = np.flatnonzero(is_lost)
    if not len(frames):
        return
    part = problem.select_frames(frames)
    rows = np.minimum(frames, len(tracking.root) - 1)  # the tracked pose is one for each frame, or one for all
    part_tracking = TrackingTerm(
        tracking.rotations[rows],
        np.where(is_uncertain[frames], tracking.weight[rows], 0.0),
        tracking.root[rows],
        np.zeros(len(frames)),
    )
    registered = register_poses(subject, problem.tree.free, prior, part.marker_positions)
    starts = [
        (own_pose[0][frames], own_pose[1][frames]),
        (registered.root_position, registered.local_rotations),
        *((pose[0][neighbours], pose[1][neighbours]) for neighbours in find_neighbours(is_lost, frames)),
    ]
    least_cost = cost[frames] - MIN_COST_IMPROVEMENT
    for root_position, local_rotations in starts:
        part.solve(root_position, local_rotations, part_tracking, RECOVERY_ROBUST_SCALES_M + options.robust_scales_m)
        new_cost = compute_marker_cost(part, predict_markers(subject, (root_position, local_rotations)))
        is_better = new_cost < least_cost
        pose[0][frames[is_better]], pose[1][frames[is_better]] = root_position[is_better], local_rotations[is_better]
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


def compute_marker_cost(problem: "PoseProblem", predicted: Float[np.ndarray, "T K 3"]) -> Float[np.ndarray, " T"]:
    """Return the cost of each frame's visible markers, half the sum of squares in standard deviations, at a wide robust scale."""
    square = ((problem.marker_positions - predicted) ** 2).sum(-1) / problem.marker_sd**2
    scale2 = (COMPARED_ROBUST_SCALE_M / problem.marker_sd) ** 2
    return np.where(problem.solver_mask, 0.5 * square * scale2 / (scale2 + square), 0.0).sum(1)
