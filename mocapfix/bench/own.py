"""mocapfix's own solver on the common task."""

import time

import numpy as np
from numba import njit

from mocapfix.bench.common_task import CommonTask, turned
from mocapfix.bench.peer import Solved
from mocapfix.bench.scene import Measured, Scene, posed
from mocapfix.kernels.levenberg import Attached, Pull, Tree, copy, of_frame, solve_frame
from mocapfix.kernels.threads import over_frames

RUN = 0.625  # seconds that are solved one frame after the other; runs are solved side by side
MARKER_SD = 0.002  # metres
MOST = 20  # iterations of a frame


def problem(task: CommonTask) -> tuple[Tree, Attached, Pull]:
    """-> the body, its markers, and the pull of every joint to the mean pose."""
    skeleton, joints = task.subject.skeleton, len(task.mean)
    information = np.tile((task.pull / MARKER_SD) ** 2 * np.eye(3), (joints, 1, 1))
    pull = Pull(turned(task.mean)[None], information[None], np.zeros((1, 3)), np.zeros(1))
    tree = Tree(skeleton.parents, skeleton.offsets, np.ones(joints, bool))
    return tree, Attached(task.subject.joints, task.subject.places), pull


def solve(task: CommonTask, name: str, every_core: bool) -> Solved:
    """-> all frames of the take `name`, on one thread (timed by what the processor spent) or on every core (by the clock)."""
    markers, (tree, attached, pull) = task.takes[name], problem(task)
    seen = ~np.isnan(markers[..., 0])
    weight, measured = seen / MARKER_SD**2, np.where(seen[..., None], markers, 0.0)
    root, local = task.starts[name].copy(), np.tile(pull.rotations, (len(markers), 1, 1, 1))
    length = round(RUN * task.rate)
    runs, given = -(-len(markers) // length), (tree, attached, measured, weight, np.array([np.inf]), pull, root, local, length)
    clock = time.perf_counter if every_core else time.thread_time
    started = clock()
    if every_core:
        over_frames(solve_runs, runs, *given)
    else:
        solve_runs(*given, 0, runs)
    return Solved(root, local, clock() - started)


@njit(cache=True, nogil=True)
def solve_runs(tree, attached, seen, weight, scales2, pull, root, local, length, first, stop):
    """Solve the runs first..stop of `length` frames in place, each frame but a run's first started from the one before."""
    for t in range(first * length, min(stop * length, len(root))):
        if t % length:
            copy(root[t - 1], root[t])
            copy(local[t - 1], local[t])
        solve_frame(tree, attached, seen[t], weight[t], scales2, (of_frame(pull, t),), root[t], local[t], MOST)


def scene(task: CommonTask) -> Scene:
    """-> the clean take's first frame in the mean pose, as a scene whose direction can be asked for."""
    tree, attached, pull = problem(task)
    targets, root = np.ascontiguousarray(task.takes["clean"][0]), task.starts["clean"][0]
    weight, nothing = np.full(len(targets), MARKER_SD**-2), np.zeros((0, 3))
    points = Measured(attached.joints, attached.places, np.zeros((0, len(targets), 3)), targets, weight)
    none = Measured(attached.joints[:0], nothing, nothing[None, :, :][:0], nothing, weight[:0])
    growth = np.zeros((0, len(tree.parents), 3))
    return posed(tree, growth, points, none, none, np.zeros(3), of_frame(pull, 0), root, pull.rotations[0])
