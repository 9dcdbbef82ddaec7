"""Evidence for and against labels: leaps of trajectories, contradicted marker distances, and the costs of exchanges.

The kernels take two named tuples of the detectors. `trajectories` is a `mocapfix.stats.marker_distances.MarkerTrajectories`,
and `distances` a `mocapfix.stats.marker_distances.MarkerDistances`.
"""

import numpy as np

from mocapfix.kernels.compilation import compile_inner_kernel, compile_kernel

LEAP_TOLERANCE_M = 0.010  # mismatch of two samples that noise and skin cause in an arbitrarily short time
LEAP_TOLERANCE_M_PER_S = 1.0  # with the time between the samples (measured: 99 of 100 mismatches are smaller)
UNKNOWN_SPEED_M_PER_S = 2.0  # possible speed of a marker of which only one sample is visible
MAX_VELOCITY_STEPS = 2  # longest time over which a velocity is measured, in frames
MAX_LEAP_GAP_S = 0.3  # samples farther apart in time are not compared

MIN_CANDIDATE_LEAP = 0.5  # A label with a larger leap may have changed its marker
MAX_CONTINUATION_LEAP = 0.3  # A label that continues another one with a smaller leap may have the same marker
MIN_SWAP_CONTRADICTION = 0.3  # samples with a larger contradiction of a marker's distances may be another marker's
MIN_CONTRADICTION_DURATION_S = 0.05  # shortest stretch of contradictions that makes a candidate
MAX_RELATIVE_CONTRADICTION = 0.85  # largest contradiction of the other marker's distances, relative to that of the own ones
MAX_COMPARED_FRAMES = 9  # number of frames of a stretch at which other labels are compared
MAX_UNSEEN_DURATION_S = 0.1  # of a marker before a label continues it: later almost every label may do so

LABEL_CHANGE_COST = 0.5  # cost, in leaps, of assigning a label to another marker
MAX_SMOOTH_LEAP = 0.25  # from one frame to the next, of a label that continues smoothly and has not changed its marker
SMOOTH_CHANGE_COST = 1000.0  # cost, in leaps, of a change of a label that continues smoothly
CONTRADICTION_S_PER_LEAP = 0.05  # duration of a full contradiction that costs as much as one leap


@compile_inner_kernel
def compute_velocity(markers, rate, frame, marker, direction):
    """Compute the velocity in m/s with which a marker arrives at a sample (direction -1) or departs from it (1).

    It is measured over the longest span without a missing sample, up to MAX_VELOCITY_STEPS; NaN if the next sample is missing.
    """
    steps = 0
    if not np.isnan(markers[frame, marker, 0]):
        while steps < MAX_VELOCITY_STEPS:
            other = frame + direction * (steps + 1)
            if other < 0 or other >= len(markers) or np.isnan(markers[other, marker, 0]):
                break
            steps += 1
    if steps == 0:
        return np.nan, np.nan, np.nan
    first, last = min(frame, frame + direction * steps), max(frame, frame + direction * steps)
    return (
        (markers[last, marker, 0] - markers[first, marker, 0]) * rate / steps,
        (markers[last, marker, 1] - markers[first, marker, 1]) * rate / steps,
        (markers[last, marker, 2] - markers[first, marker, 2]) * rate / steps,
    )


