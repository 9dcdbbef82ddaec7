"""Filling from the rest of the body: missing markers predicted from frames with a similar body state and from neighbouring
frames.  A Gaussian model of the whole marker set given the visible markers (Gloersen & Federolf 2016, "Predicting missing marker
trajectories in human motion data using marker intercorrelations", PLoS ONE 11), extended to a process over the frames of the take
that also uses time and recurrence (see `stats.gaussian_process`). Positions are relative to axes fixed to the whole marker set,
dominated by the trunk. The variance is validated: stretches as long as the gap are predicted elsewhere in the take, and the error
there is expected in the gap.  The units and covariances below minimise the error on lost limbs of captures and of CMU's training
subjects."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.stats.gaussian_process import GaussianProcess, StateCovariance, fit_gaussian_process
from mocapfix.stats.rigid_alignment import align_to_common_shape, transform_to_body_axes
from mocapfix.stats.sequences import group_gaps, select_training_frames

MAX_SETTLED_SD_M = 0.01
"""Standard deviation of other estimates below which a gap is not filled here, if it holds throughout the gap."""
MAX_INPUT_SD_M = 0.03
"""Standard deviation of other estimates below which a filled sample is an input, like a visible one."""
MIN_VISIBLE_SHARE = 0.05
"""Share of the frames in which a marker must be visible."""
MIN_PROCESS_TRAINING_FRAMES = 8
"""Frames that learning a gap requires."""
MIN_INPUT_MARKERS = 4
"""Markers that the state of the body requires."""
MIN_SHARED_FRAME_SHARE = 0.5
"""Share of the frames with the lost markers in which all input markers must be known together."""
MIN_GAP_PIECE_S = 0.1
"""Duration above which a gap with too few input markers is divided."""
FEATURE_MARKER_COUNT = 36
"""Number of input markers for which the units below are defined."""
MARKER_VELOCITY_HALF_SPAN_S = 0.067
"""Time before and after a frame over which velocities are measured."""
MARKER_POSITION_UNIT_M = 0.9
"""Difference of positions, over all markers together, that counts as one."""
MARKER_SPEED_UNIT_M_S = 20.0
"""Difference of velocities, over all markers together, that counts as one."""
TRUNK_UP_UNIT = 0.5
"""Difference of the up direction in trunk axes that counts as one."""
TRUNK_HEIGHT_UNIT_M = 0.5
"""Difference of the height of the trunk that counts as one."""
TRUNK_SPEED_UNIT_M_S = 5.0
"""Difference of the velocity of the trunk that counts as one."""
TRUNK_SPIN_UNIT_RAD_S = 20.0
"""Difference of the angular velocity of the trunk that counts as one."""
MARKER_FILL_KERNEL = StateCovariance(
    time_scale_s=0.25, similarity_rate=1.2, time_power=0.02, recurrence_power=2.0, linear_power=1.2, noise_power=3e-5
)
"""Covariance of marker positions between frames."""
PROCESS_SAMPLE_NOISE_M = 0.001
"""Noise of a sample."""


class BodyAxes(NamedTuple):
    """Axes fixed to the marker set: rotation (T, 3, 3) to the world, and origin (T, 3) m."""

    rotation: np.ndarray
    origin: np.ndarray


def fill_from_gaussian_process(
    markers: Float[np.ndarray, "T M 3"],
    other_positions: Float[np.ndarray, "T M 3"],
    other_sd: Float[np.ndarray, "T M"],
    rate: float,
) -> tuple[Float[np.ndarray, "T M 3"], Float[np.ndarray, "T M"]]:
    """Return positions of missing samples in metres, and their standard deviations per axis; NaN elsewhere.

    Gaps that other estimates fill precisely enough are left NaN, as are those with too little visible throughout.

    markers          in metres, Y up, NaN if not visible or an outlier
    other_positions  other estimates of the missing samples, with their standard deviations; NaN without an estimate
    rate             frame rate in Hz
    """
    visible = ~np.isnan(markers[..., 0])
    filled, sd = np.full(markers.shape, np.nan), np.full(visible.shape, np.nan)
    is_common = visible.sum(0) > MIN_VISIBLE_SHARE * len(visible)
    gaps = {
        gap: uncertain
        for gap, lost in group_gaps(~visible & is_common).items()
        if len(uncertain := find_uncertain_markers(other_sd, *gap, lost))
    }
    if not gaps:
        return filled, sd
    is_known = is_common & (visible | (other_sd < MAX_INPUT_SD_M))
    all_positions = np.where(visible[..., None], markers, other_positions)
    rotation, origin, is_aligned = align_to_common_shape(np.where(is_known[..., None], all_positions, np.nan))
    axes = BodyAxes(rotation, origin)
    local = transform_to_body_axes(all_positions, origin, rotation)
    remaining = list(gaps.items())
    while remaining:
        (first, last), lost = remaining.pop()
        is_shown = is_aligned & visible[:, lost].all(1)
        candidates = np.setdiff1d(np.flatnonzero(is_known[first : last + 1].all(0)), lost)
        inputs = select_input_markers(is_known[is_shown], candidates)
        training = select_training_frames(is_shown & is_known[:, inputs].all(1), first, last, rate)
        gap = np.flatnonzero(is_aligned[first : last + 1]) + first
        if len(inputs) < MIN_INPUT_MARKERS and last - first > MIN_GAP_PIECE_S * rate:
            middle = (first + last) // 2
            remaining += [((first, middle), lost), ((middle + 1, last), lost)]
            continue
        if len(training) < MIN_PROCESS_TRAINING_FRAMES or len(inputs) < MIN_INPUT_MARKERS or not len(gap):
            continue
        process = fit_marker_process(local, inputs, lost, axes, training, rate)
        states = compute_marker_state_features(local[:, inputs], axes, gap, rate)
        predicted, relative_variance = process.predict(states, gap / rate)
        power = np.fmax(process.cross_validate_gaps((last - first + 1) / rate), process.signal_power)
        power = power.reshape(-1, 3).mean(1)
        samples = np.ix_(gap, lost)
        world = np.einsum("tab,tmb->tma", rotation[gap], predicted.reshape(len(gap), -1, 3))
        filled[samples] = world + origin[gap, None]
        sd[samples] = np.sqrt(relative_variance[:, None] * power + PROCESS_SAMPLE_NOISE_M**2)
    return filled, sd


def find_uncertain_markers(
    other_sd: Float[np.ndarray, "T M"], first: int, last: int, lost_markers: Int[np.ndarray, " L"]
) -> Int[np.ndarray, " U"]:
    """Return those of the markers lost over first..last that other estimates do not fill precisely throughout."""
    return lost_markers[~(other_sd[first : last + 1, lost_markers] < MAX_SETTLED_SD_M).all(0)]


def select_input_markers(is_known: Bool[np.ndarray, "N M"], candidate_markers: Int[np.ndarray, " C"]) -> Int[np.ndarray, " I"]:
    """Return as many candidates as are known together in MIN_SHARED_FRAME_SHARE of the frames, the most frequent first."""
    by_frequency = candidate_markers[np.argsort(-is_known[:, candidate_markers].sum(0), kind="stable")]
    shared_count = np.logical_and.accumulate(is_known[:, by_frequency], axis=1).sum(0)
    return np.sort(by_frequency[shared_count >= MIN_SHARED_FRAME_SHARE * len(is_known)])


def fit_marker_process(
    local: Float[np.ndarray, "T M 3"],
    input_markers: Int[np.ndarray, " I"],
    lost_markers: Int[np.ndarray, " L"],
    axes: BodyAxes,
    training_frames: Int[np.ndarray, " N"],
    rate: float,
) -> GaussianProcess:
    """Return the process of the lost markers in the body's axes, in metres, given the state of the input markers."""
    positions = local[np.ix_(training_frames, lost_markers)].reshape(len(training_frames), -1)
    states = compute_marker_state_features(local[:, input_markers], axes, training_frames, rate)
    noise = np.full(len(training_frames), PROCESS_SAMPLE_NOISE_M**2)
    return fit_gaussian_process(positions, states, training_frames / rate, noise, MARKER_FILL_KERNEL)


