"""One frame's pose inside compiled loops: where it puts the joints, and how a step changes it.

Rotations carry a vector from a joint's axes into its parent's; world rotations carry it into the world.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from mocapfix.kernels.lie import compute_retraction, orthonormalise_rotation
from mocapfix.kernels.small_matrices import load_matrix, multiply_matrices, multiply_vector, store_matrix, transpose_matrix


class KinematicTree(NamedTuple):
    """The skeleton as the kernels see it: any tree whose parents come before their children.

    Offsets may be linear in the first Q of the unknowns that all joints share (SCOPE, Eq. 1: S_i beta + l_i).
    """

    parents: np.ndarray  # (J,)
    offsets: np.ndarray  # (J, 3) metres
    free: np.ndarray  # (J,) bool; the root always is
    shape_basis: np.ndarray = np.zeros((0, 0, 3))  # (Q, J, 3) metres: how the offsets change with each


class FramePose(NamedTuple):
    """A pose, and where it puts the joints."""

    root: np.ndarray  # (3,) metres
    local: np.ndarray  # (J, 3, 3)
    shared: np.ndarray  # (P,) unknowns that all joints share: shape, or a prior's latent code
    position: np.ndarray  # (J, 3) metres, in the world
    rotation: np.ndarray  # (J, 3, 3) in the world


@njit(cache=True)
def allocate_pose(joints, unknowns):
    """-> room for a pose."""
    return FramePose(np.empty(3), np.empty((joints, 3, 3)), np.zeros(unknowns), np.empty((joints, 3)), np.empty((joints, 3, 3)))


@njit(cache=True)
def copy_array(source, target):
    """Write every number of `source` into `target`, both contiguous and of one shape."""
    flat, out = source.reshape(-1), target.reshape(-1)
    for i in range(len(flat)):
        out[i] = flat[i]


@njit(cache=True)
def compute_forward_kinematics(tree, pose):
    """Write the pose's world positions and rotations."""
    position, rotation = pose.position, pose.rotation
    for a in range(3):
        position[0, a] = pose.root[a]
    store_matrix(load_matrix(pose.local, 0), rotation, 0)
    for j in range(1, len(tree.parents)):
        p = tree.parents[j]
        world = load_matrix(rotation, p)
        x, y, z = tree.offsets[j, 0], tree.offsets[j, 1], tree.offsets[j, 2]
        for q in range(len(tree.shape)):
            x += tree.shape[q, j, 0] * pose.shared[q]
            y += tree.shape[q, j, 1] * pose.shared[q]
            z += tree.shape[q, j, 2] * pose.shared[q]
        x, y, z = multiply_vector(world, x, y, z)
        position[j, 0], position[j, 1], position[j, 2] = position[p, 0] + x, position[p, 1] + y, position[p, 2] + z
        store_matrix(multiply_matrices(world, load_matrix(pose.local, j)), rotation, j)


@njit(cache=True)
def apply_step(tree, pose, step, target):
    """Write into `new` the pose after a step: every joint turned about its world axes, the root moved with its twist.

    The turn is carried into the parent's axes before it becomes a rotation, so that rounding in the parents' rotations
    never gathers in their children's: the product parent' turn parent would double it at every step.
    """
    for a in range(3):
        target.root[a] = pose.root[a] + step.twist[0, 3 + a]
    for p in range(len(pose.shared)):
        target.shared[p] = pose.shared[p] + step.shared[p]
    turned = multiply_matrices(
        compute_retraction(step.twist[0, 0], step.twist[0, 1], step.twist[0, 2]), load_matrix(pose.local, 0)
    )
    store_matrix(orthonormalise_rotation(turned), target.local, 0)
    for j in range(1, len(tree.parents)):
        local = load_matrix(pose.local, j)
        if tree.free[j]:
            world = transpose_matrix(load_matrix(pose.rotation, tree.parents[j]))
            x, y, z = multiply_vector(world, step.turn[j, 0], step.turn[j, 1], step.turn[j, 2])
            local = orthonormalise_rotation(multiply_matrices(compute_retraction(x, y, z), local))
        store_matrix(local, target.local, j)
