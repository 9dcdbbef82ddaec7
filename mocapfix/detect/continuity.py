"""Whether a marker's trajectory goes on from one sample to another, within one label or across two.

Both sides are carried to the moment half way between them at their own velocity, where a constant acceleration cancels; or one
of them all the way, for the other's velocity may be spoilt by a leap of its own. Where they meet the trajectory goes on.
After some tenths of a second nothing can be told.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from mocapfix.detect.trajectory_segments import TrajectorySegment

# MERGED: mocapfix.detect.continuity
LEAP_TOLERANCE_M = 0.010  # metres: what noise and skin miss by in whatever little time
LEAP_TOLERANCE_M_PER_S = 1.0  # m/s: by which the rest grows with the time between the samples (measured: 99 of 100 miss by less)
UNKNOWN_SPEED_M_PER_S = 2.0  # m/s: how fast a marker may be of which only one sample is seen
MAX_LEAP_GAP_S = 0.3  # seconds after which nothing can be told
MAX_VELOCITY_STEPS = 2  # samples over which a velocity is taken


class MarkerTrajectories(NamedTuple):
    """Where each trajectory comes from and goes to, for T frames of M labels.

    markers    (T, M, 3) metres, NaN where not seen
    before     (T, M, 3) m/s: the velocity with which it arrived at a sample; NaN where not known
    after      (T, M, 3) m/s: that with which it leaves it
    last       (T, M) int: the latest frame before this one in which the label was seen; -1 where there is none
    rate       frames a second
    """

    markers: np.ndarray
    velocity_before: np.ndarray
    velocity_after: np.ndarray
    previous_frame: np.ndarray
    rate: float


def build_trajectories(markers: np.ndarray, rate: float) -> MarkerTrajectories:
    """-> the courses of markers (T, M, 3) in metres, NaN where not seen, at `rate` frames a second."""
    markers = np.ascontiguousarray(markers, float)
    seen = ~np.isnan(markers[..., 0])
    before, after = np.full(markers.shape, np.nan), np.full(markers.shape, np.nan)
    for steps in range(1, min(MAX_VELOCITY_STEPS, len(markers) - 1) + 1):  # the longer where all samples between are there
        velocity = (markers[steps:] - markers[:-steps]) * rate / steps
        there = np.all([seen[n : len(seen) - steps + n] for n in range(steps + 1)], axis=0)
        before[steps:][there] = velocity[there]
        after[:-steps][there] = velocity[there]
    latest = np.maximum.accumulate(np.where(seen, np.arange(len(seen))[:, None], -1), axis=0)
    last = np.full(seen.shape, -1)
    last[1:] = latest[:-1]
    return MarkerTrajectories(markers, before, after, last, float(rate))


@njit(cache=True)
def compute_leap(trajectories, frame, source, target):
    """-> 0..1: how much of a leap it is from the last sample of label `source` before `frame` to that of `target` in it.

    0 where there is nothing to compare; 1 is as far as counts.
    """
    markers, before, after, last, rate = trajectories
    start = last[frame, source]
    if start < 0 or np.isnan(markers[frame, target, 0]):
        return 0.0
    seconds = (frame - start) / rate
    if seconds > MAX_LEAP_GAP_S:
        return 0.0
    gone, come = not np.isnan(before[start, source, 0]), not np.isnan(after[frame, target, 0])
    nearest = np.inf
    for share in (0.5, 0.0, 1.0):
        miss = 0.0
        for x in range(3):
            on = share * seconds * before[start, source, x] if gone else 0.0
            back = (1 - share) * seconds * after[frame, target, x] if come else 0.0
            miss += (markers[frame, target, x] - back - markers[start, source, x] - on) ** 2
        nearest = min(nearest, miss)
    tolerance = LEAP_TOLERANCE_M + seconds * (LEAP_TOLERANCE_M_PER_S + UNKNOWN_SPEED_M_PER_S / 2 * ((not gone) + (not come)))
    return min(1.0, nearest / tolerance**2)


@njit(cache=True)
def compute_own_leaps(trajectories):
    """-> (T, M) 0..1: how much each label leaps between its last sample and this one."""
    frames, count = trajectories.previous_frame.shape
    own = np.zeros((frames, count))
    for t in range(frames):
        for m in range(count):
            own[t, m] = compute_leap(trajectories, t, m, m)
    return own


# MERGED: mocapfix.detect.courses
# Courses: does one path lead on to another?
MAX_DUPLICATE_DISTANCE_M = 0.010  # metres: the same marker twice lies no farther from itself
VELOCITY_WINDOW_S = 0.03  # seconds of a course that tell its velocity
JOIN_TOLERANCE_M, JOIN_TOLERANCE_M_PER_S2 = (
    0.002,
    2.5,
)  # metres, m/s2: a course misses by the one and, after t seconds, the other times t squared besides
MAX_END_DEVIATION_SD = 3.5  # standard deviations: an end counts for no more, for the last sample of a label is often a bad one


def compute_join_cost(segment: TrajectorySegment, path: np.ndarray, rate: float, max_gap_s: float) -> float:
    """-> the cost of going from a marker's path (T, 3) to the piece and on: the mean square of what both ends miss, in standard
    deviations; NaN where neither is within `reach` seconds, infinite where piece and marker are seen together and apart.
    """
    seen = ~np.isnan(path[:, 0])
    both = seen[segment.frames]
    if both.any():
        apart = float(np.median(np.linalg.norm(segment.points[both] - path[segment.frames[both]], axis=1)))
        return (2 * apart / MAX_DUPLICATE_DISTANCE_M) ** 2 if apart <= MAX_DUPLICATE_DISTANCE_M else np.inf
    first, last, far = segment.frames[0], segment.frames[-1], round(max_gap_s * rate) + 1
    start = max(0, first - far)
    early, late = start + np.flatnonzero(seen[start:first]), last + 1 + np.flatnonzero(seen[last + 1 : last + 1 + far])
    ends = []
    if len(early):
        ends.append(measure_join_error(early, path[early], segment.frames, segment.points, rate))
    if len(late):
        ends.append(measure_join_error(segment.frames, segment.points, late, path[late], rate))
    return (
        float(
            np.mean(
                [min(MAX_END_DEVIATION_SD, off / (JOIN_TOLERANCE_M + JOIN_TOLERANCE_M_PER_S2 * lag**2)) ** 2 for off, lag in ends]
            )
        )
        if ends
        else np.nan
    )


def measure_join_error(
    early_frames: np.ndarray, early_points: np.ndarray, late_frames: np.ndarray, late_points: np.ndarray, rate: float
) -> tuple[float, float]:
    """-> metres by which a path misses that goes on from its last point to another's first at the mean of their velocities,
    and the seconds between.

    early (N,) and late (K,) frames, before (N, 3) and after (K, 3) metres
    """
    lag = (late_frames[0] - early_frames[-1]) / rate
    mean = (
        _fit_end_velocity(early_frames[::-1], early_points[::-1], rate) + _fit_end_velocity(late_frames, late_points, rate)
    ) / 2
    return float(np.linalg.norm(late_points[0] - early_points[-1] - mean * lag)), float(lag)


def _fit_end_velocity(frames: np.ndarray, points: np.ndarray, rate: float) -> np.ndarray:
    """-> (3,) m/s near the first of the frames (N,), by a straight line through what is listened to; 0 from one alone."""
    near = max(2, int(np.searchsorted(np.abs(frames - frames[0]), VELOCITY_WINDOW_S * rate, side="right")))
    time = (frames[:near] - frames[:near].mean()) / rate
    return time @ points[:near] / max(float(time @ time), 1e-12)


def is_smoother(segment: TrajectorySegment, path: np.ndarray, rate: float) -> bool:
    """Does a marker's path (T, 3) lead through the piece more smoothly, at both its ends, than through its own samples?"""
    first, last = segment.frames[0], segment.frames[-1]
    seen = np.flatnonzero(~np.isnan(path[:, 0]))
    early, late, own = seen[seen < first], seen[seen > last], seen[(seen >= first) & (seen <= last)]
    ends = []
    for frames, points in ((segment.frames, segment.points), (own, path[own])):
        into = measure_join_error(early, path[early], frames, points, rate)[0] if len(early) else 0.0
        out = measure_join_error(frames, points, late, path[late], rate)[0] if len(late) else 0.0
        ends.append((into, out))
    (into, out), (own_into, own_out) = ends
    return max(own_into, own_out) > JOIN_TOLERANCE_M and into < own_into and out < own_out
