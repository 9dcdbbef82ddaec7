"""Methods that estimate what an animation lacks over a span of frames.

The motion inside a pop or flip is correct but for an offset. It is corrected by the offset for which the signal continues most
smoothly at both edges. Frames with jitter are additional, inaccurate training frames of a Gaussian process over the take.

A lost value is interpolated linearly, or by a Gaussian process in time alone (Matern-5/2) about an unknown mean. A body that is
lost as a whole is interpolated by its world rotations, which vary less than local ones: the legs compensate the motion of the
pelvis. Its bias is estimated from the take: every stretch as long as the gap shows the error that the interpolation would have
there. A Gaussian process over these stretches, with the state of the body at both edges as input, predicts the error in the gap.
"""

from enum import IntEnum
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from mocapfix.animations import offsets
from mocapfix.animations.offsets import OffsetModel
from mocapfix.model.skeleton import compose_transforms, compute_local_rotations
from mocapfix.solve import occluded_joints
from mocapfix.stats.gaussian_process import StateCovariance, compute_matern_52, fit_gaussian_process
from mocapfix.stats.rigid_alignment import multiply_quaternions
from mocapfix.stats.sequences import sample_evenly, select_training_frames


class RepairMethod(IntEnum):
    """How a value was repaired."""

    UNCHANGED = 0
    OFFSET_REMOVED = 1
    JITTER_SMOOTHED = 2
    JOINT_INFERRED = 3
    GAP_INTERPOLATED = 4


REPAIR_DESCRIPTIONS = {
    RepairMethod.UNCHANGED: "",
    RepairMethod.OFFSET_REMOVED: "its own motion, offset removed",
    RepairMethod.JITTER_SMOOTHED: "its own motion, smoothed",
    RepairMethod.JOINT_INFERRED: "frames with a similar body state",
    RepairMethod.GAP_INTERPOLATED: "interpolation across the gap",
}
"""The source of the repaired value, as a phrase for reports."""


class SpanEstimate(NamedTuple):
    """An estimate of L tracks over n frames: rotations (n, L, 3, 3) or positions (n, L, 3), and their variance per axis."""

    method: RepairMethod
    values: np.ndarray
    variance: Float[np.ndarray, "n L"]


class FrameSpan(NamedTuple):
    """The frames first..last of a signal with a given frame rate in Hz."""

    first: int
    last: int
    rate: float

    @property
    def frames(self) -> Int[np.ndarray, " n"]:
        return np.arange(self.first, self.last + 1)


def make_quaternions_continuous(quaternions: Float[np.ndarray, "T 4"]) -> Float[np.ndarray, "T 4"]:
    """Return the same rotations without sign changes from frame to frame."""
    signs = np.where((quaternions[1:] * quaternions[:-1]).sum(1) < 0, -1.0, 1.0)
    return quaternions * np.cumprod(np.r_[1.0, signs])[:, None]


def exclude_span(mask: Bool[np.ndarray, " T"], span: FrameSpan) -> Bool[np.ndarray, " T"]:
    """Return a mask of frames without those of a span."""
    result = mask.copy()
    result[span.frames] = False
    return result


def find_context_frames(is_usable: Bool[np.ndarray, " T"], span: FrameSpan, count: int) -> Int[np.ndarray, " N"]:
    """Return the usable frames among `count` on either side of the span."""
    context = np.r_[max(0, span.first - count) : span.first, span.last + 1 : min(len(is_usable), span.last + 1 + count)]
    return context[is_usable[context]]


