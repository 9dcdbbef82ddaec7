"""The evidence for a marker set: how much more probable the points are with its markers than anywhere on the body.

A point with a label is close to the place of its marker on the average body, within the spread of the set; any other point lies
anywhere on the body. The body must follow its markers in several frames with a common pose. Markers without points are rare.
"""

from typing import NamedTuple

import numpy as np

from mocapfix.labelling.posed_body import (
    FINAL_OFFSET_WEIGHT,
    POSING_ITERATIONS,
    POSING_MARKER_SD_M,
    POSING_SCALES_M,
    ExtendedBody,
    scale_nominal_subject,
)
from mocapfix.labelling.sampled_points import SampledPoints
from mocapfix.marker_set import MarkerSet
from mocapfix.solve.kinematics import Poses

BODY_SURFACE_SD_M = 0.136
"""Standard deviation per axis of a normal distribution as dense as points anywhere on the body: 1.9 m2 by 2 cm."""
AVERAGE_BODY_SD_M = 0.02
"""Standard deviation per axis of places on the average body of the right size about those on the person's own body."""
RARE_MARKER_COST = 3.9
"""Negative logarithm of the probability that a required marker has no point, or a point no marker: 2 %."""


class MarkerEvidence(NamedTuple):
    """The evidence of the labelled points of a body that was found in some frames.

    sampled       the points in these frames
    poses         the poses of the body
    log_evidence  logarithm of how much more probable the points are at their markers than anywhere on the body
    marker_count  number of markers that were found
    """

    sampled: SampledPoints
    poses: Poses
    log_evidence: float
    marker_count: int

    @property
    def per_marker(self) -> float:
        """Evidence divided by the number of markers."""
        return self.log_evidence / max(1, self.marker_count)


def measure_marker_evidence(sampled: SampledPoints, found: ExtendedBody, required: MarkerSet) -> MarkerEvidence:
    """Return the evidence for the required markers of a set, given a body with them that was found in the points."""
    part, count = sampled.select_frames(found.frames), len(required.labels)
    positions = part.arrange_markers(found.markers, count)
    poses = found.body.register(positions)
    found.body.solve(poses, positions, POSING_MARKER_SD_M, POSING_SCALES_M, POSING_ITERATIONS)
    pose_cost = float(found.body.compute_costs(poses, positions, POSING_MARKER_SD_M, POSING_SCALES_M[-1]).mean())
    missing = count - float((~np.isnan(positions[..., 0])).sum(1).mean())
    evidence = _compute_offset_evidence(found, required) - pose_cost - RARE_MARKER_COST * missing
    return MarkerEvidence(part, poses, evidence, len(np.setdiff1d(found.markers, [-1])))


def _compute_offset_evidence(found: ExtendedBody, required: MarkerSet) -> float:
    """Return how much more probable the places of the markers on the body are than places anywhere on it, as a logarithm."""
    nominal = scale_nominal_subject(found.body.subject, required)
    is_found = np.isin(np.arange(len(required.labels)), found.markers)
    offsets = (found.body.subject.marker_offsets - nominal.marker_offsets)[is_found] / FINAL_OFFSET_WEIGHT
    spread = np.hypot(nominal.marker_spread, AVERAGE_BODY_SD_M)[is_found, None]
    return float((np.log(BODY_SURFACE_SD_M / spread) * 3 - 0.5 * ((offsets / spread) ** 2).sum(1, keepdims=True)).sum())
