"""Filling short gaps from the marker's own path beside them: a cubic Hermite from edge to edge.

Place and velocity at each edge come from a parabola through several samples, so that one noisy sample beside the gap does not
throw the curve. The path across is then a fixed linear map of those samples, and the map is tried out on sound stretches of
the same marker, struck out for the purpose: what it misses there is how sure it is here.
"""

import numpy as np

from mocapfix.take import runs

LISTENED = 0.06  # seconds on either side whose samples make the edge's place and velocity
TRIALS = 60  # sound stretches on which a gap's length is tried
FEWEST = 8  # stretches, fewer of which tell nothing of the error
NOISE = 0.0005  # metres: what a sample itself is off


def splines(markers: np.ndarray, rate: float, longest: float) -> tuple[np.ndarray, np.ndarray]:
    """-> positions (T, M, 3) in metres across interior gaps, NaN elsewhere, and their standard deviation per axis (T, M).

    A gap beside which fewer than three samples in a row are seen is left, as is one for whose length the marker has no
    sound stretches to try it on.

    markers  (T, M, 3) metres, NaN where not believed
    rate     Hz
    longest  seconds: longer gaps are left
    """
    seen = ~np.isnan(markers[..., 0])
    filled, deviation = np.full(markers.shape, np.nan), np.full(seen.shape, np.nan)
    listened = max(3, round(LISTENED * rate))
    for m in np.flatnonzero(~seen.all(0) & seen.any(0)):
        for first, last in runs(~seen[:, m]):
            gap = last - first + 1
            beside = np.r_[first - listened : first, last + 1 : last + 1 + listened]
            if gap > longest * rate or beside[0] < 0 or beside[-1] >= len(seen) or not seen[beside, m].all():
                continue
            across = hermite(gap, listened)
            missed = tried(markers[:, m], seen[:, m], across)
            if missed is not None:
                filled[first : last + 1, m] = across @ markers[beside, m]
                deviation[first : last + 1, m] = np.hypot(missed, NOISE)
    return filled, deviation


def hermite(gap: int, listened: int) -> np.ndarray:
    """-> (gap, 2 listened): the map from the samples on both sides of a gap to those in it, all of them in order."""
    back = np.arange(1 - listened, 1)
    parabola = np.linalg.pinv(np.stack([np.ones(listened), back, back**2], 1))
    place, velocity = parabola[0], parabola[1]  # at the edge, time running into the gap
    span = gap + 1
    s = np.arange(1, gap + 1)[:, None] / span
    before = (1 + 2 * s) * (1 - s) ** 2 * place + span * s * (1 - s) ** 2 * velocity
    return np.concatenate([before, before[::-1, ::-1]], 1)


def tried(path: np.ndarray, seen: np.ndarray, across: np.ndarray) -> np.ndarray | None:
    """-> (gap,) metres per axis: what the map misses on sound stretches of the path (T, 3), root mean square; None without any."""
    gap, listened = across.shape[0], across.shape[1] // 2
    length = gap + 2 * listened
    if len(path) < length:
        return None
    total = np.r_[0, np.cumsum(seen)]
    starts = np.flatnonzero(total[length:] - total[:-length] == length)
    if len(starts) < FEWEST:
        return None
    starts = starts[np.unique(np.linspace(0, len(starts) - 1, TRIALS).astype(int))]
    stretch = path[starts[:, None] + np.arange(length)]
    beside = np.r_[0:listened, length - listened : length]
    missed = stretch[:, listened : listened + gap] - across @ stretch[:, beside]
    return np.sqrt((missed**2).mean((0, 2)))
