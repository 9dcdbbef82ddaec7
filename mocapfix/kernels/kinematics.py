"""Where a pose puts joints and markers.

Rotations carry a vector from a joint's axes into its parent's; world rotations carry it into the world.
"""

import numpy as np
from numba import njit

from mocapfix.kernels.pose import Pose, Tree, forward
from mocapfix.kernels.threads import over_frames
from mocapfix.motion import Motion
from mocapfix.skeleton import Skeleton
from mocapfix.subject import Subject


@njit(cache=True, nogil=True)
def _forward_frames(tree, root, local, position, rotation, first, stop):
    none = np.empty(0)
    for t in range(first, stop):
        forward(tree, Pose(root[t], local[t], none, position[t], rotation[t]))


def world(skeleton: Skeleton, motion: Motion) -> tuple[np.ndarray, np.ndarray]:
    """-> joint positions (T, J, 3) in metres and rotations (T, J, 3, 3), in the world."""
    position, rotation = np.empty(motion.rotations.shape[:2] + (3,)), np.empty(motion.rotations.shape)
    poses = (motion.root, motion.rotations, position, rotation)
    tree = Tree(skeleton.parents, skeleton.offsets, np.ones(len(skeleton.parents), bool))
    over_frames(_forward_frames, motion.frames, tree, *poses)
    return position, rotation


def markers(subject: Subject, position: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """-> (T, K, 3) metres: where the body at these world joints carries the subject's markers."""
    placed = np.empty((len(position), len(subject.joints), 3))
    for k, (joint, place) in enumerate(zip(subject.joints, subject.places, strict=True)):  # no rotation for every marker
        placed[:, k] = position[:, joint] + rotation[:, joint] @ place
    return placed
