"""Links between the points of successive frames: which point continues which, where this is certain.

Each open trajectory is extrapolated with a constant velocity, or with a constant acceleration once it has three samples. The
cost of a point for a trajectory is minus twice the logarithm of a probability density with heavy tails (Student's t) about the
extrapolated position. A trajectory and a point are linked if each is the other's best, and if every alternative (one of them
alone, or two links exchanged) costs more by a margin. Otherwise the trajectory ends there.
"""

import numpy as np

from mocapfix.kernels.compilation import compile_inner_kernel, compile_kernel

LINK_NOISE_M = 0.0015  # scale of the deviation from the extrapolated position in an arbitrarily short time
# Scale of unknown accelerations: at least this, and a multiple of those that the trajectory had lately.
MIN_LINK_ACCELERATION_M_PER_S2 = 5.0
RECENT_ACCELERATION_FACTOR = 1.0
RECENT_DEVIATION_WEIGHT = 0.3  # weight of the latest deviation in the mean of a trajectory's recent ones
FIRST_LINK_SPEED_M_PER_S = 2.0  # scale of the speed of a point that was seen in one frame only
MAX_FIRST_LINK_FRAMES = 2  # A point that was seen in one frame only is continued over at most this many frames
# Points farther from the extrapolated position are no candidates: a constant, a term in the square of the time, and a limit.
LINK_GATE_M = 0.015
LINK_GATE_M_PER_S2 = 500.0
MAX_LINK_GATE_M = 0.15
HIDDEN_MARKER_RANGE_M = 0.2  # within which a point may be another marker that was hidden
DEVIATION_FREEDOM = 3.0  # degrees of freedom of the distribution of deviations
ACCELERATION_SAMPLES = 3  # number of samples that determine an acceleration


@compile_inner_kernel
def _extrapolate(state, count, lag):
    """Return the position at which a trajectory is expected `lag` seconds after its last sample."""
    x, y, z = state[0], state[1], state[2]
    if count > 1:
        x, y, z = x + lag * state[3], y + lag * state[4], z + lag * state[5]
    if count >= ACCELERATION_SAMPLES:
        # The velocity is that of the middle of the last step; half the acceleration is damped for longer times.
        half = 0.5 * lag * (lag + state[9])
        x, y, z = x + half * state[6], y + half * state[7], z + half * state[8]
    return x, y, z


@compile_inner_kernel
def _compute_scale(state, count, lag):
    """Return the scale in metres of the deviation from the extrapolated position."""
    if count == 1:
        return LINK_NOISE_M + FIRST_LINK_SPEED_M_PER_S * lag
    acceleration = MIN_LINK_ACCELERATION_M_PER_S2 + RECENT_ACCELERATION_FACTOR * state[10]
    return LINK_NOISE_M + acceleration * lag * lag


@compile_inner_kernel
def _append_sample(state, count, points, frame, column, lag):
    """Add a sample to the state of a trajectory.

    The state has the position, the velocity of the last step, the acceleration between the last two, the time of the last step,
    and the scale of recent accelerations.
    """
    if count > 1:
        x, y, z = _extrapolate(state, count, lag)
        square = (points[frame, column, 0] - x) ** 2 + (points[frame, column, 1] - y) ** 2 + (points[frame, column, 2] - z) ** 2
        deviation = max(0.0, np.sqrt(square) - LINK_NOISE_M) / (lag * lag)
        state[10] += RECENT_DEVIATION_WEIGHT * (deviation - state[10])
    for k in range(3):
        velocity = (points[frame, column, k] - state[k]) / lag
        if count > 1:
            state[6 + k] = (velocity - state[3 + k]) / (0.5 * (lag + state[9]))
        state[3 + k] = velocity
        state[k] = points[frame, column, k]
    state[9] = lag


