"""The labels of all tracklets of a take, outwards from those that a body has in a few frames.

The body is posed in every frame in which enough of its markers are labelled, and shows there where the other markers must be.
Tracklets that begin or end in such frames get their labels, by which the body can be posed in further frames, until no label
changes. The offsets of the markers are adapted to the take on the way.
"""

import numpy as np

from mocapfix.labelling.posed_body import (
    POSING_ITERATIONS,
    POSING_MARKER_SD_M,
    POSING_SCALES_M,
    ExtendedBody,
    PropagatedLabels,
    adapt_offsets,
)
from mocapfix.labelling.sampled_points import SampledPoints
from mocapfix.labelling.tracklet_assignment import TrackletDistances, assign_tracklets, compute_max_distances, measure_tracklets
from mocapfix.stats.sequences import sample_evenly
from mocapfix.subject import Subject

MIN_POSED_MARKER_SHARE = 0.6
"""Labelled markers with which a frame is posed, as a share of the markers that the body has in most frames."""
MAX_PROPAGATION_ROUNDS = 200
"""Rounds of posing and assignment; a round extends the labels by about the duration of a tracklet."""
MAX_OFFSET_FRAMES = 120
"""Frames from which the offsets of the markers are estimated."""
MAX_OFFSET_ROUNDS = 6
"""Rounds in which the offsets are adapted."""
PROPAGATION_GATE_M = 0.2
"""Distance above which all distances of a point from a marker are equal."""


def propagate_labels(sampled: SampledPoints, start: ExtendedBody, nominal: Subject | None) -> PropagatedLabels:
    """Return the labels of all tracklets that can be reached from those of `start`.

    Args:
        sampled: The points.
        start: A body and its labels in some frames.
        nominal: The subject whose offsets are adapted to the take; None if those of `start` are known.
    """
    body, markers = start.body, start.markers
    marker_count, frame_count = len(body.subject.joints), len(sampled.frames)
    root = np.zeros((frame_count, 3))
    local = np.tile(body.prior.mean_rotations, (frame_count, 1, 1, 1))
    posed_positions = np.full((frame_count, marker_count, 3), np.nan)
    is_posed = np.zeros(frame_count, bool)
    predicted = np.full((frame_count, marker_count, 3), np.nan)
    distances = TrackletDistances(np.full((len(markers), marker_count), np.nan), np.zeros(len(markers), int))
    min_count = MIN_POSED_MARKER_SHARE * np.median((np.append(markers, -1)[sampled.tracklets[start.frames]] >= 0).sum(1))
    max_distance = compute_max_distances(sampled)
    for number in range(MAX_PROPAGATION_ROUNDS):
        positions = sampled.arrange_markers(markers, marker_count)
        is_ready = (~np.isnan(positions[..., 0])).sum(1) >= min_count
        is_changed = is_ready & ~(
            ((positions == posed_positions) | (np.isnan(positions) & np.isnan(posed_positions))).all((1, 2))
        )
        is_changed |= is_ready & ~is_posed
        adapts = nominal is not None and number < MAX_OFFSET_ROUNDS
        if not is_changed.any() and not adapts:
            break
        frames = np.flatnonzero(is_changed)
        if len(frames):
            poses = body.register(positions[frames])
            body.solve(poses, positions[frames], POSING_MARKER_SD_M, POSING_SCALES_M, POSING_ITERATIONS)
            root[frames], local[frames] = poses
            posed_positions[frames] = positions[frames]
            is_posed |= is_changed
        if adapts and nominal is not None:
            known = np.flatnonzero(is_posed)
            chosen = known[sample_evenly(len(known), MAX_OFFSET_FRAMES)]
            body = body.change_subject(adapt_offsets(nominal, (root[chosen], local[chosen]), posed_positions[chosen]))
            frames = known
            poses = root[frames], local[frames]
            body.solve(poses, posed_positions[frames], POSING_MARKER_SD_M, POSING_SCALES_M[-1:], 3)
            root[frames], local[frames] = poses
        predicted[frames] = body.predict((root[frames], local[frames]))
        distances = measure_tracklets(sampled, predicted, PROPAGATION_GATE_M)
        markers = assign_tracklets(sampled, distances.squared_m2, max_distance)
    return PropagatedLabels(body, markers, distances, is_posed, (root, local))
