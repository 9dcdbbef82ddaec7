"""A segment laid on its markers though one of them may be wrong, compiled."""

from numba import njit

from mocapfix.kernels import registration_statistics

OUTLIER_SCALE_M = 0.05  # metres (Geman-McClure scale): a marker farther from where its segment is laid counts less and less


@njit(cache=True)
def fit_segment_pose_robustly(seen, places, weight, trust, row, pose, room, spare):
    """Write the likeliest pose; where a marker lies far from it, once more, with each marker counting as it is near.

    Near to what: to the pose, of that from all and those from all markers but one, on which the markers agree best.

    seen, places, weight  (N, 3), (N, 3), (N,) the segment's markers, which its `row` of moments holds already
    trust                 (N,) the part of each one's weight in it, 0 where not seen; both are brought up to date
    spare                 a row of moments and a pose, written over
    """
    registration_statistics.fit_segment_pose(row, pose, room)
    best, worst = _compute_disagreement(seen, places, trust, pose)
    if worst < OUTLIER_SCALE_M**2:
        return
    others, candidate = spare
    for i in range(len(trust)):
        if trust[i] > 0:
            registration_statistics.copy_row(row, others)
            registration_statistics.add_point(others, -trust[i] * weight[i], seen[i], places[i])
            registration_statistics.fit_segment_pose(others, candidate, room)
            left, _ = _compute_disagreement(seen, places, trust, candidate)
            if left < best:
                best = left
                registration_statistics.copy_row(candidate, pose)
    for i in range(len(trust)):
        if trust[i] > 0:
            near = 1 / (1 + _compute_squared_distance(pose, places[i], seen[i]) / OUTLIER_SCALE_M**2) ** 2
            registration_statistics.add_point(row, (near - trust[i]) * weight[i], seen[i], places[i])
            trust[i] = near
    registration_statistics.fit_segment_pose(row, pose, room)


@njit(cache=True)
def _compute_disagreement(seen, places, trust, pose):
    """-> how little the markers agree with a pose (from 0 to their count), and the worst one's squared distance."""
    total, worst = 0.0, 0.0
    for i in range(len(trust)):
        if trust[i] > 0:
            off = _compute_squared_distance(pose, places[i], seen[i])
            total += off / (off + OUTLIER_SCALE_M**2)
            worst = max(worst, off)
    return total, worst


@njit(cache=True)
def _compute_squared_distance(pose, p, at):
    """-> the squared distance of a marker from where the pose carries it."""
    x, y, z = registration_statistics.transform_point(pose, p)
    return (at[0] - x) ** 2 + (at[1] - y) ** 2 + (at[2] - z) ** 2
