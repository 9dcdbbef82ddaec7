"""Estimates from a marker's own trajectory: splines through short gaps, and lines or splines between the edges of any gap.

Each is a linear map from the samples beside a gap to positions in it, so that it can be applied to many hidden stretches at once.
A marker at rest is interpolated exactly in the world, one on a rigid body exactly in axes that move with this body.

Position and velocity at each edge of a spline come from a parabola through several samples, so that one noisy sample beside the
gap has little influence. `fill_with_splines` fills the many short gaps of a take at once, without other estimates; its error is
measured by applying the map to complete stretches of the same marker.
"""

from functools import cache

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.fill.gap_windows import (
    CLUSTER_SATURATION_S,
    MIN_FILL_SD_M,
    FillMethod,
    Gap,
    GapEstimate,
    GapWindow,
    MarkersInTake,
    MovingAxes,
    compute_variation_growth,
)
from mocapfix.model.take import SAMPLE_NOISE_M
from mocapfix.stats.sequences import find_runs, sample_evenly

SPLINE_CONTEXT_S = 0.06  # time on either side of a gap whose samples determine position and velocity at the edge
MIN_EDGE_SAMPLES = 3  # samples that a parabola requires at each edge
MAX_TRIAL_STRETCHES = 60  # complete stretches on which a map is tested
MIN_TRIAL_STRETCHES = 8  # complete stretches that measuring the error requires
MAX_TRIAL_STARTS = 20_000  # evenly spaced frames that are examined to find complete stretches

GapPattern = tuple[int, tuple[int, ...], tuple[int, ...]]
"""The length of a gap in frames, and which samples before and after it are visible, as distances from its edges."""


def fill_with_splines(
    markers: Float[np.ndarray, "T M 3"], rate: float, max_gap_s: float
) -> tuple[Float[np.ndarray, "T M 3"], Float[np.ndarray, "T M"]]:
    """Return positions of samples in interior gaps in metres, and their standard deviations per axis; NaN elsewhere.

    Gaps with fewer than three visible samples at an edge are not filled, nor gaps for whose length the marker has too few
    complete stretches to measure the error.

    Args:
        markers: In metres, NaN if not visible or an outlier.
        max_gap_s: Duration of the longest gap that is filled.
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
    gap_frames: int, before: Int[np.ndarray, " B"], after: Int[np.ndarray, " A"], points: Int[np.ndarray, " P"] | None = None
) -> Float[np.ndarray, "P BA"]:
    """Return the map from samples before and after a gap, as distances from its edge samples, to those in all of its frames, or
    at `points`, offsets from its first frame.
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

    Args:
        context_frames: Frames of the map's samples, relative to the first of the gap.
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


WORLD_ERROR_RATIO = 0.155
"""Expected error of the straight line in the world, relative to the path of the marker's varying velocity in a gap of 1 s."""
WORLD_ERROR_GROWTH = 1.1  # power of the gap's duration with which this error grows
CLUSTER_ERROR_RATIO = 1.2  # expected error of the straight line in moving axes, relative to the marker's variation in them
CLUSTER_ERROR_TIME_S = 0.5  # duration of a gap for which it holds; the error grows with the square root of the duration
MAX_CLUSTER_ERROR_GROWTH = 2.0  # largest growth of this error with the duration
SPLINE_ERROR_TIME_S = 1.0  # duration of a gap in which the expected error of the spline is twice that of the straight line
ACTIVITY_POWER = 0.5  # power with which the motion relative to neighbours grows with their own
ONE_EDGE_ERROR_RATIO = 2.0  # expected error in a gap with one edge, relative to a gap with two
WORLD_SATURATION_S = 0.8
"""Duration above which errors in the world no longer grow with it, where stretches shorter than the gap are scaled."""
SPLINE_ERROR_GROWTH = 2.0  # power of the duration, until then, with which the errors of a spline grow; 1 for a line


class WorldInterpolation:
    """Estimates a marker from its own trajectory, in the world."""

    def __init__(self, take: MarkersInTake) -> None:
        self.take = take

    def __call__(self, gap: Gap) -> list[GapEstimate]:
        path, rate, gap_s = self.take.markers[:, gap.marker], self.take.rate, gap.window.length / self.take.rate
        line_sd_m = WORLD_ERROR_RATIO * gap.speed_m_s * gap.activity * gap_s**WORLD_ERROR_GROWTH
        return _interpolate(path, gap.window, rate, line_sd_m, WORLD_SATURATION_S, "world")


