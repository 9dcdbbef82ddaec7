"""The assignment of tracklets to markers, given where a body carries its markers in the sampled frames.

A tracklet has one marker throughout, and two tracklets that are visible at once have different markers. In each frame the visible
tracklets are assigned one-to-one by their mean squared distances over all frames (Kuhn 1955). A tracklet gets the marker that it
has in most of its frames.

Tracklets: points are linked from frame to frame where it is certain which one continues which.

The points of a frame may be in no order at all, as cameras give them before a program has made trajectories of them. Then the
links are found by motion alone (`link_points`). Where each column is a trajectory, a column is continued unless its points leap,
or leap to where another one was going (`cut_columns`).

Points are linked forwards and backwards in time. A link that one direction gives counts unless the other contradicts it. A
tracklet ends where its continuation is ambiguous: a later step that knows the body joins tracklets, but divides none.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from mocapfix.kernels.point_linking import combine_links, link_in_order, number_tracklets
from mocapfix.labels.points import SampledPoints, UnlabelledPoints

MAX_BLOCK_FRAMES_OF_DISTANCES = 512
"""Frames whose distances between points and markers are held at a time."""
MAX_OVERLAP_SHARE = 0.5
"""Share of a tracklet's frames in which another tracklet may have its label."""
FOUND_GATE_SHARE = 0.95
"""Share of the gate below which a marker counts as found."""
MAX_LABEL_DISTANCES_M = (0.06, 0.15)
"""Distance at which no label is as likely as a label, for a short and for a long tracklet: most ghosts are short."""
LABEL_DISTANCE_DURATIONS_S = (0.5, 4.0)
"""Durations of these tracklets."""
MIN_SEARCHED_DURATION_S = 0.15
"""Duration of the tracklets among which a body is searched for: shorter ones are often ghosts."""


class TrackletDistances(NamedTuple):
    """Distances of N tracklets from K markers.

    squared_m2   (N, K) mean squared distance, each at most the square of the gate; that of frames in which the marker has no
                 position is left out. NaN if there is no other frame.
    frame_count  (N,) frames that were compared
    """

    squared_m2: np.ndarray
    frame_count: np.ndarray


class TrackletLabels(NamedTuple):
    """The marker (N,) of each tracklet, -1 for none, and the probability (N,) of this assignment."""

    markers: Int[np.ndarray, " N"]
    confidence: Float[np.ndarray, " N"]


def assign_points(squared_distance: Float[np.ndarray, "V K"], gate_m: float) -> tuple[Int[np.ndarray, " V"], float]:
    """Assign points one-to-one to markers; points and markers farther apart than the gate stay alone, and count with it.

    Returns the marker of each point, -1 for none, and the mean squared distance over the markers or points, whichever are fewer.
    """
    from scipy.optimize import linear_sum_assignment  # slow to import

    capped = np.minimum(squared_distance, gate_m**2)
    rows, columns = linear_sum_assignment(capped)
    indices, is_near = np.full(len(capped), -1), capped[rows, columns] < FOUND_GATE_SHARE * gate_m**2
    indices[rows[is_near]] = columns[is_near]
    return indices, float(capped[rows, columns].mean()) if len(rows) else 0.0


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
    from scipy.optimize import linear_sum_assignment  # slow to import

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
        rows, columns = linear_sum_assignment(padded)
        votes[visible[rows], np.minimum(columns, marker_count)] += count
    winners = votes.argmax(1)
    winners[votes.max(1) == 0] = marker_count
    return _resolve_conflicts(list(known.values()), np.where(winners == marker_count, -1, winners), votes)


def _resolve_conflicts(
    visible_sets: list[tuple[np.ndarray, int]], markers: Int[np.ndarray, " N"], votes: Int[np.ndarray, "N K1"]
) -> Int[np.ndarray, " N"]:
    """Take the label from tracklets that share it in most of their frames with another one that has it more often.

    In a shorter overlap one of them shows something else at its end; `label_overlaps` decides which.
    """
    lost = np.zeros(len(markers), int)
    for visible, count in visible_sets:
        labelled = visible[markers[visible] >= 0]
        order = labelled[np.argsort(-votes[labelled, markers[labelled]], kind="stable")]
        _, first_places = np.unique(markers[order], return_index=True)
        lost[np.delete(order, first_places)] += count
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


# Longest time for which a point may be missing within a tracklet.
MAX_MISSING_S = 0.1
# Smallest difference of cost, twice the logarithm of a ratio of probabilities, to every other way to link the points.
LINK_MARGIN = 6.0
# Evidence, in the same unit, for a point in the same column where columns are trajectories.
COLUMN_GAIN = 10.0
# Number of pairs of frames, evenly spread, from which it is decided whether points are in order.
MAX_ORDER_FRAMES = 200
# In points in no order, a larger share of the points is closer to another column's next point than to that of their own.
MIN_UNORDERED_SHARE = 0.5


def find_tracklets(positions: Float[np.ndarray, "T C 3"], rate: float) -> UnlabelledPoints:
    """Divide the points of a take into tracklets, whether or not each column is a trajectory.

    Args:
        positions: metres, NaN where missing.
        rate: frames per second.
    """
    return link_points(positions, rate) if are_points_unordered(positions) else cut_columns(positions, rate)


def link_points(positions: Float[np.ndarray, "T C 3"], rate: float) -> UnlabelledPoints:
    """Divide points in no order into tracklets. Arguments as for `find_tracklets`."""
    return _link(positions, rate, column_gain=0.0)


def cut_columns(positions: Float[np.ndarray, "T C 3"], rate: float) -> UnlabelledPoints:
    """Divide columns, each of which is a trajectory or several, into tracklets: at leaps and at long gaps.

    A tracklet may change its column where a trajectory goes on in another one. Arguments as for `find_tracklets`.
    """
    return _link(positions, rate, column_gain=COLUMN_GAIN)


def _link(positions: np.ndarray, rate: float, column_gain: float) -> UnlabelledPoints:
    points, max_frames = np.ascontiguousarray(positions, float), max(1, round(MAX_MISSING_S * rate))
    forward = link_in_order(points, float(rate), max_frames, LINK_MARGIN, column_gain)
    backward = link_in_order(np.ascontiguousarray(points[::-1]), float(rate), max_frames, LINK_MARGIN, column_gain)
    return UnlabelledPoints(points, number_tracklets(points, combine_links(forward, backward)), rate)


def are_points_unordered(positions: Float[np.ndarray, "T C 3"]) -> bool:
    """Return whether the columns of points (NaN where missing) are in no order, so that no column is a trajectory."""
    has_point = ~np.isnan(positions[..., 0])
    pairs = np.flatnonzero((has_point[:-1] & has_point[1:]).any(1))
    is_nearer_to_another: list[np.ndarray] = []
    for t in pairs[np.unique(np.linspace(0, len(pairs) - 1, min(len(pairs), MAX_ORDER_FRAMES)).astype(int))]:
        next_columns = np.flatnonzero(has_point[t + 1])
        columns = np.flatnonzero(has_point[t] & has_point[t + 1])
        distance = np.linalg.norm(positions[t, columns, None] - positions[t + 1, next_columns], axis=-1)
        is_nearer_to_another.append(next_columns[distance.argmin(1)] != columns)
    return bool(is_nearer_to_another) and float(np.concatenate(is_nearer_to_another).mean()) > MIN_UNORDERED_SHARE
