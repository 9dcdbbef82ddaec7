"""The size of a body relative to the average one, estimated from distances between its markers."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from mocapfix.marker_set import MarkerSet
from mocapfix.skeleton import Skeleton

MIN_PAIR_DISTANCE_M = 0.12
"""Nominal distance of a marker pair that is used to estimate the size; nearer pairs depend more on marker placement."""
MIN_PAIR_FRAMES = 10
"""Frames in which both markers of a pair must be visible."""
MAX_DISTANCE_VARIATION = 0.03
"""Median absolute deviation of a pair's distance as a share of its median; a pair that varies more spans a bending joint."""
MIN_SIZE_RATIO = 0.3
"""Smallest accepted size relative to the average body: a baby."""
MAX_SIZE_RATIO = 1.6
"""Largest accepted size relative to the average body: larger than any person."""


def scale_skeleton(skeleton: Skeleton, factor: float) -> Skeleton:
    """Return the skeleton with all lengths multiplied by `factor`."""
    return replace(skeleton, offsets=skeleton.offsets * factor, ends=skeleton.ends * factor)


def estimate_body_size_ratio(skeleton: Skeleton, marker_set: MarkerSet, markers: Float[np.ndarray, "T K 3"]) -> float:
    """Return the subject's size relative to the average body, from marker distances that stay constant during the motion.

    Pairs of markers on one joint, or on a joint and its parent (a knee and an ankle marker), are used. The result is the weighted
    median over pairs of each pair's median over frames, limited to MIN_SIZE_RATIO..MAX_SIZE_RATIO; 1 if no pair qualifies.

    markers  in metres, NaN if not visible or an outlier
    """
    nominal = compute_rest_marker_positions(skeleton, marker_set)
    ratios: list[float] = []
    weights: list[float] = []
    for a in range(len(nominal)):
        for b in range(a):
            i, j = marker_set.joints[a], marker_set.joints[b]
            expected = np.linalg.norm(nominal[a] - nominal[b])
            if expected < MIN_PAIR_DISTANCE_M or not (i == j or skeleton.parents[i] == j or skeleton.parents[j] == i):
                continue
            distance = np.linalg.norm(markers[:, a] - markers[:, b], axis=-1)
            distance = distance[~np.isnan(distance)]
            if len(distance) < MIN_PAIR_FRAMES:
                continue
            median = np.median(distance)
            if np.median(np.abs(distance - median)) <= MAX_DISTANCE_VARIATION * median:  # true if all lie at one point, too
                ratios.append(float(median / expected))
                weights.append(float(expected))
    if not ratios:
        return 1.0
    order = np.argsort(ratios)
    middle = np.searchsorted(np.cumsum(np.array(weights)[order]), 0.5 * np.sum(weights))
    return float(np.clip(np.array(ratios)[order][middle], MIN_SIZE_RATIO, MAX_SIZE_RATIO))


def compute_rest_marker_positions(skeleton: Skeleton, marker_set: MarkerSet) -> Float[np.ndarray, "K 3"]:
    """Return the markers of a set in the rest pose, in metres."""
    return skeleton.rest_positions[marker_set.joints] + marker_set.marker_offsets
