"""Estimates from a marker's own trajectory: splines through short gaps, and lines or splines between the edges of any gap.

Each is a linear map from the samples beside a gap to positions in it, and is applied to its hidden stretches too.
A marker at rest is interpolated exactly in the world, one on a rigid body exactly in axes that move with this body.

Position and velocity at each edge of a spline come from a parabola through several samples, so that one noisy sample beside the
gap has little influence. `fill_with_splines` fills the many short gaps of a take at once, without other estimates; its error is
measured by applying the map to complete stretches of the same marker.
"""

from functools import cache, lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.fill.gap_windows import (
    CLUSTER_SATURATION_S,
    MIN_FILL_SD_M,
    MIN_REPORTED_SD_M,
    FillMethod,
    Gap,
    GapEstimate,
    MarkersInTake,
    MovingAxes,
)
from mocapfix.model.take import SAMPLE_NOISE_M
from mocapfix.stats.rigid_alignment import interpolate_stretches
from mocapfix.stats.sequences import find_runs, sample_evenly

SPLINE_CONTEXT_S = 0.06  # time on either side of a gap whose samples determine position and velocity at the edge
MIN_EDGE_SAMPLES = 3  # samples that a parabola requires at each edge
MAX_TRIAL_STRETCHES = 60  # complete stretches on which a map is tested
MIN_TRIAL_STRETCHES = 8  # complete stretches that measuring the error requires
MAX_TRIAL_STARTS = 20_000  # evenly spaced frames that are examined to find complete stretches


def fill_with_splines(
    markers: Float[np.ndarray, "T M 3"], rate: float, max_gap_s: float
) -> tuple[Float[np.ndarray, "T M 3"], Float[np.ndarray, "T M"], Float[np.ndarray, "T M"]]:
    """Return positions of samples in interior gaps in metres, their standard deviations per axis, and those of lines; else NaN.

    Gaps with fewer than three visible samples at an edge are not filled, nor gaps for whose length the marker has too few
    complete stretches to measure the error.

    Args:
        markers: In metres, NaN if not visible or an outlier.
        max_gap_s: Duration of the longest gap that is filled.
    """
    visible, world = ~np.isnan(markers[..., 0]), build_world_axes.__wrapped__(len(markers))  # too large to keep
    filled, sd = np.full(markers.shape, np.nan), np.full(visible.shape, np.nan)
    line_sd = sd.copy()
    context_count = max(MIN_EDGE_SAMPLES, round(SPLINE_CONTEXT_S * rate))
    for m in np.flatnonzero(~visible.all(0) & visible.any(0)):
        path = np.ascontiguousarray(markers[:, m])
        for (length, before, after), first_frames in group_gap_patterns(visible[:, m], context_count, max_gap_s * rate).items():
            inside = np.arange(length)
            used = np.concatenate([-1 - np.array(before), length + np.array(after), inside])
            trials = find_complete_stretches(visible[:, m], np.sort(used), 1 + len(path) // MAX_TRIAL_STARTS)
            if len(trials) >= MIN_TRIAL_STRETCHES:
                trials, first = trials[sample_evenly(len(trials), MAX_TRIAL_STRETCHES)], np.array(first_frames)
                edges, ones = build_edge_maps(before, after), np.ones(2)
                errors = interpolate_stretches(path, *world, trials[:, None] + used, inside, length, edges, ones)[0]
                found = interpolate_stretches(path, *world, first[:, None] + used, inside, length, edges, ones[:0])[0][1]
                filled[first[:, None] + inside, m] = found
                for of_method, error in zip((line_sd, sd), errors, strict=True):
                    of_method[first[:, None] + inside, m] = np.sqrt((error**2).mean((0, 2)))
    return filled, np.maximum(sd, MIN_REPORTED_SD_M), line_sd


def group_gap_patterns(
    is_visible: Bool[np.ndarray, " T"], context_count: int, max_gap_frames: float
) -> dict[tuple[int, tuple[int, ...], tuple[int, ...]], list[int]]:
    """Return the first frames of the gaps with enough samples at both edges, by pattern.

    A pattern is the length of a gap in frames, and which samples before and after it are visible, as distances from its edges.
    Gaps with the same pattern share a map; flicker causes thousands of gaps with few patterns.
    """
    patterns = dict[tuple[int, tuple[int, ...], tuple[int, ...]], list[int]]()
    for first, last in find_runs(~is_visible):
        if last - first + 1 > max_gap_frames:
            continue
        before = tuple(np.flatnonzero(is_visible[max(0, first - context_count) : first][::-1]).tolist())
        after = tuple(np.flatnonzero(is_visible[last + 1 : last + 1 + context_count]).tolist())
        if min(len(before), len(after)) >= MIN_EDGE_SAMPLES:
            patterns.setdefault((last - first + 1, before, after), []).append(first)
    return patterns


@cache
def fit_edge_parabola(distances: tuple[int, ...]) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, " N"]]:
    """Return the maps from samples at N distances (frames) from a gap's edge to position and velocity of a parabola there.

    The velocity is per frame, into the gap.
    """
    steps = np.array(distances)
    parabola = np.linalg.pinv(np.stack([np.ones(len(steps)), -steps, steps**2], 1))
    return parabola[0], parabola[1]


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
SMOOTH_MOTION_S = 0.1  # duration below which motion is smooth: the error of the line grows with a further power of it
WORLD_SPLINE_ERROR_RATIO = 0.25  # expected error of the spline in a very short gap, relative to that of the line
AXES_SPLINE_ERROR_RATIO = 0.75  # the same in moving axes, whose own errors a spline follows
SPLINE_ERROR_TIME_S, SHORT_SPLINE_GAP_S = 1.0, 0.3  # durations in which this ratio grows by one, and its start has half gone
ACTIVITY_POWER = 0.5  # power with which the motion relative to neighbours grows with their own
ONE_EDGE_ERROR_RATIO = 2.0  # expected error in a gap with one edge, relative to a gap with two
WORLD_SATURATION_S = 0.8
"""Duration above which errors in the world no longer grow with it, where stretches shorter than the gap are scaled."""
SPLINE_ERROR_GROWTH = 2.0  # power of the duration, until then, with which the errors of a spline grow; 1 for a line


