"""The peer: what anybody would write first, scipy's least_squares with an analytic Jacobian, frame after frame.

Unknowns are a frame's root place and every joint's angles about z, y and x; method "lm" is MINPACK's.
"""

import time
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from mocapfix.bench.common_task import CommonTask, compute_zyx_rotations


class TimedSolution(NamedTuple):
    """The poses of the frames that were solved, and how long that took."""

    root_position: np.ndarray  # (T, 3) metres
    rotations: np.ndarray  # (T, J, 3, 3)
    duration_s: float  # of the processor, so that whatever else runs on the machine does not count against it


class PlacedMarkers(NamedTuple):
    """Where one frame's unknowns put the body."""

    joint_positions: np.ndarray  # (J, 3) metres
    marker_positions: np.ndarray  # (M, 3) metres
    angle_axes: np.ndarray  # (J, 3, 3): the world axes about which each joint's three angles turn it


def solve_with_scipy(task: CommonTask, take_name: str, frame_count: int) -> TimedSolution:
    """-> the first frames of the take `name`, each started from the one before."""
    joints = len(task.mean_angles)
    x, rest = np.concatenate([task.root_starts[take_name][0], task.mean_angles.ravel()]), task.mean_angles.ravel()
    below = find_moving_joints(task)
    pull = np.hstack([np.zeros((3 * joints, 3)), task.mean_pose_weight * np.eye(3 * joints)])
    found, started = np.empty((frame_count, len(x))), time.thread_time()
    for t, measured in enumerate(task.takes[take_name][:frame_count]):
        seen = ~np.isnan(measured[:, 0])

        def residual(x, measured=measured, seen=seen):
            return np.concatenate(
                [(place_markers(task, x).marker_positions - measured)[seen].ravel(), task.mean_pose_weight * (x[3:] - rest)]
            )

        def jacobian(x, seen=seen):
            return np.concatenate([compute_marker_jacobian(place_markers(task, x), below)[seen].reshape(-1, len(x)), pull])

        found[t] = x = least_squares(residual, x, jacobian, method="lm", xtol=1e-5, ftol=1e-6, gtol=1e-8).x  # pyright: ignore
    seconds = time.thread_time() - started
    return TimedSolution(found[:, :3], compute_zyx_rotations(found[:, 3:].reshape(frame_count, joints, 3)), seconds)


def place_markers(task: CommonTask, unknowns: np.ndarray) -> PlacedMarkers:
    """-> the body at the unknowns x (3 + 3 J,)."""
    skeleton, angles = task.subject.skeleton, unknowns[3:].reshape(-1, 3)
    local, place, rotation = compute_zyx_rotations(angles), np.empty(angles.shape), np.empty((len(angles), 3, 3))
    parent = np.empty_like(rotation)
    for j, p in enumerate(skeleton.parents):
        parent[j] = rotation[p] if j else np.eye(3)
        rotation[j] = parent[j] @ local[j]
        place[j] = place[p] + rotation[p] @ skeleton.offsets[j] if j else unknowns[:3]
    on = task.subject.joints
    markers = place[on] + (rotation[on] @ task.subject.marker_offsets[:, :, None])[:, :, 0]
    c, s = np.cos(angles[:, :1]), np.sin(angles[:, :1])  # z turns in the parent, y after z, x is the joint's own axis
    axes = np.stack([parent[:, :, 2], c * parent[:, :, 1] - s * parent[:, :, 0], rotation[:, :, 0]], axis=1)
    return PlacedMarkers(place, markers, axes)


def compute_marker_jacobian(placed: PlacedMarkers, moves_marker: np.ndarray) -> np.ndarray:
    """-> (M, 3, 3 + 3 J): how every marker moves with the root and with every angle of a joint it is below."""
    lever = (placed.marker_positions[:, None] - placed.joint_positions) * moves_marker[..., None]
    ax, ay, az = np.moveaxis(placed.angle_axes, -1, 0)
    x, y, z = np.moveaxis(lever[:, :, None], -1, 0)
    out = np.empty((len(moves_marker), 3, 3 + 3 * moves_marker.shape[1]))
    out[:, :, :3] = np.eye(3)
    for row, part in enumerate((ay * z - az * y, az * x - ax * z, ax * y - ay * x)):
        out[:, row, 3:] = part.reshape(len(moves_marker), -1)
    return out


def find_moving_joints(task: CommonTask) -> np.ndarray:
    """-> (M, J) bool: the marker moves when the joint turns."""
    parents, on = task.subject.skeleton.parents, task.subject.joints
    below = np.zeros((len(on), len(parents)), bool)
    for marker, joint in enumerate(on):
        while joint >= 0:
            below[marker, joint] = True
            joint = parents[joint]
    return below
