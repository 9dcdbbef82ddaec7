"""The direction as mocapfix computes it: the leaves-to-root sweep, in O(K) + O(N)."""

import time

import numpy as np
from numba import njit

from mocapfix.bench.scene import DAMPING, Scene
from mocapfix.kernels import levenberg
from mocapfix.kernels.system import linearise
from mocapfix.kernels.workspace import Workspace, workspace


def work(scene: Scene) -> Workspace:
    """-> arrays for the scene's direction."""
    return workspace(len(scene.tree.parents), len(scene.tree.shape), None)


@njit(cache=True)
def repeat(tree, terms, pose, work, times):
    """Linearise all terms of a scene and solve for the Gauss-Newton step, into the work's step; so many times."""
    for _ in range(times):
        linearise(tree, terms, 0, np.inf, pose, work.system)
        levenberg.direction(tree, work, DAMPING)


def direction(scene: Scene, room: Workspace) -> np.ndarray:
    """-> x (6 + 3 K + P,): the root's turn and shift, every joint's turn, all in world axes, the shape parameters."""
    repeat(scene.tree, scene.terms, scene.pose, room, 1)
    return np.concatenate([room.step.twist[0], room.step.turn[1:].ravel(), room.step.shared])


def seconds(scene: Scene, room: Workspace, times: int) -> float:
    """-> what one direction costs the processor, the mean of so many in a compiled loop."""
    given = (scene.tree, scene.terms, scene.pose, room, times)
    started = time.thread_time()
    repeat(*given)
    return (time.thread_time() - started) / times
