"""The baseline solver: scipy's least_squares with an analytic Jacobian, frame by frame.

The unknowns of a frame are the root position and the Euler angles z, y, x of every joint; the method "lm" is MINPACK's.
"""

import time
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import least_squares

from mocapfix.bench.common_task import CommonTask, compute_zyx_rotations


class TimedSolution(NamedTuple):
    """Solved poses and the time that they took."""

    root_position: np.ndarray  # (T, 3) metres
    rotations: np.ndarray  # (T, J, 3, 3) local
    duration_s: float  # processor time unless several threads were used, so that other programs do not matter


class PlacedMarkers(NamedTuple):
    """The body in one frame."""

    joint_positions: np.ndarray  # (J, 3) metres
    marker_positions: np.ndarray  # (M, 3) metres
    angle_axes: np.ndarray  # (J, 3, 3): the world axes of each joint's three Euler angles


def solve_with_scipy(task: CommonTask, take_name: str, frame_count: int) -> TimedSolution:
    """Return the poses of the first frames of a take, each started from the previous one."""
    joint_count = len(task.mean_angles)
    mean = task.mean_angles.ravel()
    x = np.concatenate([task.root_starts[take_name][0], mean])
    moves_marker = find_moving_joints(task)
    prior_jacobian = np.hstack([np.zeros((3 * joint_count, 3)), task.mean_pose_weight * np.eye(3 * joint_count)])
    solution, started = np.empty((frame_count, len(x))), time.thread_time()
    for t, measured in enumerate(task.takes[take_name][:frame_count]):
        is_visible = ~np.isnan(measured[:, 0])

        def residual(x: np.ndarray, measured: np.ndarray = measured, is_visible: np.ndarray = is_visible) -> np.ndarray:
            marker_residuals = (place_markers(task, x).marker_positions - measured)[is_visible].ravel()
            return np.concatenate([marker_residuals, task.mean_pose_weight * (x[3:] - mean)])

        def jacobian(x: np.ndarray, is_visible: np.ndarray = is_visible) -> np.ndarray:
            marker_jacobian = compute_marker_jacobian(place_markers(task, x), moves_marker)[is_visible]
            return np.concatenate([marker_jacobian.reshape(-1, len(x)), prior_jacobian])

        # The stubs do not allow a function as the Jacobian.
        fit = least_squares(residual, x, jacobian, method="lm", xtol=1e-5, ftol=1e-6, gtol=1e-8)  # pyright: ignore
        solution[t] = x = fit.x
    duration_s = time.thread_time() - started
    rotations = compute_zyx_rotations(solution[:, 3:].reshape(frame_count, joint_count, 3))
    return TimedSolution(solution[:, :3], rotations, duration_s)


def place_markers(task: CommonTask, unknowns: Float[np.ndarray, " X"]) -> PlacedMarkers:
    """Return the body for the unknowns (3 + 3 J,)."""
    skeleton, angles = task.subject.skeleton, unknowns[3:].reshape(-1, 3)
    local, position = compute_zyx_rotations(angles), np.empty(angles.shape)
    rotation = np.empty((len(angles), 3, 3))
    parent_rotation = np.empty_like(rotation)
    for j, p in enumerate(skeleton.parents):
        parent_rotation[j] = rotation[p] if j else np.eye(3)
        rotation[j] = parent_rotation[j] @ local[j]
        position[j] = position[p] + rotation[p] @ skeleton.offsets[j] if j else unknowns[:3]
    joints = task.subject.joints
    markers = position[joints] + (rotation[joints] @ task.subject.marker_offsets[:, :, None])[:, :, 0]
    # The axis of z is the parent's, that of y is rotated by z, that of x is the joint's own.
    c, s = np.cos(angles[:, :1]), np.sin(angles[:, :1])
    y_axis = c * parent_rotation[:, :, 1] - s * parent_rotation[:, :, 0]
    axes = np.stack([parent_rotation[:, :, 2], y_axis, rotation[:, :, 0]], axis=1)
    return PlacedMarkers(position, markers, axes)


def compute_marker_jacobian(placed: PlacedMarkers, moves_marker: Bool[np.ndarray, "M J"]) -> Float[np.ndarray, "M 3 X"]:
    """Return the derivatives (M, 3, 3 + 3 J) of every marker with respect to root position and Euler angles."""
    lever = (placed.marker_positions[:, None] - placed.joint_positions) * moves_marker[..., None]
    ax, ay, az = np.moveaxis(placed.angle_axes, -1, 0)
    x, y, z = np.moveaxis(lever[:, :, None], -1, 0)
    jacobian = np.empty((len(moves_marker), 3, 3 + 3 * moves_marker.shape[1]))
    jacobian[:, :, :3] = np.eye(3)
    for row, part in enumerate((ay * z - az * y, az * x - ax * z, ax * y - ay * x)):
        jacobian[:, row, 3:] = part.reshape(len(moves_marker), -1)
    return jacobian


def find_moving_joints(task: CommonTask) -> Bool[np.ndarray, "M J"]:
    """Return which joints move each marker: the joint that it is attached to, and all ancestors."""
    parents, marker_joints = task.subject.skeleton.parents, task.subject.joints
    moves_marker = np.zeros((len(marker_joints), len(parents)), bool)
    for marker, joint in enumerate(marker_joints):
        while joint >= 0:
            moves_marker[marker, joint] = True
            joint = parents[joint]
    return moves_marker
