"""Filling short gaps from the marker's own path beside them: a cubic Hermite from edge to edge.

Place and velocity at each edge come from a parabola through several samples, so that one noisy sample beside the gap does not
throw the curve. The path across is then a fixed linear map of those samples, and the map is tried out on sound stretches of
the same marker, struck out for the purpose: what it misses there is how sure it is here.
"""

from functools import cache

import numpy as np
from numba import njit

from mocapfix.stats.runs import find_runs

SPLINE_CONTEXT_S = 0.06  # seconds on either side whose samples make the edge's place and velocity
MAX_TRIAL_STRETCHES = 60  # sound stretches on which a gap's length is tried
MIN_TRIAL_STRETCHES = 8  # stretches, fewer of which tell nothing of the error
MAX_TRIAL_STARTS = 20_000  # at most, evenly spread, that are looked at to find sound stretches
MIN_SPLINE_SD_M = 0.0003  # metres: no fill is surer than this

GapPattern = tuple[
    int, tuple[int, ...], tuple[int, ...]
]  # a gap's length, and which samples are seen before and after it, in frames


def fill_with_splines(markers: np.ndarray, rate: float, max_gap_s: float) -> tuple[np.ndarray, np.ndarray]:
    """-> positions (T, M, 3) in metres across interior gaps, NaN elsewhere, and their standard deviation per axis (T, M).

    A gap beside which fewer than three samples are seen is left, as is one for whose length the marker has no
    sound stretches to try it on.

    markers  (T, M, 3) metres, NaN where not believed
    rate     Hz
    longest  seconds: longer gaps are left
    """
    seen = ~np.isnan(markers[..., 0])
    filled, deviation = np.full(markers.shape, np.nan), np.full(seen.shape, np.nan)
    listened = max(3, round(SPLINE_CONTEXT_S * rate))
    for m in np.flatnonzero(~seen.all(0) & seen.any(0)):
        path = np.ascontiguousarray(markers[:, m])
        for (length, before, after), firsts in group_gap_patterns(seen[:, m], listened, max_gap_s * rate).items():
            across = build_hermite_map(length, np.array(before), np.array(after))
            near = np.r_[-1 - np.array(before), length + np.array(after)]
            missed = measure_spline_error(path, seen[:, m], across, near)
            if missed is not None:
                first = np.array(firsts)[:, None]
                gap = first + np.arange(length)
                filled[gap, m] = across @ path[first + near]
                deviation[gap, m] = np.maximum(missed, MIN_SPLINE_SD_M)
    return filled, deviation


def group_gap_patterns(is_visible: np.ndarray, context_frames: int, max_gap_frames: float) -> dict[GapPattern, list[int]]:
    """-> the first frames of the gaps in `seen` (T,) that have samples enough beside them, by kind.

    Gaps of a kind have one map in common: flicker makes thousands of gaps of a few kinds.
    """
    kinds: dict[GapPattern, list[int]] = {}
    for first, last in find_runs(~is_visible):
        if last - first + 1 > max_gap_frames:
            continue
        before = tuple(np.flatnonzero(is_visible[max(0, first - context_frames) : first][::-1]).tolist())
        after = tuple(np.flatnonzero(is_visible[last + 1 : last + 1 + context_frames]).tolist())
        if min(len(before), len(after)) >= 3:
            kinds.setdefault((last - first + 1, before, after), []).append(first)
    return kinds


def build_hermite_map(gap_frames: int, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """-> (gap, B + A): the map from samples so many frames (B,) before and (A,) after the gap's edge samples to those in it."""
    s = np.arange(1, gap_frames + 1)[:, None] / (gap_frames + 1)

    def side(steps: np.ndarray, s: np.ndarray) -> np.ndarray:
        place, velocity = fit_edge_parabola(tuple(steps.tolist()))
        return (1 + 2 * s) * (1 - s) ** 2 * place + (gap_frames + 1) * s * (1 - s) ** 2 * velocity

    return np.concatenate([side(before, s), side(after, 1 - s)], 1)


@cache
def fit_edge_parabola(steps: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """-> the maps (N,) from samples so many frames (N,) before a gap's edge to the parabola's place and velocity there.

    The velocity is that of a frame at a time into the gap.
    """
    away = np.array(steps)
    parabola = np.linalg.pinv(np.stack([np.ones(len(away)), -away, away**2], 1))
    return parabola[0], parabola[1]


def measure_spline_error(
    path: np.ndarray, is_visible: np.ndarray, spline_map: np.ndarray, context_frames: np.ndarray
) -> np.ndarray | None:
    """-> (gap,) metres per axis: what the map misses on sound stretches of the path (T, 3), root mean square.

    None where there are too few. near: the frames that the map listens to, counted from the gap's first.
    """
    gap = np.arange(len(spline_map))
    starts = find_complete_stretches(is_visible, np.r_[context_frames, gap], 1 + len(path) // MAX_TRIAL_STARTS)
    if len(starts) < MIN_TRIAL_STRETCHES:
        return None
    starts = starts[np.unique(np.linspace(0, len(starts) - 1, MAX_TRIAL_STRETCHES).astype(int))][:, None]
    missed = path[starts + gap] - spline_map @ path[starts + context_frames]
    return np.sqrt((missed**2).mean((0, 2)))


@njit(cache=True)
def find_complete_stretches(is_visible, frame_offsets, step):
    """-> the frames, of every `step`th, from which all those `used` (N,), counted from there, are in `seen` (T,)."""
    found, count = np.empty(len(is_visible), np.int64), 0
    for start in range(-frame_offsets.min(), len(is_visible) - frame_offsets.max(), step):
        whole = True
        for frame in frame_offsets:
            if not is_visible[start + frame]:
                whole = False
                break
        if whole:
            found[count] = start
            count += 1
    return found[:count]
