"""The human-centric frame of Learnable SMPLify (Eqs. 7-13): joints about the pelvis, in axes that turn with the body."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from mocapfix.skeleton import load_cmu31_skeleton


class HumanFrame(NamedTuple):
    """Axes of T skeletons.

    origin    (T, 3) m: the pelvis (Eq. 7)
    to_human  (T, 3, 3): world axes to human-centric axes (Eq. 13)
    """

    origin: np.ndarray
    to_human: np.ndarray

    def transform(self, positions: Float[np.ndarray, "T J 3"]) -> Float[np.ndarray, "T J 3"]:
        """Return world positions in the human-centric frame."""
        return np.einsum("tab,tjb->tja", self.to_human, positions - self.origin[:, None])


def build_human_frame(positions: Float[np.ndarray, "T J 3"]) -> HumanFrame:
    """Return the frame of skeletons: y from the pelvis to the thorax, z forward, x to the left (Eqs. 8-12).

    positions  of the 31 joints in metres; hips, pelvis and thorax (the base of the neck) must not coincide or be in line
    """
    pelvis, left, right, thorax = map(load_cmu31_skeleton().find_joint, ("Hips", "LeftUpLeg", "RightUpLeg", "Neck"))
    y = _normalise(positions[:, thorax] - positions[:, pelvis])
    forward = np.cross(positions[:, left] - positions[:, right], y)
    z = _normalise(forward - (forward * y).sum(1, keepdims=True) * y)
    return HumanFrame(positions[:, pelvis], np.stack([np.cross(y, z), y, z], 1))


def _normalise(vectors: Float[np.ndarray, "T 3"]) -> Float[np.ndarray, "T 3"]:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
