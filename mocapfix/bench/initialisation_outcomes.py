"""The outcome of a start: its error, the poses that the solver reaches from it, and whether these are wrong.

A frame is wrong if an observed joint is further than WRONG_JOINT_DISTANCE_M from the truth. A joint is observed if three markers
on the segments that meet there are visible, or all of them if there are fewer. If the truth is not known, the pose of least cost
among all compared starts replaces it, and a frame of hardly greater cost is not wrong, whatever its pose.
"""

from collections.abc import Callable
from statistics import median
from time import perf_counter
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.bench.initialisation_takes import InitialisationTake
from mocapfix.bench.sound_takes import find_informative_markers
from mocapfix.kernels.levenberg_marquardt import compute_cost_frames
from mocapfix.kernels.terms import count_rows
from mocapfix.motion import FrameStatus, Motion
from mocapfix.options import SolveOptions
from mocapfix.pose_prior.mean_pose import load_joint_limits, load_mean_pose_prior
from mocapfix.skeleton import load_cmu31_body
from mocapfix.solve import kinematics, motion_solver
from mocapfix.solve.pose_problem import PoseProblem, build_no_tracking, build_pose_problem
from mocapfix.take import Take

StartMethod = Callable[[InitialisationTake], Motion]
WRONG_JOINT_DISTANCE_M = 0.1
MAX_EQUAL_COST_DIFFERENCE = 1.0  # costs (half a sum of squares in standard deviations) that differ less are equal
MIN_MARKERS_PER_JOINT = 3  # visible markers of an observed joint


class SolveEnd(NamedTuple):
    """The poses that a solve reached."""

    joint_positions: np.ndarray  # (T, J, 3) metres
    cost: np.ndarray  # (T,)
    iterations: np.ndarray  # (T,)


class StartOutcome(NamedTuple):
    """The outcome of one start of a take.

    marker_error_m         (T,) mean distance of the visible markers from the body at the start, NaN if none is visible
    start_joint_positions  (T, J, 3) metres
    first_solve            end of the first solve, of each frame from its start
    full_solve             end of the whole solve
    is_unconverged         (T,) whether the first solve reached the iteration limit at the last robust scale
    durations_s            of the start, and of start and solve
    """

    marker_error_m: np.ndarray
    start_joint_positions: np.ndarray
    first_solve: SolveEnd
    full_solve: SolveEnd
    is_unconverged: np.ndarray
    durations_s: tuple[float, float]


def evaluate_start(case: InitialisationTake, method: StartMethod, repeats: int) -> StartOutcome:
    """Return the outcome of a start; durations are medians, of which three repeats exclude compilation."""
    body, options = load_cmu31_body(), SolveOptions()
    prior, limits = load_mean_pose_prior("mean-pose", body.skeleton), load_joint_limits(body.skeleton)

    def start_and_solve() -> tuple[Motion, Motion, tuple[float, float]]:
        began = perf_counter()
        start = method(case)
        started = perf_counter()
        motion = motion_solver.solve_motion(case.take, case.subject, body, prior, limits, start, options)
        return start, motion, (started - began, perf_counter() - began)

    runs = [start_and_solve() for _ in range(repeats)]
    start, motion, _ = runs[0]
    start_s, total_s = (median(durations[i] for _, _, durations in runs) for i in range(2))
    problem = build_pose_problem(case.take, case.subject, body, prior, limits, options)
    root, local = start.root_position.copy(), start.local_rotations.copy()
    status, iterations = problem.solve(root, local, build_no_tracking(local.shape[1]), options.robust_scales_m)
    start_motion = build_start_motion(start, root, local)
    joint_positions, markers = kinematics.compute_joint_and_marker_positions(case.subject, start_motion)
    return StartOutcome(
        marker_error_m=compute_marker_error(markers, case.take),
        start_joint_positions=joint_positions,
        first_solve=evaluate_solve(problem, root, local, iterations),
        full_solve=evaluate_solve(problem, motion.root_position, motion.local_rotations, motion.iterations),
        is_unconverged=status == FrameStatus.ITERATION_LIMIT,
        durations_s=(start_s, total_s),
    )


