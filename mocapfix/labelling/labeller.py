"""The labeller: the marker of each of a take's unlabelled points."""

import numpy as np

from mocapfix.labelling.body_extension import compute_body_cost, extend_body, select_extension_frames
from mocapfix.labelling.body_search import fit_height, search_body
from mocapfix.labelling.key_frames import select_key_frames
from mocapfix.labelling.label_confidence import compute_label_confidence
from mocapfix.labelling.label_overlaps import CONTINUED_LABEL_CONFIDENCE, continue_labels, label_single_points
from mocapfix.labelling.limb_search import MIN_LOST_MARKERS, find_limb_frame, search_limb
from mocapfix.labelling.linking import are_points_unordered
from mocapfix.labelling.optional_markers import add_optional_markers
from mocapfix.labelling.points import PointLabels, UnlabelledPoints, assign_to_tracklets
from mocapfix.labelling.posed_body import (
    ExtendedBody,
    PropagatedLabels,
    build_average_body,
    build_subject_body,
    predict_in_posed_frames,
    scale_nominal_subject,
)
from mocapfix.labelling.propagation import PROPAGATION_GATE_M, propagate_labels
from mocapfix.labelling.sampled_points import SampledPoints, sample_points
from mocapfix.labelling.set_evidence import measure_marker_evidence
from mocapfix.labelling.tracklet_assignment import (
    assign_tracklets,
    compute_max_distances,
    measure_durations,
    measure_tracklets,
    select_lasting_tracklets,
)
from mocapfix.marker_set import MarkerSet
from mocapfix.subject import Subject

BODIES_PER_KEY_FRAME = 3
"""Bodies of each frame that are kept."""
MAX_EXTENDED_BODIES = 8
"""Best bodies of all frames that are extended to other frames."""

MIN_KEPT_CONFIDENCE = 0.5
"""Confidence below which a tracklet stays without a label."""

MIN_RECONSIDERED_S = 0.5
"""Total duration of tracklets with which other labels are tried."""
MIN_LOST_TRACKLET_S = 0.4
"""Duration of an unlabelled tracklet that may be a lost marker; shorter ones are often ghosts."""
MAX_LIMB_SEARCHES = 6
"""Frames in which limbs are searched for."""


def label_points(points: UnlabelledPoints, marker_set: MarkerSet, subject: Subject | None = None) -> PointLabels:
    """Return the marker of each point.

    Args:
        points: Points of one person, with any number of points that are not the person's.
        marker_set: The person's markers. Its optional markers are looked for once all others have their labels.
        subject: The person, if known; with the markers of the set in this order.
    """
    sampled = sample_points(points)
    searched = marker_set.select_markers(marker_set.required_labels)
    known = subject.select_markers(searched.labels) if subject else None
    lasting = select_lasting_tracklets(sampled)
    start = find_labelled_body(lasting, searched, known)
    if start is None:
        return PointLabels(np.full(points.tracklet_indices.shape, -1), np.zeros(points.tracklet_indices.shape))
    evidence = np.inf if subject else measure_marker_evidence(lasting, start, searched).per_marker
    nominal = None if subject else scale_nominal_subject(start.body.subject, searched)
    labels = recover_limbs(sampled, propagate_labels(sampled, start, nominal))
    if nominal is not None:
        labels = reconsider_labels(sampled, labels, nominal)
    confidence = compute_label_confidence(sampled, labels.markers, labels.distances)
    indices = np.array([marker_set.labels.index(label) for label in searched.labels] + [-1])
    markers = indices[np.where(confidence >= MIN_KEPT_CONFIDENCE, labels.markers, -1)]
    if len(searched.labels) < len(marker_set.labels):
        all_markers = subject or scale_nominal_subject(labels.body.subject, marker_set)
        markers = add_optional_markers(sampled, markers, marker_set, all_markers, labels)
    predicted = predict_in_posed_frames(labels, subject or scale_nominal_subject(labels.body.subject, marker_set))
    marker_indices = label_single_points(points, sampled, predicted, markers)
    point_confidence = assign_to_tracklets(points, confidence, 0.0)
    if not are_points_unordered(points.positions):
        before, marker_indices = marker_indices, continue_labels(points, marker_indices)
        point_confidence[marker_indices != before] = CONTINUED_LABEL_CONFIDENCE
    return PointLabels(marker_indices, point_confidence, evidence_per_marker=evidence)


