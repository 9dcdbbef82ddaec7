"""Where a pose puts joints and markers.

Rotations carry a vector from a joint's axes into its parent's; world rotations carry it into the world.
"""

import numpy as np
from numba import njit

from mocapfix.kernels.forward_kinematics import FramePose, KinematicTree, compute_forward_kinematics
from mocapfix.kernels.small_matrices import load_matrix, multiply_vector
from mocapfix.motion import Motion
from mocapfix.skeleton import Skeleton
from mocapfix.solve.parallel import run_over_frames
from mocapfix.subject import Subject


@njit(cache=True, nogil=True)
def _compute_world_frames(tree, root, local, position, rotation, first, stop):
    none = np.empty(0)
    for t in range(first, stop):
        compute_forward_kinematics(tree, FramePose(root[t], local[t], none, position[t], rotation[t]))


@njit(cache=True, nogil=True)
def _compute_marker_frames(tree, joints, places, root, local, position, markers, first, stop):
    none, rotation = np.empty(0), np.empty(local.shape[1:])
    for t in range(first, stop):
        compute_forward_kinematics(tree, FramePose(root[t], local[t], none, position[t], rotation))
        for k in range(len(joints)):
            x, y, z = multiply_vector(load_matrix(rotation, joints[k]), places[k, 0], places[k, 1], places[k, 2])
            markers[t, k, 0] = position[t, joints[k], 0] + x
            markers[t, k, 1] = position[t, joints[k], 1] + y
            markers[t, k, 2] = position[t, joints[k], 2] + z


def build_kinematic_tree(skeleton: Skeleton) -> KinematicTree:
    """-> the skeleton as the kernels see it, all joints free."""
    return KinematicTree(skeleton.parents, skeleton.offsets, np.ones(len(skeleton.parents), bool))


def compute_world_poses(skeleton: Skeleton, motion: Motion) -> tuple[np.ndarray, np.ndarray]:
    """-> joint positions (T, J, 3) in metres and rotations (T, J, 3, 3), in the world."""
    return compute_tree_poses(build_kinematic_tree(skeleton), motion.root_position, motion.local_rotations)


def compute_tree_poses(tree: KinematicTree, root: np.ndarray, local: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """-> likewise where poses, root (T, 3) and local rotations (T, J, 3, 3), carry a tree's joints."""
    position, rotation = np.empty(local.shape[:2] + (3,)), np.empty(local.shape)
    run_over_frames(_compute_world_frames, len(root), tree, root, local, position, rotation)
    return position, rotation


def compute_joint_and_marker_positions(subject: Subject, motion: Motion) -> tuple[np.ndarray, np.ndarray]:
    """-> joints (T, J, 3) and the subject's markers (T, K, 3), in metres, where the poses carry them."""
    position, markers = np.empty(motion.local_rotations.shape[:2] + (3,)), np.empty((motion.frame_count, len(subject.joints), 3))
    run_over_frames(
        _compute_marker_frames, motion.frame_count, build_kinematic_tree(subject.skeleton), subject.joints, subject.marker_offsets, motion.root_position, motion.local_rotations,
        position, markers,
    )  # fmt: skip
    return position, markers
