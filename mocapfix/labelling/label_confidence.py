"""The confidence of labels: how much less likely every other label of a tracklet is."""

import numpy as np
from jaxtyping import Float, Int

from mocapfix.labelling.sampled_points import SampledPoints
from mocapfix.labelling.tracklet_assignment import TrackletDistances, compute_max_distances, measure_durations

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
