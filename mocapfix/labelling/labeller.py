"""The labeller: the marker of each of a take's unlabelled points."""

import numpy as np
from jaxtyping import Int

from mocapfix.labelling.body_extension import extend_body
from mocapfix.labelling.body_search import fit_height, search_body
from mocapfix.labelling.label_confidence import compute_label_confidence
from mocapfix.labelling.label_overlaps import continue_labels, label_single_points
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
from mocapfix.labelling.propagation import propagate_labels
from mocapfix.labelling.sampled_points import SampledPoints, sample_points
from mocapfix.labelling.tracklet_assignment import measure_durations, select_lasting_tracklets
from mocapfix.marker_set import MarkerSet
from mocapfix.subject import Subject

KEY_FRAME_COUNT = 8
"""Frames in which a body is searched for."""
KEY_FRAME_POINT_SHARE = 0.9
"""Points that such a frame shows, as a share of the 90th percentile over all frames."""
KEY_FRAME_HEIGHT_QUANTILES = (0.2, 1.0)
"""Range of the heights of these frames: the lowest show people who crouch or lie."""
STANDING_HEIGHT_QUANTILE = 0.7
"""Quantile of the heights that a standing person has; the highest are those of raised arms."""
BODIES_PER_KEY_FRAME = 3
"""Bodies of each frame that are kept."""
MAX_EXTENDED_BODIES = 8
"""Best bodies of all frames that are extended to other frames."""

MIN_KEPT_CONFIDENCE = 0.5
"""Confidence below which a tracklet stays without a label."""

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
    start = find_labelled_body(select_lasting_tracklets(sampled), searched, known)
    if start is None:
        return PointLabels(np.full(points.tracklet_indices.shape, -1), np.zeros(points.tracklet_indices.shape))
    labels = propagate_labels(sampled, start, None if subject else scale_nominal_subject(start.body.subject, searched))
    labels = recover_limbs(sampled, labels)
    confidence = compute_label_confidence(sampled, labels.markers, labels.distances)
    indices = np.array([marker_set.labels.index(label) for label in searched.labels] + [-1])
    markers = indices[np.where(confidence >= MIN_KEPT_CONFIDENCE, labels.markers, -1)]
    if len(searched.labels) < len(marker_set.labels):
        all_markers = subject or scale_nominal_subject(labels.body.subject, marker_set)
        markers = add_optional_markers(sampled, markers, marker_set, all_markers, labels)
    predicted = predict_in_posed_frames(labels, subject or scale_nominal_subject(labels.body.subject, marker_set))
    marker_indices = label_single_points(points, sampled, predicted, markers)
    if not are_points_unordered(points.positions):
        marker_indices = continue_labels(points, marker_indices)
    return PointLabels(marker_indices, assign_to_tracklets(points, confidence, 0.0))


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


def select_key_frames(sampled: SampledPoints) -> tuple[Int[np.ndarray, " F"], float]:
    """Return frames in which to search for a body, and the height of the standing person's points in metres."""
    count = (sampled.tracklets >= 0).sum(1)
    full = np.flatnonzero(count >= KEY_FRAME_POINT_SHARE * np.quantile(count, 0.9))
    height = sampled.positions[full, :, 1]
    height = np.nanmax(height, axis=1) - np.nanmin(height, axis=1)
    order = full[np.argsort(height, kind="stable")]
    places = np.linspace(*KEY_FRAME_HEIGHT_QUANTILES, KEY_FRAME_COUNT) * (len(order) - 1)
    return np.unique(order[places.astype(int)]), float(np.quantile(height, STANDING_HEIGHT_QUANTILE))
