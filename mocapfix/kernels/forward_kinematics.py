"""Forward kinematics of a tree of joints: world positions and rotations of one frame or of many, and the effect of a step.

Local rotations map vectors from a joint's axes to its parent's; world rotations map them to the world.
"""

from typing import NamedTuple

import numpy as np

from mocapfix.kernels.compilation import compile_inner_kernel, compile_kernel
from mocapfix.kernels.lie import compute_retraction, orthonormalise_rotation
from mocapfix.kernels.small_matrices import load_matrix, multiply_matrices, multiply_vector, store_matrix, transpose_matrix


class KinematicTree(NamedTuple):
    """A skeleton for the kernels: any tree whose parents come before their children."""

    parents: np.ndarray  # (J,)
    offsets: np.ndarray  # (J, 3) metres, in the parent's axes
    free: np.ndarray  # (J,) bool: joints that may rotate; the root always may


class FramePose(NamedTuple):
    """One frame's pose and its forward kinematics."""

    root: np.ndarray  # (3,) metres, in the world
    local: np.ndarray  # (J, 3, 3) local rotations
    shared: np.ndarray  # (P,) unknowns that all joints share: a prior's latent code
    position: np.ndarray  # (J, 3) metres, in the world
    rotation: np.ndarray  # (J, 3, 3) in the world


@compile_inner_kernel
def allocate_pose(joints, unknowns):
    """Return arrays for a pose."""
    return FramePose(np.empty(3), np.empty((joints, 3, 3)), np.zeros(unknowns), np.empty((joints, 3)), np.empty((joints, 3, 3)))


@compile_inner_kernel
def compute_forward_kinematics(tree, pose):
    """Write the pose's world positions and rotations."""
    position, rotation = pose.position, pose.rotation
    for a in range(3):
        position[0, a] = pose.root[a]
    store_matrix(load_matrix(pose.local, 0), rotation, 0)
    for j in range(1, len(tree.parents)):
        p = tree.parents[j]
        parent_rotation = load_matrix(rotation, p)
        x, y, z = multiply_vector(parent_rotation, tree.offsets[j, 0], tree.offsets[j, 1], tree.offsets[j, 2])
        position[j, 0], position[j, 1], position[j, 2] = position[p, 0] + x, position[p, 1] + y, position[p, 2] + z
        store_matrix(multiply_matrices(parent_rotation, load_matrix(pose.local, j)), rotation, j)


@compile_inner_kernel
def apply_step(tree, pose, step, target):
    """Write into `target` the pose after a step: every joint rotated about its world axes, the root moved with its twist.

    The rotation vector is transformed into the parent's axes before it becomes a rotation, so that rounding errors in the
    parents' rotations do not accumulate in their children's: the product parent' R parent would double them at every step.
    """
    for a in range(3):
        target.root[a] = pose.root[a] + step.twist[0, 3 + a]
    for p in range(len(pose.shared)):
        target.shared[p] = pose.shared[p] + step.shared[p]
    root_step = compute_retraction(step.twist[0, 0], step.twist[0, 1], step.twist[0, 2])
    store_matrix(orthonormalise_rotation(multiply_matrices(root_step, load_matrix(pose.local, 0))), target.local, 0)
    for j in range(1, len(tree.parents)):
        local = load_matrix(pose.local, j)
        if tree.free[j]:
            to_parent = transpose_matrix(load_matrix(pose.rotation, tree.parents[j]))
            x, y, z = multiply_vector(to_parent, step.joint_turn[j, 0], step.joint_turn[j, 1], step.joint_turn[j, 2])
            local = orthonormalise_rotation(multiply_matrices(compute_retraction(x, y, z), local))
        store_matrix(local, target.local, j)


@compile_kernel(nogil=True)
def compute_world_frames(tree, root, local, position, rotation, first, stop):
    """Write world positions (T, J, 3) and rotations (T, J, 3, 3) of the frames first..stop - 1."""
    no_shared = np.empty(0)
    for t in range(first, stop):
        compute_forward_kinematics(tree, FramePose(root[t], local[t], no_shared, position[t], rotation[t]))


@compile_kernel(nogil=True)
def compute_local_frames(tree, rotation, local, first, stop):
    """Write the local rotations (T, J, 3, 3) of joints that are free, and the world rotations of the others, in the frames
    first..stop - 1.
    """
    for t in range(first, stop):
        store_matrix(load_matrix(rotation[t], 0), local[t], 0)
        for j in range(1, len(tree.parents)):
            parent = load_matrix(rotation[t], tree.parents[j])
            if tree.free[j]:
                store_matrix(multiply_matrices(transpose_matrix(parent), load_matrix(rotation[t], j)), local[t], j)
            else:
                store_matrix(multiply_matrices(parent, load_matrix(local[t], j)), rotation[t], j)


@compile_kernel(nogil=True)
def compute_marker_frames(tree, joints, offsets, root, local, position, markers, first, stop):
    """Write world positions of joints (T, J, 3) and of markers (T, K, 3) in the frames first..stop - 1.

    joints (K,) and offsets (K, 3): each marker's joint and its place in that joint's axes
    """
    no_shared, rotation = np.empty(0), np.empty(local.shape[1:])
    for t in range(first, stop):
        compute_forward_kinematics(tree, FramePose(root[t], local[t], no_shared, position[t], rotation))
        for k in range(len(joints)):
            x, y, z = multiply_vector(load_matrix(rotation, joints[k]), offsets[k, 0], offsets[k, 1], offsets[k, 2])
            markers[t, k, 0] = position[t, joints[k], 0] + x
            markers[t, k, 1] = position[t, joints[k], 1] + y
            markers[t, k, 2] = position[t, joints[k], 2] + z
