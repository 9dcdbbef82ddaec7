"""Which estimates a gap has, and the weight of each: what it achieves where the same markers are hidden elsewhere in the take.

An estimator is built once for a take and called for each lost marker of each gap, the short gaps first: what is filled precisely
serves as visible for longer ones. Gaps of similar length do not see one another's fills, so the second process estimates half of
them. `ESTIMATORS` lists the estimators; those of `LATER_ESTIMATORS` need the estimates of all other gaps, and are called in the
gaps that the others leave uncertain. Gaps that a spline fills precisely get no other estimate, unless the marker hardly moves.
Without a body, or off it, that of the body returns nothing, and the others share the weight.

The errors of estimates are correlated, and the weights with the smallest expected error follow from their covariance (Bates &
Granger 1969, "The combination of forecasts"). It is measured in the hidden stretches of the gap. Few stretches show little of it:
variances and correlations are then shrunk to the expected ones, variances by their logarithms, since errors of one method in
different gaps differ by factors.
"""

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import replace
from itertools import chain
from typing import Any, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float, Int
from threadpoolctl import threadpool_limits

from mocapfix.fill.body_fill import BodyPlacement, PredictedPlacement, estimate_preview
from mocapfix.fill.edge_interpolation import WorldInterpolation, fill_with_splines
from mocapfix.fill.gap_windows import (
    MIN_FILL_SD_M,
    MIN_REPORTED_SD_M,
    Estimator,
    FillMethod,
    Gap,
    GapEstimate,
    GapWindow,
    MarkerEstimate,
    MarkersInTake,
    choose_similar_stretches,
    compare_edge_motion,
    compute_variation_growth,
    iterate_gaps,
)
from mocapfix.fill.marker_processes import MAX_SETTLED_SD_M, MIN_LIMB_MARKERS, MarkerProcesses
from mocapfix.fill.neighbour_clusters import (
    ChangingClusterInterpolation,
    ClusterInterpolation,
    NeighbourRegression,
    measure_distance_changes,
)
from mocapfix.fill.rigid_group_fill import RigidGroupPlacement
from mocapfix.model.body_fit import BodyFit
from mocapfix.model.faults import RequestedFill
from mocapfix.model.take import Take
from mocapfix.model.windows import map_arrays
from mocapfix.solve.parallel import compute_beside
from mocapfix.stats.marker_distances import RigidGroup
from mocapfix.stats.rigid_alignment import combine_estimates, compute_lengths
from mocapfix.stats.sequences import find_runs, sample_evenly

Part = TypeVar("Part")
Value = TypeVar("Value")

ESTIMATORS: tuple[Callable[[MarkersInTake], Estimator], ...] = (
    WorldInterpolation,
    ClusterInterpolation,
    ChangingClusterInterpolation,
    NeighbourRegression,
    BodyPlacement,
    RigidGroupPlacement,
)
LATER_ESTIMATORS: tuple[Callable[[MarkersInTake], Estimator], ...] = (MarkerProcesses, PredictedPlacement)

