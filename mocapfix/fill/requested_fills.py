"""Fills by a method that a reviewer requested, in place of the combination of all methods."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from mocapfix.fill.cluster_fill import fill_from_clusters
from mocapfix.fill.fill_methods import FillMethod, MarkerEstimate
from mocapfix.fill.spline_fill import (
    MIN_SPLINE_SD_M,
    SPLINE_CONTEXT_S,
    build_hermite_map,
    group_gap_patterns,
    measure_spline_error,
)
from mocapfix.io.changes_file import Correction, RequestedFill
from mocapfix.model.detected import MarkerEpochs

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
            sd[gap] = np.maximum(error, MIN_SPLINE_SD_M)
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