def build_start_motion(
    start: Motion, root_position: Float[np.ndarray, "T 3"], local_rotations: Float[np.ndarray, "T J 3 3"]
) -> Motion:
    """Return the poses at which frames were started: those without a start used the solved pose of the previous frame."""
    has_no_start = np.isnan(start.root_position[:, 0])
    previous = np.maximum(np.arange(start.frame_count) - has_no_start, 0)
    return Motion(
        np.where(has_no_start[:, None], root_position[previous], start.root_position),
        np.where(has_no_start[:, None, None, None], local_rotations[previous], start.local_rotations),
        start.status,
        start.iterations,
        start.marker_sd,
        start.joint_sd,
    )


def compute_marker_error(markers: Float[np.ndarray, "T K 3"], take: Take) -> Float[np.ndarray, " T"]:
    """Return the mean distance in metres of markers from the visible ones, NaN if none is visible."""
    distance, visible = np.linalg.norm(markers - take.markers, axis=-1), take.visible
    return np.where(visible, distance, 0.0).sum(1) / np.where(visible.any(1), visible.sum(1), np.nan)


def evaluate_solve(
    problem: PoseProblem,
    root_position: Float[np.ndarray, "T 3"],
    local_rotations: Float[np.ndarray, "T J 3 3"],
    iterations: Int[np.ndarray, " T"],
) -> SolveEnd:
    """Return joint positions and costs of solved poses, each frame without its neighbours."""
    terms, cost = problem.build_terms(build_no_tracking(local_rotations.shape[1])), np.empty(len(root_position))
    scale2 = problem.normalise_robust_scales(SolveOptions().robust_scales_m)[-1]
    shared, frames = np.zeros((len(root_position), 0)), np.arange(len(root_position))
    compute_cost_frames(problem.tree, terms, frames, scale2, count_rows(terms), root_position, local_rotations, shared, cost)
    joint_positions, _ = kinematics.compute_tree_poses(problem.tree, root_position, local_rotations)
    return SolveEnd(joint_positions, cost, iterations)


def find_wrong_frames(case: InitialisationTake, ends: dict[str, SolveEnd]) -> dict[str, Bool[np.ndarray, " T"]]:
    """Return the wrong frames by start."""
    is_observed, costs = find_observed_joints(case), np.stack([end.cost for end in ends.values()])
    true_positions = case.true_joint_positions
    if true_positions is not None:
        return {name: has_distant_joint(end.joint_positions, true_positions, is_observed) for name, end in ends.items()}
    joint_positions, cheapest = np.stack([end.joint_positions for end in ends.values()]), costs.argmin(0)
    best_positions = joint_positions[cheapest, np.arange(len(cheapest))]
    max_cost = costs.min(0) + MAX_EQUAL_COST_DIFFERENCE
    return {
        name: has_distant_joint(end.joint_positions, best_positions, is_observed) & (end.cost > max_cost)
        for name, end in ends.items()
    }


def has_distant_joint(
    joint_positions: Float[np.ndarray, "T J 3"],
    true_positions: Float[np.ndarray, "T J 3"],
    is_observed: Bool[np.ndarray, "T J"],
) -> Bool[np.ndarray, " T"]:
    """Return whether any observed joint is further than WRONG_JOINT_DISTANCE_M from its true position."""
    is_distant = np.linalg.norm(joint_positions - true_positions, axis=-1) > WRONG_JOINT_DISTANCE_M
    return (is_distant & is_observed).any(axis=1)


def find_observed_joints(case: InitialisationTake) -> Bool[np.ndarray, "T J"]:
    """Return the joints that enough visible markers observe."""
    is_informative = find_informative_markers(case.subject)
    return case.take.visible.astype(int) @ is_informative.T >= np.minimum(is_informative.sum(1), MIN_MARKERS_PER_JOINT)
