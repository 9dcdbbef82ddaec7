"""Motion: the pose of a subject's skeleton in every frame, and how each pose was obtained."""

from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int


class FrameStatus(IntEnum):
    """How the pose of one frame was obtained."""

    CONVERGED = 0
    ITERATION_LIMIT = 1
    POOR_FIT = 2
    GUESSED = 3
    EXACT = 4
    UNCONSTRAINED = 5
    PLACED = 6
    OUT_OF_REACH = 7
    TOO_NEAR = 8

    @property
    def description(self) -> str:
        """The status as one phrase for reports and files."""
        return _FRAME_STATUS_DESCRIPTIONS[self]


_FRAME_STATUS_DESCRIPTIONS = {
    FrameStatus.CONVERGED: "solved: the solve converged",
    FrameStatus.ITERATION_LIMIT: "solved: the iteration limit was reached while the cost still fell slightly",
    FrameStatus.POOR_FIT: "poor: the markers lie far from the body",
    FrameStatus.GUESSED: "guessed: too few markers are visible; the pose comes from the neighbouring frames",
    FrameStatus.EXACT: "solved: the markers lie exactly on the body",
    FrameStatus.UNCONSTRAINED: "not solved: nothing constrains the pose; it is left unchanged",
    FrameStatus.PLACED: "placed: computed in closed form from the joint positions, without a solve",
    FrameStatus.OUT_OF_REACH: "placed: a hand or the head is out of reach of its bones; the bones point to it",
    FrameStatus.TOO_NEAR: "placed: a hand or the head is nearer than its bones can fold",
}


@dataclass(frozen=True)
class Motion:
    """Root positions and local joint rotations over T frames.

    Attributes:
        root_position: Metres: the root joint in the world, Y up.
        local_rotations: Joint axes to parent axes (for the root: to world axes).
        status: A FrameStatus for each frame.
        iterations: Levenberg-Marquardt iterations of each frame.
        marker_sd: (T, K) m: predicted standard deviation per axis of the subject's K markers as the body places them; empty if it
            was not computed.
        joint_sd: (T, J) m: the same for the joint positions.
    """

    root_position: Float[np.ndarray, "T 3"]
    local_rotations: Float[np.ndarray, "T J 3 3"]
    status: Int[np.ndarray, " T"]
    iterations: Int[np.ndarray, " T"]
    marker_sd: Float[np.ndarray, "..."]
    joint_sd: Float[np.ndarray, "..."]

    def select_frames(self, frames: Int[np.ndarray, " N"]) -> "Motion":
        """Return the motion of some frames, given their indices."""
        return Motion(*(np.ascontiguousarray(field[frames]) for field in vars(self).values()))

    @property
    def frame_count(self) -> int:
        """Number of frames."""
        return len(self.root_position)


@dataclass(frozen=True)
class PoseEvidence:
    """What is known of T solved frames besides their poses, with the weights of the solve. Windows write into the arrays."""

    marker_sd: Float[np.ndarray, "T K"]  # m: standard deviation per axis of each marker as the frame's own solution places it
    rotation_variance: Float[np.ndarray, "T J"]  # rad^2: of each joint in the frame's own solution
    gap_variance: Float[np.ndarray, "T J"]  # rad^2: of the interpolated rotations of joints that lack a marker
    root_weight: Float[np.ndarray, " T"]  # 1/m^2: of the root's smooth trajectory

    def copy(self, marker_count: int) -> "PoseEvidence":
        """Return a copy for a number of markers; markers that were not solved for have a deviation of 0."""
        marker_sd = np.zeros((len(self.marker_sd), marker_count))
        count = min(marker_count, self.marker_sd.shape[1])
        marker_sd[:, :count] = self.marker_sd[:, :count]
        return PoseEvidence(marker_sd, self.rotation_variance.copy(), self.gap_variance.copy(), self.root_weight.copy())


class PoseUncertainty(NamedTuple):
    """The uncertainty of solved poses from the curvature of their cost, per axis."""

    marker_sd: Float[np.ndarray, "T K"]  # metres, of each marker as the body places it
    joint_sd: Float[np.ndarray, "T J"]  # metres, of each joint's position
    rotation_variance: Float[np.ndarray, "T J"]  # rad^2, of each joint's rotation, [:, 0] of the root's
    root_variance: Float[np.ndarray, " T"]  # m^2, of the root's position
