"""Tracklets: points without labels, linked where it is certain which one continues which, and the labels that they get.

The points of a frame may be in no order at all, as cameras give them before a program has made trajectories of them. Then the
links are found by motion alone (`link_points`). Where each column is a trajectory, a column is continued unless its points
leap, or leap to where another one was going (`cut_columns`). Points are linked forwards and backwards in time. A link that one
direction gives counts unless the other contradicts it. A tracklet ends where its continuation is ambiguous: a later step that
knows the body joins tracklets, but divides none.

A tracklet has one marker throughout, and two tracklets that are visible at once have different markers. In each frame the
visible tracklets are assigned one-to-one by their mean squared distances over all frames (Kuhn 1955) from where a body carries
its markers. A tracklet gets the marker that it has in most of its frames; its confidence is how much less likely every other
label is.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Bool, Float, Int

from mocapfix.kernels.point_linking import combine_links, link_in_order, number_tracklets
from mocapfix.stats.sequences import assign_points, find_runs, sample_evenly


@dataclass(frozen=True)
class UnlabelledPoints:
    """T frames of at most C points."""

    positions: Float[np.ndarray, "T C 3"]  # metres, Y up, NaN where a frame has fewer points
    # The tracklet of each point, 0 to N - 1 in the order of their first frames; -1 where there is no point. A tracklet has at
    # most one point in a frame, and may change its column and miss single frames.
    tracklet_indices: Int[np.ndarray, "T C"]
    rate: float  # frames per second

    @property
    def tracklet_count(self) -> int:
        return int(self.tracklet_indices.max(initial=-1)) + 1

    def select_points(self, mask: Bool[np.ndarray, "T C"]) -> "UnlabelledPoints":
        """Return the points in `mask` only. The tracklets keep their indices."""
        return UnlabelledPoints(
            np.where(mask[..., None], self.positions, np.nan), np.where(mask, self.tracklet_indices, -1), self.rate
        )


@dataclass(frozen=True)
class PointLabels:
    """The marker to which each point belongs."""

    marker_indices: Int[np.ndarray, "T C"]  # index among the labels of the marker set, -1 for a point without a label
    confidence: Float[np.ndarray, "T C"]  # probability that the label, or that no label, is right; 0 where there is no point
    # Of several persons, to whom each point belongs, -1 for none; empty if there is one person.
    subject_indices: Int[np.ndarray, "S C"] = field(default_factory=lambda: np.zeros((0, 0), int))
    # Logarithm of how much more probable a labelled point is at its marker than anywhere on the body; infinite for the markers
    # of a known person.
    evidence_per_marker: float = np.inf


def assign_to_tracklets(points: UnlabelledPoints, values: np.ndarray, missing: float) -> np.ndarray:
    """Return for every point (T, C) the value of its tracklet, `missing` where there is no point."""
    return np.append(values, missing)[points.tracklet_indices].astype(values.dtype)


SAMPLE_STEP_S = 0.05  # step between the frames that are compared
FRAMES_PER_TRACKLET = 4  # frames in which each tracklet is compared at least, if it has so many


@dataclass(frozen=True)
class SampledPoints:
    """The points of S frames of a take, in V columns."""

    frames: Int[np.ndarray, " S"]  # indices of the frames, rising
    positions: Float[np.ndarray, "S V 3"]  # metres, NaN where a frame has fewer points
    tracklets: Int[np.ndarray, "S V"]  # the tracklet of each point, -1 where there is none
    tracklet_count: int  # number of tracklets of the take, N
    times_s: Float[np.ndarray, " S"]  # times of the frames

    def select_frames(self, indices: Int[np.ndarray, " N"]) -> "SampledPoints":
        """Return some of the frames, given by their indices among the S."""
        return SampledPoints(
            self.frames[indices], self.positions[indices], self.tracklets[indices], self.tracklet_count, self.times_s[indices]
        )

    def select_tracklets(self, is_selected: Bool[np.ndarray, " N"]) -> "SampledPoints":
        """Return the points of some of the tracklets, which keep their indices; empty places are among those of the others."""
        is_kept = np.append(is_selected, False)[self.tracklets]
        positions = np.where(is_kept[..., None], self.positions, np.nan)
        return SampledPoints(self.frames, positions, np.where(is_kept, self.tracklets, -1), self.tracklet_count, self.times_s)

    def arrange_markers(self, labels: Int[np.ndarray, " N"], marker_count: int) -> Float[np.ndarray, "S K 3"]:
        """Return the positions of the markers, given the marker of each tracklet (-1 for none); NaN where not visible."""
        markers = np.full((len(self.frames), marker_count, 3), np.nan)
        point_labels = np.append(labels, -1)[self.tracklets]
        rows, columns = np.nonzero(point_labels >= 0)
        markers[rows, point_labels[rows, columns]] = self.positions[rows, columns]
        return markers


def sample_points(points: UnlabelledPoints) -> SampledPoints:
    """Return the points at regular steps, and in a few more frames for short tracklets."""
    step = max(1, round(SAMPLE_STEP_S * points.rate))
    frames = np.unique(np.r_[np.arange(0, len(points.positions), step), _select_tracklet_frames(points)])
    indices = points.tracklet_indices[frames]
    order = np.argsort(indices < 0, axis=1, kind="stable")[:, : max(1, int((indices >= 0).sum(1).max(initial=0)))]
    rows = np.arange(len(frames))[:, None]
    return SampledPoints(
        frames, points.positions[frames][rows, order], indices[rows, order], points.tracklet_count, frames / points.rate
    )


def _select_tracklet_frames(points: UnlabelledPoints) -> Int[np.ndarray, " S"]:
    frames, columns = np.nonzero(points.tracklet_indices >= 0)
    order = np.argsort(points.tracklet_indices[frames, columns], kind="stable")
    counts = np.bincount(points.tracklet_indices[frames, columns], minlength=points.tracklet_count)
    starts = np.cumsum(counts) - counts
    shares = (np.arange(FRAMES_PER_TRACKLET) + 0.5) / FRAMES_PER_TRACKLET
    return frames[order[(starts[:, None] + shares * counts[:, None]).astype(int).ravel()]] if len(frames) else frames


MAX_BLOCK_FRAMES_OF_DISTANCES = 512  # frames whose distances between points and markers are held at a time
MAX_OVERLAP_SHARE = 0.5  # share of a tracklet's frames in which another tracklet may have its label
MAX_LABEL_DISTANCES_M = (0.06, 0.15)  # at which no label is as likely as a label, for a short and a long tracklet
LABEL_DISTANCE_DURATIONS_S = (0.5, 4.0)  # durations of these tracklets
MIN_SEARCHED_DURATION_S = 0.15  # duration of the tracklets among which a body is searched for: shorter ones are often ghosts


class TrackletDistances(NamedTuple):
    """Distances of N tracklets from K markers."""

    # (N, K) mean squared distance, each at most the square of the gate; that of frames in which the marker has no position is
    # left out. NaN if there is no other frame.
    squared_m2: np.ndarray
    frame_count: np.ndarray  # (N,) frames that were compared


def assign_within_gate(squared_distance: Float[np.ndarray, "V K"], gate_m: float) -> tuple[Int[np.ndarray, " V"], float]:
    """Assign points one-to-one to markers; points and markers farther apart than the gate stay alone, and count with it.

    Returns the marker of each point, -1 for none, and the mean squared distance over the markers or points, whichever are fewer.
    """
    indices, costs = assign_points(squared_distance, gate_m**2)
    return indices, float(costs.mean()) if len(costs) else 0.0


def measure_tracklets(sampled: SampledPoints, predicted: Float[np.ndarray, "S K 3"], gate_m: float) -> TrackletDistances:
    """Return the distances of the tracklets from the markers, which are predicted in metres, NaN where unknown."""
    tracklet_count, marker_count = sampled.tracklet_count, predicted.shape[1]
    total, weight = np.zeros((tracklet_count, marker_count)), np.zeros((tracklet_count, marker_count))
    frame_count = np.zeros(tracklet_count, int)
    for first in range(0, len(predicted), MAX_BLOCK_FRAMES_OF_DISTANCES):
        block = slice(first, first + MAX_BLOCK_FRAMES_OF_DISTANCES)
        rows, columns = np.nonzero(sampled.tracklets[block] >= 0)
        if not len(rows):
            continue
        tracklets = sampled.tracklets[block][rows, columns]
        squared = ((sampled.positions[block][rows, columns][:, None] - predicted[block][rows]) ** 2).sum(-1)
        is_known = ~np.isnan(squared)
        squared = np.where(is_known, np.minimum(squared, gate_m**2), 0.0)
        order = np.argsort(tracklets, kind="stable")
        present, starts = np.unique(tracklets[order], return_index=True)
        total[present] += np.add.reduceat(squared[order], starts)
        weight[present] += np.add.reduceat(is_known[order].astype(float), starts)
        frame_count += np.bincount(tracklets[is_known.any(1)], minlength=tracklet_count)
    with np.errstate(invalid="ignore"):
        return TrackletDistances(total / weight, frame_count)


def assign_tracklets(
    sampled: SampledPoints, squared_m2: Float[np.ndarray, "N K"], max_distance_m: Float[np.ndarray, " N"]
) -> Int[np.ndarray, " N"]:
    """Return the marker of each tracklet, -1 for one that is farther than its `max_distance_m` from all markers that are free.

    Args:
        sampled: The frames, which show which tracklets are visible at once.
        squared_m2: The costs in m2, NaN where unknown.
        max_distance_m: The distance of each tracklet at which no label is as likely as a label.
    """
    marker_count, none_cost = squared_m2.shape[1], max_distance_m**2
    costs = np.where(np.isnan(squared_m2), 2 * none_cost[:, None], squared_m2)
    votes = np.zeros((len(costs), marker_count + 1), int)
    known: dict[bytes, tuple[np.ndarray, int]] = {}
    for row in np.sort(sampled.tracklets, axis=1):
        key = row.tobytes()
        visible, count = known.get(key, (row[row >= 0], 0))
        known[key] = visible, count + 1
    for visible, count in known.values():
        padded = np.repeat(none_cost[visible, None], marker_count + len(visible), axis=1)
        padded[:, :marker_count] = costs[visible]
        rows, columns = scipy.optimize.linear_sum_assignment(padded)
        votes[visible[rows], np.minimum(columns, marker_count)] += count
    winners = votes.argmax(1)
    winners[votes.max(1) == 0] = marker_count
    markers, lost = np.where(winners == marker_count, -1, winners), np.zeros(len(costs), int)
    # A tracklet loses a label to one that has it more often, if they share it in most of its frames. In a shorter overlap one of
    # them shows something else at its end; `label_single_points` decides which.
    for visible, count in known.values():
        labelled = visible[markers[visible] >= 0]
        order = labelled[np.argsort(-votes[labelled, markers[labelled]], kind="stable")]
        lost[np.delete(order, np.unique(markers[order], return_index=True)[1])] += count
    return np.where(lost > MAX_OVERLAP_SHARE * votes.sum(1), -1, markers)


def compute_max_distances(sampled: SampledPoints) -> Float[np.ndarray, " N"]:
    """Return the distance in metres from all markers at which a tracklet is as likely no marker."""
    return np.interp(measure_durations(sampled), LABEL_DISTANCE_DURATIONS_S, MAX_LABEL_DISTANCES_M)


def measure_durations(sampled: SampledPoints) -> Float[np.ndarray, " N"]:
    """Return the time in seconds from the first to the last sampled frame of each tracklet."""
    first, last = np.full(sampled.tracklet_count, np.inf), np.full(sampled.tracklet_count, -np.inf)
    rows, columns = np.nonzero(sampled.tracklets >= 0)
    tracklets = sampled.tracklets[rows, columns]
    np.minimum.at(first, tracklets, sampled.times_s[rows])
    np.maximum.at(last, tracklets, sampled.times_s[rows])
    return np.maximum(last - first, 0.0)


def select_lasting_tracklets(sampled: SampledPoints) -> SampledPoints:
    """Return the points of the tracklets among which a body is searched for."""
    return sampled.select_tracklets(measure_durations(sampled) >= MIN_SEARCHED_DURATION_S)


MAX_MISSING_S = 0.1  # longest time for which a point may be missing within a tracklet
LINK_MARGIN = 6.0  # smallest difference of cost, twice a log probability ratio, to every other way to link the points
COLUMN_GAIN = 10.0  # evidence, in the same unit, for a point in the same column where columns are trajectories
MAX_ORDER_FRAMES = 200  # number of pairs of frames, evenly spread, from which it is decided whether points are in order
MIN_UNORDERED_SHARE = 0.5  # of unordered points that are closer to another column's next point than to their own's


def find_tracklets(positions: Float[np.ndarray, "T C 3"], rate: float) -> UnlabelledPoints:
    """Divide the points of a take into tracklets, whether or not each column is a trajectory."""
    return link_points(positions, rate) if are_points_unordered(positions) else cut_columns(positions, rate)


def cut_columns(positions: Float[np.ndarray, "T C 3"], rate: float) -> UnlabelledPoints:
    """Divide columns, each of which is a trajectory or several, into tracklets: at leaps and at long gaps.

    A tracklet may change its column where a trajectory goes on in another one.
    """
    return link_points(positions, rate, COLUMN_GAIN)


def link_points(positions: Float[np.ndarray, "T C 3"], rate: float, column_gain: float = 0.0) -> UnlabelledPoints:
    """Divide points in no order into tracklets; with a gain, links within a column are preferred."""
    points, max_frames = np.ascontiguousarray(positions, float), max(1, round(MAX_MISSING_S * rate))
    forward = link_in_order(points, float(rate), max_frames, LINK_MARGIN, column_gain)
    backward = link_in_order(np.ascontiguousarray(points[::-1]), float(rate), max_frames, LINK_MARGIN, column_gain)
    return UnlabelledPoints(points, number_tracklets(points, combine_links(forward, backward)), rate)


def are_points_unordered(positions: Float[np.ndarray, "T C 3"]) -> bool:
    """Return whether the columns of points (NaN where missing) are in no order, so that no column is a trajectory."""
    has_point = ~np.isnan(positions[..., 0])
    pairs = np.flatnonzero((has_point[:-1] & has_point[1:]).any(1))
    is_nearer_to_another: list[np.ndarray] = []
    for t in pairs[sample_evenly(len(pairs), MAX_ORDER_FRAMES)]:
        next_columns = np.flatnonzero(has_point[t + 1])
        columns = np.flatnonzero(has_point[t] & has_point[t + 1])
        distance = np.linalg.norm(positions[t, columns, None] - positions[t + 1, next_columns], axis=-1)
        is_nearer_to_another.append(next_columns[distance.argmin(1)] != columns)
    return bool(is_nearer_to_another) and float(np.concatenate(is_nearer_to_another).mean()) > MIN_UNORDERED_SHARE


MAX_CONTINUED_GAP_S = 0.05  # time between a labelled tracklet and a piece without a label in the same column that continues it
MAX_CONTINUED_STEP_M = 0.25  # distance between their ends; that of a fast hand between two frames at 50 Hz

CONTINUED_LABEL_CONFIDENCE = 0.5  # all 59 measured ones were right with whole trajectories, none of 57 single ghosts


def label_single_points(
    points: UnlabelledPoints, sampled: SampledPoints, predicted: Float[np.ndarray, "S K 3"], markers: Int[np.ndarray, " N"]
) -> Int[np.ndarray, "T C"]:
    """Return the marker of each point, no marker twice in a frame.

    Args:
        sampled: Those of the sampled frames.
        predicted: Where the body carries its markers in these frames, in metres, NaN where unknown.
        markers: The marker of each tracklet, -1 for none.
    """
    marker_indices = assign_to_tracklets(points, markers, -1)
    for marker in np.unique(markers[markers >= 0]):
        is_own = marker_indices == marker
        for first, last in find_runs(is_own.sum(1) > 1):
            _keep_nearest(points, sampled, predicted[:, marker], marker_indices[first : last + 1], (int(marker), first, last))
    return marker_indices


def _keep_nearest(
    points: UnlabelledPoints,
    sampled: SampledPoints,
    path: Float[np.ndarray, "S 3"],
    marker_indices: Int[np.ndarray, "F C"],
    place: tuple[int, int, int],
) -> None:
    """Take a label, in the frames from first to last, from all tracklets that have it but the nearest to its marker."""
    marker, first, last = place
    tracklets = np.where(marker_indices == marker, points.tracklet_indices[first : last + 1], -1)
    candidates = np.unique(tracklets[tracklets >= 0])
    nearest = np.argsort(np.abs(sampled.frames - (first + last) / 2), kind="stable")[:1]
    frames = np.union1d(np.flatnonzero((sampled.frames >= first) & (sampled.frames <= last)), nearest)
    distances: list[float] = []
    for candidate in candidates:
        is_candidate = sampled.tracklets[frames] == candidate
        distance = np.linalg.norm(sampled.positions[frames] - path[frames, None], axis=-1)[is_candidate]
        distances.append(float(distance.mean()) if len(distance) and not np.isnan(distance).all() else np.inf)
    kept = candidates[int(np.argmin(distances))]
    marker_indices[(tracklets >= 0) & (tracklets != kept)] = -1


def label_points_of_tracklets(
    points: UnlabelledPoints,
    sampled: SampledPoints,
    predicted: Float[np.ndarray, "S K 3"],
    markers: Int[np.ndarray, " N"],
    confidence: Float[np.ndarray, " N"],
) -> PointLabels:
    """Return the labels of the points, given those of tracklets (see `label_single_points`) and their confidence."""
    marker_indices = label_single_points(points, sampled, predicted, markers)
    point_confidence = assign_to_tracklets(points, confidence, 0.0)
    if not are_points_unordered(points.positions):
        before, marker_indices = marker_indices, continue_labels(points, marker_indices)
        point_confidence[marker_indices != before] = CONTINUED_LABEL_CONFIDENCE
    return PointLabels(marker_indices, point_confidence)


def label_nothing(points: UnlabelledPoints) -> PointLabels:
    """Return no label for any point."""
    return PointLabels(np.full(points.tracklet_indices.shape, -1), np.zeros(points.tracklet_indices.shape))


def continue_labels(points: UnlabelledPoints, marker_indices: Int[np.ndarray, "T C"]) -> Int[np.ndarray, "T C"]:
    """Return the labels with those of pieces in the same column before or after a labelled one, if the label is free there.

    A column shows the same marker on both sides of a leap that is no larger than a fast hand makes.
    """
    continued, max_gap = marker_indices.copy(), max(1, round(MAX_CONTINUED_GAP_S * points.rate))
    has_point = points.tracklet_indices >= 0
    for column in np.flatnonzero(((marker_indices < 0) & has_point).any(0) & (marker_indices >= 0).any(0)):
        for first, last in find_runs((marker_indices[:, column] < 0) & has_point[:, column]):
            neighbours = (
                next((t for t in range(first - 1, max(first - 1 - max_gap, -1), -1) if continued[t, column] >= 0), -1),
                next((t for t in range(last + 1, min(last + 1 + max_gap, len(continued))) if continued[t, column] >= 0), -1),
            )
            sides = [(int(continued[t, column]), edge, t) for t, edge in zip(neighbours, (first, last), strict=True) if t >= 0]
            for marker, edge, t in sides:
                step = np.linalg.norm(points.positions[edge, column] - points.positions[t, column])
                is_free = not (continued[first : last + 1] == marker).any()
                if is_free and step < MAX_CONTINUED_STEP_M * abs(t - edge):
                    continued[first : last + 1, column] = marker
                    break
    return continued


LABEL_DISTANCE_SD_M = 0.02  # standard deviation of the distance of a tracklet from its marker, for the likelihood of a label
INDEPENDENT_TIME_S = 0.5  # time after which the distance of a tracklet counts as measured again
MAX_INDEPENDENT_DISTANCES = 5.0  # largest number of distances of one tracklet that count

GHOST_ODDS = (8.0, 1.0)  # how much more often than its likelihood states a short and a long tracklet is no marker
GHOST_DURATIONS_S = (0.0, 0.1)  # durations of these tracklets


def compute_label_confidence(
    sampled: SampledPoints, markers: Int[np.ndarray, " N"], distances: TrackletDistances
) -> Float[np.ndarray, " N"]:
    """Return the probability that the label of each tracklet is right, or that it has none.

    A tracklet could have no label, a label that is free, or exchange labels with another tracklet that is visible with it.
    """
    none_cost = compute_max_distances(sampled) ** 2
    squared = np.where(np.isnan(distances.squared_m2), 2 * none_cost[:, None], distances.squared_m2)
    each, has_label = np.arange(len(markers)), markers >= 0
    own_cost = np.where(has_label, squared[each, markers], none_cost)
    holders = np.full(squared.shape, -1)  # another tracklet that is visible at the same time and has this label
    for row in np.unique(np.sort(sampled.tracklets, axis=1), axis=0):
        visible = row[row >= 0]
        labelled = visible[markers[visible] >= 0]
        holders[np.ix_(visible, markers[labelled])] = labelled
    change = squared - own_cost[:, None]
    rows, columns = np.nonzero(holders >= 0)
    others = holders[rows, columns]
    given = np.where(has_label[rows], squared[others, markers[rows]], none_cost[others])
    change[rows, columns] += given - own_cost[others]
    change[each[has_label], markers[has_label]] = 0.0
    alternatives = np.column_stack([change, np.where(has_label, none_cost - own_cost, 0.0)])
    count = np.clip(1 + measure_durations(sampled) / INDEPENDENT_TIME_S, 1, MAX_INDEPENDENT_DISTANCES)
    exponent = -0.5 * np.maximum(alternatives, 0.0) * count[:, None] / LABEL_DISTANCE_SD_M**2
    likelihood = np.exp(exponent)
    odds = np.interp(measure_durations(sampled), GHOST_DURATIONS_S, GHOST_ODDS)
    likelihood[:, -1] *= np.where(has_label, odds, 1.0)  # that it is no marker
    return np.where(distances.frame_count > 0, 1 / likelihood.sum(1), 0.0)
