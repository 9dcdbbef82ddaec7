"""The labeller: the marker of each of a take's unlabelled points.

The labeller finds one person among any number of other points. The points that it leaves without a label are searched for the
next person, as long as there are enough of them. Then every tracklet belongs to one person, those without a label to the nearest,
and each person is labelled once more as if alone: points of others no longer mislead the search.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Int

from mocapfix.labels import body_search, tracklets
from mocapfix.labels.set_comparison import add_optional_markers, measure_marker_evidence
from mocapfix.model.marker_set import MarkerSet
from mocapfix.model.subject import Subject
from mocapfix.stats.sequences import sample_evenly
from mocapfix.subject.average_body import build_average_subject, build_posed_body

BODIES_PER_KEY_FRAME = 3  # bodies of each frame that are kept
MAX_EXTENDED_BODIES = 8  # best bodies of all frames that are extended to other frames

MIN_KEPT_CONFIDENCE = 0.5  # confidence below which a tracklet stays without a label

MIN_RECONSIDERED_S = 0.5  # total duration of tracklets with which other labels are tried
MIN_LOST_TRACKLET_S = 0.4  # duration of an unlabelled tracklet that may be a lost marker; shorter ones are often ghosts
MAX_LIMB_SEARCHES = 6  # frames in which limbs are searched for


def label_points(
    points: tracklets.UnlabelledPoints, marker_set: MarkerSet, subject: Subject | None = None
) -> tracklets.PointLabels:
    """Return the marker of each point.

    Args:
        points: Points of one person, with any number of points that are not the person's.
        marker_set: The person's markers. Its optional markers are looked for once all others have their labels.
        subject: The person, if known; with the markers of the set in this order.
    """
    sampled = tracklets.sample_points(points)
    searched = marker_set.select_markers(marker_set.required_labels)
    known = subject.select_markers(searched.labels) if subject else None
    lasting = tracklets.select_lasting_tracklets(sampled)
    start = find_labelled_body(lasting, searched, known)
    if start is None:
        return tracklets.label_nothing(points)
    evidence = np.inf if subject else measure_marker_evidence(lasting, start, searched).per_marker
    nominal = None if subject else body_search.scale_nominal_subject(start.body.subject, searched)
    labels = recover_limbs(sampled, body_search.propagate_labels(sampled, start, nominal))
    if nominal is not None:
        labels = reconsider_labels(sampled, labels, nominal)
    confidence = tracklets.compute_label_confidence(sampled, labels.markers, labels.distances)
    indices = np.array([marker_set.labels.index(label) for label in searched.labels] + [-1])
    markers = indices[np.where(confidence >= MIN_KEPT_CONFIDENCE, labels.markers, -1)]
    all_markers = subject or body_search.scale_nominal_subject(labels.body.subject, marker_set)
    predicted = body_search.predict_in_posed_frames(labels, all_markers)
    if len(searched.labels) < len(marker_set.labels):
        markers = add_optional_markers(sampled, markers, marker_set, predicted)
    labelled = tracklets.label_points_of_tracklets(points, sampled, predicted, markers, confidence)
    return replace(labelled, evidence_per_marker=evidence)


def recover_limbs(sampled: tracklets.SampledPoints, labels: body_search.PropagatedLabels) -> body_search.PropagatedLabels:
    """Return the labels with those of limbs whose trajectories all broke at once."""
    is_candidate = tracklets.measure_durations(sampled) >= MIN_LOST_TRACKLET_S
    for _ in range(MAX_LIMB_SEARCHES):
        frame = body_search.find_limb_frame(sampled, labels, is_candidate & (labels.markers < 0))
        if frame < 0:
            break
        markers = body_search.search_limb(sampled, labels, frame, is_candidate)
        is_new = (markers >= 0) & (labels.markers < 0)
        if is_new.sum() >= body_search.MIN_LOST_MARKERS:
            start = body_search.ExtendedBody(labels.body, markers, 0.0, np.flatnonzero(labels.is_posed))
            recovered = body_search.propagate_labels(sampled, start, None)
            if (recovered.markers >= 0).sum() > (labels.markers >= 0).sum():
                labels = recovered
        is_candidate[sampled.tracklets[frame][sampled.tracklets[frame] >= 0]] = False
    return labels


def reconsider_labels(
    sampled: tracklets.SampledPoints, labels: body_search.PropagatedLabels, nominal: Subject
) -> body_search.PropagatedLabels:
    """Return the labels, or others that the places of the markers in the set suggest if the body fits better with them.

    Labels that were exchanged from the beginning, such as those of a wrist and a hand, are where the offsets adapted to the wrong
    markers. So the tracklets are assigned once more to where the posed body has the markers of the set itself.

    Args:
        labels: The labels with a body that is adapted to the take.
    """
    squared = tracklets.measure_tracklets(
        sampled, body_search.predict_in_posed_frames(labels, nominal), body_search.PROPAGATION_GATE_M
    ).squared_m2
    suggested = tracklets.assign_tracklets(sampled, squared, tracklets.compute_max_distances(sampled))
    is_other = (suggested != labels.markers) & (suggested >= 0)
    if tracklets.measure_durations(sampled)[is_other].sum() < MIN_RECONSIDERED_S:
        return labels
    start = body_search.ExtendedBody(labels.body.change_subject(nominal), suggested, 0.0, np.flatnonzero(labels.is_posed))
    others = body_search.propagate_labels(sampled, start, nominal)
    if (others.markers == labels.markers).all():
        return labels
    frames = body_search.select_extension_frames(sampled, np.maximum(labels.markers, others.markers))
    part = sampled.select_frames(frames)

    def compute_cost(each: body_search.PropagatedLabels) -> float:
        return body_search.compute_body_cost(part, each.markers, each.body, nominal)

    return min((labels, others), key=compute_cost)


def find_labelled_body(
    sampled: tracklets.SampledPoints, marker_set: MarkerSet, subject: Subject | None
) -> body_search.ExtendedBody | None:
    """Return the best body in a few frames of the take; None if the points show neither a body nor a part of one."""
    body = build_posed_body(subject or build_average_subject(marker_set))
    frames, height_m = body_search.select_key_frames(sampled)
    if not subject:
        body = body.fit_height(height_m)
    candidates = body_search.search_key_frames(
        sampled, frames, lambda points: body_search.search_body(points, body)[:BODIES_PER_KEY_FRAME]
    )
    extended = [
        body_search.extend_body(sampled, candidate.markers, body, None if subject else marker_set)
        for candidate in candidates[:MAX_EXTENDED_BODIES]
    ]
    best = min(extended, key=lambda each: each.cost, default=None)
    found = {marker_set.labels[k] for k in set(best.markers.tolist()) - {-1}} if best else set[str]()
    return best if best and not marker_set.describe_missing_body(found) else None


PersonLabeller = Callable[[tracklets.UnlabelledPoints, MarkerSet], tracklets.PointLabels]

MIN_PERSON_SHARE = 0.6  # share of the markers of the set that another person has at least
POINT_COUNT_QUANTILE = 0.9  # quantile over the frames of the number of points
MAX_PEOPLE = 6  # largest number of people
MAX_PROXIMITY_FRAMES = 60  # frames in which the distance of a tracklet from each person is measured
NEAREST_POINT_COUNT = 3  # labelled points of a person to which that distance is measured


def label_people(
    points: tracklets.UnlabelledPoints, marker_set: MarkerSet, label_person: PersonLabeller
) -> tracklets.PointLabels:
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
    return tracklets.PointLabels(markers, confidence, subjects, evidence)


def separate_people(
    labels: tracklets.PointLabels, marker_labels: tuple[str, ...]
) -> tuple[tracklets.PointLabels, tuple[str, ...]]:
    """Return the labels of several people as those of one list of markers, and this list: P1:LFHD and so on."""
    if not labels.subject_indices.size:
        return labels, marker_labels
    count = int(labels.subject_indices.max()) + 1
    indices = np.where(labels.marker_indices >= 0, labels.subject_indices * len(marker_labels) + labels.marker_indices, -1)
    single = tracklets.PointLabels(indices, labels.confidence, evidence_per_marker=labels.evidence_per_marker)
    return single, tuple(f"P{n + 1}:{label}" for n in range(count) for label in marker_labels)


def assign_to_people(points: tracklets.UnlabelledPoints, masks: list[Bool[np.ndarray, "T C"]]) -> Int[np.ndarray, "T C"]:
    """Return the person of each point, -1 where there is no point.

    Args:
        masks: The labelled points of each person. A tracklet belongs to whom most of them are, or else to the nearest person.
    """
    of_point = points.tracklet_indices
    counts = np.stack([np.bincount(of_point[mask & (of_point >= 0)], minlength=points.tracklet_count) for mask in masks])
    person = counts.argmax(0)
    order = np.argsort(of_point, axis=None, kind="stable")
    starts = np.searchsorted(of_point.ravel()[order], np.arange(points.tracklet_count + 1))
    for n in np.flatnonzero(counts.sum(0) == 0):
        places = order[starts[n] : starts[n + 1]]
        places = places[sample_evenly(len(places), MAX_PROXIMITY_FRAMES)]
        frames, columns = np.unravel_index(places, of_point.shape)
        person[n] = int(np.argmin([_measure_distance(points.positions, frames, columns, mask) for mask in masks]))
    return np.append(person, -1)[of_point]


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
