"""Interpolation between the edges of a gap: straight, damped or cubic, in the world or in axes that move with other markers.

Each method is a linear map from the samples beside the gap to positions in it, so that it can be applied to many hidden stretches
at once. A marker at rest is interpolated exactly in the world, one on a rigid body exactly in the axes of that body.

How a marker moves at the edges of a gap: at rest or not. Hidden stretches with a similar motion tell most about a gap.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.fill.fill_methods import (
    CLUSTER_SATURATION_S,
    FillMethod,
    GapEstimate,
    GapWindow,
    MovingAxes,
    compute_variation_growth,
)
from mocapfix.fill.spline_fill import MIN_EDGE_SAMPLES, MIN_FILL_SD_M, build_hermite_map, fit_edge_parabola
from mocapfix.model.take import SAMPLE_NOISE_M

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
ERROR_GROWTH_POWERS = (1.0, 1.2, 2.0)
"""Powers of the duration, until then, with which the errors of the straight, damped and cubic methods grow."""


class MethodRatios(NamedTuple):
    """Errors of the methods for neighbours in the same gap, relative to the error expected of the straight method."""

    log_ratio: np.ndarray  # (K,) their logarithms, on average
    neighbour_count: int  # number of neighbours

    def adjust_factors(self, factors: Float[np.ndarray, " K"], *, is_world: bool) -> Float[np.ndarray, " K"]:
        """Return factors on the expected error of the straight method, from those that are usual.

        is_world  whether the axes are those of the world, or move with other markers while a limb is lost
        """
        straight, each = self.log_ratio[0], self.log_ratio[: len(factors)]
        shown = WORLD_RATIO_POWER * each if is_world else LIMB_RATIO_POWER * straight + LIMB_METHOD_POWER * (each - straight)
        share = self.neighbour_count / (self.neighbour_count + 1)
        return np.exp(share * shown + (1 - share) * np.log(factors))


def build_edge_maps(
    before: Int[np.ndarray, " B"], after: Int[np.ndarray, " A"], length: int, points: Int[np.ndarray, " P"], rate: float
) -> list[Float[np.ndarray, "P BA"]]:
    """Return the straight, the damped and, with enough samples at both edges, the cubic map to some points in a gap.

    before, after, points  offsets in frames from the first frame of the gap, which is `length` frames long
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

    speed_m_s     variation of the marker's velocity in the world
    cluster_sd_m  variation of its position in moving axes; None in the world
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


def keep_known_context(window: GapWindow, is_known: Bool[np.ndarray, " T"]) -> GapWindow:
    """Return a window with those of the samples beside its gap that are known: markers that define axes can be missing there."""
    w = window
    is_before, is_after = is_known[w.first + w.before], is_known[w.first + w.after]
    return w._replace(before=w.before[is_before], after=w.after[is_after], hidden_after=w.hidden_after[is_after])


def estimate_from_edges(
    path: Float[np.ndarray, "T 3"],
    axes: MovingAxes | None,
    window: GapWindow,
    rate: float,
    speed_m_s: float,
    *,
    ratios: MethodRatios | None = None,
    axes_number: int = 0,
    activity: float = 1.0,
) -> list[GapEstimate]:
    """Return the estimates of all methods in some axes, or in the world where `axes` is None.

    path         in metres in the world, NaN if not visible
    speed_m_s    variation of the marker's velocity in the world
    ratios       errors for neighbours in this gap; None if they show nothing of the motion in these axes
    axes_number  by which the axes differ from others
    activity     how many times as fast the neighbours are in the gap as while the marker is visible
    """
    local = axes.transform_from_world(path) if axes else path
    w = keep_known_context(window, ~np.isnan(local[:, 0]))
    if not len(w.context_frames):
        return []
    frames, hidden_frames = w.gap_frames, w.hidden_frames
    cluster_sd = None
    if axes:
        shown = local[~np.isnan(local[:, 0])]
        shown_sd = float(np.sqrt(((shown - shown.mean(0)) ** 2).mean()))
        cluster_sd = shown_sd * activity**ACTIVITY_POWER * compute_variation_growth(~np.isnan(path[:, 0]), w.length / rate, rate)
    expected_sd = compute_expected_sd(w, rate, speed_m_s * activity, cluster_sd)
    gap_s = w.length / rate
    damped_factor = DAMPED_ERROR_RATIO + (gap_s / DAMPED_ERROR_TIME_S if axes else 0.0)
    factors = np.array([1.0, damped_factor, 1 + gap_s / CUBIC_ERROR_TIME_S])
    saturation = rate * (CLUSTER_SATURATION_S if axes else WORLD_SATURATION_S)
    growth = w.length / w.hidden_length * (saturation + w.hidden_length) / (saturation + w.length)
    gap_maps = build_edge_maps(w.before, w.after, w.length, np.arange(w.length), rate)
    factors = factors[: len(gap_maps)]
    if ratios is not None:
        factors = ratios.adjust_factors(factors, is_world=axes is None)
    hidden_maps = build_edge_maps(w.before, w.hidden_after, w.hidden_length, w.hidden_points, rate)
    context, hidden_context, hidden = local[w.context_frames], local[w.hidden_context_frames], local[hidden_frames]
    estimates: list[GapEstimate] = []
    for gap_map, hidden_map, factor, power in zip(gap_maps, hidden_maps, factors.tolist(), ERROR_GROWTH_POWERS, strict=False):
        position, error = gap_map @ context, (hidden_map @ hidden_context - hidden) * growth**power
        if axes:
            position = np.einsum("tab,tb->ta", axes.rotation[frames], position) + axes.origin[frames]
            error = np.einsum("ksab,ksb->ksa", axes.rotation[hidden_frames], error)
        method = FillMethod.CLUSTER if axes else FillMethod.SPLINE
        noise = SAMPLE_NOISE_M * np.linalg.norm(gap_map[w.points], axis=1)
        estimates.append(GapEstimate(method, position, error, np.hypot(expected_sd * factor, noise), axes_number))
    return estimates


RESTING_SPEED_M_S = 0.02  # speed that is added to all, below which markers count as equally at rest
MAX_EDGE_SPEED_SHARE = 0.5
"""Exponent of the speed at the edges in the expected speed within a short gap; the marker's usual speed has the rest."""
REST_TIME_S = 5.0  # time in which this share decays
SIMILAR_SPEED_RATIO = 2.0
"""Ratio of the speeds of a gap and a stretch at which the stretch has the weight of one standard deviation, 0.61."""


class EdgeMotion(NamedTuple):
    """The motion of a marker beside a gap."""

    speed_m_s: float | None  # mean of the speeds before, across and after the gap, and RESTING_SPEED_M_S; None without two edges
    similarity: Float[np.ndarray, " K"]  # of each hidden stretch to the gap, 0 to 1

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
