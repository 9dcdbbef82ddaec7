"""Labels of single points: of tracklets that share a label for a while, and of pieces between labelled tracklets.

The confidence of labels: how much less likely every other label of a tracklet is.
"""

import numpy as np
from jaxtyping import Float, Int

from mocapfix.labels.points import SampledPoints, UnlabelledPoints, assign_to_tracklets
from mocapfix.labels.tracklets import TrackletDistances, compute_max_distances, measure_durations
from mocapfix.stats.sequences import find_runs

MAX_CONTINUED_GAP_S = 0.05
"""Time between a labelled tracklet and a piece without a label in the same column that continues it."""
MAX_CONTINUED_STEP_M = 0.25
"""Distance between their ends; that of a fast hand between two frames at 50 Hz."""

CONTINUED_LABEL_CONFIDENCE = 0.5
"""Confidence of such a label: all of 59 measured ones were right in takes with whole trajectories, none of 57 single ghosts."""


def label_single_points(
    points: UnlabelledPoints, sampled: SampledPoints, predicted: Float[np.ndarray, "S K 3"], markers: Int[np.ndarray, " N"]
) -> Int[np.ndarray, "T C"]:
    """Return the marker of each point, no marker twice in a frame.

    Args:
        points: The points.
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


LABEL_DISTANCE_SD_M = 0.02
"""Standard deviation of the distance of a tracklet from its marker, for the likelihood of a label."""
INDEPENDENT_TIME_S = 0.5
"""Time after which the distance of a tracklet counts as measured again."""
MAX_INDEPENDENT_DISTANCES = 5.0
"""Largest number of distances of one tracklet that count."""

GHOST_ODDS = (8.0, 1.0)
"""How many times more often than its likelihood states a tracklet is no marker: a short and a long one. Most ghosts are short."""
GHOST_DURATIONS_S = (0.0, 0.1)
"""Durations of these tracklets."""


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
    holders = _find_holders(sampled, markers, squared.shape[1])
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


def _find_holders(sampled: SampledPoints, markers: Int[np.ndarray, " N"], marker_count: int) -> Int[np.ndarray, "N K"]:
    """Return for each tracklet and marker another tracklet that is visible at the same time and has this label, -1 for none."""
    holders = np.full((len(markers), marker_count), -1)
    for row in np.unique(np.sort(sampled.tracklets, axis=1), axis=0):
        visible = row[row >= 0]
        labelled = visible[markers[visible] >= 0]
        holders[np.ix_(visible, markers[labelled])] = labelled
    return holders
