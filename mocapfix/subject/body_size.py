"""The size of a body relative to the average one, estimated from distances between its markers.

Measurements of a body from its markers alone: distances that do not depend on the pose. Takes of one person agree in them.

They need neither detected faults nor a solved body, so that comparing the takes of a session costs little more than reading them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from mocapfix.model.marker_set import MarkerSet
from mocapfix.model.skeleton import Skeleton, load_cmu31_body
from mocapfix.model.take import Take
from mocapfix.stats.sequences import sample_evenly

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


MAX_MEASURED_FRAMES = 200
MIN_COMPARED_PAIRS = 8
"""Marker pairs that two takes must have in common to compare their bodies."""
MIN_PAIR_LENGTH_M = 0.10
"""Median distance of a marker pair that is compared."""


@dataclass(frozen=True)
class BodyMeasurements:
    """Distances between markers of one subject in a take.

    Attributes:
        take: id of the take.
        subject_name: name of the subject among several in the take; "" if it is the only one.
        label_name: name of the person in the labels; "" if they have none.
        marker_set: name of the marker set.
        distances_m: median distance of markers on one segment or on neighbouring ones, by their labels joined with a space.
    """

    take: str
    subject_name: str
    label_name: str
    marker_set: str
    distances_m: dict[str, float]


def measure_body(take_id: str, take: Take, marker_set: MarkerSet) -> BodyMeasurements:
    """Return the measurements of the subject of a take. A few faulty samples do not change them, since they are medians."""
    columns = marker_set.find_columns(take.labels)
    seen = np.flatnonzero(columns >= 0)
    markers = take.markers[sample_evenly(len(take.markers), MAX_MEASURED_FRAMES)][:, columns[seen]]
    labels = [marker_set.labels[k] for k in seen]
    distances_m = measure_marker_distances(markers, labels, marker_set.joints[seen])
    return BodyMeasurements(take_id, take.subject_name, take.main_subject, marker_set.name, distances_m)


def measure_marker_distances(
    markers: Float[np.ndarray, "N K 3"], labels: Sequence[str], joints: Int[np.ndarray, " K"]
) -> dict[str, float]:
    """Return the median distances in metres of marker pairs whose joints are the same or neighbours.

    joints  (K,) the joint that carries each marker
    """
    parents = np.array(load_cmu31_body().skeleton.parents)
    second, first = np.tril_indices(len(labels), -1)
    i, j = joints[second], joints[first]
    near = (i == j) | (parents[i] == j) | (parents[j] == i)
    first, second = first[near], second[near]
    distance = np.linalg.norm(markers[:, second] - markers[:, first], axis=2)
    known = (~np.isnan(distance)).any(0)
    median = np.nanmedian(distance[:, known], axis=0)
    kept = median > MIN_PAIR_LENGTH_M
    pairs = zip(first[known][kept], second[known][kept], median[kept], strict=True)
    return {f"{labels[a]} {labels[b]}": round(float(length), 6) for a, b, length in pairs}


def compute_body_difference(first: BodyMeasurements, second: BodyMeasurements) -> float | None:
    """Return the median relative difference of the distances that two subjects have in common; None if they are too few."""
    common = sorted(first.distances_m.keys() & second.distances_m.keys())
    if len(common) < MIN_COMPARED_PAIRS:
        return None
    lengths = np.array([[each.distances_m[pair] for pair in common] for each in (first, second)])
    return float(np.median(np.abs(np.log(lengths[0] / lengths[1]))))