WORLD_AXES = "world"  # the name of the axes of the world


class WorldInterpolation(NamedTuple):
    """Estimates a marker from its own trajectory, in the world."""

    take: MarkersInTake

    def __call__(self, gap: Gap) -> list[GapEstimate]:
        path, rate, gap_s = self.take.markers[gap.frames, gap.marker], self.take.rate, gap.window.length / self.take.rate
        line_sd_m = WORLD_ERROR_RATIO * gap.speed_m_s * gap.activity * gap_s**WORLD_ERROR_GROWTH
        return _interpolate(path, build_world_axes(len(path)), gap, line_sd_m, WORLD_SATURATION_S * rate, WORLD_AXES, rate)


@lru_cache(32)
def build_world_axes(frames: int) -> MovingAxes:
    """Return the axes of the world, which do not move."""
    return MovingAxes(np.tile(np.eye(3), (frames, 1, 1)), np.zeros((frames, 3)))


def interpolate_in_axes(path: Float[np.ndarray, "T 3"], axes: MovingAxes, gap: Gap, rate: float, name: str) -> list[GapEstimate]:
    """Return the estimates between the edges of a gap in moving axes, none if the axes are known at neither edge.

    Args:
        path: Metres in the world, NaN if not visible.
        axes: The axes in which the path is interpolated, in the frames of the gap.
        rate: Frame rate in Hz.
    """
    shown, gap_s = path[gap.frames], gap.window.length / rate
    local = axes.transform_from_world(shown)
    local = local[~np.isnan(local[:, 0])]
    if not len(local):
        return []
    variation_m = float(np.sqrt(((local - local.mean(0)) ** 2).mean())) * gap.activity**ACTIVITY_POWER
    variation_m *= gap.variation_growth
    line_sd_m = CLUSTER_ERROR_RATIO * variation_m * min(np.sqrt(gap_s / CLUSTER_ERROR_TIME_S), MAX_CLUSTER_ERROR_GROWTH)
    estimates = _interpolate(shown, axes, gap, line_sd_m, CLUSTER_SATURATION_S * rate, name, rate)
    return [each._replace(method=FillMethod.CLUSTER) for each in estimates]


