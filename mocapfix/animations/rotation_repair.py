"""Repair of one signal of an animation: removal of a constant offset (pop, flip or position spike), and smoothing of jitter.

The motion inside a pop or flip is correct but for an offset. It is kept, and corrected by the offset for which the signal
continues most smoothly at both edges. Frames with jitter are treated as additional, inaccurate training frames of a Gaussian
process over the take.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.solve import occluded_joints
from mocapfix.stats import constant_offsets
from mocapfix.stats.constant_offsets import OffsetModel
from mocapfix.stats.gaussian_process import fit_gaussian_process
from mocapfix.stats.sequences import select_training_frames

MIN_STEADY_FRAMES = 3
"""Frames without jitter that the smoothing requires."""
QUATERNION_VARIANCE_RATIO = 0.75
"""Variance of a number of twice a quaternion over the variance of the rotation per axis: four numbers for three axes."""
OFFSET_CONTEXT_S = 0.3
"""Time on either side of each edge over which the smoothness is evaluated."""
MIN_CONTEXT_FRAMES = 4
"""The same in frames, at low frame rates."""


class FrameSpan(NamedTuple):
    """The frames first..last of a signal with a given frame rate in Hz."""

    first: int
    last: int
    rate: float

    @property
    def frames(self) -> Int[np.ndarray, " n"]:
        """The indices of the frames."""
        return np.arange(self.first, self.last + 1)


def smooth_joint_jitter(
    root_position: Float[np.ndarray, "T 3"],
    local_rotations: Float[np.ndarray, "T J 3 3"],
    quaternions: Float[np.ndarray, "T 4"],
    joints: Int[np.ndarray, " O"],
    is_steady: Bool[np.ndarray, " T"],
    span: FrameSpan,
    jitter_sd_rad: float,
) -> tuple[Float[np.ndarray, "n 4"], Float[np.ndarray, " n"]]:
    """Return the quaternions of one joint over a span without jitter, and their variance in rad^2 per axis.

    quaternions    of the joint, without sign changes
    joints         the other joints whose state is used
    is_steady      known frames without jitter
    jitter_sd_rad  standard deviation of the jitter per axis
    """
    rate, frames = span.rate, span.frames
    steady = select_training_frames(is_steady & ~np.isin(np.arange(len(is_steady)), frames), span.first, span.last, rate)
    training = np.sort(np.r_[steady, frames])
    has_jitter = np.isin(training, frames)
    noise = np.where(has_jitter, QUATERNION_VARIANCE_RATIO * jitter_sd_rad**2, 0.0)
    states = occluded_joints.compute_joint_state_features(root_position, local_rotations, joints, training, rate)
    process = fit_gaussian_process(
        2 * quaternions[training], states, training / rate, noise, occluded_joints.RECORDED_ROTATION_KERNEL
    )
    smoothed, variance = process.predict(states[has_jitter], frames / rate)
    return smoothed / np.linalg.norm(smoothed, axis=1, keepdims=True), variance * process.signal_power.sum() / 3


def remove_rotation_offset(
    quaternions: Float[np.ndarray, "T 4"], is_sound: Bool[np.ndarray, " T"], span: FrameSpan, rotation_order: str
) -> tuple[Float[np.ndarray, "n 4"], float]:
    """Return one joint's quaternions over a span without its offset, and the variance of the offset in rad^2 per axis.

    is_sound        frames without faults
    rotation_order  the joint's axes of rotation, such as "ZYX"
    """
    inside = make_quaternions_continuous(quaternions[span.first : span.last + 1])
    context = _find_offset_context(is_sound, span)
    known = make_quaternions_continuous(quaternions[context])
    models = constant_offsets.build_rotation_offset_models(inside, rotation_order)
    corrected, variance = _solve_offset(2 * known, context, models, span)
    return corrected / np.linalg.norm(corrected, axis=1, keepdims=True), variance


def remove_position_offset(
    positions: Float[np.ndarray, "T 3"], is_sound: Bool[np.ndarray, " T"], span: FrameSpan
) -> tuple[Float[np.ndarray, "n 3"], float]:
    """Return the root positions over a span without their offset, and its variance in m^2 per axis."""
    context = _find_offset_context(is_sound, span)
    models = constant_offsets.build_position_offset_models(positions[span.first : span.last + 1])
    return _solve_offset(positions[context], context, models, span)


def make_quaternions_continuous(quaternions: Float[np.ndarray, "T 4"]) -> Float[np.ndarray, "T 4"]:
    """Return the same rotations without sign changes from frame to frame."""
    signs = np.where((quaternions[1:] * quaternions[:-1]).sum(1) < 0, -1.0, 1.0)
    return quaternions * np.cumprod(np.r_[1.0, signs])[:, None]


def _count_context_frames(span: FrameSpan) -> int:
    return max(MIN_CONTEXT_FRAMES, round(OFFSET_CONTEXT_S * span.rate))


def _find_offset_context(is_sound: np.ndarray, span: FrameSpan) -> np.ndarray:
    """Return the sound frames near the span."""
    count = _count_context_frames(span)
    context = np.r_[max(0, span.first - count) : span.first, span.last + 1 : min(len(is_sound), span.last + 1 + count)]
    return context[is_sound[context]]


def _solve_offset(
    known: np.ndarray, context_frames: np.ndarray, models: tuple[OffsetModel, ...], span: FrameSpan
) -> tuple[np.ndarray, float]:
    """Return the corrected samples (n, C) and the variance of the offset, given the samples (N, C) in the context."""
    count, length = _count_context_frames(span), span.last - span.first + 1
    near_edges = np.unique(np.r_[: min(count, length), max(0, length - count) : length])
    return constant_offsets.fit_smoothest_offset(known, context_frames / span.rate, models, span.frames / span.rate, near_edges)
