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
SURE = 0.0003  # metres: no fill is surer than this


def splines(markers: np.ndarray, rate: float, longest: float) -> tuple[np.ndarray, np.ndarray]:
    """-> positions (T, M, 3) in metres across interior gaps, NaN elsewhere, and their standard deviation per axis (T, M).

    A gap beside which fewer than three samples are seen is left, as is one for whose length the marker has no
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
            before = np.flatnonzero(seen[max(0, first - listened) : first, m][::-1])
            after = np.flatnonzero(seen[last + 1 : last + 1 + listened, m])
            gap = np.arange(first, last + 1)
            if len(gap) > longest * rate or min(len(before), len(after)) < 3:
                continue
            across = hermite(len(gap), before, after)
            near = np.r_[-1 - before, len(gap) + after]
            missed = tried(markers[:, m], seen[:, m], across, near)
            if missed is not None:
                filled[gap, m] = across @ markers[first + near, m]
                deviation[gap, m] = np.maximum(missed, SURE)
    return filled, deviation


def hermite(gap: int, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """-> (gap, B + A): the map from samples so many frames (B,) before and (A,) after the gap's edge samples to those in it."""
    s = np.arange(1, gap + 1)[:, None] / (gap + 1)

    def side(steps, s):
        parabola = np.linalg.pinv(np.stack([np.ones(len(steps)), -steps, steps**2], 1))
        place, velocity = parabola[0], parabola[1]  # at the edge, a frame at a time into the gap
        return (1 + 2 * s) * (1 - s) ** 2 * place + (gap + 1) * s * (1 - s) ** 2 * velocity

    return np.concatenate([side(before, s), side(after, 1 - s)], 1)


def tried(path: np.ndarray, seen: np.ndarray, across: np.ndarray, near: np.ndarray) -> np.ndarray | None:
    """-> (gap,) metres per axis: what the map misses on sound stretches of the path (T, 3), root mean square.

    None where there are too few. near: the frames that the map listens to, counted from the gap's first.
    """
    gap = np.arange(len(across))
    used = np.r_[near, gap]
    starts = np.arange(-used.min(), len(path) - used.max())
    for frame in used:
        starts = starts[seen[starts + frame]]
    if len(starts) < FEWEST:
        return None
    starts = starts[np.unique(np.linspace(0, len(starts) - 1, TRIALS).astype(int))][:, None]
    missed = path[starts + gap] - across @ path[starts + near]
    return np.sqrt((missed**2).mean((0, 2)))
