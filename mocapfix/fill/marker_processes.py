"""Gaussian processes over all markers (see `gaussian_process_fill`), with their errors in hidden stretches.

The axes of a gap follow its input markers only, as in the gap nothing else is known.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from mocapfix.fill.edge_interpolation import compute_variation_growth
from mocapfix.fill.fill_methods import FillMethod, GapEstimate, GapWindow
from mocapfix.fill.gaussian_process_fill import (
    MAX_INPUT_SD_M,
    MIN_GAP_PIECE_S,
    MIN_INPUT_MARKERS,
    MIN_PROCESS_TRAINING_FRAMES,
    MIN_VISIBLE_SHARE,
    PROCESS_SAMPLE_NOISE_M,
    BodyAxes,
    compute_marker_state_features,
    fit_marker_process,
    select_input_markers,
)
from mocapfix.stats.gaussian_process import GaussianProcess, HeldOutPrediction
from mocapfix.stats.rigid_alignment import align_to_shape, fit_common_shape, transform_to_body_axes
from mocapfix.stats.sequences import sample_evenly, select_training_frames

MAX_HIDDEN_PROCESS_STRETCHES = 8
"""Hidden stretches in which the errors of a process are measured."""
MAX_EDGE_TRAINING_FRAMES = 6
"""Frames beside each of them on which the process is trained."""
MAX_HELD_OUT_SHARE = 0.7
"""Share of the training frames above which a hidden stretch leaves too few."""


class MarkerProcesses:
    """The Gaussian processes of a take, one for each gap that is estimated.

    markers          in metres, Y up, NaN if not visible or an outlier
    other_positions  other estimates of the missing samples, with their standard deviations; NaN without an estimate
    rate             frame rate in Hz
    """

    def __init__(
        self,
        markers: Float[np.ndarray, "T M 3"],
        other_positions: Float[np.ndarray, "T M 3"],
        other_sd: Float[np.ndarray, "T M"],
        rate: float,
    ) -> None:
        self.rate, self.is_visible = rate, ~np.isnan(markers[..., 0])
        self.is_common = self.is_visible.sum(0) > MIN_VISIBLE_SHARE * len(markers)
        self.is_known = self.is_common & (self.is_visible | (other_sd < MAX_INPUT_SD_M))
        self.positions = np.where(self.is_visible[..., None], markers, other_positions)
        self.common_shape = fit_common_shape(np.where(self.is_known[..., None], self.positions, np.nan))
        self._axes_of_inputs: dict[tuple[int, ...], _InputAxes] = {}

    def estimate_gap(self, window: GapWindow, lost_markers: Int[np.ndarray, " L"]) -> list[GapEstimate] | None:
        """Return the estimates of the markers that are lost throughout a gap; None if too little is visible."""
        w = window
        if not self.is_common[lost_markers].all():
            return None
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
            estimate = (
                self._estimate_piece(w, w.gap_frames[piece], inputs, lost_markers) if len(inputs) >= MIN_INPUT_MARKERS else None
            )
            if estimate is None:
                return None
            position[piece], sd[piece] = estimate.position, estimate.sd
            if end - begin + 1 == w.length:
                error = estimate.error
        return [
            GapEstimate(FillMethod.GAUSSIAN_PROCESS, position[:, n], error[:, :, n], sd[w.points, n])
            for n in range(len(lost_markers))
        ]

    def _select_inputs(self, first: int, last: int, lost_markers: np.ndarray) -> np.ndarray:
        """Return the markers from which others, lost over first..last, are predicted."""
        is_shown = self.is_visible[:, lost_markers].all(1)
        candidates = np.setdiff1d(np.flatnonzero(self.is_known[first : last + 1].all(0)), lost_markers)
        return select_input_markers(self.is_known[is_shown], candidates) if is_shown.any() else candidates[:0]

    def _get_axes(self, inputs: np.ndarray) -> "_InputAxes":
        """Return the axes of the input markers. The lost markers do not influence them: in the gap they cannot."""
        key = tuple(inputs.tolist())
        if key not in self._axes_of_inputs:
            self._axes_of_inputs.clear()  # consecutive gaps often have the same inputs
            positions = self.positions[:, inputs]
            rotation, origin, is_aligned = align_to_shape(positions, self.is_known[:, inputs], self.common_shape.select(inputs))
            local = transform_to_body_axes(self.positions, origin, rotation)
            self._axes_of_inputs[key] = _InputAxes(BodyAxes(rotation, origin), local, is_aligned)
        return self._axes_of_inputs[key]

    def _estimate_piece(
        self, window: GapWindow, frames: np.ndarray, inputs: np.ndarray, lost_markers: np.ndarray
    ) -> "_PieceEstimate | None":
        """Return the estimate of some frames of a gap."""
        w, (axes, local, is_aligned) = window, self._get_axes(inputs)
        is_usable = is_aligned & self.is_visible[:, lost_markers].all(1) & self.is_known[:, inputs].all(1)
        training = select_training_frames(is_usable, int(frames[0]), int(frames[-1]), self.rate)
        tried = sample_evenly(len(w.starts), MAX_HIDDEN_PROCESS_STRETCHES) if len(w.starts) else np.zeros(0, int)
        beside = w.hidden_context_frames[:, sample_evenly(len(w.before) + len(w.after), MAX_EDGE_TRAINING_FRAMES)]
        added = np.concatenate([w.hidden_frames[tried].ravel(), beside[tried].ravel()])
        training = np.union1d(training, added[is_usable[added]])
        if len(training) < MIN_PROCESS_TRAINING_FRAMES or not is_aligned[frames].all():
            return None
        process = fit_marker_process(local, inputs, lost_markers, axes, training, self.rate)
        states = compute_marker_state_features(local[:, inputs], axes, frames, self.rate)
        predicted, relative_variance = process.predict(states, frames / self.rate)
        world = (
            np.einsum("tab,tmb->tma", axes.rotation[frames], predicted.reshape(len(frames), -1, 3)) + axes.origin[frames, None]
        )
        power = np.fmax(process.cross_validate_gaps(len(frames) / self.rate), process.signal_power).reshape(-1, 3).mean(1)
        novelty = compute_variation_growth(is_usable, w.length / self.rate, self.rate)
        sd = np.sqrt(relative_variance[:, None] * power + PROCESS_SAMPLE_NOISE_M**2) * novelty
        error = np.full((len(w.starts), len(w.points), len(lost_markers), 3), np.nan)
        if len(frames) == w.length:
            for k in tried:
                hidden = self._hold_out(process, training, int(w.starts[k]), w.hidden_length)
                error[k] = self._compute_hidden_error(hidden, training, w.hidden_frames[k], relative_variance[w.points], axes)
        return _PieceEstimate(world, sd, error)

    @staticmethod
    def _hold_out(process: GaussianProcess, training: np.ndarray, first: int, length: int) -> HeldOutPrediction | None:
        """Return the prediction of the training frames in a stretch from the others; None if these are too few."""
        indices = np.flatnonzero((training >= first) & (training < first + length))
        return process.predict_held_out(indices) if 0 < len(indices) <= MAX_HELD_OUT_SHARE * len(training) else None

    @staticmethod
    def _compute_hidden_error(
        hidden: HeldOutPrediction | None, training: np.ndarray, frames: np.ndarray, relative_variance: np.ndarray, axes: BodyAxes
    ) -> np.ndarray:
        """Return the errors (S, L, 3) in the world at some frames of a stretch, increased to the uncertainty in the gap."""
        if hidden is None:
            return np.array(np.nan)
        held_frames = training[hidden.indices]
        at = np.minimum(np.searchsorted(held_frames, frames), len(held_frames) - 1)
        inflation = np.sqrt(np.maximum(relative_variance / hidden.relative_variance[at], 1.0))
        error = hidden.error[at].reshape(len(frames), -1, 3) * inflation[:, None, None]
        error[held_frames[at] != frames] = np.nan
        return np.einsum("sab,smb->sma", axes.rotation[frames], error)


class _InputAxes(NamedTuple):
    """The axes of some input markers, all markers in them (T, M, 3), and whether a frame determines them (T,)."""

    axes: BodyAxes
    local: np.ndarray
    is_aligned: np.ndarray


class _PieceEstimate(NamedTuple):
    """Positions (n, L, 3) and standard deviations (n, L) in a piece of a gap, and errors (K, S, L, 3) in hidden stretches."""

    position: np.ndarray
    sd: np.ndarray
    error: np.ndarray
