"""Estimates of every gap of a take, weighted by what each of them achieves where the same markers are hidden elsewhere in it.

`estimate_gaps` fills a gap from the marker's own trajectory, from rigid clusters of its neighbours and by a regression on their
deformation, the short gaps first: what is filled precisely is a neighbour for longer ones. `add_processes` adds a Gaussian
process over all markers where these leave a gap uncertain. The weights come from two kinds of evidence:

- `choose_hidden_stretches`: visible parts of the take that imitate the gap and are treated as missing. They are as long, hide
  the same markers, and have visible samples beside them; where the take has none that long, shorter ones, which are worth less;
- `measure_neighbour_errors`: markers that are visible throughout the gap are treated as missing in it. Hidden stretches are few
  in a short take, and often those in which the marker rests; the neighbours show how the person moves during this gap.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.fill.cluster_fill import MAX_DISTANCE_CHANGE_M, MIN_CLUSTER_MARKERS
from mocapfix.fill.edge_interpolation import (
    ACTIVITY_POWER,
    EdgeMotion,
    MethodRatios,
    build_edge_maps,
    compare_edge_motion,
    compute_expected_sd,
    estimate_from_edges,
)
from mocapfix.fill.fill_methods import (
    FillMethod,
    GapEstimate,
    GapWindow,
    MarkerEstimate,
    MovingAxes,
    SpeedLimit,
    build_marker_estimate,
    measure_speed_limit,
    measure_velocity_variation,
)
from mocapfix.fill.marker_processes import MAX_SETTLED_SD_M, MIN_VISIBLE_SHARE, MarkerProcesses
from mocapfix.fill.neighbour_clusters import (
    MIN_KEPT_FRAME_SHARE,
    build_changing_axes,
    build_cluster_axes,
    estimate_by_regression,
    measure_distance_changes,
    remove_steps,
    select_changing_cluster,
    select_regression_cluster,
)
from mocapfix.fill.spline_fill import fill_with_splines
from mocapfix.fill.weighted_estimates import combine_gap_estimates
from mocapfix.stats.sequences import group_gaps, sample_evenly

MAX_HIDDEN_STRETCHES = 12  # stretches that are hidden for one gap
MIN_STRETCH_STARTS = 2  # first frames that must be possible for stretches of a length
MIN_STARTS_PER_LENGTH = 0.05  # the same, relative to the length
SHORTER_STRETCH_RATIO = 0.7  # ratio by which stretches are shortened at a time while too few first frames are possible
MAX_EXAMINED_STARTS = 4000  # first frames that are examined
MAX_GAP_POINTS = 7  # points along a gap at which errors are measured
MAX_EDGE_SAMPLES = 4  # samples at each edge of a gap that are used
EDGE_CONTEXT_S = 0.06  # time on either side of a gap whose samples determine position and velocity at its edge


def choose_hidden_stretches(is_usable: Bool[np.ndarray, " T"], first: int, last: int, rate: float) -> GapWindow:
    """Return the window of a gap first..last.

    is_usable  frames in which all markers are visible that the gap hides
    rate       frame rate in Hz
    """
    length, reach = last - first + 1, max(1, round(EDGE_CONTEXT_S * rate))
    before = -1 - find_adjacent_samples(is_usable[max(0, first - reach) : first][::-1])[::-1]
    steps = find_adjacent_samples(is_usable[last + 1 : last + 1 + reach])
    lead, tail = (-int(before[0]) if len(before) else 0), (int(steps[-1]) + 1 if len(steps) else 0)
    hidden_length, starts = find_stretches(is_usable, length, lead, tail)
    count = min(length, MAX_GAP_POINTS)
    return GapWindow(
        first, length, before, length + steps, space_points(length, count),
        starts, hidden_length, hidden_length + steps, space_points(hidden_length, count),
    )  # fmt: skip


def find_adjacent_samples(is_usable: Bool[np.ndarray, " N"]) -> Int[np.ndarray, " A"]:
    """Return indices of usable samples, the first and some others, if the first is usable; otherwise none."""
    usable = np.flatnonzero(is_usable)
    return usable[sample_evenly(len(usable), MAX_EDGE_SAMPLES)] if len(usable) and usable[0] == 0 else usable[:0]


def space_points(length: int, count: int) -> Int[np.ndarray, " S"]:
    """Return the offsets of evenly spaced points from the first to the last frame of a gap."""
    return np.round(np.linspace(0, length - 1, count)).astype(int)


def find_stretches(is_usable: Bool[np.ndarray, " T"], length: int, lead: int, tail: int) -> tuple[int, Int[np.ndarray, " K"]]:
    """Return the length of the stretches, the gap's own if the take has enough of them, and their first frames.

    lead, tail  frames before and after a stretch that must be usable too
    """
    missing_before = np.concatenate([[0], np.cumsum(~is_usable)])
    while True:
        span = lead + length + tail
        step = 1 + max(0, len(is_usable) - span) // MAX_EXAMINED_STARTS
        starts = np.arange(0, len(is_usable) - span + 1, step)
        starts = starts[missing_before[starts + span] == missing_before[starts]] + lead
        if length == 1 or len(starts) * step >= max(MIN_STRETCH_STARTS, MIN_STARTS_PER_LENGTH * length):
            return length, starts[sample_evenly(len(starts), MAX_HIDDEN_STRETCHES)] if len(starts) else starts
        length = max(1, int(length * SHORTER_STRETCH_RATIO))


MAX_RATIO_NEIGHBOURS = 8  # number of neighbours, the steadiest first, whose errors are compared with the expected ones
COMPARED_ERROR_MARGIN_M = 0.001  # length that is added to both errors: smaller ones count as equal
VELOCITY_SPAN_S = 0.1  # time over which speeds are measured
MIN_COMPARED_SPEED_M_S = 0.02  # speed below which neighbours count as equally at rest
MIN_COMPARED_STEPS = 5  # steps in which a neighbour must be visible while the marker is
MIN_KNOWN_GAP_SHARE = 0.8  # share of a gap in which a neighbour must be visible
MAX_ACTIVITY_RATIO = 30.0  # largest ratio of the neighbours' speeds


class NeighbourActivity:
    """The speeds of all markers, which show whether a marker is visible mainly while the person rests.

    markers  in metres, NaN if not visible
    rate     frame rate in Hz
    """

    def __init__(self, markers: Float[np.ndarray, "T M 3"], rate: float) -> None:
        self.lag = min(max(1, round(VELOCITY_SPAN_S * rate)), max(1, len(markers) - 1))
        square = (((markers[self.lag :] - markers[: -self.lag]) * (rate / self.lag)) ** 2).sum(-1)
        self.is_known, self.square = ~np.isnan(square), np.nan_to_num(square)
        self.is_visible = ~np.isnan(markers[self.lag // 2 :, :, 0][: len(square)])
        self._square_with_marker: dict[int, np.ndarray] = {}

    def compare(self, marker: int, window: GapWindow, neighbours: Int[np.ndarray, " N"]) -> float:
        """Return how many times as fast neighbours are in a gap as while the marker is visible, at least one.

        neighbours  the steadiest first
        """
        if not len(self.square):
            return 1.0
        first = min(max(0, window.first - self.lag // 2), len(self.square) - 1)
        steps = slice(first, max(first + 1, window.first + window.length - self.lag // 2))
        in_gap = self._average(neighbours, self.square[steps][:, neighbours], self.is_known[steps][:, neighbours])
        with_marker = self._compute_squares_with(marker)[neighbours]
        both = np.stack([in_gap, with_marker])[:, ~np.isnan(in_gap + with_marker)][:, :MAX_RATIO_NEIGHBOURS]
        if not both.size:
            return 1.0
        difference = np.diff(np.log(both + MIN_COMPARED_SPEED_M_S**2), axis=0).mean()
        return float(np.exp(np.clip(-difference / 2, 0, np.log(MAX_ACTIVITY_RATIO))))

    @staticmethod
    def _average(neighbours: np.ndarray, square: np.ndarray, is_known: np.ndarray) -> np.ndarray:
        mean = np.full(len(neighbours), np.nan)
        return np.divide(square.sum(0), is_known.sum(0), out=mean, where=is_known.mean(0) > MIN_KNOWN_GAP_SHARE)

    def _compute_squares_with(self, marker: int) -> np.ndarray:
        """Return the mean square speed of all markers while one is visible; NaN where unknown."""
        if marker not in self._square_with_marker:
            weight = self.is_visible[:, marker].astype(float)
            count = weight @ self.is_known
            mean = np.full(len(count), np.nan)
            np.divide(weight @ self.square, count, out=mean, where=count >= MIN_COMPARED_STEPS)
            self._square_with_marker[marker] = mean
        return self._square_with_marker[marker]


class NeighbourErrors(NamedTuple):
    """The errors of K methods for M markers in one gap."""

    # (K, M) logarithms of the errors relative to that expected of the straight method; NaN where a marker is not visible
    log_ratio: np.ndarray

    def compute_ratios(self, neighbours: Int[np.ndarray, " N"]) -> MethodRatios | None:
        """Return the mean ratios of some markers, the steadiest first; None if none of them is visible.

        neighbours  markers in descending order of how constant their distance to the lost one is
        """
        known = neighbours[~np.isnan(self.log_ratio[:, neighbours]).any(0)][:MAX_RATIO_NEIGHBOURS]
        return MethodRatios(self.log_ratio[:, known].mean(1), len(known)) if len(known) else None


def measure_neighbour_errors(
    markers: Float[np.ndarray, "T M 3"], window: GapWindow, rate: float, velocity_sd: Float[np.ndarray, " M"]
) -> NeighbourErrors:
    """Return the errors of the markers that are visible at the points of a gap and beside it.

    markers      in metres, NaN if not visible
    velocity_sd  variation of each marker's velocity in m/s
    """
    w = window
    maps = np.stack(build_edge_maps(w.before, w.after, w.length, w.points, rate))
    error = np.einsum("kpc,cma->kpma", maps, markers[w.context_frames]) - markers[w.first + w.points]
    size = np.sqrt((error**2).sum(-1).mean(1))
    expected = np.sqrt(3 * (compute_expected_sd(w, rate, 1.0, None) ** 2).mean()) * velocity_sd
    return NeighbourErrors(np.log((size + COMPARED_ERROR_MARGIN_M) / (expected + COMPARED_ERROR_MARGIN_M)))


CLUSTER_SIZES = (4, 8)  # numbers of the steadiest neighbours that define axes
MIN_LIMB_MARKERS = 3  # markers lost together from which all others define axes too
MAX_VARIATION_FRAMES = 100  # frames that show how much a marker varies in the axes of a cluster
MAX_LONE_SPLINE_GAP_S = 0.5  # duration of the longest gap that is filled by a spline alone
MAX_LONE_SPLINE_SD_M = 0.0005  # standard deviation of a spline up to which nothing else is tried
MAX_KNOWN_SD_M = 0.003  # standard deviation of a filled gap below which it serves as visible for longer gaps


def estimate_without_body(markers: Float[np.ndarray, "T M 3"], is_inlier: Bool[np.ndarray, "T M"], rate: float) -> MarkerEstimate:
    """Return the estimates of all samples that are missing or no inliers, where no body is solved.

    markers    in metres, NaN if missing
    is_inlier  samples that are used
    rate       frame rate in Hz
    """
    markers = np.where(is_inlier[..., None], markers, np.nan)
    position, sd = fill_with_splines(markers, rate, MAX_LONE_SPLINE_GAP_S)
    is_unsettled = ~(sd <= MAX_LONE_SPLINE_SD_M)
    position[is_unsettled], sd[is_unsettled] = np.nan, np.nan
    settled = build_marker_estimate(position, sd, FillMethod.SPLINE)
    if not (np.isnan(markers[..., 0]) & is_unsettled).any():
        return settled
    estimate, gaps, neighbourhood = estimate_gaps(markers, settled, rate, measure_speed_limit(markers, rate))
    return add_processes(estimate, gaps, neighbourhood, markers)


class EstimatedGap(NamedTuple):
    """A gap, the markers that are lost throughout it, and for each its estimates and the activity of its neighbours."""

    window: GapWindow
    lost_markers: np.ndarray
    estimates: list[list[GapEstimate]]
    activities: list[float]
    is_limb: list[bool]  # for each whether it is one of several lost markers of a limb


class Neighbourhood:
    """The markers of a take, visible or filled precisely, and how constant their distances are."""

    def __init__(self, markers: np.ndarray, settled: MarkerEstimate, rate: float, limit: SpeedLimit) -> None:
        self.rate, self.limit, self.is_visible = rate, limit, ~np.isnan(markers[..., 0])
        self.is_common = self.is_visible.mean(0) > MIN_VISIBLE_SHARE
        self.change_m = measure_distance_changes(markers)
        self.velocity_sd = measure_velocity_variation(markers, rate)
        self.activity = NeighbourActivity(markers, rate)
        is_settled = ~np.isnan(settled.sd)
        self.markers = np.where(is_settled[..., None], settled.position, markers)
        self.is_known = ~np.isnan(self.markers[..., 0])

    def open_window(self, first: int, last: int, lost_markers: np.ndarray) -> GapWindow:
        """Return the window of a gap of some markers."""
        is_shown: np.ndarray = np.all(self.is_known[:, lost_markers], axis=1)
        return choose_hidden_stretches(is_shown, first, last, self.rate)

    def estimate_gap(self, window: GapWindow, lost_markers: np.ndarray) -> EstimatedGap:
        """Return the estimates of the markers that are lost throughout a gap."""
        w, known = window, self.is_known
        shown = np.flatnonzero(known[:, lost_markers].all(1))
        shown = shown[sample_evenly(len(shown), MAX_VARIATION_FRAMES)] if len(shown) else shown
        used = (shown, w.gap_frames, w.context_frames, w.hidden_frames.ravel(), w.hidden_context_frames.ravel())
        frames = np.unique(np.concatenate(used))
        is_neighbour = np.all(known[max(w.first - 1, 0) : w.first + w.length + 1], axis=0)
        is_lost = self.is_common & ~known[w.first + w.length // 2]
        is_limb = [self._is_in_lost_limb(marker, is_lost) for marker in lost_markers.tolist()]
        others = self._build_axes_of_others(lost_markers, is_neighbour, frames) if any(is_limb) else None
        errors = measure_neighbour_errors(self.markers, w, self.rate, self.velocity_sd) if len(w.context_frames) else None
        gap = EstimatedGap(w, lost_markers, [], [], is_limb)
        for marker, in_limb in zip(lost_markers.tolist(), is_limb, strict=True):
            order = self._order_neighbours(marker, is_neighbour)
            gap.activities.append(self.activity.compare(marker, w, order))
            surroundings = _MarkerSurroundings(w, frames, order, gap.activities[-1], others if in_limb else None, errors, in_limb)
            gap.estimates.append(self._estimate_marker(marker, surroundings))
        return gap

    def _is_in_lost_limb(self, marker: int, is_lost: np.ndarray) -> bool:
        """Return whether a lost marker is one of several on the same limb."""
        steadiest = np.argsort(np.where(self.is_common, self.change_m[marker], np.inf), kind="stable")[: CLUSTER_SIZES[0]]
        return 1 + int(is_lost[steadiest].sum()) >= MIN_LIMB_MARKERS

    def _order_neighbours(self, marker: int, is_neighbour: np.ndarray) -> np.ndarray:
        """Return the neighbours of a marker, those with the most constant distance first."""
        order = np.argsort(self.change_m[marker], kind="stable")
        return order[is_neighbour[order] & np.isfinite(self.change_m[marker, order])]

    def _estimate_marker(self, marker: int, surroundings: "_MarkerSurroundings") -> list[GapEstimate]:
        """Return the estimates of one marker."""
        window, order, change = surroundings.window, surroundings.neighbours, self.change_m[marker]
        estimates = self._estimate_from_edges(marker, surroundings) if len(window.context_frames) else []
        cluster = select_regression_cluster(self.is_known, marker, order[change[order] < MAX_DISTANCE_CHANGE_M])
        if len(cluster) >= MIN_CLUSTER_MARKERS:
            regressed = estimate_by_regression(self.markers, marker, cluster, change[cluster], window, self.rate)
            estimates += [regressed.grow(surroundings.activity**ACTIVITY_POWER)] if regressed else []
        return [each for each in estimates if self.is_plausible(each, marker, window)]

    def _estimate_from_edges(self, marker: int, surroundings: "_MarkerSurroundings") -> list[GapEstimate]:
        """Return the interpolations of one marker, in the world and in axes of its neighbours."""
        window, frames, neighbours, activity, others, errors, is_limb = surroundings
        change, axes = self.change_m[marker], list[MovingAxes | None]([None, others] if others else [None])
        for size in CLUSTER_SIZES:
            cluster = neighbours[:size]
            if len(cluster) >= MIN_CLUSTER_MARKERS and (size == CLUSTER_SIZES[0] or len(neighbours) > CLUSTER_SIZES[0]):
                built = build_cluster_axes(self.markers, cluster, change[cluster], frames)
                axes += [built] if built else []
        # What it costs that members come and go is not known where no stretch shows it.
        is_tried = len(window.starts) > 0 or len(neighbours) < MIN_CLUSTER_MARKERS
        changing = select_changing_cluster(self.is_known, change, window, CLUSTER_SIZES[-1]) if is_tried else None
        changing_axes = build_changing_axes(self.markers, changing, window, frames) if changing else None
        edges = self.compare_edges(marker, window)
        speed = edges.estimate_speed_in_gap(float(self.velocity_sd[marker]), window.length / self.rate)
        ratios = errors.compute_ratios(neighbours) if errors else None
        estimates: list[GapEstimate] = []
        for number, each in enumerate(axes):
            estimates += estimate_from_edges(
                self.markers[:, marker],
                each,
                window,
                self.rate,
                speed,
                ratios=ratios if each is None or is_limb else None,
                axes_number=number,
                activity=activity,
            )
        if changing and changing_axes:
            in_changing_axes = estimate_from_edges(
                self.markers[:, marker], changing_axes, window, self.rate, speed, axes_number=len(axes), activity=activity
            )
            estimates += [remove_steps(each, changing, window) for each in in_changing_axes]
        return estimates

    def compare_edges(self, marker: int, window: GapWindow) -> EdgeMotion:
        """Return how fast a marker is beside a gap, and how similar the hidden stretches are."""
        return compare_edge_motion(self.markers[:, marker], window, self.rate)

    def is_plausible(self, estimate: GapEstimate, marker: int, window: GapWindow) -> bool:
        """Return whether an estimate is complete and nowhere impossibly fast, edges included."""
        beside = np.concatenate([[window.first - 1], window.gap_frames, [window.first + window.length]])
        path = self.markers[np.clip(beside, 0, len(self.markers) - 1), marker].copy()
        path[1:-1] = estimate.position
        return not np.isnan(estimate.position).any() and not self.limit.is_exceeded(path, self.rate)

    def _build_axes_of_others(self, lost_markers: np.ndarray, is_neighbour: np.ndarray, frames: np.ndarray) -> MovingAxes | None:
        """Return axes fixed to all neighbours of a lost limb; None if few markers are left."""
        cluster = np.setdiff1d(np.flatnonzero(is_neighbour), lost_markers)
        if len(cluster) <= CLUSTER_SIZES[-1]:
            return None
        change = np.median(self.change_m[np.ix_(cluster, cluster)], axis=1)
        return build_cluster_axes(self.markers, cluster, np.where(np.isfinite(change), change, 1.0), frames)

    def remember(self, estimated: MarkerEstimate, window: GapWindow, lost_markers: np.ndarray) -> None:
        """Use what was filled precisely as visible from now on."""
        for marker in lost_markers:
            samples = window.gap_frames, marker
            if (estimated.sd[samples] <= MAX_KNOWN_SD_M).all():
                self.markers[samples] = estimated.position[samples]
                self.is_known[samples] = True


class _MarkerSurroundings(NamedTuple):
    """What is known around a marker that is lost throughout a gap."""

    window: GapWindow
    frames: np.ndarray  # in which it is compared with its neighbours
    neighbours: np.ndarray  # markers that are known throughout, those with the most constant distance first
    activity: float  # how many times as fast they are in the gap as while the marker is visible
    axes_of_others: MovingAxes | None  # axes fixed to all of them; None if few are left, or no limb is lost
    errors: NeighbourErrors | None  # of the neighbours in the gap; None if nothing is visible beside it
    is_limb: bool  # whether the marker is one of several lost markers of a limb


def estimate_gaps(
    markers: Float[np.ndarray, "T M 3"], settled: MarkerEstimate, rate: float, limit: SpeedLimit
) -> tuple[MarkerEstimate, list[EstimatedGap], Neighbourhood]:
    """Return the estimates of the missing samples from trajectories and neighbours, and those of each gap.

    markers  in metres, NaN if not visible or an outlier
    settled  samples that splines fill precisely
    rate     frame rate in Hz
    limit    on the speed of a marker
    """
    neighbourhood = Neighbourhood(markers, settled, rate, limit)
    result = MarkerEstimate(*(values.copy() for values in settled))
    estimated: list[EstimatedGap] = []
    for first, last, lost in iterate_gaps(np.isnan(neighbourhood.markers[..., 0]), neighbourhood.is_visible):
        window = neighbourhood.open_window(first, last, lost)
        estimated.append(neighbourhood.estimate_gap(window, lost))
        for marker, each in zip(lost.tolist(), estimated[-1].estimates, strict=True):
            if each:
                _store(result, marker, window, each, neighbourhood.compare_edges(marker, window).similarity)
        neighbourhood.remember(result, window, lost)
    return result, estimated, neighbourhood


def _store(
    result: MarkerEstimate, marker: int, window: GapWindow, estimates: list[GapEstimate], similarity: Float[np.ndarray, " K"]
) -> None:
    """Set the samples of one marker in a gap to the combination of its estimates."""
    samples = window.gap_frames, marker
    result.position[samples], result.sd[samples], result.method[samples] = combine_gap_estimates(estimates, window, similarity)


def iterate_gaps(is_missing: np.ndarray, is_visible: np.ndarray) -> Iterator[tuple[int, int, np.ndarray]]:
    """Yield the first and last frame of each gap and the markers it has, the shortest first.

    Markers that are visible together come together. A marker that is rarely visible has no gaps at the beginning and end.
    """
    gaps, is_common = group_gaps(is_missing & is_visible.any(0)), is_visible.mean(0) > MIN_VISIBLE_SHARE
    for (first, last), lost in sorted(gaps.items(), key=lambda gap: (gap[0][1] - gap[0][0], gap[0])):
        is_inside = first > 0 and last < len(is_missing) - 1
        remaining = lost if is_inside else lost[is_common[lost]]
        while len(remaining):
            together = _select_visible_together(is_visible, remaining)
            yield first, last, together
            remaining = np.setdiff1d(remaining, together)


def _select_visible_together(is_visible: np.ndarray, markers: np.ndarray) -> np.ndarray:
    """Return the marker that is visible most often and those that leave enough of the frames in which it is."""
    by_frequency = markers[np.argsort(-is_visible[:, markers].sum(0), kind="stable")]
    shared, together = is_visible[:, by_frequency[0]].copy(), [int(by_frequency[0])]
    for marker in by_frequency[1:].tolist():
        both = shared & is_visible[:, marker]
        if both.sum() >= MIN_KEPT_FRAME_SHARE * shared.sum():
            shared = both
            together.append(marker)
    return np.sort(together)


def add_processes(
    result: MarkerEstimate,
    gaps: list[EstimatedGap],
    neighbourhood: Neighbourhood,
    visible_markers: Float[np.ndarray, "T M 3"],
) -> MarkerEstimate:
    """Return the estimates with Gaussian processes in the gaps that the others leave uncertain."""
    is_settled = result.sd < MAX_SETTLED_SD_M
    uncertain = [(gap, np.flatnonzero(~is_settled[gap.window.gap_frames][:, gap.lost_markers].all(0))) for gap in gaps]
    if not any(len(rows) for _, rows in uncertain):
        return result
    processes = MarkerProcesses(visible_markers, result.position, result.sd, neighbourhood.rate)
    result = MarkerEstimate(*(values.copy() for values in result))
    for (window, lost, estimates, activities, is_limb), rows in uncertain:
        predicted = processes.estimate_gap(window, lost[rows]) if len(rows) else None
        for row, process in zip(rows.tolist(), predicted or [], strict=False):
            marker, growth = int(lost[row]), 1.0 if is_limb[row] else activities[row] ** ACTIVITY_POWER
            if neighbourhood.is_plausible(process, marker, window):
                grown = process.grow(growth)
                similarity = neighbourhood.compare_edges(marker, window).similarity
                _store(result, marker, window, [*estimates[row], grown], similarity)
    return result