def interpolate_in_axes(path: Float[np.ndarray, "T 3"], axes: MovingAxes, gap: Gap, rate: float, name: str) -> list[GapEstimate]:
    """Return the estimates between the edges of a gap in moving axes, none if the axes are known at neither edge.

    Args:
        path: Metres in the world, NaN if not visible.
        axes: The axes in which the path is interpolated.
        rate: Frame rate in Hz.
    """
    w, gap_s, local = gap.window, gap.window.length / rate, axes.transform_from_world(path)
    shown = local[~np.isnan(local[:, 0])]
    if not len(shown):
        return []
    variation_m = float(np.sqrt(((shown - shown.mean(0)) ** 2).mean())) * gap.activity**ACTIVITY_POWER
    variation_m *= compute_variation_growth(~np.isnan(path[:, 0]), gap_s, rate)
    line_sd_m = CLUSTER_ERROR_RATIO * variation_m * min(np.sqrt(gap_s / CLUSTER_ERROR_TIME_S), MAX_CLUSTER_ERROR_GROWTH)
    return [
        each._replace(
            method=FillMethod.CLUSTER,
            position=axes.transform_to_world(each.position, w.gap_frames),
            error=axes.rotate_to_world(each.error, w.hidden_frames),
        )
        for each in _interpolate(local, w, rate, line_sd_m, CLUSTER_SATURATION_S, name)
    ]


def _interpolate(
    path: Float[np.ndarray, "T 3"], window: GapWindow, rate: float, line_sd_m: float, saturation_s: float, name: str
) -> list[GapEstimate]:
    """Return the estimates between the edges of a gap, on a line and on a spline, in the axes in which the path is given.

    Args:
        path: Metres, NaN if unknown.
        rate: Frame rate in Hz.
        line_sd_m: Expected standard deviation of the line per axis, in the middle of the gap.
        saturation_s: Duration above which errors no longer grow with it.
    """
    w = window.keep_known_context(~np.isnan(path[:, 0]))
    if not len(w.context_frames):
        return []
    line_sd, saturation = shape_expected_sd(w, line_sd_m), saturation_s * rate
    growth = w.length / w.hidden_length * (saturation + w.hidden_length) / (saturation + w.length)
    methods = [(FillMethod.LINE, build_line_map, line_sd, growth)]
    if min(len(w.before), len(w.after)) >= MIN_EDGE_SAMPLES:
        spline_sd = line_sd * (1 + w.length / rate / SPLINE_ERROR_TIME_S)
        methods.append((FillMethod.SPLINE, build_spline_map, spline_sd, growth**SPLINE_ERROR_GROWTH))
    estimates: list[GapEstimate] = []
    for method, build_map, expected_sd, error_growth in methods:
        gap_map, hidden_map = w.build_maps(build_map)
        error = (hidden_map @ path[w.hidden_context_frames] - path[w.hidden_frames]) * error_growth
        noise_sd = SAMPLE_NOISE_M * np.linalg.norm(gap_map[w.points], axis=1)
        position = gap_map @ path[w.context_frames]
        estimates.append(GapEstimate(method, position, error, np.hypot(expected_sd, noise_sd), name))
    return estimates


def build_line_map(
    before: Int[np.ndarray, " B"], after: Int[np.ndarray, " A"], length: int, points: Int[np.ndarray, " P"]
) -> Float[np.ndarray, "P BA"]:
    """Return the map from the samples beside a gap to points on the line between its edges, at one place if it has only one.

    All are offsets in frames from the first frame of the gap, which is `length` frames long.
    """
    line_map, share = np.zeros((len(points), len(before) + len(after))), (points + 1) / (length + 1)
    if len(before):
        line_map[:, len(before) - 1] = 1 - share if len(after) else 1.0
    if len(after):
        line_map[:, len(before)] = share if len(before) else 1.0
    return line_map


def build_spline_map(
    before: Int[np.ndarray, " B"], after: Int[np.ndarray, " A"], length: int, points: Int[np.ndarray, " P"]
) -> Float[np.ndarray, "P BA"]:
    """Return the map from the samples beside a gap, at least MIN_EDGE_SAMPLES on either side, to points on a spline."""
    columns = np.concatenate([np.arange(len(before))[::-1], len(before) + np.arange(len(after))])
    return build_hermite_map(length, -1 - before[::-1], after - length, points)[:, columns]


def shape_expected_sd(window: GapWindow, middle_sd_m: float) -> Float[np.ndarray, " S"]:
    """Return the expected standard deviation per axis at the points of a gap, from that in its middle."""
    middle_sd_m, share = max(middle_sd_m, MIN_FILL_SD_M), (window.points + 1) / (window.length + 1)
    if len(window.before) and len(window.after):
        return middle_sd_m * 2 * np.sqrt(share * (1 - share))
    return middle_sd_m * ONE_EDGE_ERROR_RATIO * np.sqrt(share if len(window.before) else 1 - share)
