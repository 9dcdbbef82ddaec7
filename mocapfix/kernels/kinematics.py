"""Where a pose puts joints and markers.

Rotations carry a vector from a joint's axes into its parent's; world rotations carry it into the world.
"""

import numpy as np
from numba import njit

from mocapfix.kernels.pose import Pose, Tree, forward
from mocapfix.kernels.small import matrix, times
from mocapfix.kernels.threads import over_frames
from mocapfix.motion import Motion
from mocapfix.skeleton import Skeleton
from mocapfix.subject import Subject


@njit(cache=True, nogil=True)
def _world_frames(tree, root, local, position, rotation, first, stop):
    none = np.empty(0)
    for t in range(first, stop):
        forward(tree, Pose(root[t], local[t], none, position[t], rotation[t]))


@njit(cache=True, nogil=True)
def _place_frames(tree, joints, places, root, local, position, markers, first, stop):
    none, rotation = np.empty(0), np.empty(local.shape[1:])
    for t in range(first, stop):
        forward(tree, Pose(root[t], local[t], none, position[t], rotation))
        for k in range(len(joints)):
            x, y, z = times(matrix(rotation, joints[k]), places[k, 0], places[k, 1], places[k, 2])
            markers[t, k, 0] = position[t, joints[k], 0] + x
            markers[t, k, 1] = position[t, joints[k], 1] + y
            markers[t, k, 2] = position[t, joints[k], 2] + z


def tree_of(skeleton: Skeleton) -> Tree:
    """-> the skeleton as the kernels see it, all joints free."""
    return Tree(skeleton.parents, skeleton.offsets, np.ones(len(skeleton.parents), bool))


def world(skeleton: Skeleton, motion: Motion) -> tuple[np.ndarray, np.ndarray]:
    """-> joint positions (T, J, 3) in metres and rotations (T, J, 3, 3), in the world."""
    return carried(tree_of(skeleton), motion.root, motion.rotations)


def carried(tree: Tree, root: np.ndarray, local: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """-> likewise where poses, root (T, 3) and local rotations (T, J, 3, 3), carry a tree's joints."""
    position, rotation = np.empty(local.shape[:2] + (3,)), np.empty(local.shape)
    over_frames(_world_frames, len(root), tree, root, local, position, rotation)
    return position, rotation


def placed(subject: Subject, motion: Motion) -> tuple[np.ndarray, np.ndarray]:
    """-> joints (T, J, 3) and the subject's markers (T, K, 3), in metres, where the poses carry them."""
    position, markers = np.empty(motion.rotations.shape[:2] + (3,)), np.empty((motion.frames, len(subject.joints), 3))
    over_frames(
        _place_frames, motion.frames, tree_of(subject.skeleton), subject.joints, subject.places, motion.root, motion.rotations,
        position, markers,
    )  # fmt: skip
    return position, markers