MAX_VARIATION_FRAMES = 100  # frames that show how much a marker varies in the axes of a cluster
MAX_LONE_SPLINE_GAP_S = 0.5  # duration of the longest gap that is filled by a spline alone
MAX_LONE_SPLINE_SD_M = 0.0005  # standard deviation of a spline up to which nothing else is tried
MIN_LINE_SD_RATIO = 3.0  # of a straight line to a spline; where the marker hardly moves, others and a line can be more precise
MIN_RESTING_GAP_S = 0.04  # duration of a gap up to which nothing can be much more precise than a spline
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
    hands: Sequence[BodyFit] = (),
    alternatives: Sequence[Sequence[FillRequest]] = ((),),
) -> Iterator[MarkerEstimate]:
    """Yield the estimates of all missing samples with each of some lists of requests, in the same arrays.

    Args:
        markers: Metres, NaN if not visible or an outlier.
        rate: Frame rate in Hz.
        body: The solved body, or that of a preview, in which only gaps off the body and on unseen segments need more than it.
        rigid_groups: Groups of markers that are rigid and not on the body.
        hands: The solved hands, as bodies that carry the finger markers; the fills of other markers do not depend on them.
        alternatives: Requests for samples that are estimated by one method only, or not at all; NaN where it gives no estimate.
            The gaps are estimated once, so that the lists differ in their methods only.
    """
    requests = alternatives[0]
    second_process = compute_beside(bool)
    markers = np.ascontiguousarray(markers.swapaxes(0, 1)).swapaxes(0, 1)  # a marker's path lies together
    if body and body.evidence is None and not requests:
        settled = estimate_preview(markers, rate, body)
    else:
        settled = fill_short_gaps(markers, rate, requests)
    is_settled = ~np.isnan(settled.sd)
    if not (np.isnan(markers[..., 0]) & ~is_settled).any():
        yield from [settled] * len(alternatives)
        return
    known = markers.copy(order="K")
    known[is_settled] = settled.position[is_settled]
    take = MarkersInTake(markers, known, settled, measure_distance_changes(markers), rate, body, rigid_groups, hands)
    is_idle = second_process.future is not None and second_process.future.done()
    on_hands = [column for hand in hands for column in hand.marker_columns.tolist()]
    estimation = _GapEstimation(take, {*on_hands, *(each.column for each in requests)})
    try:
        gaps = _estimate_gaps(estimation, requests, is_shared=is_idle)
    finally:
        if estimation.is_shared:
            compute_beside(_end_estimation, id(estimation))
    for alternative in alternatives:
        for request in alternative:
            _use_request(take, gaps, request)
        yield take.estimate


