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

from mocapfix import prior, solve
from mocapfix.bench.start_takes import Case
from mocapfix.bench.uncertainty import telling
from mocapfix.kernels import kinematics
from mocapfix.kernels.cost import cost_frames
from mocapfix.kernels.levenberg import RAN_OUT
from mocapfix.kernels.problem import Problem, no_pull
from mocapfix.kernels.terms import rows_of
from mocapfix.motion import Motion
from mocapfix.skeleton import cmu31
from mocapfix.solve import SolveOptions
from mocapfix.take import Take

Way = Callable[[Case], Motion]
WRONG = 0.1  # metres
SAME = 1.0  # half a sum of squares in standard deviations: costs that differ less are alike
ENOUGH = 3  # markers that tell of a joint


class End(NamedTuple):
    """Poses that a solve came to: their joints (T, J, 3) in metres, what each costs (T,) and took in iterations (T,)."""

    joints: np.ndarray
    cost: np.ndarray
    iterations: np.ndarray


class Found(NamedTuple):
    """What became of a take from one start.

    markers      (T,) metres: mean distance of the seen markers from the body as the frame starts, NaN where none is seen
    joints       (T, J, 3) metres: where the joints are as it starts
    alone whole  the ends of the first solve, of each frame from its start, and of all of it
    unconverged  (T,) bool: the iterations of the first solve ran out at the last robust scale
    seconds      what the start took, and what that and the solve did
    """

    markers: np.ndarray
    joints: np.ndarray
    alone: End
    whole: End
    unconverged: np.ndarray
    seconds: tuple[float, float]


def found(case: Case, way: Way, repeats: int) -> Found:
    """-> what becomes of a take from one start, `repeats` times: the median is the time, and of three leaves compilation out."""
    body, options = cmu31(), SolveOptions()
    mean_pose, limits = prior.load("mean-pose", body.skeleton), prior.load_limits(body.skeleton)
    given = case.worn, case.subject, body, mean_pose

    def start_and_solve() -> tuple[Motion, Motion, float, float]:
        began = perf_counter()
        start = way(case)
        started = perf_counter()
        return start, solve.motion(*given, limits, start, options), started - began, perf_counter() - began

    starts, motions, *times = zip(*(start_and_solve() for _ in range(repeats)), strict=True)
    start, motion = starts[0], motions[0]
    problem = solve.bound(*given, limits, options)
    root, local = start.root.copy(), start.rotations.copy()
    status, iterations = problem.solve(root, local, no_pull(local.shape[1]), options.robust)
    joints, markers = kinematics.placed(case.subject, begun(start, root, local))
    alone, whole = (
        ended(problem, case, *pose) for pose in ((root, local, iterations), (motion.root, motion.rotations, motion.iterations))
    )
    return Found(
        off(markers, case.worn), joints, alone, whole, status == RAN_OUT,
        (median(times[0]), median(times[1])),
    )  # fmt: skip


def begun(start: Motion, root: np.ndarray, local: np.ndarray) -> Motion:
    """-> where frames started: from the pose (T, 3), (T, J, 3, 3) that the frame before came to where they have none."""
    none = np.isnan(start.root[:, 0])
    before = np.maximum(np.arange(start.frames) - none, 0)
    return Motion(
        np.where(none[:, None], root[before], start.root), np.where(none[:, None, None, None], local[before], start.rotations),
        start.status, start.iterations, start.deviation, start.joint_deviation,
    )  # fmt: skip


def off(markers: np.ndarray, worn: Take) -> np.ndarray:
    """-> (T,) metres: how far markers (T, K, 3) are from those seen, on average; NaN where none is."""
    distance, seen = np.linalg.norm(markers - worn.markers, axis=-1), worn.seen
    return np.where(seen, distance, 0.0).sum(1) / np.where(seen.any(1), seen.sum(1), np.nan)


def ended(problem: Problem, case: Case, root: np.ndarray, local: np.ndarray, iterations: np.ndarray) -> End:
    """-> the end at poses (T, 3), (T, J, 3, 3), each on its own."""
    terms, cost = problem.terms(no_pull(local.shape[1])), np.empty(len(root))
    scale2 = problem.scales2(SolveOptions().robust)[-1]
    shared, frames = np.zeros((len(root), 0)), np.arange(len(root))
    cost_frames(problem.tree, terms, frames, scale2, rows_of(terms), root, local, shared, cost)
    return End(kinematics.carried(problem.tree, root, local)[0], cost, iterations)


def wrong(case: Case, ends: dict[str, End]) -> dict[str, np.ndarray]:
    """-> way -> (T,) bool: the frames that end wrong."""
    told, costs = told_of(case), np.stack([end.cost for end in ends.values()])
    if case.joints is not None:
        return {way: far(end.joints, case.joints, told) for way, end in ends.items()}
    joints, cheapest = np.stack([end.joints for end in ends.values()]), costs.argmin(0)
    best = joints[cheapest, np.arange(len(cheapest))]
    return {way: far(end.joints, best, told) & (end.cost > costs.min(0) + SAME) for way, end in ends.items()}


def far(joints: np.ndarray, truth: np.ndarray, told: np.ndarray) -> np.ndarray:
    """-> (T,) bool: whether a joint (T, J, 3) that is told of (T, J) is far from where it should be."""
    return ((np.linalg.norm(joints - truth, axis=-1) > WRONG) & told).any(axis=1)


def told_of(case: Case) -> np.ndarray:
    """-> (T, J) bool: the joints that the markers seen tell of."""
    tell = telling(case.subject)
    return case.worn.seen.astype(int) @ tell.T >= np.minimum(tell.sum(1), ENOUGH)