@compile_inner_kernel
def compute_leap(trajectories, frame, source, target):
    """Compute how much of a leap it is from the last sample of `source` before `frame` to the sample of `target` in it.

    Returns a value in 0..1: 0 if there is nothing to compare, 1 for a mismatch of the tolerance or more.
    """
    markers, previous_frame, rate = trajectories
    start = previous_frame[frame, source]
    if start < 0 or np.isnan(markers[frame, target, 0]):
        return 0.0
    seconds = (frame - start) / rate
    if seconds > MAX_LEAP_GAP_S:
        return 0.0
    velocity_before = compute_velocity(markers, rate, start, source, -1)
    velocity_after = compute_velocity(markers, rate, frame, target, 1)
    has_before, has_after = not np.isnan(velocity_before[0]), not np.isnan(velocity_after[0])
    nearest = np.inf
    for share in (0.5, 0.0, 1.0):
        miss = 0.0
        for x in range(3):
            forward = share * seconds * velocity_before[x] if has_before else 0.0
            backward = (1 - share) * seconds * velocity_after[x] if has_after else 0.0
            miss += (markers[frame, target, x] - backward - markers[start, source, x] - forward) ** 2
        nearest = min(nearest, miss)
    tolerance = LEAP_TOLERANCE_M + seconds * (
        LEAP_TOLERANCE_M_PER_S + UNKNOWN_SPEED_M_PER_S / 2 * ((not has_before) + (not has_after))
    )
    return min(1.0, nearest / tolerance**2)


@compile_kernel
def compute_own_leaps(trajectories):
    """Compute the leap (T, M), 0..1, of each label between its previous sample and the present one."""
    frames, count = trajectories.previous_frame.shape
    own = np.zeros((frames, count))
    for t in range(frames):
        for m in range(count):
            own[t, m] = compute_leap(trajectories, t, m, m)
    return own


@compile_inner_kernel
def compute_contradiction(markers, distances, frame, label, marker, is_excluded, unseen_vote):
    """Compute how badly the sample under `label` fits as the `marker`: 0 (well) to 1.

    The value is the weighted mean over the marker's partners. Partners with `is_excluded` (M,) have no vote. Missing partners
    vote `unseen_vote`: 1 where labels are compared, because a marker that may be anywhere explains the samples no better than
    chance.
    """
    contradiction, votes = 0.0, 0.0
    for k in range(distances.partner.shape[1]):
        p = distances.partner[marker, k]
        if p < 0 or is_excluded[p] or p == label:
            continue
        square = 0.0
        for x in range(3):
            square += (markers[frame, label, x] - markers[frame, p, x]) ** 2
        weight = 1 / distances.tolerance_m[marker, k] ** 2
        votes += weight
        deviation = (np.sqrt(square) - distances.length_m[marker, k]) / distances.tolerance_m[marker, k]
        contradiction += weight * (unseen_vote if np.isnan(square) else min(1.0, deviation * deviation))
    return contradiction / votes if votes else unseen_vote


@compile_kernel
def compute_own_contradictions(markers, distances, unseen_vote):
    """Compute how badly each sample fits under its own label: (T, M), 0..1."""
    frames, count = markers.shape[:2]
    is_excluded = np.zeros(count, np.bool_)
    own = np.empty((frames, count))
    for t in range(frames):
        for m in range(count):
            own[t, m] = compute_contradiction(markers, distances, t, m, m, is_excluded, unseen_vote)
    return own


@compile_kernel
def mark_continuations(trajectories, distances, leaps, own_contradiction, is_candidate):
    """Mark in `is_candidate` (M, M) that label j may continue marker i: one leaps to where the other was going.

    A sample that contradicts the distances of marker i is no continuation.
    """
    frames, count = leaps.shape
    is_excluded = np.zeros(count, np.bool_)
    for t in range(1, frames):
        for j in range(count):
            appears = trajectories.previous_frame[t, j] != t - 1
            if np.isnan(trajectories.markers[t, j, 0]) or not (leaps[t, j] > MIN_CANDIDATE_LEAP or appears):
                continue
            for i in range(count):
                is_missing = np.isnan(trajectories.markers[t, i, 0])
                is_late = t - trajectories.previous_frame[t, i] > MAX_UNSEEN_DURATION_S * trajectories.rate
                if i == j or is_candidate[i, j] or not (is_missing or leaps[t, i] > MIN_CANDIDATE_LEAP):
                    continue
                if trajectories.previous_frame[t, i] < 0 or is_late:
                    continue
                if compute_leap(trajectories, t, i, j) < MAX_CONTINUATION_LEAP:
                    contradiction = compute_contradiction(trajectories.markers, distances, t, j, i, is_excluded, 1.0)
                    is_candidate[i, j] = contradiction <= own_contradiction[t, j] + MIN_SWAP_CONTRADICTION