def recover_limbs(sampled: SampledPoints, labels: PropagatedLabels) -> PropagatedLabels:
    """Return the labels with those of limbs whose trajectories all broke at once."""
    is_candidate = measure_durations(sampled) >= MIN_LOST_TRACKLET_S
    for _ in range(MAX_LIMB_SEARCHES):
        frame = find_limb_frame(sampled, labels, is_candidate & (labels.markers < 0))
        if frame < 0:
            break
        markers = search_limb(sampled, labels, frame, is_candidate)
        is_new = (markers >= 0) & (labels.markers < 0)
        if is_new.sum() >= MIN_LOST_MARKERS:
            start = ExtendedBody(labels.body, markers, 0.0, np.flatnonzero(labels.is_posed))
            recovered = propagate_labels(sampled, start, None)
            if (recovered.markers >= 0).sum() > (labels.markers >= 0).sum():
                labels = recovered
        is_candidate[sampled.tracklets[frame][sampled.tracklets[frame] >= 0]] = False
    return labels


def reconsider_labels(sampled: SampledPoints, labels: PropagatedLabels, nominal: Subject) -> PropagatedLabels:
    """Return the labels, or others that the places of the markers in the set suggest if the body fits better with them.

    Labels that were exchanged from the beginning, such as those of a wrist and a hand, are where the offsets adapted to the wrong
    markers. So the tracklets are assigned once more to where the posed body has the markers of the set itself.

    Args:
        sampled: The points.
        labels: The labels with a body that is adapted to the take.
        nominal: The subject with the marker offsets of the set.
    """
    squared = measure_tracklets(sampled, predict_in_posed_frames(labels, nominal), PROPAGATION_GATE_M).squared_m2
    suggested = assign_tracklets(sampled, squared, compute_max_distances(sampled))
    is_other = (suggested != labels.markers) & (suggested >= 0)
    if measure_durations(sampled)[is_other].sum() < MIN_RECONSIDERED_S:
        return labels
    start = ExtendedBody(labels.body.change_subject(nominal), suggested, 0.0, np.flatnonzero(labels.is_posed))
    others = propagate_labels(sampled, start, nominal)
    if (others.markers == labels.markers).all():
        return labels
    frames = select_extension_frames(sampled, np.maximum(labels.markers, others.markers))
    part = sampled.select_frames(frames)

    def compute_cost(each: PropagatedLabels) -> float:
        return compute_body_cost(part, each.markers, each.body, nominal)

    return min((labels, others), key=compute_cost)


def find_labelled_body(sampled: SampledPoints, marker_set: MarkerSet, subject: Subject | None) -> ExtendedBody | None:
    """Return the best body in a few frames of the take; None if the points show neither a body nor a part of one."""
    body = build_subject_body(subject) if subject else build_average_body(marker_set)
    candidates: list[tuple[float, np.ndarray]] = []
    frames, height_m = select_key_frames(sampled)
    if not subject:
        body = fit_height(body, height_m)
    for frame in frames:
        visible = np.flatnonzero(sampled.tracklets[frame] >= 0)
        for found in search_body(sampled.positions[frame, visible], body)[:BODIES_PER_KEY_FRAME]:
            markers = np.full(sampled.tracklet_count, -1)
            markers[sampled.tracklets[frame, visible]] = found.markers
            candidates.append((found.cost, markers))
    candidates.sort(key=lambda candidate: candidate[0])
    extended = [
        extend_body(sampled, markers, body, None if subject else marker_set) for _, markers in candidates[:MAX_EXTENDED_BODIES]
    ]
    best = min(extended, key=lambda each: each.cost, default=None)
    found = {marker_set.labels[k] for k in set(best.markers.tolist()) - {-1}} if best else set[str]()
    return best if best and not marker_set.describe_missing_body(found) else None
