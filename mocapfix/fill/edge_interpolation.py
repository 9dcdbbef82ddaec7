"""Estimates from a marker's own trajectory: splines through short gaps, and lines or splines between the edges of any gap.

Each method is a linear map from the samples beside a gap to positions in it, so that it can be applied to many hidden stretches
at once. A marker at rest is interpolated exactly in the world, one on a rigid body exactly in axes that move with this body.

Position and velocity at each edge of a spline come from a parabola through several samples, so that one noisy sample beside the
gap has little influence. `fill_with_splines` fills the many short gaps of a take at once, without other estimates; its error is
measured by applying the map to complete stretches of the same marker.
"""

from functools import cache
from typing import NamedTuple

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
    gap_frames: int,
    before: Int[np.ndarray, " B"],
    after: Int[np.ndarray, " A"],
    points: Int[np.ndarray, " P"] | None = None,
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


DAMPED_VELOCITY_S = 0.12  # time in which the velocity at an edge decays, in the damped method
WORLD_ERROR_RATIO = 0.155
"""Expected error of the straight method in the world, relative to the path of the marker's varying velocity in a gap of 1 s."""
WORLD_ERROR_GROWTH = 1.1  # power of the gap's duration with which this error grows
CLUSTER_ERROR_RATIO = 1.2  # expected error of the straight method in moving axes, relative to the marker's variation in them
CLUSTER_ERROR_TIME_S = 0.5  # duration of a gap for which it holds; the error grows with the square root of the duration
MAX_CLUSTER_ERROR_GROWTH = 2.0  # largest growth of this error with the duration
DAMPED_ERROR_RATIO = 1.1  # expected error of the damped method, relative to the straight one
DAMPED_ERROR_TIME_S = 5.0  # duration of a gap in which this ratio is larger by one, in moving axes
CUBIC_ERROR_TIME_S = 1.0  # duration of a gap in which the expected error of the cubic method is twice that of the straight one
WORLD_RATIO_POWER = 0.6  # power with which the neighbours' errors in the gap determine the expected error in the world
LIMB_RATIO_POWER = 0.4  # the same for the straight method in moving axes, where a limb is lost
LIMB_METHOD_POWER = 0.5  # the same for the errors of the other methods there, relative to the straight one
ACTIVITY_POWER = 0.5  # power with which the motion relative to neighbours grows with their own
ONE_EDGE_ERROR_RATIO = 2.0  # expected error in a gap with one edge, relative to a gap with two
WORLD_SATURATION_S = 0.8
"""Duration above which errors in the world no longer grow with it, where stretches shorter than the gap are scaled."""


class _EdgeMethod(NamedTuple):
    """A method of `build_edge_maps`: its name in reports, and the power of the duration, until then, with which errors grow."""

    fill_method: FillMethod
    growth_power: float


EDGE_METHODS = (_EdgeMethod(FillMethod.LINE, 1.0), _EdgeMethod(FillMethod.LINE, 1.2), _EdgeMethod(FillMethod.SPLINE, 2.0))
"""The straight, the damped and the cubic one."""


MAX_RATIO_NEIGHBOURS = 8  # number of neighbours, the steadiest first, whose errors are compared with the expected ones
COMPARED_ERROR_MARGIN_M = 0.001  # length that is added to both errors: smaller ones count as equal


