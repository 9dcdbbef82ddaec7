"""Whether a marker's trajectory goes on from one sample to another, within one label or across two.

Both sides are carried to the moment half way between them at their own velocity, where a constant acceleration cancels; or one
of them all the way, for the other's velocity may be spoilt by a leap of its own. Where they meet the trajectory goes on.
After some tenths of a second nothing can be told.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

SLACK = 0.010  # metres: what noise and skin miss by in whatever little time
DRIFT = 1.0  # m/s: by which the rest grows with the time between the samples (measured: 99 of 100 miss by less)
UNKNOWN = 2.0  # m/s: how fast a marker may be of which only one sample is seen
FORGOTTEN = 0.3  # seconds after which nothing can be told
STEPS = 2  # samples over which a velocity is taken


class Courses(NamedTuple):
    """Where each trajectory comes from and goes to, for T frames of M labels.

    markers    (T, M, 3) metres, NaN where not seen
    before     (T, M, 3) m/s: the velocity with which it arrived at a sample; NaN where not known
    after      (T, M, 3) m/s: that with which it leaves it
    last       (T, M) int: the latest frame before this one in which the label was seen; -1 where there is none
    rate       frames a second
    """

    markers: np.ndarray
    before: np.ndarray
    after: np.ndarray
    last: np.ndarray
    rate: float


def of(markers: np.ndarray, rate: float) -> Courses:
    """-> the courses of markers (T, M, 3) in metres, NaN where not seen, at `rate` frames a second."""
    markers = np.ascontiguousarray(markers, float)
    seen = ~np.isnan(markers[..., 0])
    before, after = np.full(markers.shape, np.nan), np.full(markers.shape, np.nan)
    for steps in range(1, min(STEPS, len(markers) - 1) + 1):  # the longer where all samples between are there
        velocity = (markers[steps:] - markers[:-steps]) * rate / steps
        there = np.all([seen[n : len(seen) - steps + n] for n in range(steps + 1)], axis=0)
        before[steps:][there] = velocity[there]
        after[:-steps][there] = velocity[there]
    latest = np.maximum.accumulate(np.where(seen, np.arange(len(seen))[:, None], -1), axis=0)
    last = np.full(seen.shape, -1)
    last[1:] = latest[:-1]
    return Courses(markers, before, after, last, float(rate))


@njit(cache=True)
def leap(courses, frame, source, target):
    """-> 0..1: how much of a leap it is from the last sample of label `source` before `frame` to that of `target` in it.

    0 where there is nothing to compare; 1 is as far as counts.
    """
    markers, before, after, last, rate = courses
    start = last[frame, source]
    if start < 0 or np.isnan(markers[frame, target, 0]):
        return 0.0
    seconds = (frame - start) / rate
    if seconds > FORGOTTEN:
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
    tolerance = SLACK + seconds * (DRIFT + UNKNOWN / 2 * ((not gone) + (not come)))
    return min(1.0, nearest / tolerance**2)


@njit(cache=True)
def own_leaps(courses):
    """-> (T, M) 0..1: how much each label leaps between its last sample and this one."""
    frames, count = courses.last.shape
    own = np.zeros((frames, count))
    for t in range(frames):
        for m in range(count):
            own[t, m] = leap(courses, t, m, m)
    return own
