"""Which markers the labels of a small group really follow, frame by frame: the cheapest course through their permutations.

In a state each marker of the group rides on one label of it. A course pays for each leap that its markers make, for samples
that contradict the distances of the markers they are held for, and for each change of state. The cheapest is found exactly,
by dynamic programming (Viterbi's algorithm). All is counted in leaps, 1 being as far as counts, so neither a spike nor a
moment's misfit buys a change; and where labels change within a gap, with no leap to be seen, distances alone can.
"""

from itertools import permutations
from typing import NamedTuple

import numpy as np
from numba import njit

from mocapfix.detect.continuity import Courses, leap
from mocapfix.detect.distances import Distances, contradiction
from mocapfix.take import runs

CHANGE = 0.5  # leaps: the price of a label's change from one marker to another
SMOOTH = 0.25  # of a leap: a label that goes on so well from one frame to the next has not changed its marker
NEVER = 1000.0  # leaps: the price of saying so all the same
TELLING = 0.05  # seconds for which a sample must be wholly contradicted to count as much as a leap
BLINK = 0.1  # seconds: a label in the place of one that is not seen meanwhile may be a spike if it is there for less
DOUBT = 0.1  # leaps a second: labels are rather right than wrong where nothing tells


class Exchange(NamedTuple):
    """A ring of labels over the frames first..last: the samples of each marker in `ring` are under the next one's label.

    gain     leaps that it saves
    against  leaps that it would cost, on the evidence of distances, if these frames were right and all the others wrong
    """

    ring: tuple[int, ...]
    first: int
    last: int
    gain: float
    against: float


def within(group: tuple[int, ...], courses: Courses, known: Distances) -> list[Exchange]:
    """-> the exchanges of labels in a group of two or three markers, by first frame."""
    states = np.array(list(permutations(range(len(group)))))  # marker i rides on label states[s, i]; in the first on its own
    step, stay = _costs(states, np.array(group), courses, known)
    doubt = DOUBT / courses.rate * (np.arange(len(states)) > 0)
    course = cheapest(step, stay + doubt)
    seen, found = ~np.isnan(courses.markers[:, group, 0]), []
    for s in range(1, len(states)):
        extra = stay[:, s] - stay[:, 0]
        for first, last in runs(course == s):
            inside = slice(first, last + 1)
            gain = _steps_saved(step, course, first, last) - float(extra[inside].sum())
            against = float(extra[course == 0].sum() - extra[inside].sum())
            for ring in _rings(states[s]):
                there = first + np.flatnonzero(seen[inside][:, ring].any(1))
                whole = seen[inside][:, ring].any(0).all()
                if len(there) >= (1 if whole else BLINK * courses.rate):
                    named = tuple(group[i] for i in ring)
                    found.append(Exchange(named, int(there[0]), int(there[-1]), gain, against))
    return sorted(found, key=lambda each: each.first)


def _rings(state: np.ndarray) -> list[list[int]]:
    """-> the rings of a permutation, those of one alone left out: each is followed by the one on whose label it rides."""
    rings, left = [], set(range(len(state)))
    while left:
        ring = [min(left)]
        while (following := int(state[ring[-1]])) != ring[0]:
            ring.append(following)
        left -= set(ring)
        rings += [ring] if len(ring) > 1 else []
    return rings


def _steps_saved(step: np.ndarray, course: np.ndarray, first: int, last: int) -> float:
    """-> leaps and prices of change that the labels as they are would cost more than the course does over first..last."""
    as_is = course.copy()
    as_is[first : last + 1] = 0
    t = np.arange(max(first, 1), min(last + 2, len(course)))
    return float((step[t, as_is[t - 1], as_is[t]] - step[t, course[t - 1], course[t]]).sum())


@njit(cache=True)
def _costs(states, group, courses, known):
    """-> step (T, S, S) into a frame's state from the one before, and stay (T, S) in a state, all in leaps."""
    frames, count = courses.last.shape
    size, n = len(group), len(states)
    left_out = np.zeros(count, np.bool_)
    for marker in group:
        left_out[marker] = True
    step, stay = np.zeros((frames, n, n)), np.zeros((frames, n))
    leaps, fixed, misfit = np.zeros((size, size)), np.zeros(size, np.bool_), np.zeros((size, size))
    for t in range(frames):
        for j in range(size):
            there = not np.isnan(courses.markers[t, group[j], 0])
            leaps[j, j] = leap(courses, t, group[j], group[j])
            fixed[j] = there and courses.last[t, group[j]] == t - 1 and leaps[j, j] < SMOOTH
            for i in range(size):
                off = contradiction(courses.markers, known, t, group[j], group[i], left_out, 1.0) if there else 0.0
                misfit[i, j] = off / (TELLING * courses.rate)
        if not fixed.all():
            for i in range(size):
                for j in range(size):
                    leaps[i, j] = leap(courses, t, group[i], group[j])
        for s in range(n):
            for i in range(size):
                stay[t, s] += misfit[i, states[s, i]]
                for r in range(n):
                    before, now = states[r, i], states[s, i]
                    step[t, r, s] += leaps[before, now] + (before != now) * (CHANGE + NEVER * fixed[before])
    return step, stay


@njit(cache=True)
def cheapest(step, stay):
    """-> (T,) the state in each frame of the cheapest course."""
    frames, n = stay.shape
    cost, came = stay[0].copy(), np.zeros((frames, n), np.int64)
    total = cost.copy()
    for t in range(1, frames):
        for s in range(n):
            for r in range(n):
                if cost[r] + step[t, r, s] < cost[came[t, s]] + step[t, came[t, s], s]:
                    came[t, s] = r
            total[s] = cost[came[t, s]] + step[t, came[t, s], s] + stay[t, s]
        cost[:] = total
    course = np.zeros(frames, np.int64)
    course[-1] = np.argmin(cost)
    for t in range(frames - 1, 0, -1):
        course[t - 1] = came[t, course[t]]
    return course
