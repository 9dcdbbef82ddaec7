"""Robust registration of a segment to its markers, of which one may be an outlier, compiled."""

from numba import njit

from mocapfix.kernels import registration_statistics as statistics

OUTLIER_SCALE_M = 0.05  # Geman-McClure scale: a marker's weight falls with its distance from the segment, over this


@njit(cache=True)
def fit_segment_pose_robustly(measured, offsets, weight, inlier_weight, row, pose, work, spare):
    """Write the most likely pose; if a marker lies far from it, fit again with weights that fall with the distance.

    The distance is that from the pose on which the markers agree best, among the fit to all markers and the fits to all but
    one.

    measured, offsets, weight  (N, 3), (N, 3), (N,) the segment's markers, which its `row` of statistics already includes
    inlier_weight              (N,) the fraction of each one's weight in the row, 0 where missing; updated, as is the row
    spare                      a row of statistics and a pose, overwritten
    """
    statistics.fit_segment_pose(row, pose, work)
    best, worst_square = _compute_disagreement(measured, offsets, inlier_weight, pose)
    if worst_square < OUTLIER_SCALE_M**2:
        return
    others, candidate = spare
    for i in range(len(inlier_weight)):
        if inlier_weight[i] > 0:
            statistics.copy_row(row, others)
            statistics.add_point(others, -inlier_weight[i] * weight[i], measured[i], offsets[i])
            statistics.fit_segment_pose(others, candidate, work)
            disagreement, _ = _compute_disagreement(measured, offsets, inlier_weight, candidate)
            if disagreement < best:
                best = disagreement
                statistics.copy_row(candidate, pose)
    for i in range(len(inlier_weight)):
        if inlier_weight[i] > 0:
            inlier = 1 / (1 + _compute_squared_distance(pose, offsets[i], measured[i]) / OUTLIER_SCALE_M**2) ** 2
            statistics.add_point(row, (inlier - inlier_weight[i]) * weight[i], measured[i], offsets[i])
            inlier_weight[i] = inlier
    statistics.fit_segment_pose(row, pose, work)


@njit(cache=True)
def _compute_disagreement(measured, offsets, inlier_weight, pose):
    """Return the markers' robust disagreement with a pose (from 0 to their count) and the largest squared distance."""
    total, worst_square = 0.0, 0.0
    for i in range(len(inlier_weight)):
        if inlier_weight[i] > 0:
            square = _compute_squared_distance(pose, offsets[i], measured[i])
            total += square / (square + OUTLIER_SCALE_M**2)
            worst_square = max(worst_square, square)
    return total, worst_square


@njit(cache=True)
def _compute_squared_distance(pose, p, point):
    """Return the squared distance of a measured point from its position according to the pose."""
    x, y, z = statistics.transform_point(pose, p)
    return (point[0] - x) ** 2 + (point[1] - y) ** 2 + (point[2] - z) ** 2
