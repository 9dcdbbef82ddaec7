"""Gaussian processes over all markers: missing ones are predicted from frames with a similar body state, and neighbouring ones.

A Gaussian model of the whole marker set given the visible markers (Gloersen & Federolf 2016, "Predicting missing marker
trajectories in human motion data using marker intercorrelations", PLoS ONE 11), extended to a process over the frames that also
uses time and recurrence (`stats.gaussian_process`). Positions are relative to axes fixed to the marker set, dominated by the
trunk. They follow the input markers only, as in the gap nothing else is known. The constants minimise the error on lost limbs of
captures and of CMU's training subjects.
"""

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.fill.edge_interpolation import ACTIVITY_POWER
from mocapfix.fill.gap_windows import FillMethod, Gap, GapEstimate, GapWindow, MarkersInTake, MovingAxes, compute_variation_growth
from mocapfix.stats.gaussian_process import StateCovariance, fit_gaussian_process
from mocapfix.stats.rigid_alignment import CommonShape, align_to_shape, fit_common_shape, transform_to_body_axes
from mocapfix.stats.sequences import sample_evenly, select_training_frames

MAX_SETTLED_SD_M = 0.01
"""Standard deviation of other estimates below which a gap is not filled here, if it holds throughout the gap."""
MAX_INPUT_SD_M = 0.03  # standard deviation of other estimates below which a filled sample is an input, like a visible one
MIN_PROCESS_TRAINING_FRAMES = 8  # frames that learning a gap requires
MIN_INPUT_MARKERS = 4  # markers that the state of the body requires
MIN_SHARED_FRAME_SHARE = 0.5  # share of the frames with the lost markers in which all input markers must be known together
MIN_GAP_PIECE_S = 0.1  # duration above which a gap with too few input markers is divided
FEATURE_MARKER_COUNT = 36  # number of input markers for which the units below are defined
MARKER_VELOCITY_HALF_SPAN_S = 0.067  # time before and after a frame over which velocities are measured
MARKER_POSITION_UNIT_M = 0.9  # difference of positions, over all markers together, that counts as one
MARKER_SPEED_UNIT_M_S = 20.0  # difference of velocities, over all markers together, that counts as one
TRUNK_UP_UNIT = 0.5  # difference of the up direction in trunk axes that counts as one
TRUNK_HEIGHT_UNIT_M = 0.5  # difference of the height of the trunk that counts as one
TRUNK_SPEED_UNIT_M_S = 5.0  # difference of the velocity of the trunk that counts as one
TRUNK_SPIN_UNIT_RAD_S = 20.0  # difference of the angular velocity of the trunk that counts as one
MARKER_FILL_KERNEL = StateCovariance(
    time_scale_s=0.25, similarity_rate=1.2, time_power=0.02, recurrence_power=2.0, linear_power=1.2, noise_power=3e-5
)
"""Covariance of marker positions between frames."""
MIN_LIMB_MARKERS = 3  # markers lost together from which the activity of others says little about them
LIMB_POWER_M2 = 0.15**2  # power per axis of a limb's markers in composed takes of 3 to 30 s of training people
LIMB_POWER_STRETCHES = 0.5  # number of stretches of the gap's length that it counts as: short takes show little of a limb
PROCESS_SAMPLE_NOISE_M = 0.001  # noise of a sample


def select_input_markers(is_known: Bool[np.ndarray, "N M"], candidate_markers: Int[np.ndarray, " C"]) -> Int[np.ndarray, " I"]:
    """Return as many candidates as are known together in MIN_SHARED_FRAME_SHARE of the frames, the most frequent first."""
    by_frequency = candidate_markers[np.argsort(-is_known[:, candidate_markers].sum(0), kind="stable")]
    shared_count = np.logical_and.accumulate(is_known[:, by_frequency], axis=1).sum(0)
    return np.sort(by_frequency[shared_count >= MIN_SHARED_FRAME_SHARE * len(is_known)])


def compute_marker_state_features(
    inputs: Float[np.ndarray, "T I 3"], axes: MovingAxes, frames: Int[np.ndarray, " N"], rate: float
) -> Float[np.ndarray, "N F"]:
    """Return the features of the body's state in some frames, each in units of a difference that counts as one; `inputs` are
    positions of the input markers in the body's axes, in metres.
    """
    rotation, origin = axes.rotation_world_axes, axes.origin
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


