"""Motion: the pose of a subject's skeleton in every frame, how each pose was obtained, and its resampling."""

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


FRAME_TOLERANCE = 1e-9  # distance in frames below which a new frame coincides with an original one


def is_frame_subset(rate: float, new_rate: float) -> bool:
    """Return whether all frames at `new_rate` are frames at `rate`."""
    step = rate / new_rate
    return step > 1 - FRAME_TOLERANCE and abs(step - round(step)) < FRAME_TOLERANCE


def resample_motion(motion: Motion, rate: float, new_rate: float) -> Motion:
    """Return the motion, which has the frame rate `rate`, at `new_rate` (Hz), from its first frame on.

    Rotations follow a rotation spline with continuous angular velocity and acceleration (scipy's RotationSpline), the root a
    cubic spline. For four CMU captures at 120 Hz, joints reconstructed from every second frame have a root mean square error of
    0.4 to 0.7 mm in the frames between, from every fourth 1.0 to 1.3 mm; spherical linear interpolation (slerp) is 2 to 40 %
    worse. There is no low-pass filter before frames are dropped: motion above the Nyquist frequency of 30 Hz is a millimetre on
    average, but removing it would move the feet by one to two centimetres when they strike the floor.

    If the new frames are a subset of the original ones, these are selected; at the same rate the motion itself is returned.
    Status and iterations are those of the nearest frame, standard deviations the larger of the two neighbouring frames.
    """
    if rate == new_rate:
        return motion
    count = int((motion.frame_count - 1) * new_rate / rate + FRAME_TOLERANCE) + 1
    new_frames = np.arange(count) * rate / new_rate  # in frames of the motion
    nearest = np.rint(new_frames).astype(int)
    if motion.frame_count == 1 or is_frame_subset(rate, new_rate):
        return motion.select_frames(nearest)
    from scipy.interpolate import CubicSpline  # slow to import
    from scipy.spatial.transform import Rotation, RotationSpline

    frames = np.arange(motion.frame_count)
    new_frames = np.minimum(new_frames, frames[-1])
    below, above = np.floor(new_frames).astype(int), np.ceil(new_frames).astype(int)
    local_rotations = np.empty((len(new_frames), *motion.local_rotations.shape[1:]))
    for joint in range(motion.local_rotations.shape[1]):
        spline = RotationSpline(frames, Rotation.from_matrix(motion.local_rotations[:, joint]))
        local_rotations[:, joint] = spline(new_frames).as_matrix()
    root_position = CubicSpline(frames, motion.root_position)(new_frames)
    marker_sd, joint_sd = (np.maximum(sd[below], sd[above]) for sd in (motion.marker_sd, motion.joint_sd))
    return Motion(root_position, local_rotations, motion.status[nearest], motion.iterations[nearest], marker_sd, joint_sd)
