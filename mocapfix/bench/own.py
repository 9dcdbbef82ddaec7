"""mocapfix's own solver on the common task."""

import time

import numpy as np

from mocapfix.bench.common_task import CommonTask, turned
from mocapfix.bench.peer import Solved
from mocapfix.bench.scene import Scene, no_directions, no_views, placed
from mocapfix.kernels import plan
from mocapfix.kernels.levenberg import solve_frames
from mocapfix.kernels.pose import Tree
from mocapfix.kernels.terms import Courses, Points
from mocapfix.kernels.threads import over_frames

WINDOW = 0.625  # seconds that are solved one frame after the other; windows are solved side by side
MARKER_SD = 0.002  # metres
WARM = 1e-6  # initial damping: the frame before is a good start
MOST = 20  # iterations of a frame


def problem(task: CommonTask, name: str) -> tuple[Tree, Points, Courses]:
    """-> the body, its markers in the take `name`, and the pull of every joint to the mean pose."""
    skeleton, joints, markers = task.subject.skeleton, len(task.mean), task.takes[name]
    seen = ~np.isnan(markers[..., 0])
    measured = np.ascontiguousarray(np.where(seen[..., None], markers, 0.0))
    points = Points(task.subject.joints, task.subject.places, measured, np.ascontiguousarray(seen / MARKER_SD**2))
    pull = Courses(turned(task.mean)[None], np.full((1, joints), (task.pull / MARKER_SD) ** 2), np.zeros((1, 3)), np.zeros(1))
    return Tree(skeleton.parents, skeleton.offsets, np.ones(joints, bool)), points, pull


def solve(task: CommonTask, name: str, every_core: bool) -> Solved:
    """-> all frames of the take `name`, on one thread (timed by what the processor spent) or on every core (by the clock)."""
    tree, points, pull = problem(task, name)
    frames, joints = len(points.seen), len(task.mean)
    root, local = task.starts[name].copy(), np.tile(pull.rotations, (frames, 1, 1, 1))
    windows = plan.windows(frames, joints, round(WINDOW * task.rate))
    status, iterations = np.zeros((2, frames), int)
    given = (
        tree, (points, pull), windows, np.array([np.inf]), WARM, MOST, None,
        root, local, np.zeros((frames, 0)), status, iterations,
    )  # fmt: skip
    clock = time.perf_counter if every_core else time.thread_time
    started = clock()
    if every_core:
        over_frames(solve_frames, len(windows.chains) - 1, *given)
    else:
        solve_frames(*given, 0, len(windows.chains) - 1)
    return Solved(root, local, clock() - started)


def scene(task: CommonTask) -> Scene:
    """-> the clean take's first frame in the mean pose, as a scene whose direction can be asked for."""
    tree, points, pull = problem(task, "clean")
    pose = placed(tree, task.starts["clean"][0], pull.rotations[0])
    return Scene(tree, points, no_views(), no_directions(), pull, pose)