@compile_kernel
def link_in_order(points, rate, max_lag_frames, margin, column_gain):
    """Link the points of each frame to those of earlier frames, one frame after the other.

    Args:
        points: (T, C, 3) positions in metres, NaN where missing.
        rate: frames per second.
        max_lag_frames: largest distance in frames of two points that are linked.
        margin: smallest difference of cost to every alternative.
        column_gain: what it costs less to continue in the same column; 0 where columns mean nothing.

    Returns:
        (T, C) for each point the index t * C + c of the point that it continues, -1 if there is none.
    """
    frame_count, column_count = points.shape[:2]
    point_limit = _count_most_points(points)
    capacity = point_limit * (max_lag_frames + 1) + 1
    previous = np.full((frame_count, column_count), -1, np.int64)
    state, sample_count = np.zeros((capacity, 11)), np.zeros(capacity, np.int64)
    last_frame, last_column = np.zeros(capacity, np.int64), np.zeros(capacity, np.int64)
    cost, x_here = np.empty((capacity, point_limit)), np.empty(point_limit)
    # the points that may continue each trajectory, and the trajectories that each point may continue
    candidates, candidate_count = np.empty((capacity, point_limit), np.int64), np.zeros(capacity, np.int64)
    rivals, rival_count = np.empty((point_limit, capacity), np.int64), np.zeros(point_limit, np.int64)
    best_point, best_track = np.empty(capacity, np.int64), np.empty(point_limit, np.int64)
    chosen, columns = np.empty(capacity, np.int64), np.empty(point_limit, np.int64)
    open_count = 0
    for t in range(frame_count):
        here = 0
        for c in range(column_count):
            if not np.isnan(points[t, c, 0]):
                columns[here], x_here[here] = c, points[t, c, 0]
                best_track[here], rival_count[here] = -1, 0
                here += 1
        for i in range(open_count):
            best_point[i], candidate_count[i] = -1, 0
            lag_frames = t - last_frame[i]
            lag = lag_frames / rate
            x, y, z = _extrapolate(state[i], sample_count[i], lag)
            scale = _compute_scale(state[i], sample_count[i], lag)
            gate = min(MAX_LINK_GATE_M, LINK_GATE_M + LINK_GATE_M_PER_S2 * lag * lag)
            if sample_count[i] == 1:
                gate = min(MAX_LINK_GATE_M, 3 * scale)
            spread_cost = 6 * np.log(scale / LINK_NOISE_M)
            largest_cost = 6 * np.log(HIDDEN_MARKER_RANGE_M / LINK_NOISE_M) - margin
            cost[i, :here] = np.inf
            for j in range(here):
                if abs(x_here[j] - x) >= gate:
                    continue
                c = columns[j]
                square = (points[t, c, 0] - x) ** 2 + (points[t, c, 1] - y) ** 2 + (points[t, c, 2] - z) ** 2
                if square < gate * gate:
                    deviation = square / (scale * scale)
                    cost[i, j] = (DEVIATION_FREEDOM + 3) * np.log(1 + deviation / DEVIATION_FREEDOM) + spread_cost
                    if cost[i, j] > largest_cost:
                        cost[i, j] = np.inf
                        continue
                    if c == last_column[i]:
                        cost[i, j] -= column_gain
                    candidates[i, candidate_count[i]], rivals[j, rival_count[j]] = j, i
                    candidate_count[i] += 1
                    rival_count[j] += 1
                    if best_point[i] < 0 or cost[i, j] < cost[i, best_point[i]]:
                        best_point[i] = j
                    if best_track[j] < 0 or cost[i, j] < cost[best_track[j], j]:
                        best_track[j] = i
        for i in range(open_count):
            chosen[i] = best_point[i]
            if best_point[i] >= 0 and (
                best_track[best_point[i]] != i
                or _has_rival(cost, i, best_point, best_track, candidates[i, : candidate_count[i]], rivals, rival_count, margin)
            ):
                chosen[i] = -2  # ambiguous: the trajectory ends
        _mark_linked(previous, chosen, columns, last_frame, last_column, open_count, t)
        kept = 0
        for i in range(open_count):
            if chosen[i] == -2:
                continue
            if chosen[i] >= 0:
                c = columns[chosen[i]]
                _append_sample(state[i], sample_count[i], points, t, c, (t - last_frame[i]) / rate)
                sample_count[i] += 1
                last_frame[i], last_column[i] = t, c
                best_track[chosen[i]] = -3  # is continued
            limit = MAX_FIRST_LINK_FRAMES if sample_count[i] == 1 else max_lag_frames
            if t - last_frame[i] < limit:
                for k in range(11):
                    state[kept, k] = state[i, k]
                sample_count[kept], last_frame[kept], last_column[kept] = sample_count[i], last_frame[i], last_column[i]
                kept += 1
        open_count = kept
        for j in range(here):
            if best_track[j] != -3 and open_count < capacity:
                for k in range(11):
                    state[open_count, k] = points[t, columns[j], k] if k < 3 else 0.0
                sample_count[open_count], last_frame[open_count], last_column[open_count] = 1, t, columns[j]
                open_count += 1
    return previous