def _interpolate(
    path: Float[np.ndarray, "F 3"], axes: MovingAxes, gap: Gap, line_sd_m: float, saturation: float, name: str, rate: float
) -> list[GapEstimate]:
    """Return the estimates between the edges of a gap, on a line and on a spline, in moving axes.

    `line_sd_m` is expected of the line per axis, in the middle of the gap; beyond `saturation` frames errors no longer grow.
    """
    w, rows, hidden_rows = gap.window, gap.rows, gap.hidden_rows
    is_known = ~np.isnan(path[rows, 0] + axes.origin[rows, 0])[: len(rows) - w.length]
    if not is_known.all():
        w = w.keep_known_context(is_known)
        rows = rows[np.append(is_known, [True] * w.length)]
        hidden_rows = np.ascontiguousarray(hidden_rows[:, np.append(is_known, w.points >= 0)])
    if not is_known.any():
        return []
    edges = build_edge_maps(tuple((-1 - w.before).tolist()), tuple((w.after - w.length).tolist()))
    share = (w.points + 1) / (w.length + 1)
    one_edge = ONE_EDGE_ERROR_RATIO * np.sqrt(share if len(w.before) else 1 - share)
    gap_s = w.length / rate
    line_sd_m *= gap_s / (gap_s + SMOOTH_MOTION_S)
    line_sd = max(line_sd_m, MIN_FILL_SD_M) * (2 * np.sqrt(share * (1 - share)) if len(w.before) and len(w.after) else one_edge)
    growth = w.length / w.hidden_length * (saturation + w.hidden_length) / (saturation + w.length)
    growths = growth ** np.array([1.0, SPLINE_ERROR_GROWTH])
    position, noise = interpolate_stretches(path, *axes, rows[None], np.arange(w.length), w.length, edges, growths[:0])
    error, _ = interpolate_stretches(path, *axes, hidden_rows, w.hidden_points, w.hidden_length, edges, growths)
    noise_sd = SAMPLE_NOISE_M * noise[:, w.points]
    ratio = WORLD_SPLINE_ERROR_RATIO if name == WORLD_AXES else AXES_SPLINE_ERROR_RATIO
    expected_sd = line_sd, line_sd * (1 - (1 - ratio) / (1 + (gap_s / SHORT_SPLINE_GAP_S) ** 2) + gap_s / SPLINE_ERROR_TIME_S)
    methods = FillMethod.LINE, FillMethod.SPLINE
    deviations = [np.hypot(sd, noise) for sd, noise in zip(expected_sd, noise_sd, strict=False)]
    return [GapEstimate(methods[e], position[e, 0], error[e], sd, name) for e, sd in enumerate(deviations)]


@cache
def build_edge_maps(before: tuple[int, ...], after: tuple[int, ...]) -> Float[np.ndarray, "E 4 C"]:
    """Return the maps from the samples beside a gap to position and velocity at the edge before it, then after it, per frame.

    The first is that of a line between the edges, at one place if the gap has only one; the second that of a spline, if there
    are MIN_EDGE_SAMPLES at either edge.

    Args:
        before: Distances of the samples from the edge, in frames; the last is at the edge.
        after: The same after the gap; the first is at the edge.
    """
    maps, split = np.zeros((2, 4, len(before) + len(after))), len(before)
    maps[0, 0, split - 1 if before else 0] = maps[0, 2, split if after else split - 1] = 1.0
    if min(len(before), len(after)) < MIN_EDGE_SAMPLES:
        return maps[:1]
    maps[1, :2, :split], maps[1, 2:, split:] = fit_edge_parabola(before), fit_edge_parabola(after)
    return maps
