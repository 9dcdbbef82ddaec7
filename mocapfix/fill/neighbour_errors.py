"""How well the visible markers are interpolated in the very gap of a lost one.

Stretches of a take in which a marker is visible are often those in which it rests, and a short take has few of them. The markers
that are visible throughout the gap are treated as missing there: they show how the person moves during the gap, and whether
velocities at its edges tell more than positions.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from mocapfix.fill.edge_interpolation import MethodRatios, build_edge_maps, compute_expected_sd
from mocapfix.fill.fill_methods import GapWindow

MAX_RATIO_NEIGHBOURS = 8
"""Number of neighbours, the steadiest first, whose errors are compared with the expected ones."""
COMPARED_ERROR_MARGIN_M = 0.003
"""Length that is added to both errors: smaller ones count as equal."""


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