@compile_kernel
def mark_distance_matches(trajectories, distances, own_contradiction, is_candidate):
    """Mark in `is_candidate` (M, M) that label j's samples match the distances of marker i and contradict those of j."""
    frames, count = own_contradiction.shape
    for j in range(count):
        first = -1
        for t in range(frames + 1):
            if t < frames and own_contradiction[t, j] > MIN_SWAP_CONTRADICTION and not np.isnan(trajectories.markers[t, j, 0]):
                first = t if first < 0 else first
            elif first >= 0:
                if t - first >= MIN_CONTRADICTION_DURATION_S * trajectories.rate:
                    mark_stretch_matches(trajectories.markers, distances, own_contradiction, first, t - 1, j, is_candidate)
                first = -1


@compile_inner_kernel
def mark_stretch_matches(markers, distances, own_contradiction, first, last, label, is_candidate):
    """Mark in `is_candidate` (M, M) the markers i that the samples first..last under a label match better than its own.

    Only those with contradicted samples of their own are compared, which are few, and each only until it has matched too badly.
    """
    count = markers.shape[1]
    is_excluded, own_sum = np.zeros(count, np.bool_), np.zeros(count)
    steps = max(1, min(MAX_COMPARED_FRAMES - 1, last - first))
    compared = min(steps, last - first) + 1
    for n in range(compared):
        t = first + n * (last - first) // steps
        for i in range(count):
            own_sum[i] += own_contradiction[t, i]
    for i in range(count):
        if i == label or is_candidate[i, label] or not own_sum[i] > MIN_SWAP_CONTRADICTION * compared:
            continue
        misfit_sum = 0.0
        for n in range(compared):
            t = first + n * (last - first) // steps
            misfit_sum += compute_contradiction(markers, distances, t, label, i, is_excluded, 1.0)
            if not misfit_sum < MAX_RELATIVE_CONTRADICTION * own_sum[label]:
                break
        is_candidate[i, label] = misfit_sum < MAX_RELATIVE_CONTRADICTION * own_sum[label]


@compile_kernel
def compute_exchange_costs(states, group, trajectories, distances):
    """Compute the costs in leaps of the step (T, S, S) into a frame's state from the one before, and of the state (T, S)."""
    frames, count = trajectories.previous_frame.shape
    size, n = len(group), len(states)
    is_excluded = np.zeros(count, np.bool_)
    for marker in group:
        is_excluded[marker] = True
    step_cost, state_cost = np.zeros((frames, n, n)), np.zeros((frames, n))
    leaps, is_smooth, misfit = np.zeros((size, size)), np.zeros(size, np.bool_), np.zeros((size, size))
    for t in range(frames):
        for j in range(size):
            visible = not np.isnan(trajectories.markers[t, group[j], 0])
            leaps[j, j] = compute_leap(trajectories, t, group[j], group[j])
            is_consecutive = trajectories.previous_frame[t, group[j]] == t - 1
            is_smooth[j] = visible and is_consecutive and leaps[j, j] < MAX_SMOOTH_LEAP
            for i in range(size):
                contradiction = 0.0
                if visible:
                    contradiction = compute_contradiction(
                        trajectories.markers, distances, t, group[j], group[i], is_excluded, 1.0
                    )
                misfit[i, j] = contradiction / (CONTRADICTION_S_PER_LEAP * trajectories.rate)
        if not is_smooth.all():
            for i in range(size):
                for j in range(size):
                    leaps[i, j] = compute_leap(trajectories, t, group[i], group[j])
        for s in range(n):
            for i in range(size):
                state_cost[t, s] += misfit[i, states[s, i]]
                for r in range(n):
                    before, now = states[r, i], states[s, i]
                    change_cost = LABEL_CHANGE_COST + SMOOTH_CHANGE_COST * is_smooth[before]
                    step_cost[t, r, s] += leaps[before, now] + (before != now) * change_cost
    return step_cost, state_cost
