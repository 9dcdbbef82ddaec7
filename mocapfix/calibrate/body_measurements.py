"""Measurements of a body from its markers alone: distances that do not depend on the pose. Takes of one person agree in them.

They need neither detected faults nor a solved body, so that comparing the takes of a session costs little more than reading them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from mocapfix.marker_set import MarkerSet
from mocapfix.skeleton import load_cmu31_body
from mocapfix.stats.sequences import sample_evenly
from mocapfix.take import Take

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
