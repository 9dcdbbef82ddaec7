"""The labeller: the marker of each of a take's unlabelled points."""

import numpy as np
from jaxtyping import Float, Int

from mocapfix.labelling.body_extension import extend_body
from mocapfix.labelling.body_search import fit_height, search_body
from mocapfix.labelling.points import PointLabels, UnlabelledPoints, assign_to_tracklets
from mocapfix.labelling.posed_body import ExtendedBody, build_average_body, build_subject_body
from mocapfix.labelling.propagation import PropagatedLabels, propagate_labels
from mocapfix.labelling.sampled_points import SampledPoints, sample_points
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
MAX_EXTENDED_BODIES = 6
"""Best bodies of all frames that are extended to other frames."""


def label_points(points: UnlabelledPoints, marker_set: MarkerSet, subject: Subject | None = None) -> PointLabels:
    """Return the marker of each point.

    Args:
        points: Points of one person, with any number of points that are not the person's.
        marker_set: The person's markers.
        subject: The person, if known; with the markers of the set in this order.
    """
    sampled = sample_points(points)
    start = find_labelled_body(sampled, marker_set, subject)
    if start is None:
        return PointLabels(np.full(points.tracklet_indices.shape, -1), np.zeros(points.tracklet_indices.shape))
    nominal = None if subject else start.body.subject
    labels = propagate_labels(sampled, start, nominal)
    confidence = compute_label_confidence(sampled, labels)
    return PointLabels(assign_to_tracklets(points, labels.markers, -1), assign_to_tracklets(points, confidence, 0.0))


def find_labelled_body(sampled: SampledPoints, marker_set: MarkerSet, subject: Subject | None) -> ExtendedBody | None:
    """Return the best body in a few frames of the take; None if no frame shows enough points."""
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
    return min(extended, key=lambda each: each.cost, default=None)


def select_key_frames(sampled: SampledPoints) -> tuple[Int[np.ndarray, " F"], float]:
    """Return frames in which to search for a body, and the height of the standing person's points in metres."""
    count = (sampled.tracklets >= 0).sum(1)
    full = np.flatnonzero(count >= KEY_FRAME_POINT_SHARE * np.quantile(count, 0.9))
    height = sampled.positions[full, :, 1]
    height = np.nanmax(height, axis=1) - np.nanmin(height, axis=1)
    order = full[np.argsort(height, kind="stable")]
    places = np.linspace(*KEY_FRAME_HEIGHT_QUANTILES, KEY_FRAME_COUNT) * (len(order) - 1)
    return np.unique(order[places.astype(int)]), float(np.quantile(height, STANDING_HEIGHT_QUANTILE))


def compute_label_confidence(sampled: SampledPoints, labels: PropagatedLabels) -> Float[np.ndarray, " N"]:
    """Return the probability that each tracklet's label is right."""
    return np.where(labels.markers >= 0, 1.0, 0.5)
