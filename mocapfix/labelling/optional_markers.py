"""The labels of optional markers of a set, which long trajectories get that have no other label."""

import numpy as np
from jaxtyping import Int

from mocapfix.labelling.posed_body import PropagatedLabels, predict_in_posed_frames
from mocapfix.labelling.sampled_points import SampledPoints
from mocapfix.labelling.tracklet_assignment import assign_tracklets, measure_durations, measure_tracklets
from mocapfix.marker_set import MarkerSet
from mocapfix.subject import Subject

MAX_OPTIONAL_DISTANCE_M = 0.05
"""Distance of a tracklet from an optional marker of the set up to which it has its label."""
MIN_OPTIONAL_DURATION_S = 2.0
"""Duration of such a tracklet; a shorter one may be a ghost."""


def add_optional_markers(
    sampled: SampledPoints, markers: Int[np.ndarray, " N"], marker_set: MarkerSet, subject: Subject, labels: PropagatedLabels
) -> Int[np.ndarray, " N"]:
    """Return the markers of the tracklets with optional ones for long tracklets that have none."""
    predicted = predict_in_posed_frames(labels, subject)
    squared = measure_tracklets(sampled, predicted, 2 * MAX_OPTIONAL_DISTANCE_M).squared_m2
    is_optional = np.array([label in marker_set.optional_labels for label in marker_set.labels])
    is_free = (markers < 0) & (measure_durations(sampled) >= MIN_OPTIONAL_DURATION_S)
    squared[~is_free[:, None] | ~is_optional] = np.nan
    found = assign_tracklets(sampled, squared, np.full(len(markers), MAX_OPTIONAL_DISTANCE_M))
    return np.where(is_free, found, markers)
