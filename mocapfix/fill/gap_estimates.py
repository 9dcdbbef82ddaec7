"""Estimates of every gap of a take, weighted by what each of them achieves where the same markers are hidden elsewhere in it.

A gap is filled from the marker's own trajectory, from rigid clusters of its neighbours, by a regression on their deformation and,
where these leave it uncertain, by a Gaussian process over all markers. Short gaps come first: what is filled precisely is a
neighbour for longer ones.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from mocapfix.fill.cluster_fill import MAX_DISTANCE_CHANGE_M, MIN_CLUSTER_MARKERS
from mocapfix.fill.edge_interpolation import estimate_from_edges
from mocapfix.fill.edge_motion import EdgeMotion, compare_edge_motion
from mocapfix.fill.fill_methods import FillMethod, GapEstimate, GapWindow, MarkerEstimate, MovingAxes, build_marker_estimate
from mocapfix.fill.gaussian_process_fill import MAX_SETTLED_SD_M, MIN_VISIBLE_SHARE
from mocapfix.fill.hidden_stretches import choose_hidden_stretches
from mocapfix.fill.marker_processes import MarkerProcesses
from mocapfix.fill.marker_speeds import SpeedLimit, measure_speed_limit, measure_velocity_variation
from mocapfix.fill.neighbour_clusters import (
    build_cluster_axes,
    estimate_by_regression,
    measure_distance_changes,
    select_regression_cluster,
)
from mocapfix.fill.spline_fill import fill_with_splines
from mocapfix.fill.weighted_estimates import combine_gap_estimates
from mocapfix.stats.sequences import group_gaps, sample_evenly

CLUSTER_SIZES = (4, 8)
"""Numbers of the steadiest neighbours that define axes."""
MIN_LIMB_MARKERS = 3
"""Markers lost together from which all others define axes too."""
MAX_VARIATION_FRAMES = 100
"""Frames that show how much a marker varies in the axes of a cluster."""
MAX_LONE_SPLINE_GAP_S = 0.5
"""Duration of the longest gap that is filled by a spline alone."""
MAX_LONE_SPLINE_SD_M = 0.0005
"""Standard deviation of a spline up to which nothing else is tried."""
MAX_KNOWN_SD_M = 0.003
"""Standard deviation of a filled gap below which it serves as visible for longer gaps."""


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
    """A gap, the markers that are lost throughout it, and the estimates of each."""

    window: GapWindow
    lost_markers: np.ndarray
    estimates: list[list[GapEstimate]]


class Neighbourhood:
    """The markers of a take, visible or filled precisely, and how constant their distances are."""

    def __init__(self, markers: np.ndarray, settled: MarkerEstimate, rate: float, limit: SpeedLimit) -> None:
        self.rate, self.limit, self.is_visible = rate, limit, ~np.isnan(markers[..., 0])
        self.change_m = measure_distance_changes(markers)
        self.velocity_sd = measure_velocity_variation(markers, rate)
        is_settled = ~np.isnan(settled.sd)
        self.markers = np.where(is_settled[..., None], settled.position, markers)

    def open_window(self, first: int, last: int, lost_markers: np.ndarray) -> GapWindow:
        """Return the window of a gap of some markers."""
        is_shown = np.all(~np.isnan(self.markers[:, lost_markers, 0]), axis=1)
        return choose_hidden_stretches(is_shown, first, last, self.rate)

    def estimate_gap(self, window: GapWindow, lost_markers: np.ndarray) -> list[list[GapEstimate]]:
        """Return the estimates of each marker that is lost throughout a gap."""
        w, known = window, ~np.isnan(self.markers[..., 0])
        shown = np.flatnonzero(known[:, lost_markers].all(1))
        shown = shown[sample_evenly(len(shown), MAX_VARIATION_FRAMES)] if len(shown) else shown
        used = (shown, w.gap_frames, w.context_frames, w.hidden_frames.ravel(), w.hidden_context_frames.ravel())
        frames = np.unique(np.concatenate(used))
        is_neighbour = np.all(known[max(w.first - 1, 0) : w.first + w.length + 1], axis=0)
        others = self._build_axes_of_others(lost_markers, is_neighbour, frames)
        return [self._estimate_marker(marker, w, is_neighbour, frames, others) for marker in lost_markers.tolist()]

    def _estimate_marker(
        self, marker: int, window: GapWindow, is_neighbour: np.ndarray, frames: np.ndarray, others: MovingAxes | None
    ) -> list[GapEstimate]:
        """Return the estimates of one marker."""
        path, change = self.markers[:, marker], self.change_m[marker]
        order = np.argsort(change, kind="stable")
        order = order[is_neighbour[order] & np.isfinite(change[order])]
        estimates: list[GapEstimate] = []
        if len(window.context_frames):
            axes: list[MovingAxes | None] = [None, others] if others else [None]
            for size in CLUSTER_SIZES:
                cluster = order[:size]
                if len(cluster) >= MIN_CLUSTER_MARKERS and (size == CLUSTER_SIZES[0] or len(order) > CLUSTER_SIZES[0]):
                    built = build_cluster_axes(self.markers, cluster, change[cluster], frames)
                    axes += [built] if built else []
            edges = self.compare_edges(marker, window)
            speed = edges.estimate_speed_in_gap(float(self.velocity_sd[marker]), window.length / self.rate)
            for each in axes:
                estimates += estimate_from_edges(path, each, window, self.rate, speed)
        cluster = select_regression_cluster(~np.isnan(self.markers[..., 0]), marker, order[change[order] < MAX_DISTANCE_CHANGE_M])
        if len(cluster) >= MIN_CLUSTER_MARKERS:
            regressed = estimate_by_regression(self.markers, marker, cluster, change[cluster], window, self.rate)
            estimates += [regressed] if regressed else []
        return [each for each in estimates if self.is_plausible(each, marker, window)]

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
        """Return axes fixed to all neighbours of a lost limb; None if few markers are lost, or few are left."""
        cluster = np.setdiff1d(np.flatnonzero(is_neighbour), lost_markers)
        if len(lost_markers) < MIN_LIMB_MARKERS or len(cluster) <= CLUSTER_SIZES[-1]:
            return None
        change = np.median(self.change_m[np.ix_(cluster, cluster)], axis=1)
        return build_cluster_axes(self.markers, cluster, np.where(np.isfinite(change), change, 1.0), frames)

    def remember(self, estimated: MarkerEstimate, window: GapWindow, lost_markers: np.ndarray) -> None:
        """Use what was filled precisely as visible from now on."""
        for marker in lost_markers:
            samples = window.gap_frames, marker
            if (estimated.sd[samples] <= MAX_KNOWN_SD_M).all():
                self.markers[samples] = estimated.position[samples]


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
    for first, last, lost in _iterate_gaps(np.isnan(neighbourhood.markers[..., 0]), neighbourhood.is_visible):
        window = neighbourhood.open_window(first, last, lost)
        estimates = neighbourhood.estimate_gap(window, lost)
        for marker, each in zip(lost.tolist(), estimates, strict=True):
            if each:
                _store(result, marker, window, each, neighbourhood.compare_edges(marker, window).similarity)
        neighbourhood.remember(result, window, lost)
        estimated.append(EstimatedGap(window, lost, estimates))
    return result, estimated, neighbourhood


def _store(
    result: MarkerEstimate, marker: int, window: GapWindow, estimates: list[GapEstimate], similarity: Float[np.ndarray, " K"]
) -> None:
    """Set the samples of one marker in a gap to the combination of its estimates."""
    samples = window.gap_frames, marker
    result.position[samples], result.sd[samples], result.method[samples] = combine_gap_estimates(estimates, window, similarity)


def _iterate_gaps(is_missing: np.ndarray, is_visible: np.ndarray) -> Iterator[tuple[int, int, np.ndarray]]:
    """Yield the first and last frame of each gap and the markers it has, the shortest first; no marker that is rarely visible."""
    gaps = group_gaps(is_missing & (is_visible.mean(0) > MIN_VISIBLE_SHARE))
    for (first, last), lost in sorted(gaps.items(), key=lambda gap: (gap[0][1] - gap[0][0], gap[0])):
        yield first, last, lost


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
    for (window, lost, estimates), rows in uncertain:
        predicted = processes.estimate_gap(window, lost[rows]) if len(rows) else None
        for row, process in zip(rows.tolist(), predicted or [], strict=False):
            marker = int(lost[row])
            if neighbourhood.is_plausible(process, marker, window):
                similarity = neighbourhood.compare_edges(marker, window).similarity
                _store(result, marker, window, [*estimates[row], process], similarity)
    return result
