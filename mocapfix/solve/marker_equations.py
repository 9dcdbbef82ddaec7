"""Marker equations: the dense normal equations of the markers of single frames, for steps that couple all joints.

The compiled kernels never form this matrix; it is needed where a pose model couples every joint with every other.
"""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

if TYPE_CHECKING:  # to keep the import layers few
    from mocapfix.solve.pose_problem import PoseProblem

MIN_ROOT_CURVATURE = 1.0
"""Curvature, in 1/m^2 and 1/rad^2, that keeps the root where it is in frames without markers."""
SMALL_ANGLE_RAD = 1e-4
"""Angle below which the derivative of the exponential is given by its series."""


class WorldPoses(NamedTuple):
    """Poses of N frames: joint positions (N, J, 3) in metres and rotations (N, J, 3, 3) in the world; local rotations."""

    position: np.ndarray
    rotation: np.ndarray
    local_rotations: np.ndarray


class MarkerEquations(NamedTuple):
    """The quadratic cost of the markers of N frames about their poses, in root position, root rotation and pose vectors.

    curvature  (N, 6 + 3 F, 6 + 3 F)
    gradient   (N, 6 + 3 F)
    """

    curvature: np.ndarray
    gradient: np.ndarray


def compute_marker_equations(
    problem: "PoseProblem", pose: WorldPoses, jacobian: Float[np.ndarray, "N F 3 3"], robust_scale_m: float
) -> MarkerEquations:
    """Return the cost of the markers of a problem's frames about poses.

    jacobian  rotation of each free joint, in its parent's axes, by its pose vector
    """
    tree, attachment = problem.tree, problem.attachment
    joints = np.flatnonzero(tree.free)[1:]
    position, rotation, _ = pose
    carried = attachment.joints
    markers = position[:, carried] + (rotation[:, carried] @ attachment.offsets[..., None])[..., 0]
    error = np.where(problem.solver_mask[..., None], markers - problem.marker_positions, 0.0)
    scale2 = (robust_scale_m / problem.marker_sd) ** 2
    square = (error**2).sum(-1) / problem.marker_sd**2
    weight = problem.solver_mask * (scale2 / (scale2 + square)) ** 2 / problem.marker_sd**2
    slopes = np.zeros((*markers.shape, 6 + 3 * len(joints)))
    slopes[..., :3] = np.eye(3)
    arm = markers - position[:, :1]
    slopes[..., 3:6] = cross_columns(np.broadcast_to(np.eye(3), (*arm.shape, 3)), arm)
    is_below = find_moved_joints(tree.parents)
    for n, j in enumerate(joints.tolist()):
        moved = np.flatnonzero(is_below[j, carried])
        axes = rotation[:, tree.parents[j]] @ jacobian[:, n]
        arm = markers[:, moved] - position[:, j : j + 1]
        slopes[:, moved, :, 6 + 3 * n : 9 + 3 * n] = cross_columns(axes[:, None], arm)
    flat = slopes.reshape(len(slopes), -1, slopes.shape[-1])
    weighted = np.swapaxes(flat * np.repeat(weight, 3, axis=1)[..., None], 1, 2)
    curvature = weighted @ flat
    curvature[:, range(6), range(6)] += MIN_ROOT_CURVATURE
    return MarkerEquations(curvature, (weighted @ error.reshape(len(error), -1, 1))[..., 0])


def cross_columns(axes: Float[np.ndarray, "... 3 3"], arm: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 3 3"]:
    """Return the cross product of each column of `axes` with an arm: the velocity at its end for rotations about the columns."""
    x, y, z = arm[..., 0, None], arm[..., 1, None], arm[..., 2, None]
    a, b, c = axes[..., 0, :], axes[..., 1, :], axes[..., 2, :]
    return np.stack([b * z - c * y, c * x - a * z, a * y - b * x], axis=-2)


def find_moved_joints(parents: Int[np.ndarray, " J"]) -> Bool[np.ndarray, "J J"]:
    """Return for each joint which joints it moves: itself and those below it."""
    is_below = np.eye(len(parents), dtype=bool)
    for j in range(1, len(parents)):
        is_below[:, j] |= is_below[:, parents[j]]
    return is_below


def compute_left_jacobian(vectors: Float[np.ndarray, "N F 3"]) -> Float[np.ndarray, "N F 3 3"]:
    """Return the derivative of rotations by their rotation vectors in radians: exp(v + dv) = exp(J dv) exp(v)."""
    angle2 = (vectors**2).sum(-1)
    angle = np.sqrt(np.maximum(angle2, SMALL_ANGLE_RAD**2))
    first, second = (1 - np.cos(angle)) / angle**2, (angle - np.sin(angle)) / angle**3
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*vectors.shape, 3)
    return np.eye(3) + first[..., None, None] * cross + second[..., None, None] * (cross @ cross)


def exponentiate_vectors(vectors: Float[np.ndarray, "N F 3"]) -> Float[np.ndarray, "N F 3 3"]:
    """Return the rotations of rotation vectors in radians."""
    return Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(*vectors.shape, 3)
