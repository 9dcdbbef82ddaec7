"""Evidence that a sample off the solved body is right, and that the body is wrong there.

A marker that leaves its place for a while leaps relative to its neighbours, when it leaves and when it returns. Where its
neighbours carry it across an end as a rigid body, it has not left or not returned. And where the body loses a limb, the samples
of several markers of the limb lie off it in the same direction, which faults of single markers do not.
"""

import numpy as np
from jaxtyping import Float, Int

from mocapfix.detect.body_outliers import BodyOutlier, BodyResiduals
from mocapfix.detect.marker_distances import MarkerDistances
from mocapfix.detect.shared_motion import find_shared_deviations

# Number of neighbours that determine a rigid motion.
MIN_RIGID_NEIGHBOURS = 3
# Smallest extent of the neighbours along their second longest axis (standard deviation): a line shows no turn about it.
MIN_NEIGHBOUR_WIDTH_M = 0.015
# Largest leap relative to the neighbours at an end of an outlier that they carry, relative to its distance from the body.
MAX_CARRIED_LEAP_RATIO = 0.5
# Smallest fraction of an outlier's frames in which other markers lie off the body alike.
MIN_SHARED_FRACTION = 0.5


def is_body_wrong(outlier: BodyOutlier, residuals: BodyResiduals, distances: MarkerDistances) -> bool:
    """Return whether the body is wrong where a marker lies off it, rather than the marker.

    Args:
        outlier: The samples off the body.
        residuals: The residuals of K markers.
        distances: The usual distances between these markers.
    """
    visible = np.flatnonzero(~np.isnan(residuals.measured_world[:, outlier.marker, 0]))
    before, after = visible[visible < outlier.first], visible[visible > outlier.last]
    ends = [(int(outlier.frames[0]), int(before[-1]))] if len(before) else []
    ends += [(int(outlier.frames[-1]), int(after[0]))] if len(after) else []
    leap_m = measure_leaps_from_neighbours(
        residuals.measured_world, distances, outlier.marker, np.array(ends, int).reshape(-1, 2)
    )
    if (leap_m < MAX_CARRIED_LEAP_RATIO * outlier.distance_m).any():
        return True
    residual_world = residuals.measured_world[outlier.frames] - residuals.expected_world[outlier.frames]
    partners = distances.partner[outlier.marker]
    is_shared = find_shared_deviations(residual_world[:, outlier.marker], residual_world[:, partners[partners >= 0]])
    return bool(is_shared.mean() >= MIN_SHARED_FRACTION)


def measure_leaps_from_neighbours(
    markers: Float[np.ndarray, "T M 3"], distances: MarkerDistances, marker: int, ends: Int[np.ndarray, "E 2"]
) -> Float[np.ndarray, " E"]:
    """Measure by how far a marker leaps relative to its neighbours between pairs of frames.

    Args:
        markers: World positions in metres, NaN where missing.
        distances: The usual distances between the markers.
        marker: Index of the marker.
        ends: Pairs of frame indices, in both of which the marker is visible.

    Returns:
        The distances in metres from where its neighbours carry it, NaN where they do not determine it.
    """
    leap_m = np.full(len(ends), np.nan)
    is_known = distances.partner[marker] >= 0
    partners, weight = distances.partner[marker][is_known], distances.tolerance_m[marker][is_known] ** -2
    for n, (one, other) in enumerate(ends):
        is_visible = ~np.isnan(markers[one, partners, 0] + markers[other, partners, 0])
        seen = partners[is_visible]
        carried = carry_rigidly(markers[one, seen], markers[other, seen], weight[is_visible], markers[one, marker])
        leap_m[n] = np.linalg.norm(markers[other, marker] - carried)
    return leap_m


def carry_rigidly(
    before: Float[np.ndarray, "N 3"],
    after: Float[np.ndarray, "N 3"],
    weight: Float[np.ndarray, " N"],
    point: Float[np.ndarray, " 3"],
) -> Float[np.ndarray, " 3"]:
    """Return where a point is carried by the rigid motion that fits the positions of its neighbours before and after best.

    NaN if the neighbours are too few, or lie on a line.
    """
    if len(weight) < MIN_RIGID_NEIGHBOURS:
        return np.full(3, np.nan)
    share = weight / weight.sum()
    centre_before, centre_after = share @ before, share @ after
    start, end = before - centre_before, after - centre_after
    extent_m = np.linalg.svd(np.sqrt(share)[:, None] * start, compute_uv=False)
    if extent_m[1] < MIN_NEIGHBOUR_WIDTH_M:
        return np.full(3, np.nan)
    u, _, vt = np.linalg.svd((share[:, None] * start).T @ end)
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return (point - centre_before) @ rotation + centre_after
