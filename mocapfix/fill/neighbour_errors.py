"""How well the visible markers are interpolated in the very gap of a lost one.

Stretches of a take in which a marker is visible are often those in which it rests, and a short take has few of them. The markers
that are visible throughout the gap are treated as missing there: they show how the person moves during the gap, and whether
velocities at its edges help.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from mocapfix.fill.edge_interpolation import MethodRatios, build_edge_maps, compute_expected_sd
from mocapfix.fill.fill_methods import GapWindow

MAX_RATIO_NEIGHBOURS = 8
"""Number of neighbours, the steadiest first, whose errors are compared with the expected ones."""
COMPARED_ERROR_MARGIN_M = 0.001
"""Length that is added to both errors: smaller ones count as equal."""
VELOCITY_SPAN_S = 0.1
"""Time over which speeds are measured."""
MIN_COMPARED_SPEED_M_S = 0.02
"""Speed below which neighbours count as equally at rest."""
MIN_COMPARED_STEPS = 5
"""Steps in which a neighbour must be visible while the marker is."""
MIN_KNOWN_GAP_SHARE = 0.8
"""Share of a gap in which a neighbour must be visible."""
MAX_ACTIVITY_RATIO = 30.0
"""Largest ratio of the neighbours' speeds."""


class NeighbourActivity:
    """The speeds of all markers, which show whether a marker is visible mainly while the person rests.

    markers  in metres, NaN if not visible
    rate     frame rate in Hz
    """

    def __init__(self, markers: Float[np.ndarray, "T M 3"], rate: float) -> None:
        self.lag = min(max(1, round(VELOCITY_SPAN_S * rate)), max(1, len(markers) - 1))
        square = (((markers[self.lag :] - markers[: -self.lag]) * (rate / self.lag)) ** 2).sum(-1)
        self.is_known, self.square = ~np.isnan(square), np.nan_to_num(square)
        self.is_visible = ~np.isnan(markers[self.lag // 2 :, :, 0][: len(square)])
        self._square_with_marker: dict[int, np.ndarray] = {}

    def compare(self, marker: int, window: GapWindow, neighbours: Int[np.ndarray, " N"]) -> float:
        """Return how many times as fast neighbours are in a gap as while the marker is visible, at least one.

        neighbours  the steadiest first
        """
        if not len(self.square):
            return 1.0
        first = min(max(0, window.first - self.lag // 2), len(self.square) - 1)
        steps = slice(first, max(first + 1, window.first + window.length - self.lag // 2))
        in_gap = self._average(neighbours, self.square[steps][:, neighbours], self.is_known[steps][:, neighbours])
        with_marker = self._compute_squares_with(marker)[neighbours]
        both = np.stack([in_gap, with_marker])[:, ~np.isnan(in_gap + with_marker)][:, :MAX_RATIO_NEIGHBOURS]
        if not both.size:
            return 1.0
        difference = np.diff(np.log(both + MIN_COMPARED_SPEED_M_S**2), axis=0).mean()
        return float(np.exp(np.clip(-difference / 2, 0, np.log(MAX_ACTIVITY_RATIO))))

    @staticmethod
    def _average(neighbours: np.ndarray, square: np.ndarray, is_known: np.ndarray) -> np.ndarray:
        mean = np.full(len(neighbours), np.nan)
        return np.divide(square.sum(0), is_known.sum(0), out=mean, where=is_known.mean(0) > MIN_KNOWN_GAP_SHARE)

    def _compute_squares_with(self, marker: int) -> np.ndarray:
        """Return the mean square speed of all markers while one is visible; NaN where unknown."""
        if marker not in self._square_with_marker:
            weight = self.is_visible[:, marker].astype(float)
            count = weight @ self.is_known
            mean = np.full(len(count), np.nan)
            np.divide(weight @ self.square, count, out=mean, where=count >= MIN_COMPARED_STEPS)
            self._square_with_marker[marker] = mean
        return self._square_with_marker[marker]


class NeighbourErrors(NamedTuple):
    """The errors of K methods for M markers in one gap.

    log_ratio  (K, M) logarithms of the errors relative to that expected of the straight method; NaN where a marker is not visible
    """

    log_ratio: np.ndarray

    def compute_ratios(self, neighbours: Int[np.ndarray, " N"]) -> MethodRatios | None:
        """Return the mean ratios of some markers, the steadiest first; None if none of them is visible.

        neighbours  markers in descending order of how constant their distance to the lost one is
        """
        known = neighbours[~np.isnan(self.log_ratio[:, neighbours]).any(0)][:MAX_RATIO_NEIGHBOURS]
        return MethodRatios(self.log_ratio[:, known].mean(1), len(known)) if len(known) else None


def measure_neighbour_errors(
    markers: Float[np.ndarray, "T M 3"], window: GapWindow, rate: float, velocity_sd: Float[np.ndarray, " M"]
) -> NeighbourErrors:
    """Return the errors of the markers that are visible at the points of a gap and beside it.

    markers      in metres, NaN if not visible
    velocity_sd  variation of each marker's velocity in m/s
    """
    w = window
    maps = np.stack(build_edge_maps(w.before, w.after, w.length, w.points, rate))
    error = np.einsum("kpc,cma->kpma", maps, markers[w.context_frames]) - markers[w.first + w.points]
    size = np.sqrt((error**2).sum(-1).mean(1))
    expected = np.sqrt(3 * (compute_expected_sd(w, rate, 1.0, None) ** 2).mean()) * velocity_sd
    return NeighbourErrors(np.log((size + COMPARED_ERROR_MARGIN_M) / (expected + COMPARED_ERROR_MARGIN_M)))