def fill_short_gaps(markers: Float[np.ndarray, "T M 3"], rate: float, requests: Sequence[FillRequest]) -> MarkerEstimate:
    """Return the estimates of the gaps that splines fill precisely, and of which a reviewer requests no sample."""
    position, sd, line_sd = fill_with_splines(markers, rate, MAX_LONE_SPLINE_GAP_S)
    is_unsettled = ~(sd <= MAX_LONE_SPLINE_SD_M)
    for m in np.flatnonzero(np.isnan(markers[..., 0]).any(0)):
        requested = [each for each in requests if each.column == m]
        for first, last in find_runs(np.isnan(markers[:, m, 0])) if requested or not is_unsettled[:, m].all() else []:
            gap, middle = (slice(first, last + 1), m), ((first + last) // 2, m)
            spline_sd = max(sd[middle], MIN_FILL_SD_M)
            is_moving = line_sd[middle] >= MIN_LINE_SD_RATIO * spline_sd or last - first < MIN_RESTING_GAP_S * rate
            is_requested = any(first <= each.last and last >= each.first for each in requested)
            is_unsettled[gap] = is_unsettled[gap].any() or not is_moving or is_requested
    position[is_unsettled], sd[is_unsettled] = np.nan, np.nan
    return MarkerEstimate(position, sd, np.full(sd.shape, FillMethod.SPLINE, np.int8))


SIMILAR_LENGTH_RATIO = 1.5  # longest to shortest gap of a group: errors in captures grow by 0.05 %, as with 1.25
MIN_SHARED_GAPS = 20  # gaps from which the second process estimates half of them
UNUSED_OF_BODY = ".joint_positions", ".marker_positions", ".evidence", ".motion.joint_sd"  # arrays that no estimator needs
Fill = tuple[np.ndarray, np.ndarray, np.ndarray]  # the positions (n, 3), deviations (n,) and methods (n,) of n samples
GapFill = tuple[int, int, Fill]  # of a marker, from a first frame on


class _EstimatedMarker(NamedTuple):
    """A lost marker, the similarity of each hidden stretch to its gap, its fill, and the estimates if they are needed again."""

    gap: Gap
    similarity: Float[np.ndarray, " K"]
    fill: Fill
    estimates: list[GapEstimate]

    def is_requested(self, request: FillRequest) -> bool:
        """Return whether a request is for samples of this marker in its gap."""
        frames = self.gap.window.gap_frames
        return self.gap.marker == request.column and bool(frames[0] <= request.last and request.first <= frames[-1])


class _GapEstimation:
    """The estimation of the gaps of a take. There is another one in the second process, with the same fills, if it is shared."""

    def __init__(self, take: MarkersInTake, requested: Collection[int]) -> None:
        self.take, self.requested, markers = take, requested, take.visible_markers
        self.velocity_sd, self.activity = measure_velocity_variation(markers, take.rate), NeighbourActivity(markers, take.rate)
        self.max_speed_m_s = measure_speed_limit(markers, take.rate)
        is_preview = take.body is not None and take.body.evidence is None  # which guesses the segments that no marker shows
        self.estimators = [build(take) for build in ESTIMATORS if not (is_preview and build is BodyPlacement)]
        self.is_shared, self.unsent_fills, self.later_estimators = False, list[GapFill](), list[Estimator]()

    def share(self) -> None:
        """Begin the same estimation in the second process, which then does half."""
        take, body, samples = self.take, self.take.body, np.nonzero(~np.isnan(self.take.estimate.sd))
        if body:
            body = replace(body, take=Take(body.take.markers[:0], body.take.labels, take.rate))
            body = map_arrays(body, body.motion.frame_count, lambda name, of: of[:0] if name.startswith(UNUSED_OF_BODY) else of)
        paths, settled = take.visible_markers.swapaxes(0, 1), [*samples, *(each[samples] for each in take.estimate)]
        others = (take.distance_change_m, take.rate, body, take.rigid_groups)
        compute_beside(_begin_estimation, id(self), paths, settled, others, self.requested)
        self.is_shared = True

    def estimate_markers(self, lost_in_gap: tuple[int, int, Int[np.ndarray, " L"]]) -> list[_EstimatedMarker]:
        """Estimate the markers that are lost in a gap, given its first and last frame, and them."""
        (first, last, lost), estimated = lost_in_gap, list[_EstimatedMarker]()
        is_usable = np.all(self.take.is_known.T[lost], axis=0)
        window = choose_similar_stretches(self.take.markers[:, lost], is_usable, first, last, self.take.rate)
        for gap, similarity in self.describe_gap(window, lost):
            estimates = self.call_estimators(self.estimators, gap)
            fill = combine_gap_estimates(estimates, window, similarity, window.length / self.take.rate)
            is_kept = gap.marker in self.requested or not (fill[1] < MAX_SETTLED_SD_M).all()
            estimated.append(_EstimatedMarker(gap, similarity, fill, estimates if is_kept else []))
        return estimated

    def estimate_later(self, markers: Sequence[Gap]) -> list[list[GapEstimate]]:
        """Return the later estimates of markers that are lost in a gap, once the fills of all gaps are used."""
        self.later_estimators = self.later_estimators or [build(self.take) for build in LATER_ESTIMATORS]
        return [self.call_estimators(self.later_estimators, gap) for gap in markers]

    def describe_gap(
        self, window: GapWindow, lost_markers: Int[np.ndarray, " L"]
    ) -> Iterator[tuple[Gap, Float[np.ndarray, " K"]]]:
        """Yield what is known around each of the markers that are lost throughout a gap, and the similarity of its stretches."""
        take, w, known, gap_s = self.take, window, self.take.is_known, window.length / self.take.rate
        shown = np.flatnonzero(known.T[lost_markers].all(0))
        frames = w.list_frames(shown[sample_evenly(len(shown), MAX_VARIATION_FRAMES)], len(known))
        is_neighbour = np.all(known[max(w.first - 1, 0) : w.first + w.length + 1], axis=0)
        edges = compare_edge_motion(take.markers[:, lost_markers], w, take.rate)
        for n, marker in enumerate(lost_markers.tolist()):
            change = take.distance_change_m[marker]
            order = np.argsort(change, kind="stable")
            neighbours = order[(is_neighbour & np.isfinite(change))[order]]
            gap = Gap(
                marker,
                w,
                lost_markers,
                neighbours,
                *frames,
                activity=self.activity.compare(marker, w, neighbours),
                speed_m_s=edges.estimate_speed_in_gap(n, float(self.velocity_sd[marker]), gap_s),
                variation_growth=compute_variation_growth(known[:, marker], gap_s, take.rate),
            )
            yield gap, np.ascontiguousarray(edges.similarity[:, n])

    def call_estimators(self, estimators: Sequence[Estimator], gap: Gap) -> list[GapEstimate]:
        """Return the estimates of a gap that are nowhere faster than the limit, edges included.

        A cluster of few visible or collinear markers can flip between two frames, which no standard deviation shows.
        """
        w, estimates = gap.window, [e for estimate in estimators for e in estimate(gap)]
        first, last = max(w.first - 1, 0), min(w.first + w.length, len(self.take.markers) - 1)
        paths = np.repeat(self.take.markers[None, first : last + 1, gap.marker], len(estimates), axis=0)
        inside = slice(w.first - first, w.first - first + w.length)
        for path, estimate in zip(paths, estimates, strict=True):
            path[inside] = estimate.position
        step = np.diff(paths, axis=1) * self.take.rate
        is_fast = np.any((step * step).sum(2) > self.max_speed_m_s**2, axis=1)
        is_chosen = ~is_fast & ~np.isnan(paths[:, inside, 0]).all(1)
        return [each for each, is_one in zip(estimates, is_chosen, strict=True) if is_one]

    def map(self, function: "Callable[[_GapEstimation, Part], Value]", parts: Sequence[Part]) -> list[Value]:
        """Return a function, a method of this class, of each part. Parts do not depend on one another."""
        if not self.is_shared or len(parts) < 2:
            return [function(self, part) for part in parts]
        there = compute_beside(_compute_parts, id(self), self.unsent_fills, function, parts[1::2])
        self.unsent_fills = []
        there = there._replace(compute=lambda: [function(self, part) for part in parts[1::2]])  # not by its number
        halves = [function(self, part) for part in parts[::2]], there.finish()
        return [halves[n % 2][n // 2] for n in range(len(parts))]

    def use_fills(self, fills: list[GapFill]) -> None:
        """Use fills. Those that are precise serve as visible from now on."""
        self.unsent_fills += fills if self.is_shared else []
        for marker, first, fill in fills:
            samples = slice(first, first + len(fill[1])), marker
            for values, new in zip(self.take.estimate, fill, strict=True):
                values[samples] = new
            if (fill[1] <= MAX_KNOWN_SD_M).all():
                self.take.markers[samples], self.take.is_known[samples] = fill[0], True


_estimations: dict[int, _GapEstimation] = {}  # in the second process: those that it shares, by number


def _begin_estimation(number: int, paths: np.ndarray, settled: list[np.ndarray], others: Any, requested: Collection[int]) -> None:
    threadpool_limits(1, user_api="blas")  # as in the first process, so that sums are the same
    markers, samples = paths.swapaxes(0, 1), tuple(settled[:2])
    nothing = np.full(markers.shape, np.nan), np.full(markers.shape[:2], np.nan), np.zeros(markers.shape[:2], np.int8)
    known, estimate = markers.copy(order="K"), MarkerEstimate(*nothing)
    for values, new in zip((known, *estimate), (settled[2], *settled[2:]), strict=True):
        values[samples] = new
    _estimations[number] = _GapEstimation(MarkersInTake(markers, known, estimate, *others), requested)


def _compute_parts(
    number: int, fills: list[GapFill], function: Callable[[_GapEstimation, Part], Value], parts: Sequence[Part]
) -> list[Value]:
    if number not in _estimations:
        raise MemoryError  # there was none for the take
    _estimations[number].use_fills(fills)
    return [function(_estimations[number], part) for part in parts]


def _end_estimation(number: int) -> None:
    _estimations.pop(number, None)


def _estimate_gaps(estimation: _GapEstimation, requests: Sequence[FillRequest], *, is_shared: bool) -> list[_EstimatedMarker]:
    """Estimate every gap; if they are shared and many, the second process does half. No gap sees fills of its group."""
    take, estimated = estimation.take, list[list[_EstimatedMarker]]()
    has_ends = take.is_common.copy()
    if take.body:
        has_ends[take.body.marker_columns[take.body.marker_columns >= 0]] = True
    gaps = list(iterate_gaps(~take.is_known, take.is_visible, has_ends))
    if is_shared and len(gaps) >= MIN_SHARED_GAPS:
        estimation.share()
    while gaps:
        longest = SIMILAR_LENGTH_RATIO * (gaps[0][1] - gaps[0][0] + 1)
        group = [(first, last, lost) for first, last, lost in gaps if last - first + 1 <= longest]
        gaps = gaps[len(group) :]
        estimated += (new := estimation.map(_GapEstimation.estimate_markers, group))
        estimation.use_fills([(each.gap.marker, each.gap.window.first, each.fill) for each in chain(*new)])
    uncertain = [[each for each in markers if not (each.fill[1] < MAX_SETTLED_SD_M).all()] for markers in estimated]
    later = estimation.map(_GapEstimation.estimate_later, [[each.gap for each in markers] for markers in uncertain if markers])
    for each in chain(*estimated) if requests else []:
        if any(each.is_requested(request) for request in requests) and (each.fill[1] < MAX_SETTLED_SD_M).all():
            each.estimates.extend(*estimation.estimate_later([each.gap]))
    found = {id(each): of_later for each, of_later in zip(chain(*uncertain), chain(*later), strict=True)}
    place_on_hand = BodyPlacement(take, take.hands)  # last, so that fills of fingers change no other
    for each in chain(*estimated):
        added = [*found.get(id(each), ()), *estimation.call_estimators([place_on_hand], each.gap)]
        if not added:
            continue
        each.estimates.extend(added)
        fill = combine_gap_estimates(each.estimates, each.gap.window, each.similarity, each.gap.window.length / take.rate)
        if len(each.gap.lost_markers) >= MIN_LIMB_MARKERS:
            sd = np.minimum(fill[1] * compare_with_spread(each.estimates, fill), np.maximum(fill[1], MAX_LIMB_SD_M))
            fill = fill[0], np.maximum(sd, MIN_FILL_SD_M), fill[2]
        estimation.use_fills([(each.gap.marker, each.gap.window.first, fill)])
    return list(chain(*estimated))


def _use_request(take: MarkersInTake, gaps: Sequence[_EstimatedMarker], request: FillRequest) -> None:
    """Set the requested samples to the estimates of one method."""
    wanted = np.arange(request.first, request.last + 1)
    wanted = wanted[~take.is_visible[wanted, request.column]]
    take.estimate.sd[wanted, request.column] = np.nan
    for each in gaps:
        chosen = [estimate for estimate in each.estimates if estimate.method.name.lower() == request.method]
        if each.is_requested(request) and chosen:
            frames = np.intersect1d(each.gap.window.gap_frames, wanted)
            combined = combine_gap_estimates(chosen, each.gap.window, each.similarity, each.gap.window.length / take.rate)
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
        step = (markers[self.lag :] - markers[: -self.lag]) * (rate / self.lag)
        square = np.einsum("tma,tma->tm", step, step)
        self.is_known, self.square = ~np.isnan(square), np.nan_to_num(square)
        is_visible = (~np.isnan(markers[self.lag // 2 :, :, 0][: len(square)])).T.astype(float)
        count = is_visible @ self.is_known.astype(float)
        # of all markers while one is visible
        self.square_with = is_visible @ self.square / np.where(count >= MIN_COMPARED_STEPS, count, np.nan)

    def compare(self, marker: int, window: GapWindow, neighbours: Int[np.ndarray, " N"]) -> float:
        """Return how many times as fast neighbours, the steadiest first, are in a gap as while the marker is visible, or one."""
        if not len(self.square):
            return 1.0
        first = min(max(0, window.first - self.lag // 2), len(self.square) - 1)
        steps = slice(first, max(first + 1, window.first + window.length - self.lag // 2))
        is_known = self.is_known[steps][:, neighbours]
        count = np.where(is_known.mean(0) > MIN_KNOWN_GAP_SHARE, is_known.sum(0), np.nan)
        in_gap = self.square[steps][:, neighbours].sum(0) / count
        both = np.stack([in_gap, self.square_with[marker, neighbours]])
        both = both[:, ~np.isnan(both).any(0)][:, :MAX_ACTIVITY_NEIGHBOURS]
        if not both.size:
            return 1.0
        difference = np.diff(np.log(both + MIN_COMPARED_SPEED_M_S**2), axis=0).mean()
        return float(np.exp(np.clip(-difference / 2, 0, np.log(MAX_ACTIVITY_RATIO))))


MAX_SPEED_RATIO = 3.0  # speed of an estimate, relative to the fastest visible motion, above which it is rejected
SPEED_PERCENTILE = 99.9  # percentile of the speeds of visible markers that counts as the fastest visible motion
MIN_SPEED_LIMIT_M_S = 2.0  # smallest value of this fastest speed, for takes with little motion


def measure_velocity_variation(markers: Float[np.ndarray, "T M 3"], rate: float) -> Float[np.ndarray, " M"]:
    """Return the standard deviation of each marker's velocity in m/s; near that of all for markers that show little of it.

    Velocities are those over VELOCITY_SPAN_S, in which noise is small.
    """
    lag = min(max(1, round(VELOCITY_SPAN_S * rate)), max(1, len(markers) - 1))
    step = markers[lag:] - markers[:-lag]
    count, step = (~np.isnan(step[..., 0])).sum(0), np.nan_to_num(step)
    frames = np.maximum(count, 1)
    square = np.maximum(np.einsum("tma,tma->m", step, step) / frames - ((step.sum(0).T / frames) ** 2).sum(0), 0.0)
    typical = square[count > 0].mean() if (count > 0).any() else 0.0
    typical_share = np.exp(-count / lag)
    return np.sqrt(typical_share * typical + (1 - typical_share) * square) * rate / lag


def measure_speed_limit(markers: Float[np.ndarray, "T M 3"], rate: float) -> float:
    """Return the largest speed of an estimate in m/s; infinite if no marker is visible in two frames in a row.

    Args:
        markers: Metres, NaN if not visible or an outlier.
        rate: Frame rate in Hz.
    """
    speeds = compute_lengths(np.diff(markers, axis=0)) * rate
    visible = speeds[~np.isnan(speeds)]
    if not len(visible):
        return np.inf
    return MAX_SPEED_RATIO * max(float(np.percentile(visible, SPEED_PERCENTILE)), MIN_SPEED_LIMIT_M_S)


EXPECTED_CORRELATION = 0.3  # expected correlation of the errors of two estimates of one sample
SHORT_GAP_S = 0.3  # duration of a gap at which a hidden stretch tells half as much beyond what one of a long gap tells
SHORT_GAP_STRETCHES = 3.0
"""Number of stretches of a long gap that one of a very short gap is worth: errors of one method in short gaps are more alike."""
MIN_WEIGHED_SD_M = 0.00003  # standard deviation of an estimate below which it has no more weight
SAME_AXES_CORRELATION = 0.75  # the same where both were made in the same axes


def combine_gap_estimates(
    estimates: Sequence[GapEstimate], window: GapWindow, similarity: Float[np.ndarray, " K"], gap_s: float
) -> Fill:
    """Return the combination of estimates with the smallest expected error: positions, their deviations, and the main methods.

    An estimate that lacks some frames counts in the others only. Without estimates there is none: NaN.

    Args:
        similarity: Of each hidden stretch to the gap, 0 to 1.
        gap_s: Duration of the gap.
    """
    out = np.full((window.length, 3), np.nan), np.full(window.length, np.nan), np.zeros(window.length, np.int8)
    if not estimates:
        return out
    position, error, expected_sd = (np.stack(each) for each in zip(*(e[1:4] for e in estimates), strict=True))
    largest = np.nanmax(expected_sd, axis=1, initial=MIN_FILL_SD_M, keepdims=True)
    expected_sd = np.where(np.isnan(expected_sd), largest, expected_sd)  # of one that lacks frames
    correlation = build_expected_correlation([e.axes for e in estimates])
    worth = 1 + (SHORT_GAP_STRETCHES - 1) / (1 + (gap_s / SHORT_GAP_S) ** 4)
    shown = window.hidden_length / window.length * np.array([e.evidence for e in estimates])
    methods, independent = np.array([int(e.method) for e in estimates]), worth * window.count_independent_stretches()
    weighting = similarity, independent, shown, correlation, MIN_WEIGHED_SD_M, window.points, methods
    combine_estimates(position, error, expected_sd, *weighting, out)
    np.maximum(out[1], MIN_REPORTED_SD_M, out=out[1])
    return out


MAX_LIMB_SD_M = 0.24  # to which a spread can raise the deviation per axis of a limb: with more, fast limbs were left empty
USUAL_LIMB_SD_M = 0.06  # standard deviation per axis of a limb's fill at which it is the mean that `compare_with_spread` takes
LIMB_SD_GROWTH = 0.3
"""Power of this mean, relative to USUAL_LIMB_SD_M, by which the deviation is too near to it. It and USUAL_LIMB_SD_M were measured
on composed takes of 3 to 30 s of training people, in gaps of 0.5 to 2 s."""


def compare_with_spread(estimates: Sequence[GapEstimate], fill: Fill) -> float:
    """Return the factor by which the spread of a limb's estimates in its gap changes the deviations of its fill.

    How much a limb moves differs from gap to gap, so that errors elsewhere in the take say too little about those in a gap. Where
    its estimates disagree, its errors are large (Birge 1932, "The calculation of errors by the method of least squares"). The
    deviation is the geometric mean of the expected one and the weighted spread about the fill.
    """
    estimates = [e for e in estimates if 0 < np.nansum(e.expected_sd) < np.inf and np.isfinite(e.position + fill[0]).any()]
    if len(estimates) < 2:  # one alone cannot disagree
        return 1.0
    squares, variances = np.array([[np.nanmean((e.position - fill[0]) ** 2), np.nanmean(e.expected_sd**2)] for e in estimates]).T
    shown = [e.error[~np.isnan(e.error)] for e in estimates]
    measured = np.array([(each**2).mean() if len(each) else v for each, v in zip(shown, variances, strict=True)])
    weights = 1 / np.maximum(np.sqrt(variances * measured), MIN_FILL_SD_M**2)
    expected_m, spread_m = np.sqrt(np.nanmean(fill[1] ** 2)), np.sqrt(np.average(squares, weights=weights))
    mean_m = np.sqrt(expected_m * max(spread_m, MIN_FILL_SD_M))
    return float(mean_m / expected_m * (mean_m / USUAL_LIMB_SD_M) ** LIMB_SD_GROWTH)


def build_expected_correlation(axes: Sequence[str | None]) -> Float[np.ndarray, "E E"]:
    """Return the expected correlations of the errors of estimates in axes with these names."""
    is_same = np.array([[a is not None and a == b for b in axes] for a in axes])
    return np.where(is_same, SAME_AXES_CORRELATION, EXPECTED_CORRELATION)
