"""Filling short gaps from the marker's own trajectory: a cubic Hermite spline from edge to edge.

Position and velocity at each edge come from a parabola through several samples, so that one noisy sample beside the gap has
little influence. The spline is then a fixed linear map of these samples. Its error is measured by applying the map to complete
stretches of the same marker.
"""

from functools import cache

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.stats.sequences import find_runs, sample_evenly

SPLINE_CONTEXT_S = 0.06  # time on either side of a gap whose samples determine position and velocity at the edge
MIN_EDGE_SAMPLES = 3  # samples that a parabola requires at each edge
MAX_TRIAL_STRETCHES = 60  # complete stretches on which a map is tested
MIN_TRIAL_STRETCHES = 8  # complete stretches that measuring the error requires
MAX_TRIAL_STARTS = 20_000  # evenly spaced frames that are examined to find complete stretches
MIN_FILL_SD_M = 0.0003  # smallest standard deviation per axis of a fill, and of an estimate of one

GapPattern = tuple[int, tuple[int, ...], tuple[int, ...]]
"""The length of a gap in frames, and which samples before and after it are visible, as distances from its edges."""


def fill_with_splines(
    markers: Float[np.ndarray, "T M 3"], rate: float, max_gap_s: float
) -> tuple[Float[np.ndarray, "T M 3"], Float[np.ndarray, "T M"]]:
    """Return positions of samples in interior gaps in metres, and their standard deviations per axis; NaN elsewhere.

    Gaps with fewer than three visible samples at an edge are not filled, nor gaps for whose length the marker has too few
    complete stretches to measure the error.

    markers    in metres, NaN if not visible or an outlier
    rate       frame rate in Hz
    max_gap_s  duration of the longest gap that is filled
    """
    visible = ~np.isnan(markers[..., 0])
    filled, sd = np.full(markers.shape, np.nan), np.full(visible.shape, np.nan)
    context_count = max(MIN_EDGE_SAMPLES, round(SPLINE_CONTEXT_S * rate))
    for m in np.flatnonzero(~visible.all(0) & visible.any(0)):
        path = np.ascontiguousarray(markers[:, m])
        patterns = group_gap_patterns(visible[:, m], context_count, max_gap_s * rate)
        for (length, before, after), first_frames in patterns.items():
            spline_map = build_hermite_map(length, np.array(before), np.array(after))
            context = np.r_[-1 - np.array(before), length + np.array(after)]
            error = measure_spline_error(path, visible[:, m], spline_map, context)
            if error is not None:
                first = np.array(first_frames)[:, None]
                gap = first + np.arange(length)
                filled[gap, m] = spline_map @ path[first + context]
                sd[gap, m] = np.maximum(error, MIN_FILL_SD_M)
    return filled, sd


def group_gap_patterns(
    is_visible: Bool[np.ndarray, " T"], context_count: int, max_gap_frames: float
) -> dict[GapPattern, list[int]]:
    """Return the first frames of the gaps with enough samples at both edges, by pattern.

    Gaps with the same pattern share a map; flicker causes thousands of gaps with few patterns.
    """
    patterns: dict[GapPattern, list[int]] = {}
    for first, last in find_runs(~is_visible):
        if last - first + 1 > max_gap_frames:
            continue
        before = tuple(np.flatnonzero(is_visible[max(0, first - context_count) : first][::-1]).tolist())
        after = tuple(np.flatnonzero(is_visible[last + 1 : last + 1 + context_count]).tolist())
        if min(len(before), len(after)) >= MIN_EDGE_SAMPLES:
            patterns.setdefault((last - first + 1, before, after), []).append(first)
    return patterns


def build_hermite_map(
    gap_frames: int,
    before: Int[np.ndarray, " B"],
    after: Int[np.ndarray, " A"],
    points: Int[np.ndarray, " P"] | None = None,
) -> Float[np.ndarray, "P BA"]:
    """Return the map from samples before and after a gap, as distances from its edge samples, to those in the gap.

    points  offsets in the gap, from its first frame; None for all of its frames
    """
    s = ((np.arange(gap_frames) if points is None else points) + 1)[:, None] / (gap_frames + 1)

    def map_edge(distances: np.ndarray, s: np.ndarray) -> np.ndarray:
        position, velocity = fit_edge_parabola(tuple(distances.tolist()))
        return (1 + 2 * s) * (1 - s) ** 2 * position + (gap_frames + 1) * s * (1 - s) ** 2 * velocity

    return np.concatenate([map_edge(before, s), map_edge(after, 1 - s)], 1)


@cache
def fit_edge_parabola(distances: tuple[int, ...]) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, " N"]]:
    """Return the maps from samples at N distances (frames) from a gap's edge to position and velocity of a parabola there.

    The velocity is per frame, into the gap.
    """
    steps = np.array(distances)
    parabola = np.linalg.pinv(np.stack([np.ones(len(steps)), -steps, steps**2], 1))
    return parabola[0], parabola[1]


def measure_spline_error(
    path: Float[np.ndarray, "T 3"],
    is_visible: Bool[np.ndarray, " T"],
    spline_map: Float[np.ndarray, "gap N"],
    context_frames: Int[np.ndarray, " N"],
) -> Float[np.ndarray, " gap"] | None:
    """Return the root mean square error of a map in metres per axis on complete stretches, None if there are too few.

    context_frames  frames of the map's samples, relative to the first of the gap
    """
    gap = np.arange(len(spline_map))
    frame_offsets = np.sort(np.concatenate([context_frames, gap]))
    starts = find_complete_stretches(is_visible, frame_offsets, 1 + len(path) // MAX_TRIAL_STARTS)
    if len(starts) < MIN_TRIAL_STRETCHES:
        return None
    starts = starts[sample_evenly(len(starts), MAX_TRIAL_STRETCHES)][:, None]
    errors = path[starts + gap] - spline_map @ path[starts + context_frames]
    return np.sqrt((errors**2).mean((0, 2)))


def find_complete_stretches(
    is_visible: Bool[np.ndarray, " T"], frame_offsets: Int[np.ndarray, " N"], step: int
) -> Int[np.ndarray, " S"]:
    """Return the frames, of every `step`th, for which all frames at the given offsets, which ascend, are visible.

    Consecutive offsets are looked up together, by the number of missing samples before each frame.
    """
    first, stop = -int(frame_offsets[0]), len(is_visible) - int(frame_offsets[-1])
    starts = np.arange(first, stop, step)
    missing_before = np.concatenate([[0], np.cumsum(~is_visible)])
    is_complete = np.ones(len(starts), bool)
    for run in np.split(frame_offsets, np.flatnonzero(np.diff(frame_offsets) > 1) + 1):
        is_complete &= missing_before[starts + run[-1] + 1] == missing_before[starts + run[0]]
    return starts[is_complete]