@compile_inner_kernel
def _count_most_points(points):
    """Return the largest number of points in a frame."""
    most = 0
    for t in range(len(points)):
        count = 0
        for c in range(points.shape[1]):
            if not np.isnan(points[t, c, 0]):
                count += 1
        most = max(most, count)
    return most


@compile_inner_kernel
def _has_rival(cost, i, best_point, best_track, candidates, rivals, rival_count, margin):
    """Return whether an alternative to trajectory i and its best point costs less than a margin more."""
    j = best_point[i]
    for other in candidates:  # the trajectory continues at another point
        if other == j:
            continue
        k = best_track[other]
        if k >= 0 and k != i and best_point[k] == other:  # whose trajectory then has this one's point, or none
            exchanged = cost[i, other] + min(cost[k, j], cost[k, other] + margin)
            if exchanged - cost[i, j] - cost[k, other] < margin:
                return True
        elif cost[i, other] - cost[i, j] < margin:
            return True
    for k in rivals[j, : rival_count[j]]:  # another trajectory, without a point of its own, continues here
        has_no_point = best_point[k] == j or best_track[best_point[k]] != k
        if k != i and has_no_point and cost[k, j] - cost[i, j] < margin:
            return True
    return False


@compile_inner_kernel
def _mark_linked(previous, chosen, columns, last_frame, last_column, open_count, t):
    for i in range(open_count):
        if chosen[i] >= 0:
            previous[t, columns[chosen[i]]] = last_frame[i] * previous.shape[1] + last_column[i]


@compile_kernel
def combine_links(forward, backward):
    """Return the links that one direction of time gives and the other does not contradict.

    Args:
        forward: (T, C) index of the point that each point continues, from `link_in_order`.
        backward: the same of the reversed frames, in reversed order: index there of the point that continues each point.

    Returns:
        (T, C) index of the point that each point continues, -1 if there is none.
    """
    frame_count, column_count = forward.shape
    count = frame_count * column_count
    before, after = forward.copy().reshape(count), np.full(count, -1, np.int64)
    reversed_before, reversed_after = np.full(count, -1, np.int64), np.full(count, -1, np.int64)
    for i in range(count):
        if before[i] >= 0:
            after[before[i]] = i
        t, c = i // column_count, i % column_count
        later = backward[frame_count - 1 - t, c]
        if later >= 0:
            reversed_after[i] = (frame_count - 1 - later // column_count) * column_count + later % column_count
            reversed_before[reversed_after[i]] = i
    previous = np.full(count, -1, np.int64)
    for i in range(count):
        a, b = before[i], reversed_before[i]
        if a >= 0 and (b == a or (b < 0 and (reversed_after[a] < 0 or reversed_after[a] == i))):
            previous[i] = a
        elif a < 0 and b >= 0 and (after[b] < 0 or after[b] == i):
            previous[i] = b
    return previous.reshape(forward.shape)


@compile_kernel
def number_tracklets(points, previous):
    """Return the number (T, C) of each point's chain of links, in the order of their first frames, -1 where there is no point."""
    frame_count, column_count = previous.shape
    number, count = np.full((frame_count, column_count), -1, np.int32), 0
    for t in range(frame_count):
        for c in range(column_count):
            if np.isnan(points[t, c, 0]):
                continue
            if previous[t, c] >= 0:
                number[t, c] = number[previous[t, c] // column_count, previous[t, c] % column_count]
            else:
                number[t, c] = count
                count += 1
    return number