MAX_HIDDEN_PROCESS_STRETCHES = 8  # hidden stretches in which the errors of a process are measured
MAX_EDGE_TRAINING_FRAMES = 6  # frames beside each of them on which the process is trained
MAX_COMMON_SHAPE_FRAMES = 1000  # evenly spaced frames from which the common shape of all markers is estimated
MAX_HELD_OUT_SHARE = 0.7  # share of the training frames above which a hidden stretch leaves too few


class MarkerProcesses:
    """Estimates markers by Gaussian processes over all others, one for each gap in which these leave them uncertain.

    The filled samples of other gaps are inputs too.
    """

    def __init__(self, take: MarkersInTake) -> None:
        self.rate, self.is_visible, self.is_common, self.sd = take.rate, take.is_visible, take.is_common, take.estimate.sd.copy()
        self.is_known = self.is_common & (self.is_visible | (self.sd < MAX_INPUT_SD_M))
        self.positions = np.where(self.is_visible[..., None], take.visible_markers, take.estimate.position)
        frames = sample_evenly(len(self.positions), MAX_COMMON_SHAPE_FRAMES)
        self.common_shape = fit_common_shape(np.where(self.is_known[frames, :, None], self.positions[frames], np.nan))
        self._axes_of_inputs: dict[tuple[int, ...], tuple[MovingAxes, np.ndarray, np.ndarray]] = {}
        self._latest: tuple[tuple[int, ...], dict[int, GapEstimate]] = ((), {})

    def __call__(self, gap: Gap) -> list[GapEstimate]:
        w = gap.window
        is_settled = (self.sd[w.gap_frames][:, gap.lost_markers] < MAX_SETTLED_SD_M).all(0)
        uncertain = gap.lost_markers[~is_settled | (gap.lost_markers == gap.marker)]
        key = (w.first, w.length, *uncertain.tolist())
        if key != self._latest[0]:
            self._latest = key, dict(zip(uncertain.tolist(), self.estimate_gap(w, uncertain), strict=False))
        if gap.marker not in self._latest[1]:
            return []
        estimate = self._latest[1][gap.marker]
        growth = gap.activity**ACTIVITY_POWER if len(gap.lost_markers) < MIN_LIMB_MARKERS else 1.0
        return [estimate._replace(expected_sd=estimate.expected_sd * growth)]

    def estimate_gap(self, window: GapWindow, lost_markers: Int[np.ndarray, " L"]) -> list[GapEstimate]:
        """Return the estimates of the markers that are lost throughout a gap; none if too little is visible."""
        w = window
        if not self.is_common[lost_markers].all():
            return []
        position = np.full((w.length, len(lost_markers), 3), np.nan)
        error = np.full((len(w.starts), len(w.points), len(lost_markers), 3), np.nan)
        sd = np.full((w.length, len(lost_markers)), np.nan)
        remaining = [(0, w.length - 1)]
        while remaining:
            begin, end = remaining.pop()
            inputs = self._select_inputs(w.first + begin, w.first + end, lost_markers)
            if len(inputs) < MIN_INPUT_MARKERS and end - begin > MIN_GAP_PIECE_S * self.rate:
                middle = (begin + end) // 2
                remaining += [(begin, middle), (middle + 1, end)]
                continue
            piece = slice(begin, end + 1)
            has_inputs = len(inputs) >= MIN_INPUT_MARKERS
            estimate = self._estimate_piece(w, w.gap_frames[piece], inputs, lost_markers) if has_inputs else None
            if estimate is None:
                return []
            position[piece], sd[piece], error_of_whole = estimate
            error = error_of_whole if end - begin + 1 == w.length else error
        return [
            GapEstimate(FillMethod.GAUSSIAN_PROCESS, position[:, n], error[:, :, n], sd[w.points, n])
            for n in range(len(lost_markers))
        ]

    def _select_inputs(self, first: int, last: int, lost_markers: np.ndarray) -> np.ndarray:
        """Return the markers from which others, lost over first..last, are predicted."""
        is_shown = self.is_visible[:, lost_markers].all(1)
        candidates = np.setdiff1d(np.flatnonzero(self.is_known[first : last + 1].all(0)), lost_markers)
        return select_input_markers(self.is_known[is_shown], candidates) if is_shown.any() else candidates[:0]

    def _get_axes(self, inputs: np.ndarray) -> tuple[MovingAxes, Float[np.ndarray, "T M 3"], Bool[np.ndarray, " T"]]:
        """Return the axes of the input markers, all markers in them, and whether a frame determines them.

        The lost markers do not influence them: in the gap they cannot.
        """
        key = tuple(inputs.tolist())
        if key not in self._axes_of_inputs:
            self._axes_of_inputs.clear()  # consecutive gaps often have the same inputs
            positions, shape = self.positions[:, inputs], CommonShape(*(each[inputs] for each in self.common_shape))
            rotation, origin, is_aligned = align_to_shape(positions, self.is_known[:, inputs], shape)
            local = transform_to_body_axes(self.positions, origin, rotation)
            self._axes_of_inputs[key] = MovingAxes(rotation, origin), local, is_aligned
        return self._axes_of_inputs[key]

    def _estimate_piece(
        self, window: GapWindow, frames: np.ndarray, inputs: np.ndarray, lost_markers: np.ndarray
    ) -> tuple[Float[np.ndarray, "n L 3"], Float[np.ndarray, "n L"], Float[np.ndarray, "K S L 3"]] | None:
        """Return positions in some frames of a gap, their standard deviations, and the errors in hidden stretches."""
        w, (axes, local, is_aligned) = window, self._get_axes(inputs)
        is_usable = is_aligned & self.is_visible[:, lost_markers].all(1) & self.is_known[:, inputs].all(1)
        training = select_training_frames(is_usable, int(frames[0]), int(frames[-1]), self.rate)
        tried = sample_evenly(len(w.starts), MAX_HIDDEN_PROCESS_STRETCHES) if len(w.starts) else np.zeros(0, int)
        beside = w.hidden_context_frames[:, sample_evenly(len(w.before) + len(w.after), MAX_EDGE_TRAINING_FRAMES)]
        added = np.concatenate([w.hidden_frames[tried].ravel(), beside[tried].ravel()])
        training = np.union1d(training, added[is_usable[added]])
        if len(training) < MIN_PROCESS_TRAINING_FRAMES or not is_aligned[frames].all():
            return None
        positions = local[np.ix_(training, lost_markers)].reshape(len(training), -1)
        states = compute_marker_state_features(local[:, inputs], axes, training, self.rate)
        noise = np.full(len(training), PROCESS_SAMPLE_NOISE_M**2)
        process = fit_gaussian_process(positions, states, training / self.rate, noise, MARKER_FILL_KERNEL)
        states = compute_marker_state_features(local[:, inputs], axes, frames, self.rate)
        predicted, relative_variance = process.predict(states, frames / self.rate)
        world = np.einsum("tab,tmb->tma", axes.rotation_world_axes[frames], predicted.reshape(len(frames), -1, 3))
        world += axes.origin[frames, None]
        power = np.fmax(process.measure_gap_errors(len(frames) / self.rate)[0], process.signal_power).reshape(-1, 3).mean(1)
        if len(lost_markers) >= MIN_LIMB_MARKERS:
            share = LIMB_POWER_STRETCHES / (LIMB_POWER_STRETCHES + np.count_nonzero(is_usable) / w.length)
            power = power ** (1 - share) * LIMB_POWER_M2**share
        novelty = compute_variation_growth(is_usable, w.length / self.rate, self.rate)
        sd = np.sqrt(relative_variance[:, None] * power + PROCESS_SAMPLE_NOISE_M**2) * novelty
        error = np.full((len(w.starts), len(w.points), len(lost_markers), 3), np.nan)
        for k in tried if len(frames) == w.length else ():
            held_out = np.flatnonzero((training >= w.starts[k]) & (training < w.starts[k] + w.hidden_length))
            if 0 < len(held_out) <= MAX_HELD_OUT_SHARE * len(training):
                held_frames, hidden_frames = training[held_out], w.hidden_frames[k]
                at = np.minimum(np.searchsorted(held_frames, hidden_frames), len(held_out) - 1)
                held_error, held_variance = process.predict_held_out(held_out)
                scale = np.sqrt(relative_variance[w.points] / held_variance[at])  # from the uncertainty there to that in the gap
                local_error = held_error[at].reshape(len(at), -1, 3) * scale[:, None, None]
                local_error[held_frames[at] != hidden_frames] = np.nan
                error[k] = np.einsum("sab,smb->sma", axes.rotation_world_axes[hidden_frames], local_error)
        shown = ~np.isnan(error).all((1, 2, 3))
        if len(lost_markers) >= MIN_LIMB_MARKERS and shown.any():  # a few stretches of rare motion would outweigh all others
            log_power = np.log(np.nanmean(error[shown] ** 2, axis=(1, 3)) + PROCESS_SAMPLE_NOISE_M**2)
            error[shown] *= np.exp((log_power.mean(0) - log_power) / 4)[:, None, :, None]
        return world, sd, error