def compute_marker_state_features(
    inputs: Float[np.ndarray, "T I 3"], axes: BodyAxes, frames: Int[np.ndarray, " N"], rate: float
) -> Float[np.ndarray, "N F"]:
    """Return the features of the body's state in some frames, each in units of a difference that counts as one.

    inputs  positions of the input markers in the body's axes, in metres
    """
    rotation, origin = axes
    half_span, last = max(1, round(MARKER_VELOCITY_HALF_SPAN_S * rate)), len(inputs) - 1
    before, after = np.maximum(frames - half_span, 0), np.minimum(frames + half_span, last)
    seconds = ((after - before) / rate + (last == 0))[:, None]
    step = np.swapaxes(rotation[before], 1, 2) @ rotation[after]
    spin = np.stack([step[:, 2, 1] - step[:, 1, 2], step[:, 0, 2] - step[:, 2, 0], step[:, 1, 0] - step[:, 0, 1]], 1) / 2
    displacement = np.einsum("tba,tb->ta", rotation[frames], origin[after] - origin[before])
    scale = np.sqrt(FEATURE_MARKER_COUNT / inputs.shape[1])
    positions = inputs[frames].reshape(len(frames), -1) * (scale / MARKER_POSITION_UNIT_M)
    steps = np.nan_to_num(inputs[after] - inputs[before]).reshape(len(frames), -1)  # 0 where unknown
    velocities = steps * (scale / MARKER_SPEED_UNIT_M_S) / seconds
    trunk = [
        rotation[frames, 1] / TRUNK_UP_UNIT,
        origin[frames, 1:2] / TRUNK_HEIGHT_UNIT_M,
        displacement / seconds / TRUNK_SPEED_UNIT_M_S,
        spin / seconds / TRUNK_SPIN_UNIT_RAD_S,
    ]
    return np.concatenate([positions, velocities, *trunk], axis=1)