def build_edge_maps(
    before: Int[np.ndarray, " B"], after: Int[np.ndarray, " A"], length: int, points: Int[np.ndarray, " P"], rate: float
) -> list[Float[np.ndarray, "P BA"]]:
    """Return the straight, the damped and, with enough samples at both edges, the cubic map to some points in a gap.

    Samples and points are offsets in frames from the first frame of the gap, which is `length` frames long.
    """
    distances = [-1 - before[::-1], after - length]  # of the samples from their edge, nearest first
    columns = [np.arange(len(before))[::-1], len(before) + np.arange(len(after))]
    steps = [points + 1.0, length - points * 1.0]
    share = steps[0] / (length + 1)
    weights = [1 - share, share] if len(before) and len(after) else [np.ones(len(points))] * 2
    straight, damped = np.zeros((2, len(points), len(before) + len(after)))
    reach = rate * DAMPED_VELOCITY_S
    for side in (0, 1):
        if not len(distances[side]):
            continue
        straight[:, columns[side][0]] += weights[side]
        damped[:, columns[side][0]] += weights[side]
        if len(distances[side]) >= MIN_EDGE_SAMPLES:
            _, velocity = fit_edge_parabola(tuple(distances[side].tolist()))
            travel = reach * (1 - np.exp(-steps[side] / reach))
            damped[:, columns[side]] += (weights[side] * travel)[:, None] * velocity
    maps = [straight, damped]
    if min(len(before), len(after)) >= MIN_EDGE_SAMPLES:
        maps.append(build_hermite_map(length, distances[0], distances[1], points)[:, np.r_[columns[0], columns[1]]])
    return maps


def compute_expected_sd(window: GapWindow, rate: float, speed_m_s: float, cluster_sd_m: float | None) -> Float[np.ndarray, " S"]:
    """Return the expected standard deviation per axis of the straight method at the points of a gap.

    Args:
        speed_m_s: Variation of the marker's velocity in the world.
        cluster_sd_m: Variation of its position in moving axes; None in the world.
    """
    gap_s, share = window.length / rate, (window.points + 1) / (window.length + 1)
    if cluster_sd_m is None:
        middle_sd = WORLD_ERROR_RATIO * speed_m_s * gap_s**WORLD_ERROR_GROWTH
    else:
        middle_sd = CLUSTER_ERROR_RATIO * cluster_sd_m * min(np.sqrt(gap_s / CLUSTER_ERROR_TIME_S), MAX_CLUSTER_ERROR_GROWTH)
    middle_sd = max(middle_sd, MIN_FILL_SD_M)
    if len(window.before) and len(window.after):
        return middle_sd * 2 * np.sqrt(share * (1 - share))
    return middle_sd * ONE_EDGE_ERROR_RATIO * np.sqrt(share if len(window.before) else 1 - share)


def measure_neighbour_errors(
    markers: Float[np.ndarray, "T M 3"], window: GapWindow, rate: float, velocity_sd: Float[np.ndarray, " M"]
) -> Float[np.ndarray, "methods M"]:
    """Return the logarithms of the errors of the methods in a gap for the markers that are visible at its points and beside it.

    Hidden stretches are few in a short take, and often those in which the marker rests; its neighbours show how the person moves
    in this gap. Errors are relative to that expected of the straight method; NaN where a marker is not visible.

    Args:
        markers: Metres, NaN if not visible.
        window: The gap.
        rate: Frame rate in Hz.
        velocity_sd: Variation of each marker's velocity in m/s.
    """
    w = window
    maps = np.stack(build_edge_maps(w.before, w.after, w.length, w.points, rate))
    error = np.einsum("kpc,cma->kpma", maps, markers[w.context_frames]) - markers[w.first + w.points]
    size = np.sqrt((error**2).sum(-1).mean(1))
    expected = np.sqrt(3 * (compute_expected_sd(w, rate, 1.0, None) ** 2).mean()) * velocity_sd
    return np.log((size + COMPARED_ERROR_MARGIN_M) / (expected + COMPARED_ERROR_MARGIN_M))


def average_neighbour_errors(
    log_errors: Float[np.ndarray, "methods M"], neighbours: Int[np.ndarray, " N"]
) -> tuple[Float[np.ndarray, " methods"], int] | None:
    """Return the mean of `measure_neighbour_errors` over the first neighbours that have errors, and their number."""
    known = neighbours[~np.isnan(log_errors[:, neighbours]).any(0)][:MAX_RATIO_NEIGHBOURS]
    return (log_errors[:, known].mean(1), len(known)) if len(known) else None


