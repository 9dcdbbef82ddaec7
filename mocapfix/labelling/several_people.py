"""Several people in the points of one take: each person is found among all points, and labelled again among their own.

The labeller finds one person among any number of other points. The points that it leaves without a label are searched for the
next person, as long as there are enough of them. Then every tracklet belongs to one person, those without a label to the nearest,
and each person is labelled once more as if alone: points of others no longer mislead the search.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Int

from mocapfix.labelling.points import PointLabels, UnlabelledPoints
from mocapfix.marker_set import MarkerSet

PersonLabeller = Callable[[UnlabelledPoints, MarkerSet], PointLabels]

MIN_PERSON_SHARE = 0.6
"""Share of the markers of the set that another person has at least."""
POINT_COUNT_QUANTILE = 0.9
"""Quantile over the frames of the number of points."""
MAX_PEOPLE = 6
"""Largest number of people."""
MAX_PROXIMITY_FRAMES = 60
"""Frames in which the distance of a tracklet from each person is measured."""
NEAREST_POINT_COUNT = 3
"""Labelled points of a person to which that distance is measured."""


def label_people(points: UnlabelledPoints, marker_set: MarkerSet, label_person: PersonLabeller) -> PointLabels:
    """Return the marker of each point, and to whom it belongs if there are several people with the markers of a set.

    `label_person` labels one person among any number of other points (`labeller.label_points`).
    """
    people = [label_person(points, marker_set)]
    rest = points.select_points(people[0].marker_indices < 0)
    while len(people) < MAX_PEOPLE and _has_person(rest.tracklet_indices >= 0, marker_set):
        found = label_person(rest, marker_set)
        if not _has_person(found.marker_indices >= 0, marker_set):
            break
        people.append(found)
        rest = rest.select_points(found.marker_indices < 0)
    if len(people) == 1:
        return people[0]
    persons = assign_to_people(points, [labels.marker_indices >= 0 for labels in people])
    markers, confidence = np.full(points.tracklet_indices.shape, -1), np.zeros(points.tracklet_indices.shape)
    subjects, evidence = np.full(points.tracklet_indices.shape, -1), np.inf
    for n in range(len(people)):
        is_own = persons == n
        labels = label_person(points.select_points(is_own), marker_set)
        markers[is_own], confidence[is_own] = labels.marker_indices[is_own], labels.confidence[is_own]
        subjects[is_own & (labels.marker_indices >= 0)] = n
        evidence = min(evidence, labels.evidence_per_marker)
    return PointLabels(markers, confidence, subjects, evidence)


def separate_people(labels: PointLabels, marker_labels: tuple[str, ...]) -> tuple[PointLabels, tuple[str, ...]]:
    """Return the labels of several people as those of one list of markers, and this list: P1:LFHD and so on."""
    if not labels.subject_indices.size:
        return labels, marker_labels
    count = int(labels.subject_indices.max()) + 1
    indices = np.where(labels.marker_indices >= 0, labels.subject_indices * len(marker_labels) + labels.marker_indices, -1)
    single = PointLabels(indices, labels.confidence, evidence_per_marker=labels.evidence_per_marker)
    return single, tuple(f"P{n + 1}:{label}" for n in range(count) for label in marker_labels)


def assign_to_people(points: UnlabelledPoints, masks: list[Bool[np.ndarray, "T C"]]) -> Int[np.ndarray, "T C"]:
    """Return the person of each point, -1 where there is no point.

    Args:
        points: The points.
        masks: The labelled points of each person. A tracklet belongs to whom most of them are, or else to the nearest person.
    """
    tracklets = points.tracklet_indices
    counts = np.stack([np.bincount(tracklets[mask & (tracklets >= 0)], minlength=points.tracklet_count) for mask in masks])
    person = counts.argmax(0)
    order = np.argsort(tracklets, axis=None, kind="stable")
    starts = np.searchsorted(tracklets.ravel()[order], np.arange(points.tracklet_count + 1))
    for n in np.flatnonzero(counts.sum(0) == 0):
        places = order[starts[n] : starts[n + 1]]
        places = places[np.unique(np.linspace(0, len(places) - 1, MAX_PROXIMITY_FRAMES).astype(int))]
        frames, columns = np.unravel_index(places, tracklets.shape)
        person[n] = int(np.argmin([_measure_distance(points.positions, frames, columns, mask) for mask in masks]))
    return np.append(person, -1)[tracklets]


def _measure_distance(
    positions: np.ndarray, frames: Int[np.ndarray, " F"], columns: Int[np.ndarray, " F"], mask: Bool[np.ndarray, "T C"]
) -> float:
    """Return the mean distance (m) of points from the nearest ones in a mask; infinite where there are none in these frames."""
    distance = np.linalg.norm(positions[frames] - positions[frames, columns, None], axis=-1)
    nearest = np.sort(np.where(mask[frames], distance, np.inf), axis=1)[:, :NEAREST_POINT_COUNT]
    known = nearest[np.isfinite(nearest)]
    return float(known.mean()) if len(known) else np.inf


def _has_person(mask: Bool[np.ndarray, "T C"], marker_set: MarkerSet) -> bool:
    """Return whether a mask has enough points in most frames for another person."""
    count = np.quantile(mask.sum(1), POINT_COUNT_QUANTILE) if len(mask) else 0
    return bool(count >= MIN_PERSON_SHARE * len(marker_set.required_labels))
