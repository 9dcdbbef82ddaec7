"""Where a pose puts joints and markers.

Rotations carry a vector from a joint's axes into its parent's; world rotations carry it into the world.
"""

import numpy as np
from numba import njit

from mocapfix.kernels.threads import over_frames
from mocapfix.motion import Motion
from mocapfix.skeleton import Skeleton
from mocapfix.subject import Subject


@njit(cache=True)
def forward(parents, offsets, root, local, position, rotation):
    """One frame: local rotations (J, 3, 3) -> world `position` (J, 3) and `rotation` (J, 3, 3), written in place."""
    for j in range(len(parents)):
        p = parents[j]
        if p < 0:
            for a in range(3):
                position[j, a] = root[a]
                for b in range(3):
                    rotation[j, a, b] = local[j, a, b]
            continue
        for a in range(3):
            total = position[p, a]
            for c in range(3):
                total += rotation[p, a, c] * offsets[j, c]
            position[j, a] = total
            for b in range(3):
                turned = 0.0
                for c in range(3):
                    turned += rotation[p, a, c] * local[j, c, b]
                rotation[j, a, b] = turned


@njit(cache=True, nogil=True)
def _forward_frames(parents, offsets, root, local, position, rotation, first, stop):
    for t in range(first, stop):
        forward(parents, offsets, root[t], local[t], position[t], rotation[t])


def world(skeleton: Skeleton, motion: Motion) -> tuple[np.ndarray, np.ndarray]:
    """-> joint positions (T, J, 3) in metres and rotations (T, J, 3, 3), in the world."""
    position, rotation = np.empty(motion.rotations.shape[:2] + (3,)), np.empty(motion.rotations.shape)
    poses = (motion.root, motion.rotations, position, rotation)
    over_frames(_forward_frames, motion.frames, skeleton.parents, skeleton.offsets, *poses)
    return position, rotation


def markers(subject: Subject, position: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """-> (T, K, 3) metres: where the body at these world joints carries the subject's markers."""
    placed = np.empty((len(position), len(subject.joints), 3))
    for k, (joint, place) in enumerate(zip(subject.joints, subject.places, strict=True)):  # no rotation for every marker
        placed[:, k] = position[:, joint] + rotation[:, joint] @ place
    return placed
