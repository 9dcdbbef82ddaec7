"""The extension of a body found in one frame to other frames, in all of which its labels must hold.

A body that faces backwards, or has an arm assigned to a leg, fits one frame nearly as well as the right one. Its joints cannot
follow the markers through a motion.
"""

import numpy as np
from jaxtyping import Int

from mocapfix.calibrate.body_size import estimate_body_size_ratio
from mocapfix.labelling.posed_body import (
    FINAL_OFFSET_WEIGHT,
    POSING_ITERATIONS,
    POSING_MARKER_SD_M,
    POSING_SCALES_M,
    ExtendedBody,
    PosedBody,
    adapt_offsets,
    build_average_body,
    scale_subject,
)
from mocapfix.labelling.sampled_points import SampledPoints
from mocapfix.labelling.tracklet_assignment import assign_tracklets, measure_tracklets
from mocapfix.marker_set import MarkerSet
from mocapfix.stats.sequences import sample_evenly
from mocapfix.subject import Subject

MAX_EXTENSION_FRAMES = 40
"""Frames to which a body is extended."""
MIN_EXTENSION_MARKER_SHARE = 0.75
"""Markers that such a frame must show, as a share of those of the frame in which the body was found."""
EXTENSION_GATE_M = 0.2
"""Distance above which all distances of a point from a marker are equal."""
MAX_EXTENSION_DISTANCES_M = (0.1, 0.1, 0.1, 0.15, 0.15)
"""Distance in each round at which no label is as likely as a label."""
MISSING_MARKER_COST = 120.0
"""Cost of a marker without a point in a frame that has points without a marker, in half squares of standard deviations."""
OFFSET_WEIGHTS = (0.0, 0.2, 0.4, 0.6, FINAL_OFFSET_WEIGHT)
"""Weight of the measured offset of a marker after each round."""
MIN_OFFSET_SPREAD_M = 0.015
"""Smallest standard deviation per axis of the offset of a person's marker from that of the set."""


def extend_body(
    sampled: SampledPoints, markers: Int[np.ndarray, " N"], body: PosedBody, marker_set: MarkerSet | None
) -> ExtendedBody:
    """Return a body with the labels that hold in several frames.

    Args:
        sampled: The points.
        markers: The marker of each tracklet that was found in one frame, -1 for all others.
        body: The body with which they were found.
        marker_set: The set, from which size and offsets of the body are estimated; None if those of `body` are known.
    """
    count = len(body.subject.joints)
    frames = select_extension_frames(sampled, markers)
    part = sampled.select_frames(frames)
    if marker_set is not None:
        average = build_average_body(marker_set)
        size = estimate_body_size_ratio(average.subject.skeleton, marker_set, part.arrange_markers(markers, count))
        body = body.change_subject(scale_subject(average.subject, size))
    nominal = body.subject
    for offset_weight, max_distance in zip(OFFSET_WEIGHTS, MAX_EXTENSION_DISTANCES_M, strict=True):
        positions = part.arrange_markers(markers, count)
        poses = body.register(positions)
        body.solve(poses, positions, POSING_MARKER_SD_M, POSING_SCALES_M, POSING_ITERATIONS)
        if marker_set is not None:
            body = body.change_subject(adapt_offsets(nominal, poses, positions, offset_weight))
        distances = measure_tracklets(part, body.predict(poses), EXTENSION_GATE_M)
        markers = assign_tracklets(part, distances.squared_m2, np.full(len(markers), max_distance))
    return ExtendedBody(body, markers, compute_body_cost(part, markers, body, nominal), frames)


def compute_body_cost(sampled: SampledPoints, markers: Int[np.ndarray, " N"], body: PosedBody, nominal: Subject) -> float:
    """Return the mean cost of a body in frames, with that of its marker offsets and of markers that it lacks.

    Args:
        sampled: The points in these frames.
        markers: The marker of each tracklet.
        body: The body with its offsets.
        nominal: The subject with the offsets of the marker set.
    """
    count = len(body.subject.joints)
    positions = sampled.arrange_markers(markers, count)
    poses = body.register(positions)
    body.solve(poses, positions, POSING_MARKER_SD_M, POSING_SCALES_M, POSING_ITERATIONS)
    costs = body.compute_costs(poses, positions, POSING_MARKER_SD_M, POSING_SCALES_M[-1])
    spread = np.maximum(nominal.marker_spread, MIN_OFFSET_SPREAD_M)[:, None]
    offset_cost = 0.5 * float((((body.subject.marker_offsets - nominal.marker_offsets) / spread) ** 2).sum())
    possible = np.minimum((sampled.tracklets >= 0).sum(1), count)
    missing = possible - (~np.isnan(positions[..., 0])).sum(1)
    return float((costs + MISSING_MARKER_COST * missing).mean()) + offset_cost


def select_extension_frames(sampled: SampledPoints, markers: Int[np.ndarray, " N"]) -> Int[np.ndarray, " E"]:
    """Return the frames that show most of the labelled tracklets."""
    count = (np.append(markers, -1)[sampled.tracklets] >= 0).sum(1)
    enough = np.flatnonzero(count >= MIN_EXTENSION_MARKER_SHARE * count.max())
    return enough[sample_evenly(len(enough), MAX_EXTENSION_FRAMES)]
