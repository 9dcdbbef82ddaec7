"""A motion: the pose of a subject's skeleton in every frame."""

from dataclasses import dataclass

import numpy as np

STATUS_TEXTS = (
    "solved: the step became smaller than it could matter",
    "solved: the iterations ran out while still improving a little",
    "poor: the markers lie far from the body; look at labels and swaps in these frames",
    "guessed: too few markers were seen; the pose comes from the frames around",
    "solved: the markers lie on the body exactly",
    "not solved: nothing holds the pose; it stays as it was",
    "placed: in closed form from where the joints are; nothing was solved",
    "placed: a hand or the head is out of reach of the bones before it; they point to it",
    "placed: a hand or the head is nearer than the bones before it can fold",
)
GUESSED, PLACED, STRETCHED, FOLDED = 3, 6, 7, 8  # indices into STATUS


@dataclass(frozen=True)
class Motion:
    """Local joint rotations and the root's place over T frames.

    root        (T, 3) metres: the root joint in the world, Y up
    rotations   (T, J, 3, 3): each joint's axes in its parent's (the root's in the world)
    status      (T,) int: an index into STATUS
    iterations  (T,) int: Levenberg-Marquardt iterations spent on the frame
    deviation   (T, K) metres: predicted standard deviation per axis of the subject's K markers as the body places them
    joint_deviation  (T, J) metres: likewise of the joints' places
    """

    root_position: np.ndarray
    local_rotations: np.ndarray
    status: np.ndarray
    iterations: np.ndarray
    marker_sd: np.ndarray
    joint_sd: np.ndarray

    def select_frames(self, frames: np.ndarray) -> "Motion":
        """-> the motion of some frames alone, by index."""
        return Motion(*(np.ascontiguousarray(field[frames]) for field in vars(self).values()))

    @property
    def frame_count(self) -> int:
        return len(self.root_position)