QUATERNION_VARIANCE_RATIO = 0.75
"""Variance of a number of twice a quaternion over the variance of the rotation per axis: four numbers for three axes."""
OFFSET_CONTEXT_S = 0.3  # time on either side of each edge over which the smoothness is evaluated
MIN_CONTEXT_FRAMES = 4  # the same in frames, at low frame rates


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

    They have no sign changes. The state of other `joints` is used, in known frames without jitter, which are steady.
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

    The rotation order has the joint's axes of rotation, such as "ZYX".
    """
    inside = make_quaternions_continuous(quaternions[span.first : span.last + 1])
    context = find_context_frames(is_sound, span, _count_context_frames(span))
    known = make_quaternions_continuous(quaternions[context])
    models = offsets.build_rotation_offset_models(inside, rotation_order)
    corrected, variance = _solve_offset(2 * known, context, models, span)
    return corrected / np.linalg.norm(corrected, axis=1, keepdims=True), variance


def remove_position_offset(
    positions: Float[np.ndarray, "T 3"], is_sound: Bool[np.ndarray, " T"], span: FrameSpan
) -> tuple[Float[np.ndarray, "n 3"], float]:
    """Return the root positions over a span without their offset, and its variance in m^2 per axis."""
    context = find_context_frames(is_sound, span, _count_context_frames(span))
    models = offsets.build_position_offset_models(positions[span.first : span.last + 1])
    return _solve_offset(positions[context], context, models, span)


def _count_context_frames(span: FrameSpan) -> int:
    return max(MIN_CONTEXT_FRAMES, round(OFFSET_CONTEXT_S * span.rate))


def _solve_offset(
    known: np.ndarray, context_frames: np.ndarray, models: tuple[OffsetModel, ...], span: FrameSpan
) -> tuple[np.ndarray, float]:
    """Return the corrected samples (n, C) and the variance of the offset, given the samples (N, C) in the context."""
    count, length = _count_context_frames(span), span.last - span.first + 1
    near_edges = np.unique(np.r_[: min(count, length), max(0, length - count) : length])
    return offsets.fit_smoothest_offset(known, context_frames / span.rate, models, span.frames / span.rate, near_edges)


INTERPOLATION_TIMESCALE_S = 0.45  # time scale of the interpolated signals
INTERPOLATION_NOISE_VARIANCE = 1e-4  # variance of a sample relative to the power of the signal
MIN_POWER, POWER_ITERATIONS = 1e-12, 6  # of a signal; in which its power is found beside jitter
MIN_QUATERNION_NORM = 1e-9  # of an interpolated quaternion: a smaller one is no rotation
INTERPOLATION_MEAN_VARIANCE = 100.0  # variance of the mean of a signal relative to its power
INTERPOLATION_CONTEXT_S = 0.6  # time on either side of a gap from which it is interpolated
MAX_TRAINING_STRETCHES = 250  # stretches from which the bias is learned
MIN_TRAINING_STRETCHES = 8  # stretches that learning the bias requires
GAP_BIAS_KERNEL = StateCovariance(
    time_scale_s=1.0, similarity_rate=0.5, time_power=0.0, recurrence_power=1.6, linear_power=0.0, noise_power=0.05
)
"""Covariance of the bias between stretches."""
DISPLACEMENT_UNIT_M = 1.0  # difference of the displacements between the edges that counts as one


class InterpolatedBody(NamedTuple):
    """An interpolated body over n frames: metres, rotations, and variances per axis in m^2 and rad^2."""

    root_position: np.ndarray
    local_rotations: np.ndarray
    root_variance: np.ndarray
    rotation_variance: np.ndarray


class GapBias(NamedTuple):
    """The predicted error of an interpolation over n frames."""

    rotation_vectors: np.ndarray  # (n, J, 3) radians in the axes of the segments
    displacement: np.ndarray  # (n, 3) m in the heading before the gap
    variance_ratio: float  # remaining variance over that of the interpolation


class BodyMotion(NamedTuple):
    """The motion of a body: root (T, 3) m, local and world rotations (T, J, 3, 3), and (T,) the frames in which it is known."""

    root_position: np.ndarray
    local_rotations: np.ndarray
    world_rotations: np.ndarray
    is_known: np.ndarray


def interpolate_body(
    parents: Int[np.ndarray, " J"],
    root_position: Float[np.ndarray, "T 3"],
    local_rotations: Float[np.ndarray, "T J 3 3"],
    is_known: Bool[np.ndarray, " T"],
    span: FrameSpan,
) -> InterpolatedBody:
    """Return the interpolated body over a span, from the frames in which the whole body is known."""
    frame_count, joint_count = local_rotations.shape[:2]
    context = find_context_frames(is_known, span, round(INTERPOLATION_CONTEXT_S * span.rate))
    if not len(context):  # at low rates, or far from the nearest known frames
        known = np.flatnonzero(is_known)
        context = np.r_[known[known < span.first][-1:], known[known > span.last][:1]]
    world_rotations = compose_transforms(parents, np.zeros((frame_count, joint_count, 3)), local_rotations)[1]
    root, root_variance = interpolate_values(root_position[context], context, span)
    length = span.last - span.first + 1
    rotations, rotation_variance = np.empty((length, joint_count, 3, 3)), np.empty((length, joint_count))
    for j in range(joint_count):
        rotations[:, j], rotation_variance[:, j] = interpolate_rotations(world_rotations[context, j], context, span)
    weights = compute_interpolation_weights(context, span)[0]
    motion = BodyMotion(root_position, local_rotations, world_rotations, is_known)
    if bias := predict_gap_bias(motion, weights, context, span):
        correction = Rotation.from_rotvec(bias.rotation_vectors.reshape(-1, 3)).as_matrix()
        rotations = rotations @ correction.reshape(rotations.shape)
        root = root + bias.displacement @ extract_heading(world_rotations[span.first - 1, 0]).T
        root_variance, rotation_variance = root_variance * bias.variance_ratio, rotation_variance * bias.variance_ratio
    return InterpolatedBody(root, compute_local_rotations(rotations, parents), root_variance, rotation_variance)


def compute_interpolation_weights(
    frames: Int[np.ndarray, " N"], span: FrameSpan, noise: Float[np.ndarray, " N"] | float = 0.0
) -> tuple[Float[np.ndarray, "n N"], Float[np.ndarray, " n"]]:
    """Return the weights of known frames in a signal over a span, and its variance relative to the power of the signal.

    `noise` is the variance of known values by jitter, relative to this power.
    """
    covariance = _compute_covariance(frames, span.rate, noise)
    cross = INTERPOLATION_MEAN_VARIANCE + compute_matern_52(
        (span.frames[:, None] - frames) / span.rate, INTERPOLATION_TIMESCALE_S
    )
    weights = np.linalg.solve(covariance, cross.T).T
    variance = INTERPOLATION_MEAN_VARIANCE + 1 - (weights * cross).sum(1)
    return weights, np.maximum(variance, INTERPOLATION_NOISE_VARIANCE)


def interpolate_linearly(
    track: Float[np.ndarray, "T ..."], is_known: Bool[np.ndarray, " T"], span: FrameSpan
) -> Float[np.ndarray, "n ..."]:
    """Return rotations (3, 3), along the shortest arc, or positions (3,) over a span, from the nearest known frames beside it.

    If frames are known on one side only, these are held; there must be any.
    """
    known = np.flatnonzero(is_known)
    ends = np.r_[known[known < span.first][-1:], known[known > span.last][:1]]
    share = ((span.frames - ends[0]) / max(ends[-1] - ends[0], 1)).clip(0, 1)
    if track.ndim == 2:
        return track[ends[0]] + share[:, None] * (track[ends[-1]] - track[ends[0]])
    turn = Rotation.from_matrix(track[ends[0]].T @ track[ends[-1]]).as_rotvec()
    return track[ends[0]] @ Rotation.from_rotvec(share[:, None] * turn).as_matrix()


def interpolate_values(
    known: Float[np.ndarray, "N C"], frames: Int[np.ndarray, " N"], span: FrameSpan, noise_variance: np.ndarray | float = 0.0
) -> tuple[Float[np.ndarray, "n C"], Float[np.ndarray, " n"]]:
    """Return a signal over a span, given its values in known frames with jitter (N,), and its variance per number."""
    power = float(known.var(0).mean()) + MIN_POWER
    for _ in range(POWER_ITERATIONS if np.any(noise_variance) else 1):
        covariance = _compute_covariance(frames, span.rate, noise_variance / power)
        power = float((known * np.linalg.solve(covariance, known)).sum() / known.size) + MIN_POWER
    weights, variance = compute_interpolation_weights(frames, span, noise_variance / power)
    return weights @ known, variance * power


def smooth_own_jitter(track: np.ndarray, is_sound: Bool[np.ndarray, " T"], span: FrameSpan, jitter_sd: float) -> SpanEstimate:
    """Return rotations (T, 1, 3, 3) or positions (T, 1, 3) over a span without jitter, by their own motion alone.

    Those of the root are smoothed so, because the state of the body has both in it.
    """
    is_position, margin = track.ndim == 3, round(INTERPOLATION_CONTEXT_S * span.rate)
    ratio = 1.0 if is_position else QUATERNION_VARIANCE_RATIO
    numbers = track[:, 0] if is_position else 2 * make_quaternions_continuous(Rotation.from_matrix(track[:, 0]).as_quat())
    is_used, parts = is_sound.copy(), list[tuple[np.ndarray, np.ndarray]]()
    is_used[span.frames] = True
    for first in range(span.first, span.last + 1, max(1, margin)):
        part = FrameSpan(first, min(first + max(1, margin) - 1, span.last), span.rate)
        frames = np.arange(max(0, first - margin), min(len(track), part.last + 1 + margin))
        frames = frames[is_used[frames]]
        noise = np.where(is_sound[frames], 0.0, ratio * jitter_sd**2)
        parts.append(interpolate_values(numbers[frames], frames, part, noise))
    smoothed, variance = (np.concatenate(each) for each in zip(*parts, strict=True))
    values = smoothed if is_position else Rotation.from_quat(smoothed).as_matrix()
    return SpanEstimate(RepairMethod.JITTER_SMOOTHED, values[:, None], variance[:, None] / ratio)


def interpolate_rotations(
    rotations: Float[np.ndarray, "N 3 3"], frames: Int[np.ndarray, " N"], span: FrameSpan
) -> tuple[Float[np.ndarray, "n 3 3"], Float[np.ndarray, " n"]]:
    """Return a rotation over a span, given its values in known frames, and its variance in rad^2 per axis."""
    known = 2 * make_quaternions_continuous(Rotation.from_matrix(rotations).as_quat())
    interpolated, variance = interpolate_values(known, frames, span)
    is_undefined = np.linalg.norm(interpolated, axis=1) < MIN_QUATERNION_NORM  # between opposite rotations
    interpolated[is_undefined] = known[:1]
    return Rotation.from_quat(interpolated).as_matrix(), variance * 4 / 3


def predict_gap_bias(
    motion: BodyMotion, weights: Float[np.ndarray, "n N"], context_frames: Int[np.ndarray, " N"], span: FrameSpan
) -> GapBias | None:
    """Return the predicted error of the interpolation with these weights of context frames, None if it cannot be learned."""
    length = span.last - span.first + 1
    half_span = max(1, round(occluded_joints.VELOCITY_HALF_SPAN_S * span.rate))
    offsets = context_frames - span.first
    required = np.unique(np.r_[offsets, -1 - 2 * half_span, length + 2 * half_span, np.arange(-1, length + 1)])
    starts = np.arange(-required.min(), len(motion.root_position) - required.max())
    starts = starts[[bool(motion.is_known[start + required].all()) for start in starts]]
    has_edges = 2 * half_span < span.first < len(motion.root_position) - length - 2 * half_span
    if len(starts) < MIN_TRAINING_STRETCHES or not has_edges:
        return None
    starts = starts[sample_evenly(len(starts), MAX_TRAINING_STRETCHES)]
    biases = np.array([_measure_gap_bias(motion, weights, offsets, start, length) for start in starts.tolist()])
    features = compute_edge_features(motion, np.r_[starts, span.first], length, half_span, span.rate)
    no_time = np.zeros(len(starts))
    process = fit_gaussian_process(biases, features[:-1], no_time, no_time, GAP_BIAS_KERNEL)
    predicted, variance = process.predict(features[-1:], np.zeros(1))
    bias = predicted.reshape(length, -1, 3)
    variance_ratio = float(variance[0] / (GAP_BIAS_KERNEL.recurrence_power + GAP_BIAS_KERNEL.noise_power))
    return GapBias(bias[:, :-1], bias[:, -1], variance_ratio)


def compute_edge_features(
    motion: BodyMotion, start_frames: Int[np.ndarray, " S"], length: int, half_span: int, rate: float
) -> Float[np.ndarray, "S F"]:
    """Return the state features at both edges of stretches, and the displacement and rotation of the root between the edges.

    A stretch has `length` frames, and `half_span` frames are between it and the states at its edges.
    """
    before, after = start_frames - 1 - half_span, start_frames + length + half_span
    root_position, local_rotations = motion.root_position, motion.local_rotations
    joints = np.arange(1, local_rotations.shape[1])
    world_to_heading = np.swapaxes(extract_heading(local_rotations[before, 0]), -1, -2)
    displacement = (world_to_heading @ (root_position[after] - root_position[before])[..., None])[..., 0] / DISPLACEMENT_UNIT_M
    rotation = np.swapaxes(local_rotations[before, 0], -1, -2) @ local_rotations[after, 0]
    states = [
        occluded_joints.compute_joint_state_features(root_position, local_rotations, joints, frames, rate)
        for frames in (before, after)
    ]
    return np.concatenate([*states, displacement, rotation.reshape(len(start_frames), 9) / np.sqrt(2)], axis=1)


def extract_heading(rotations: Float[np.ndarray, "*batch 3 3"]) -> Float[np.ndarray, "*batch 3 3"]:
    """Return the rotations about the vertical that bring Z below the direction to which the given rotations bring it."""
    angle = np.arctan2(rotations[..., 0, 2], rotations[..., 2, 2])
    return Rotation.from_euler("y", angle.reshape(-1, 1)).as_matrix().reshape(rotations.shape)


def _compute_covariance(frames: np.ndarray, rate: float, noise: np.ndarray | float = 0.0) -> np.ndarray:
    """Return the covariance (N, N) of a signal's samples relative to its power."""
    return (
        INTERPOLATION_MEAN_VARIANCE
        + compute_matern_52((frames[:, None] - frames) / rate, INTERPOLATION_TIMESCALE_S)
        + (INTERPOLATION_NOISE_VARIANCE + noise) * np.eye(len(frames))
    )


