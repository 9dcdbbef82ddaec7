"""How a marker moves at the edges of a gap: at rest or not. Hidden stretches with a similar motion tell most about a gap."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from mocapfix.fill.fill_methods import GapWindow

RESTING_SPEED_M_S = 0.02
"""Speed that is added to all, below which markers count as equally at rest."""
MAX_EDGE_SPEED_SHARE = 0.5
"""Exponent of the speed at the edges in the expected speed within a short gap; the marker's usual speed has the rest."""
REST_TIME_S = 5.0
"""Time in which this share decays."""
SIMILAR_SPEED_RATIO = 2.0
"""Ratio of the speeds of a gap and a stretch at which the stretch has the weight of one standard deviation, 0.61."""


class EdgeMotion(NamedTuple):
    """The motion of a marker beside a gap.

    speed_m_s   mean of the speeds before, across and after the gap, and RESTING_SPEED_M_S; None without two edges
    similarity  (K,) of each hidden stretch to the gap, 0 to 1
    """

    speed_m_s: float | None
    similarity: Float[np.ndarray, " K"]

    def estimate_speed_in_gap(self, usual_speed_m_s: float, gap_s: float) -> float:
        """Return the speed in m/s that is expected within a gap: the longer it is, the less the edges show of it."""
        if self.speed_m_s is None:
            return usual_speed_m_s
        edge_share = MAX_EDGE_SPEED_SHARE * np.exp(-gap_s / REST_TIME_S)
        return float(usual_speed_m_s ** (1 - edge_share) * self.speed_m_s**edge_share)


def compare_edge_motion(path: Float[np.ndarray, "T 3"], window: GapWindow, rate: float) -> EdgeMotion:
    """Return the motion of a marker beside a gap and the similarity of the hidden stretches.

    path  in metres, NaN if not visible
    """
    w = window
    if not len(w.before) or not len(w.after):
        return EdgeMotion(None, np.ones(len(w.starts)))
    frames = np.array([[w.before[0], w.before[-1], w.after[0], w.after[-1]]])
    hidden = np.array([w.before[0], w.before[-1], w.hidden_after[0], w.hidden_after[-1]])
    speed = _measure_speed(path[w.first + frames], frames[0], rate)
    hidden_speeds = _measure_speed(path[w.starts[:, None] + hidden], hidden, rate)
    difference = np.log(hidden_speeds / speed) / np.log(SIMILAR_SPEED_RATIO)
    return EdgeMotion(float(speed[0]), np.exp(-0.5 * np.nan_to_num(difference, nan=np.inf) ** 2))


def _measure_speed(edges: Float[np.ndarray, "N 4 3"], offsets: Int[np.ndarray, "4"], rate: float) -> Float[np.ndarray, " N"]:
    """Return the mean speed in m/s before, across and after a gap, from the positions at four offsets in frames."""
    seconds = np.maximum(np.diff(offsets), 1) / rate
    return (np.linalg.norm(np.diff(edges, axis=1), axis=-1) / seconds).mean(1) + RESTING_SPEED_M_S
