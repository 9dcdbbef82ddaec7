"""How large the subject is, before anything else is known of them."""

import numpy as np

from mocapfix.marker_set import MarkerSet
from mocapfix.skeleton import Skeleton

SHORTEST = 0.12  # metres: nearer pairs say more of where the markers were stuck than of the body's size
SMALLEST, LARGEST = 0.3, 1.6  # of the average body: a baby, and more than anybody
STEADY = 0.03  # a distance that varies by more than this share, over the take, spans a joint that bends


def ratio(skeleton: Skeleton, marker_set: MarkerSet, markers: np.ndarray) -> float:
    """-> the subject's size over the average body's, from distances that stay the same while the subject moves.

    Candidates are pairs of markers on one joint or on a joint and its parent (a knee and an ankle marker). The median
    over pairs, each pair's median over frames, within SMALLEST and LARGEST; 1 where no pair tells.

    markers  (T, K, 3) metres, NaN where not believed
    """
    nominal = skeleton_places(skeleton, marker_set)
    ratios, weights = [], []
    for a in range(len(nominal)):
        for b in range(a):
            i, j = marker_set.joints[a], marker_set.joints[b]
            expected = np.linalg.norm(nominal[a] - nominal[b])
            if expected < SHORTEST or not (i == j or skeleton.parents[i] == j or skeleton.parents[j] == i):
                continue
            distance = np.linalg.norm(markers[:, a] - markers[:, b], axis=-1)
            distance = distance[~np.isnan(distance)]
            if len(distance) < 10:
                continue
            middle = np.median(distance)
            if np.median(np.abs(distance - middle)) <= STEADY * middle:  # markers all at one point, too
                ratios.append(middle / expected)
                weights.append(expected)
    if not ratios:
        return 1.0
    order = np.argsort(ratios)
    halfway = np.searchsorted(np.cumsum(np.array(weights)[order]), 0.5 * np.sum(weights))
    return float(np.clip(np.array(ratios)[order][halfway], SMALLEST, LARGEST))


def skeleton_places(skeleton: Skeleton, marker_set: MarkerSet) -> np.ndarray:
    """-> (K, 3) metres: the markers in the rest pose."""
    return skeleton.resting[marker_set.joints] + marker_set.places
