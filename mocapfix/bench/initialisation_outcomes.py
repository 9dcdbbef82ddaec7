"""What becomes of a start: where it lies, to which poses the solve comes from it, and whether these are wrong.

A frame ends wrong where a joint lies more than WRONG from the truth though markers tell of it: three of those on the segments
that meet there, or all where they are fewer. Where nobody knows the truth, the pose of least cost stands for it, among those
that the compared ways came to, and a frame that costs hardly more (SAME) is as good, wherever it is.
"""

from collections.abc import Callable
from statistics import median
from time import perf_counter
from typing import NamedTuple

import numpy as np

from mocapfix.bench.initialisation_takes import InitialisationTake
from mocapfix.bench.uncertainty import find_informative_markers
from mocapfix.kernels.levenberg_marquardt import compute_cost_frames
from mocapfix.kernels.terms import count_rows
from mocapfix.motion import FrameStatus, Motion
from mocapfix.options import SolveOptions
from mocapfix.pose_prior import mean_pose as prior
from mocapfix.pose_prior.joint_limits import load_joint_limits
from mocapfix.skeleton import load_cmu31_body
from mocapfix.solve import kinematics, motion_solver
from mocapfix.solve.pose_problem import PoseProblem, build_no_tracking
from mocapfix.take import Take

StartMethod = Callable[[InitialisationTake], Motion]
WRONG_JOINT_DISTANCE_M = 0.1  # metres
MAX_EQUAL_COST_DIFFERENCE = 1.0  # half a sum of squares in standard deviations: costs that differ less are alike
MIN_MARKERS_PER_JOINT = 3  # markers that tell of a joint


class SolveEnd(NamedTuple):
    """Poses that a solve came to: their joints (T, J, 3) in metres, what each costs (T,) and took in iterations (T,)."""

    joint_positions: np.ndarray
    cost: np.ndarray
    iterations: np.ndarray


class StartOutcome(NamedTuple):
    """What became of a take from one start.

    markers      (T,) metres: mean distance of the seen markers from the body as the frame starts, NaN where none is seen
    joints       (T, J, 3) metres: where the joints are as it starts
    alone whole  the ends of the first solve, of each frame from its start, and of all of it
    unconverged  (T,) bool: the iterations of the first solve ran out at the last robust scale
    seconds      what the start took, and what that and the solve did
    """

    marker_error_m: np.ndarray
    start_joint_positions: np.ndarray
    first_solve: SolveEnd
    full_solve: SolveEnd
    is_unconverged: np.ndarray
    durations_s: tuple[float, float]


def evaluate_start(case: InitialisationTake, method: StartMethod, repeats: int) -> StartOutcome:
    """-> what becomes of a take from one start, `repeats` times: the median is the time, and of three leaves compilation out."""
    body, options = load_cmu31_body(), SolveOptions()
    mean_pose, limits = prior.load_mean_pose_prior("mean-pose", body.skeleton), load_joint_limits(body.skeleton)
    given = case.take, case.subject, body, mean_pose

    def start_and_solve() -> tuple[Motion, Motion, float, float]:
        began = perf_counter()
        start = method(case)
        started = perf_counter()
        return start, motion_solver.solve_motion(*given, limits, start, options), started - began, perf_counter() - began

    starts, motions, *times = zip(*(start_and_solve() for _ in range(repeats)), strict=True)
    start, motion = starts[0], motions[0]
    problem = motion_solver.build_pose_problem(*given, limits, options)
    root, local = start.root.copy(), start.rotations.copy()
    status, iterations = problem.solve(root, local, build_no_tracking(local.shape[1]), options.robust_scales_m)
    joints, markers = kinematics.compute_joint_and_marker_positions(case.subject, build_start_motion(start, root, local))
    alone, whole = (
        evaluate_solve(problem, case, *pose)
        for pose in ((root, local, iterations), (motion.root, motion.rotations, motion.iterations))
    )
    return StartOutcome(
        compute_marker_error(markers, case.take), joints, alone, whole, status == FrameStatus.ITERATION_LIMIT,
        (median(times[0]), median(times[1])),
    )  # fmt: skip


def build_start_motion(start: Motion, root_position: np.ndarray, local_rotations: np.ndarray) -> Motion:
    """-> where frames started: from the pose (T, 3), (T, J, 3, 3) that the frame before came to where they have none."""
    none = np.isnan(start.root_position[:, 0])
    before = np.maximum(np.arange(start.frame_count) - none, 0)
    return Motion(
        np.where(none[:, None], root_position[before], start.root_position), np.where(none[:, None, None, None], local_rotations[before], start.local_rotations),
        start.status, start.iterations, start.marker_sd, start.joint_sd,
    )  # fmt: skip


def compute_marker_error(markers: np.ndarray, take: Take) -> np.ndarray:
    """-> (T,) metres: how far markers (T, K, 3) are from those seen, on average; NaN where none is."""
    distance, seen = np.linalg.norm(markers - take.markers, axis=-1), take.visible
    return np.where(seen, distance, 0.0).sum(1) / np.where(seen.any(1), seen.sum(1), np.nan)


def evaluate_solve(
    problem: PoseProblem, case: InitialisationTake, root_position: np.ndarray, local_rotations: np.ndarray, iterations: np.ndarray
) -> SolveEnd:
    """-> the end at poses (T, 3), (T, J, 3, 3), each on its own."""
    terms, cost = problem.build_terms(build_no_tracking(local_rotations.shape[1])), np.empty(len(root_position))
    scale2 = problem.normalise_robust_scales(SolveOptions().robust_scales_m)[-1]
    shared, frames = np.zeros((len(root_position), 0)), np.arange(len(root_position))
    compute_cost_frames(problem.tree, terms, frames, scale2, count_rows(terms), root_position, local_rotations, shared, cost)
    return SolveEnd(kinematics.compute_tree_poses(problem.tree, root_position, local_rotations)[0], cost, iterations)


def find_wrong_frames(case: InitialisationTake, ends: dict[str, SolveEnd]) -> dict[str, np.ndarray]:
    """-> way -> (T,) bool: the frames that end wrong."""
    told, costs = find_observed_joints(case), np.stack([end.cost for end in ends.values()])
    if case.true_joint_positions is not None:
        return {way: has_distant_joint(end.joint_positions, case.true_joint_positions, told) for way, end in ends.items()}
    joints, cheapest = np.stack([end.joint_positions for end in ends.values()]), costs.argmin(0)
    best = joints[cheapest, np.arange(len(cheapest))]
    return {
        way: has_distant_joint(end.joint_positions, best, told) & (end.cost > costs.min(0) + MAX_EQUAL_COST_DIFFERENCE)
        for way, end in ends.items()
    }


def has_distant_joint(joint_positions: np.ndarray, true_positions: np.ndarray, is_observed: np.ndarray) -> np.ndarray:
    """-> (T,) bool: whether a joint (T, J, 3) that is told of (T, J) is far from where it should be."""
    return ((np.linalg.norm(joint_positions - true_positions, axis=-1) > WRONG_JOINT_DISTANCE_M) & is_observed).any(axis=1)


def find_observed_joints(case: InitialisationTake) -> np.ndarray:
    """-> (T, J) bool: the joints that the markers seen tell of."""
    tell = find_informative_markers(case.subject)
    return case.take.visible.astype(int) @ tell.T >= np.minimum(tell.sum(1), MIN_MARKERS_PER_JOINT)