class WorldInterpolation:
    """Estimates a marker from its own trajectory, in the world."""

    def __init__(self, take: MarkersInTake) -> None:
        self.take = take

    def __call__(self, gap: Gap) -> list[GapEstimate]:
        return interpolate_in_axes(self.take.markers[:, gap.marker], None, gap, self.take.rate, "world")


def interpolate_in_axes(
    path: Float[np.ndarray, "T 3"], axes: MovingAxes | None, gap: Gap, rate: float, name: str
) -> list[GapEstimate]:
    """Return the estimates of all methods in some axes, or in the world where `axes` is None.

    Args:
        path: Metres in the world, NaN if not visible.
        axes: The axes in which the path is interpolated.
        gap: The gap.
        rate: Frame rate in Hz.
        name: Name of the axes.
    """
    local = axes.transform_from_world(path) if axes else path
    w = gap.window.keep_known_context(~np.isnan(local[:, 0]))
    if not len(w.context_frames):
        return []
    gap_s, cluster_sd = w.length / rate, None
    if axes:
        shown = local[~np.isnan(local[:, 0])]
        shown_sd = float(np.sqrt(((shown - shown.mean(0)) ** 2).mean()))
        growth = compute_variation_growth(~np.isnan(path[:, 0]), gap_s, rate)
        cluster_sd = shown_sd * gap.activity**ACTIVITY_POWER * growth
    expected_sd = compute_expected_sd(w, rate, gap.speed_m_s * gap.activity, cluster_sd)
    saturation = rate * (CLUSTER_SATURATION_S if axes else WORLD_SATURATION_S)
    growth = w.length / w.hidden_length * (saturation + w.hidden_length) / (saturation + w.length)
    gap_maps = build_edge_maps(w.before, w.after, w.length, np.arange(w.length), rate)
    hidden_maps = build_edge_maps(w.before, w.hidden_after, w.hidden_length, w.hidden_points, rate)
    factors = compute_method_factors(gap, gap_s, len(gap_maps), is_world=axes is None)
    context, hidden_context, hidden = local[w.context_frames], local[w.hidden_context_frames], local[w.hidden_frames]
    estimates: list[GapEstimate] = []
    for method, gap_map, hidden_map, factor in zip(EDGE_METHODS, gap_maps, hidden_maps, factors.tolist(), strict=False):
        position, error = gap_map @ context, (hidden_map @ hidden_context - hidden) * growth**method.growth_power
        if axes:
            position, error = axes.transform_to_world(position, w.gap_frames), axes.rotate_to_world(error, w.hidden_frames)
        noise = SAMPLE_NOISE_M * np.linalg.norm(gap_map[w.points], axis=1)
        fill_method = FillMethod.CLUSTER if axes else method.fill_method
        estimates.append(GapEstimate(fill_method, position, error, np.hypot(expected_sd * factor, noise), name))
    return estimates


def compute_method_factors(gap: Gap, gap_s: float, method_count: int, *, is_world: bool) -> Float[np.ndarray, " methods"]:
    """Return the expected errors of the methods relative to that of the straight one, as it is usual.

    Those that they have for the neighbours in this gap count too, in the world and, where a limb is lost, in moving axes.
    """
    damped_factor = DAMPED_ERROR_RATIO + (0.0 if is_world else gap_s / DAMPED_ERROR_TIME_S)
    factors = np.array([1.0, damped_factor, 1 + gap_s / CUBIC_ERROR_TIME_S])[:method_count]
    if gap.method_ratios is None or not (is_world or gap.is_limb):
        return factors
    log_ratio, neighbour_count = gap.method_ratios
    straight, each = log_ratio[0], log_ratio[:method_count]
    shown = WORLD_RATIO_POWER * each if is_world else LIMB_RATIO_POWER * straight + LIMB_METHOD_POWER * (each - straight)
    share = neighbour_count / (neighbour_count + 1)
    return np.exp(share * shown + (1 - share) * np.log(factors))
