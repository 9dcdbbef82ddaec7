"""The peer: what anybody would write first, scipy's least_squares with an analytic Jacobian, frame after frame.

Unknowns are a frame's root place and every joint's angles about z, y and x; method "lm" is MINPACK's.
"""

import time
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from mocapfix.bench.common_task import CommonTask, turned


class Solved(NamedTuple):
    """The poses of the frames that were solved, and how long that took."""

    root: np.ndarray  # (T, 3) metres
    rotations: np.ndarray  # (T, J, 3, 3)
    seconds: float  # of the processor, so that whatever else runs on the machine does not count against it


class Pose(NamedTuple):
    """Where one frame's unknowns put the body."""

    joints: np.ndarray  # (J, 3) metres
    markers: np.ndarray  # (M, 3) metres
    axes: np.ndarray  # (J, 3, 3): the world axes about which each joint's three angles turn it


def solve(task: CommonTask, name: str, frames: int) -> Solved:
    """-> the first frames of the take `name`, each started from the one before."""
    joints = len(task.mean)
    x, rest = np.concatenate([task.starts[name][0], task.mean.ravel()]), task.mean.ravel()
    below = descendants(task)
    pull = np.hstack([np.zeros((3 * joints, 3)), task.pull * np.eye(3 * joints)])
    found, started = np.empty((frames, len(x))), time.thread_time()
    for t, measured in enumerate(task.takes[name][:frames]):
        seen = ~np.isnan(measured[:, 0])

        def residual(x, measured=measured, seen=seen):
            return np.concatenate([(pose(task, x).markers - measured)[seen].ravel(), task.pull * (x[3:] - rest)])

        def jacobian(x, seen=seen):
            return np.concatenate([marker_jacobian(pose(task, x), below)[seen].reshape(-1, len(x)), pull])

        found[t] = x = least_squares(residual, x, jacobian, method="lm", xtol=1e-5, ftol=1e-6, gtol=1e-8).x  # pyright: ignore
    seconds = time.thread_time() - started
    return Solved(found[:, :3], turned(found[:, 3:].reshape(frames, joints, 3)), seconds)


def pose(task: CommonTask, x: np.ndarray) -> Pose:
    """-> the body at the unknowns x (3 + 3 J,)."""
    skeleton, angles = task.subject.skeleton, x[3:].reshape(-1, 3)
    local, place, rotation = turned(angles), np.empty(angles.shape), np.empty((len(angles), 3, 3))
    parent = np.empty_like(rotation)
    for j, p in enumerate(skeleton.parents):
        parent[j] = rotation[p] if j else np.eye(3)
        rotation[j] = parent[j] @ local[j]
        place[j] = place[p] + rotation[p] @ skeleton.offsets[j] if j else x[:3]
    on = task.subject.joints
    markers = place[on] + (rotation[on] @ task.subject.places[:, :, None])[:, :, 0]
    c, s = np.cos(angles[:, :1]), np.sin(angles[:, :1])  # z turns in the parent, y after z, x is the joint's own axis
    axes = np.stack([parent[:, :, 2], c * parent[:, :, 1] - s * parent[:, :, 0], rotation[:, :, 0]], axis=1)
    return Pose(place, markers, axes)


def marker_jacobian(at: Pose, below: np.ndarray) -> np.ndarray:
    """-> (M, 3, 3 + 3 J): how every marker moves with the root and with every angle of a joint it is below."""
    lever = (at.markers[:, None] - at.joints) * below[..., None]
    ax, ay, az = np.moveaxis(at.axes, -1, 0)
    x, y, z = np.moveaxis(lever[:, :, None], -1, 0)
    out = np.empty((len(below), 3, 3 + 3 * below.shape[1]))
    out[:, :, :3] = np.eye(3)
    for row, part in enumerate((ay * z - az * y, az * x - ax * z, ax * y - ay * x)):
        out[:, row, 3:] = part.reshape(len(below), -1)
    return out


def descendants(task: CommonTask) -> np.ndarray:
    """-> (M, J) bool: the marker moves when the joint turns."""
    parents, on = task.subject.skeleton.parents, task.subject.joints
    below = np.zeros((len(on), len(parents)), bool)
    for marker, joint in enumerate(on):
        while joint >= 0:
            below[marker, joint] = True
            joint = parents[joint]
    return below
