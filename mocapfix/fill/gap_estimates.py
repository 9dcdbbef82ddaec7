"""Which estimates a gap has, and the weight of each: what it achieves where the same markers are hidden elsewhere in the take.

An estimator is built once for a take and called for each lost marker of each gap, the short gaps first: what is filled precisely
serves as visible for longer ones. `ESTIMATORS` lists them; those of `LATER_ESTIMATORS` need the estimates of all other gaps, and
are called in the gaps that the others leave uncertain. Gaps that a spline fills precisely get no other estimate.
Without a body, or off it, that of the body returns nothing, and the others share the weight.

The errors of estimates are correlated, and the weights with the smallest expected error follow from their covariance (Bates &
Granger 1969, "The combination of forecasts"). It is measured in the hidden stretches of the gap. Few stretches show little of it:
variances and correlations are then shrunk to the expected ones, variances by their logarithms, since errors of one method in
different gaps differ by factors.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, Int8

from mocapfix.fill.body_fill import BodyPlacement, estimate_preview
from mocapfix.fill.edge_interpolation import WorldInterpolation, fill_with_splines
from mocapfix.fill.gap_windows import (
    MIN_FILL_SD_M,
    Estimator,
    FillMethod,
    Gap,
    GapEstimate,
    GapWindow,
    MarkerEstimate,
    MarkersInTake,
    choose_hidden_stretches,
    compare_edge_motion,
    iterate_gaps,
)
from mocapfix.fill.marker_processes import MAX_SETTLED_SD_M, MarkerProcesses
from mocapfix.fill.neighbour_clusters import (
    ChangingClusterInterpolation,
    ClusterInterpolation,
    NeighbourRegression,
    measure_distance_changes,
)
from mocapfix.fill.rigid_group_fill import RigidGroupPlacement
from mocapfix.model.body_fit import BodyFit
from mocapfix.model.faults import RequestedFill
from mocapfix.stats.marker_distances import RigidGroup
from mocapfix.stats.rigid_alignment import combine_estimates
from mocapfix.stats.sequences import find_runs, sample_evenly

EstimatorClass = Callable[[MarkersInTake], Estimator]

ESTIMATORS: tuple[EstimatorClass, ...] = (
    WorldInterpolation,
    ClusterInterpolation,
    ChangingClusterInterpolation,
    NeighbourRegression,
    BodyPlacement,
    RigidGroupPlacement,
)
LATER_ESTIMATORS: tuple[EstimatorClass, ...] = (MarkerProcesses,)

MAX_VARIATION_FRAMES = 100  # frames that show how much a marker varies in the axes of a cluster
MAX_LONE_SPLINE_GAP_S = 0.5  # duration of the longest gap that is filled by a spline alone
MAX_LONE_SPLINE_SD_M = 0.0005  # standard deviation of a spline up to which nothing else is tried
MAX_KNOWN_SD_M = 0.003  # standard deviation of a filled gap below which it serves as visible for longer gaps


class FillRequest(NamedTuple):
    """A request to fill the samples of a column of a take, over the frames first..last, by one method."""

    column: int
    first: int
    last: int
    method: RequestedFill


def estimate_missing_samples(
    markers: Float[np.ndarray, "T M 3"],
    rate: float,
    *,
    body: BodyFit | None = None,
    rigid_groups: Sequence[RigidGroup] = (),
    requests: Sequence[FillRequest] = (),
) -> MarkerEstimate:
    """Return the estimates of all missing samples.

    Args:
        markers: Metres, NaN if not visible or an outlier.
        rate: Frame rate in Hz.
        body: The solved body, or that of a preview, in which only gaps off the body and on unseen segments need more than it.
        rigid_groups: Groups of markers that are rigid and not on the body.
        requests: Samples that are estimated by one method only, or not at all; NaN where it gives no estimate.
    """
    markers = np.ascontiguousarray(markers.swapaxes(0, 1)).swapaxes(0, 1)  # a marker's path lies together
    if body and body.evidence is None and not requests:
        settled = estimate_preview(markers, rate, body)
    else:
        settled = _fill_short_gaps(markers, rate, requests)
    is_settled = ~np.isnan(settled.sd)
    if not (np.isnan(markers[..., 0]) & ~is_settled).any():
        return settled
    known = markers.copy(order="K")
    known[is_settled] = settled.position[is_settled]
    changes = measure_distance_changes(markers)
    take = MarkersInTake(markers, known, settled, changes, rate, body, rigid_groups)
    surroundings = _Surroundings(take)
    gaps = _estimate_gaps(take, surroundings)
    _add_later_estimates(take, gaps, surroundings)
    for request in requests:
        _use_request(take, gaps, request)
    return take.estimate


def _fill_short_gaps(markers: Float[np.ndarray, "T M 3"], rate: float, requests: Sequence[FillRequest]) -> MarkerEstimate:
    """Return the estimates of the gaps that splines fill precisely, and of which a reviewer requests no sample."""
    position, sd = fill_with_splines(markers, rate, MAX_LONE_SPLINE_GAP_S)
    is_unsettled = ~(sd <= MAX_LONE_SPLINE_SD_M)
    for request in requests:
        for first, last in find_runs(np.isnan(markers[:, request.column, 0])):
            is_unsettled[first : last + 1, request.column] |= first <= request.last and last >= request.first
    position[is_unsettled], sd[is_unsettled] = np.nan, np.nan
    return MarkerEstimate(position, sd, np.full(sd.shape, FillMethod.SPLINE, np.int8))


class _EstimatedMarker(NamedTuple):
    """A lost marker, its estimates, and the similarity of each hidden stretch to its gap."""

    gap: Gap
    estimates: list[GapEstimate]
    similarity: Float[np.ndarray, " K"]


def _estimate_gaps(take: MarkersInTake, surroundings: "_Surroundings") -> list[_EstimatedMarker]:
    """Estimate every gap, the shortest first."""
    is_preview = take.body is not None and take.body.evidence is None  # which guesses the segments that no marker shows
    estimators = [build(take) for build in ESTIMATORS if not (is_preview and build is BodyPlacement)]
    estimated: list[_EstimatedMarker] = []
    has_ends = take.is_common.copy()
    if take.body:
        has_ends[take.body.marker_columns[take.body.marker_columns >= 0]] = True
    for first, last, lost in iterate_gaps(~take.is_known, take.is_visible, has_ends):
        is_shown: np.ndarray = np.all(take.is_known.T[lost], axis=0)
        window = choose_hidden_stretches(is_shown, first, last, take.rate)
        for gap, similarity in surroundings.describe_gap(window, lost):
            estimates = surroundings.select_plausible([e for estimate in estimators for e in estimate(gap)], gap)
            estimated.append(_EstimatedMarker(gap, estimates, similarity))
            _store(take, estimated[-1], estimates)
        _remember(take, window, lost)
    return estimated


def _add_later_estimates(take: MarkersInTake, gaps: Sequence[_EstimatedMarker], surroundings: "_Surroundings") -> None:
    """Estimate the gaps that are uncertain by the estimators that need the estimates of all others."""
    is_settled = take.estimate.sd < MAX_SETTLED_SD_M
    uncertain = [each for each in gaps if not is_settled[each.gap.window.gap_frames, each.gap.marker].all()]
    if not uncertain:
        return
    estimators = [build(take) for build in LATER_ESTIMATORS]
    for each in uncertain:
        later = surroundings.select_plausible([e for estimate in estimators for e in estimate(each.gap)], each.gap)
        if later:
            each.estimates.extend(later)
            _store(take, each, each.estimates)


def _store(take: MarkersInTake, marker: _EstimatedMarker, estimates: Sequence[GapEstimate]) -> None:
    """Set the samples of a marker in a gap to the combination of estimates, if there are any."""
    if estimates:
        samples = marker.gap.window.gap_frames, marker.gap.marker
        combined = combine_gap_estimates(estimates, marker.gap.window, marker.similarity)
        take.estimate.position[samples], take.estimate.sd[samples], take.estimate.method[samples] = combined


def _remember(take: MarkersInTake, window: GapWindow, lost_markers: Int[np.ndarray, " L"]) -> None:
    """Use what was filled precisely as visible from now on."""
    for marker in lost_markers:
        samples = window.gap_frames, marker
        if (take.estimate.sd[samples] <= MAX_KNOWN_SD_M).all():
            take.markers[samples] = take.estimate.position[samples]
            take.is_known[samples] = True


def _use_request(take: MarkersInTake, gaps: Sequence[_EstimatedMarker], request: FillRequest) -> None:
    """Set the requested samples to the estimates of one method."""
    wanted = np.arange(request.first, request.last + 1)
    wanted = wanted[~take.is_visible[wanted, request.column]]
    take.estimate.sd[wanted, request.column] = np.nan
    for each in gaps:
        chosen = [estimate for estimate in each.estimates if estimate.method.name.lower() == request.method]
        frames = np.intersect1d(each.gap.window.gap_frames, wanted)
        if each.gap.marker == request.column and chosen and len(frames):
            combined = combine_gap_estimates(chosen, each.gap.window, each.similarity)
            for values, new in zip(take.estimate, combined, strict=True):
                values[frames, request.column] = new[frames - each.gap.window.first]


MAX_ACTIVITY_NEIGHBOURS = 8  # number of neighbours, the steadiest first, whose speeds are compared
VELOCITY_SPAN_S = 0.1  # time over which speeds are measured
MIN_COMPARED_SPEED_M_S = 0.02  # speed below which neighbours count as equally at rest
MIN_COMPARED_STEPS = 5  # steps in which a neighbour must be visible while the marker is
MIN_KNOWN_GAP_SHARE = 0.8  # share of a gap in which a neighbour must be visible
MAX_ACTIVITY_RATIO = 30.0  # largest ratio of the neighbours' speeds


class NeighbourActivity:
    """The speeds of all markers, which show whether a marker is visible mainly while the person rests."""

    def __init__(self, markers: Float[np.ndarray, "T M 3"], rate: float) -> None:
        self.lag = min(max(1, round(VELOCITY_SPAN_S * rate)), max(1, len(markers) - 1))
        square = (((markers[self.lag :] - markers[: -self.lag]) * (rate / self.lag)) ** 2).sum(-1)
        self.is_known, self.square = ~np.isnan(square), np.nan_to_num(square)
        is_visible = (~np.isnan(markers[self.lag // 2 :, :, 0][: len(square)])).T.astype(float)
        count = is_visible @ self.is_known
        # of all markers while one is visible
        self.square_with = _divide(is_visible @ self.square, count, count >= MIN_COMPARED_STEPS)

    def compare(self, marker: int, window: GapWindow, neighbours: Int[np.ndarray, " N"]) -> float:
        """Return how many times as fast neighbours, the steadiest first, are in a gap as while the marker is visible, or one."""
        if not len(self.square):
            return 1.0
        first = min(max(0, window.first - self.lag // 2), len(self.square) - 1)
        steps = slice(first, max(first + 1, window.first + window.length - self.lag // 2))
        is_known = self.is_known[steps][:, neighbours]
        in_gap = _divide(self.square[steps][:, neighbours].sum(0), is_known.sum(0), is_known.mean(0) > MIN_KNOWN_GAP_SHARE)
        both = np.stack([in_gap, self.square_with[marker, neighbours]])
        both = both[:, ~np.isnan(both).any(0)][:, :MAX_ACTIVITY_NEIGHBOURS]
        if not both.size:
            return 1.0
        difference = np.diff(np.log(both + MIN_COMPARED_SPEED_M_S**2), axis=0).mean()
        return float(np.exp(np.clip(-difference / 2, 0, np.log(MAX_ACTIVITY_RATIO))))


def _divide(values: np.ndarray, count: np.ndarray, is_enough: np.ndarray) -> np.ndarray:
    """Return the quotients, NaN where they are not known well enough."""
    return np.divide(values, count, out=np.full(values.shape, np.nan), where=is_enough)


MAX_SPEED_RATIO = 3.0  # speed of an estimate, relative to the fastest visible motion, above which it is rejected
SPEED_PERCENTILE = 99.9  # percentile of the speeds of visible markers that counts as the fastest visible motion
VELOCITY_LAG_S = 0.1  # time over which the variation of velocities is measured
MIN_SPEED_LIMIT_M_S = 2.0  # smallest value of this fastest speed, for takes with little motion


class _Surroundings:
    """How the markers of a take move around its gaps."""

    def __init__(self, take: MarkersInTake) -> None:
        self.take = take
        self.velocity_sd = measure_velocity_variation(take.visible_markers, take.rate)
        self.activity = NeighbourActivity(take.visible_markers, take.rate)
        self.max_speed_m_s = measure_speed_limit(take.visible_markers, take.rate)

    def describe_gap(
        self, window: GapWindow, lost_markers: Int[np.ndarray, " L"]
    ) -> Iterator[tuple[Gap, Float[np.ndarray, " K"]]]:
        """Yield what is known around each of the markers that are lost throughout a gap, and the similarity of its stretches."""
        take, w, known = self.take, window, self.take.is_known
        shown = np.flatnonzero(known.T[lost_markers].all(0))
        frames = w.list_frames(shown[sample_evenly(len(shown), MAX_VARIATION_FRAMES)], len(known))
        is_neighbour = np.all(known[max(w.first - 1, 0) : w.first + w.length + 1], axis=0)
        for marker in lost_markers.tolist():
            change = take.distance_change_m[marker]
            order = np.argsort(change, kind="stable")
            neighbours = order[is_neighbour[order] & np.isfinite(change[order])]
            edges = compare_edge_motion(take.markers[:, marker], w, take.rate)
            gap = Gap(
                marker,
                w,
                lost_markers,
                neighbours,
                *frames,
                activity=self.activity.compare(marker, w, neighbours),
                speed_m_s=edges.estimate_speed_in_gap(float(self.velocity_sd[marker]), w.length / take.rate),
            )
            yield gap, edges.similarity

    def select_plausible(self, estimates: list[GapEstimate], gap: Gap) -> list[GapEstimate]:
        """Return the estimates that are nowhere faster than the limit, edges included.

        A cluster of few visible or collinear markers can flip between two frames, which no standard deviation shows.
        """
        w = gap.window
        first, last = max(w.first - 1, 0), min(w.first + w.length, len(self.take.markers) - 1)
        paths = np.repeat(self.take.markers[None, first : last + 1, gap.marker], len(estimates), axis=0)
        inside = slice(w.first - first, w.first - first + w.length)
        for path, estimate in zip(paths, estimates, strict=True):
            path[inside] = estimate.position
        step = np.diff(paths, axis=1) * self.take.rate
        is_fast = np.any((step * step).sum(2) > self.max_speed_m_s**2, axis=1)
        is_chosen = ~is_fast & ~np.isnan(paths[:, inside, 0]).all(1)
        return [each for each, is_one in zip(estimates, is_chosen, strict=True) if is_one]


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


def measure_speed_limit(markers: Float[np.ndarray, "T M 3"], rate: float) -> float:
    """Return the largest speed of an estimate in m/s; infinite if no marker is visible in two frames in a row.

    Args:
        markers: Metres, NaN if not visible or an outlier.
        rate: Frame rate in Hz.
    """
    speeds = [np.linalg.norm(np.diff(markers[:, m], axis=0), axis=-1) for m in range(markers.shape[1])]
    visible = np.concatenate([speed[~np.isnan(speed)] for speed in speeds]) * rate if speeds else np.zeros(0)
    if not len(visible):
        return np.inf
    return MAX_SPEED_RATIO * max(float(np.percentile(visible, SPEED_PERCENTILE)), MIN_SPEED_LIMIT_M_S)


EXPECTED_CORRELATION = 0.3  # expected correlation of the errors of two estimates of one sample
SAME_AXES_CORRELATION = 0.75  # the same where both were made in the same axes


def combine_gap_estimates(
    estimates: Sequence[GapEstimate], window: GapWindow, similarity: Float[np.ndarray, " K"]
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"], Int8[np.ndarray, " n"]]:
    """Return the combination of estimates with the smallest expected error: positions, their deviations, and the main methods.

    An estimate that lacks some frames counts in the others only.

    Args:
        estimates: At least one.
        similarity: Of each hidden stretch to the gap, 0 to 1.
    """
    position, error, expected_sd = (np.stack(each) for each in zip(*(e[1:4] for e in estimates), strict=True))
    largest = np.nanmax(expected_sd, axis=1, initial=MIN_FILL_SD_M, keepdims=True)
    expected_sd = np.where(np.isnan(expected_sd), largest, expected_sd)  # of one that lacks frames
    correlation = build_expected_correlation([e.axes for e in estimates])
    shown = window.hidden_length / window.length * np.array([e.evidence for e in estimates])
    methods, independent = np.array([int(e.method) for e in estimates]), window.count_independent_stretches()
    out = np.empty((window.length, 3)), np.empty(window.length), np.empty(window.length, np.int8)
    weighting = similarity, independent, shown, correlation, MIN_FILL_SD_M, window.points, methods
    combine_estimates(position, error, expected_sd, *weighting, out)
    return out


def build_expected_correlation(axes: Sequence[str | None]) -> Float[np.ndarray, "E E"]:
    """Return the expected correlations of the errors of estimates in axes with these names."""
    is_same = np.array([[a is not None and a == b for b in axes] for a in axes])
    return np.where(is_same, SAME_AXES_CORRELATION, EXPECTED_CORRELATION)