def _measure_gap_bias(
    motion: BodyMotion, weights: np.ndarray, context_offsets: np.ndarray, start: int, length: int
) -> np.ndarray:
    """Return the error (n * (J + 1) * 3,) of the interpolation over a known stretch of `length` frames."""
    root_position, world_rotations = motion.root_position, motion.world_rotations
    frames, context_count = np.r_[start + context_offsets, start : start + length], len(context_offsets)
    quaternions = Rotation.from_matrix(world_rotations[frames].reshape(-1, 3, 3)).as_quat()
    quaternions = quaternions.reshape(-1, world_rotations.shape[1], 4)
    signs = np.where((quaternions[1:] * quaternions[:-1]).sum(-1, keepdims=True) < 0, -1.0, 1.0)
    context, actual = quaternions[:context_count].copy(), quaternions[context_count:]
    context[1:] *= np.cumprod(signs[: context_count - 1], axis=0)
    interpolated = np.einsum("gn,njc->gjc", weights, context)
    interpolated /= np.linalg.norm(interpolated, axis=-1, keepdims=True)
    error = multiply_quaternions(interpolated * [-1, -1, -1, 1], actual)
    rotation_vectors = 2 * error[..., :3] * np.where(error[..., 3:] < 0, -1.0, 1.0)
    displacement = root_position[start : start + length] - weights @ root_position[start + context_offsets]
    displacement = displacement @ extract_heading(world_rotations[start - 1, 0])
    return np.concatenate([rotation_vectors.reshape(length, -1), displacement], axis=1).ravel()
