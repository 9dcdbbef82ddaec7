"""The ways to fill a sample, as reports name them, and estimates that are made in these ways.

Also the speed of markers from which on an estimate is impossible, and fills by a method that a reviewer requested.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Int8, Shaped
from scipy.ndimage import maximum_filter1d

from mocapfix.fill.cluster_fill import fill_from_clusters
from mocapfix.fill.spline_fill import (
    MIN_FILL_SD_M,
    SPLINE_CONTEXT_S,
    build_hermite_map,
    group_gap_patterns,
    measure_spline_error,
)
from mocapfix.io.changes_file import Correction, RequestedFill
from mocapfix.model.detected import MarkerEpochs

CLUSTER_SATURATION_S = 0.4  # time scale in which the error of an interpolation in moving axes stops growing


class FillMethod(IntEnum):
    """How a sample was filled."""

    SPLINE = 0
    CLUSTER = 1
    BODY = 2
    GAUSSIAN_PROCESS = 3
    RIGID_GROUP = 4

    @property
    def description(self) -> str:
        """The source of the sample, as a phrase for reports."""
        return _FILL_METHOD_DESCRIPTIONS[self]


_FILL_METHOD_DESCRIPTIONS = {
    FillMethod.SPLINE: "a spline through its own trajectory",
    FillMethod.CLUSTER: "the markers that move with it",
    FillMethod.BODY: "the solved body",
    FillMethod.GAUSSIAN_PROCESS: "all markers, in frames with a similar body state",
    FillMethod.RIGID_GROUP: "the rigid group to which it belongs",
}


class MarkerEstimate(NamedTuple):
    """Estimates of samples: positions in metres, standard deviations per axis, NaN for none, and FillMethods.

    They are those of a take (T, M), or those of its missing samples only (N,).
    """

    position: Float[np.ndarray, "*samples 3"]
    sd: Float[np.ndarray, "*samples"]
    method: Int8[np.ndarray, "*samples"]

    def select(self, is_missing: Bool[np.ndarray, "T M"]) -> "MarkerEstimate":
        """Return the estimates of the missing samples of a take."""
        return MarkerEstimate(*(values[is_missing] for values in self))

    def expand(self, is_missing: Bool[np.ndarray, "T M"]) -> "MarkerEstimate":
        """Return the estimates of a take from those of its missing samples."""
        position, sd = np.full((*is_missing.shape, 3), np.nan), np.full(is_missing.shape, np.nan)
        method = np.zeros(is_missing.shape, np.int8)
        position[is_missing], sd[is_missing], method[is_missing] = self
        return MarkerEstimate(position, sd, method)


def build_marker_estimate(
    position: Float[np.ndarray, "*samples 3"], sd: Float[np.ndarray, "*samples"], method: FillMethod
) -> MarkerEstimate:
    """Return an estimate from one method."""
    return MarkerEstimate(position, sd, np.full(sd.shape, method, np.int8))


class GapWindow(NamedTuple):
    """A gap, the visible samples beside it, and the hidden stretches that imitate it.

    Offsets count frames from the first frame of the gap, or of a stretch.
    """

    first: int  # first, length: of the gap, in frames
    length: int
    # before, after: offsets of the visible samples beside the gap, ascending; they reach up to it without interruption or are
    # empty
    before: np.ndarray
    after: np.ndarray
    points: np.ndarray  # (S,) offsets of the points in the gap at which errors are measured
    starts: np.ndarray  # (K,) first frames of the hidden stretches
    hidden_length: int  # of each stretch, in frames
    hidden_after: np.ndarray  # offsets of the samples after a stretch; those before it are `before`
    hidden_points: np.ndarray  # (S,) offsets of the points in a stretch

    @property
    def gap_frames(self) -> Int[np.ndarray, " n"]:
        """The frames of the gap."""
        return self.first + np.arange(self.length)

    @property
    def context_frames(self) -> Int[np.ndarray, " C"]:
        """The frames of the samples beside the gap."""
        return self.first + np.concatenate([self.before, self.after])

    @property
    def hidden_frames(self) -> Int[np.ndarray, "K S"]:
        """The frames at which errors are measured."""
        return self.starts[:, None] + self.hidden_points

    @property
    def hidden_context_frames(self) -> Int[np.ndarray, "K C"]:
        """The frames of the samples beside the stretches."""
        return self.starts[:, None] + np.concatenate([self.before, self.hidden_after])

    def count_independent_stretches(self) -> float:
        """Return the number of stretches of this length in the frames that are hidden at least once."""
        if not len(self.starts):
            return 0.0
        steps = np.minimum(np.diff(self.starts), self.hidden_length)
        return min(len(self.starts), (float(steps.sum()) + self.hidden_length) / self.hidden_length)

    def compute_distance_to_edges(self) -> Float[np.ndarray, " S"]:
        """Return the distance of each point, in frames, from the nearest edge of the gap that has a visible sample."""
        to_first, to_last = self.points + 1.0, self.length - self.points * 1.0
        if not len(self.after):
            return to_first
        return np.minimum(to_first, to_last) if len(self.before) else to_last


class MovingAxes(NamedTuple):
    """Axes that move with some markers: rotation (T, 3, 3) to the world, and origin (T, 3) m; NaN where unknown."""

    rotation: np.ndarray
    origin: np.ndarray

    def transform_from_world(self, path: Float[np.ndarray, "T 3"]) -> Float[np.ndarray, "T 3"]:
        """Return a path in these axes."""
        local = np.full(path.shape, np.nan)
        known = np.flatnonzero(~np.isnan(self.origin[:, 0]) & ~np.isnan(path[:, 0]))
        local[known] = np.einsum("tba,tb->ta", self.rotation[known], path[known] - self.origin[known])
        return local


class GapEstimate(NamedTuple):
    """One estimate of a marker in one gap of n frames."""

    method: FillMethod  # how it was made
    position: np.ndarray  # (n, 3) m in the world
    error: np.ndarray  # (K, S, 3) m in the world, in the hidden stretches of the gap's window; NaN where unknown
    # (S,) m per axis, of the error at the points of the window, expected without looking at hidden stretches
    expected_sd: np.ndarray
    # of the axes in which it was made; estimates in the same axes have similar errors. None: in none of its own
    axes_number: int | None = None

    def grow(self, factor: float) -> "GapEstimate":
        """Return the estimate with a larger expected error."""
        return self._replace(expected_sd=self.expected_sd * factor)


MAX_SPEED_RATIO = 3.0  # speed of an estimate, relative to the fastest visible motion, above which it is rejected
SPEED_PERCENTILE = 99.9  # percentile of the speeds of visible markers that counts as the fastest visible motion
SPEED_MARGIN_S = 0.25  # time around an impossible speed in which estimates are rejected
VELOCITY_LAG_S = 0.1  # time over which the variation of velocities is measured
MIN_SPEED_LIMIT_M_S = 2.0  # smallest value of this fastest speed, for takes with little motion


class SpeedLimit(NamedTuple):
    """The largest speed of an estimate in m/s."""

    speed_m_s: float

    def is_exceeded(self, path: Float[np.ndarray, "n 3"], rate: float) -> bool:
        """Return whether a path in metres is faster anywhere.

        A cluster of few visible or collinear markers can flip between two frames, which no standard deviation shows.
        """
        speed = np.linalg.norm(np.diff(path, axis=0), axis=-1) * rate
        return bool((np.nan_to_num(speed) > self.speed_m_s).any())


def measure_speed_limit(markers: Float[np.ndarray, "T M 3"], rate: float) -> SpeedLimit:
    """Return the limit for a take; infinite if no marker is visible in two frames in a row.

    markers  in metres, NaN if not visible or an outlier
    rate     frame rate in Hz
    """
    fastest = measure_fastest_speed(markers, rate)
    return SpeedLimit(np.inf if fastest is None else MAX_SPEED_RATIO * max(fastest, MIN_SPEED_LIMIT_M_S))


def measure_velocity_variation(markers: Float[np.ndarray, "T M 3"], rate: float) -> Float[np.ndarray, " M"]:
    """Return the standard deviation of each marker's velocity in m/s; near that of all for markers that show little of it.

    Velocities are those over VELOCITY_LAG_S, in which noise is small.
    """
    lag = min(max(1, round(VELOCITY_LAG_S * rate)), max(1, len(markers) - 1))
    step = markers[lag:] - markers[:-lag]
    count = (~np.isnan(step[..., 0])).sum(0)
    square = np.zeros(markers.shape[1])
    for m in np.flatnonzero(count):
        square[m] = np.nanvar(step[:, m], axis=0).sum()
    typical = square[count > 0].mean() if (count > 0).any() else 0.0
    typical_share = np.exp(-count / lag)
    return np.sqrt(typical_share * typical + (1 - typical_share) * square) * rate / lag


def measure_fastest_speed(markers: Float[np.ndarray, "T M 3"], rate: float) -> float | None:
    """Return the speed in m/s of the fastest visible motion; None if no marker is visible in two frames in a row.

    markers  in metres, NaN if not visible or an outlier
    rate     frame rate in Hz
    """
    speeds = [np.linalg.norm(np.diff(markers[:, m], axis=0), axis=-1) for m in range(markers.shape[1])]
    visible = np.concatenate([speed[~np.isnan(speed)] for speed in speeds]) * rate if speeds else np.zeros(0)
    return float(np.percentile(visible, SPEED_PERCENTILE)) if len(visible) else None


def find_impossible_speeds(
    path: Float[np.ndarray, "T M 3"], is_inlier: Bool[np.ndarray, "T M"], rate: float, fastest_speed: float | None
) -> Bool[np.ndarray, "T M"]:
    """Find samples of gaps near a time at which the marker would be MAX_SPEED_RATIO times as fast as any visible one.

    A cluster of few visible or collinear markers can flip between two frames, which no standard deviation shows.

    path           positions in metres with the gaps filled
    is_inlier      the samples that are visible
    rate           frame rate in Hz
    fastest_speed  of the visible motion in m/s; None if there is none, and no speed is impossible
    """
    is_impossible = np.zeros_like(is_inlier)
    if fastest_speed is None:
        return is_impossible
    frames, markers = np.nonzero(~(is_inlier[1:] & is_inlier[:-1]))  # of the steps into, within and out of gaps
    speed = np.nan_to_num(np.linalg.norm(path[frames + 1, markers] - path[frames, markers], axis=-1)) * rate
    is_fast = speed > MAX_SPEED_RATIO * max(fastest_speed, MIN_SPEED_LIMIT_M_S)
    if not is_fast.any():
        return is_impossible
    is_impossible[frames[is_fast], markers[is_fast]] = is_impossible[frames[is_fast] + 1, markers[is_fast]] = True
    return maximum_filter1d(is_impossible, 2 * round(SPEED_MARGIN_S * rate) + 1, axis=0) & ~is_inlier


EMPTY_REASON = "left empty in review"
NO_ESTIMATE_REASON = "the method that was requested in review ({method}) gives no estimate"
UNMEASURED_SD_M = 0.1
"""Standard deviation of a spline whose error cannot be measured, where no other method estimates the samples."""
MIN_SPLINE_CONTEXT_FRAMES = 3


@dataclass(frozen=True)
class FillRequest:
    """A request to fill the samples of a column of a take, over the frames first..last, by one method."""

    column: int
    first: int
    last: int
    method: RequestedFill

    @property
    def samples(self) -> tuple[slice, int]:
        """Index of the samples."""
        return slice(self.first, self.last + 1), self.column


def locate_requested_fills(corrections: Sequence[Correction], epochs: MarkerEpochs) -> list[FillRequest]:
    """Return the requests among corrections, for every column of a marker that moved."""
    return [
        FillRequest(int(column), each.first, each.last, each.entry.method)
        for each in corrections
        if each.entry.method is not None
        for column in np.flatnonzero(epochs.column_marker == each.markers[0])
    ]


def use_requested_methods(
    estimate: MarkerEstimate,
    requests: Sequence[FillRequest],
    markers: Float[np.ndarray, "T M 3"],
    body_estimate: MarkerEstimate | None,
    rate: float,
) -> MarkerEstimate:
    """Return the estimates, with those of a requested method where one was requested; NaN where it gives none.

    markers        in metres, NaN where missing or faulty
    body_estimate  the estimate from the solved body; None without one
    rate           frame rate in Hz
    """
    position, sd, method = (values.copy() for values in estimate)
    cluster = fill_from_clusters(markers, rate) if any(each.method == "cluster" for each in requests) else None
    for each in requests:
        known = MarkerEstimate(position, sd, method)
        if each.method == "spline":
            values = fill_run_with_spline(markers[:, each.column], known, each, rate)
        elif each.method == "cluster" and cluster:
            values = cluster[0][each.samples], cluster[1][each.samples]
        elif each.method == "body" and body_estimate is not None:
            values = body_estimate.position[each.samples], body_estimate.sd[each.samples]
        else:
            values = np.nan, np.nan
        position[each.samples], sd[each.samples] = values
        if each.method != "empty":
            method[each.samples] = FillMethod[each.method.upper()]
    return MarkerEstimate(position, sd, method)


def fill_run_with_spline(
    path: Float[np.ndarray, "T 3"], estimate: MarkerEstimate, request: FillRequest, rate: float
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
    """Return the positions of the requested samples on splines through their gaps, and standard deviations per axis, in metres.

    Where the marker has too few complete stretches to measure the error of a spline, its difference from the other estimates is
    taken for it.
    """
    is_visible = ~np.isnan(path[:, 0])
    position, sd = np.full(path.shape, np.nan), np.full(len(path), np.nan)
    context_count = max(MIN_SPLINE_CONTEXT_FRAMES, round(SPLINE_CONTEXT_S * rate))
    for (length, before, after), firsts in group_gap_patterns(is_visible, context_count, np.inf).items():
        context = np.r_[-1 - np.array(before), length + np.array(after)]
        spline_map: np.ndarray | None = None
        for first in firsts:
            if first > request.last or first + length <= request.first:
                continue
            if spline_map is None:
                spline_map = build_hermite_map(length, np.array(before), np.array(after))
            gap = np.arange(first, first + length)
            position[gap] = spline_map @ path[first + context]
            error = measure_spline_error(path, is_visible, spline_map, context)
            if error is None:
                error = _compare_with_estimate(position[gap], estimate, gap, request.column)
            sd[gap] = np.maximum(error, MIN_FILL_SD_M)
    return position[request.first : request.last + 1], sd[request.first : request.last + 1]


def _compare_with_estimate(
    position: Float[np.ndarray, "n 3"], estimate: MarkerEstimate, gap: Int[np.ndarray, " n"], column: int
) -> Float[np.ndarray, " n"]:
    """Return the standard deviation of positions about their true values, as far as another estimate shows it."""
    difference_sd = np.sqrt(((position - estimate.position[gap, column]) ** 2).mean(-1) + estimate.sd[gap, column] ** 2)
    return np.where(np.isnan(difference_sd), UNMEASURED_SD_M, difference_sd)


def explain_requested_fills(
    reasons: Shaped[np.ndarray, "T M"], requests: Sequence[FillRequest], is_without_estimate: Bool[np.ndarray, "T M"]
) -> Shaped[np.ndarray, "T M"]:
    """Return the reasons why samples stay empty, with those that follow from a request."""
    reasons = reasons.copy()
    for each in requests:
        reason = EMPTY_REASON if each.method == "empty" else NO_ESTIMATE_REASON.format(method=each.method)
        reasons[each.samples] = np.where(is_without_estimate[each.samples], reason, reasons[each.samples])
    return reasons


def compute_variation_growth(is_shown: Bool[np.ndarray, " T"], gap_s: float, rate: float) -> float:
    """Return the factor, at least one, by which a marker varies more in a gap than while it is visible, relative to others.

    A marker that is visible for a shorter time than the gap shows less of its motion. Each visible frame shows the time until the
    next one, up to CLUSTER_SATURATION_S.
    """
    steps_s = np.diff(np.flatnonzero(is_shown)) / rate
    shown_s = 1 / rate + float(np.minimum(steps_s, CLUSTER_SATURATION_S).sum())
    shown, hidden = (duration_s / (CLUSTER_SATURATION_S + duration_s) for duration_s in (shown_s, gap_s))
    return max(hidden / shown, 1.0)
