"""Which markers may have exchanged their labels: a first look that costs little and lets nothing pass.

Two hints say that marker i may ride on label j: j leaps, or appears, where i would have gone on, and i leaps or
disappears; or for some time i's own samples contradict i's distances and those of j keep them.
"""

import numpy as np
from numba import njit

from mocapfix.detect.continuity import Courses, leap, own_leaps
from mocapfix.detect.distances import Distances, contradiction, own_contradictions
from mocapfix.take import runs

LEAPS = 0.5  # of a leap: a label that does so may change its marker
MEETS = 0.3  # of a leap: where another goes on so well, it may be the same marker
WRONG = 0.3  # how far samples contradict a marker's distances that may be another's
BETTER = 0.85  # of that: how far they contradict the other's at most
LONGEST = 0.05  # seconds: for less than that distances hint at nothing
RECENT = 0.1  # seconds since a marker was seen: later a label is too easily where it might have gone
OFTEN = 0.5  # of the take: a label seen in less of it is a fragment, not a marker of its own
LOOKS = 9  # frames of a stretch at which other labels are tried


def groups(courses: Courses, known: Distances) -> list[tuple[int, ...]]:
    """-> pairs and triples of markers among which labels may have been exchanged."""
    count = courses.last.shape[1]
    rides = np.zeros((count, count), bool)
    own = own_contradictions(courses.markers, known, 1.0)
    _where_it_goes_on(courses, known, own_leaps(courses), own, rides)
    _where_it_fits(courses, known, own, rides)
    rare = np.isnan(courses.markers[..., 0]).mean(0) > 1 - OFTEN
    rides[rare] = rides[:, rare] = False
    pairs = {tuple(sorted(map(int, pair))) for pair in np.argwhere(rides)}
    triples = set()
    for i, j in np.argwhere(rides):
        for k in np.flatnonzero(rides[j]):
            if len({i, j, k}) == 3:
                triples.add(tuple(sorted((int(i), int(j), int(k)))))
    return sorted(pairs) + sorted(triples)


@njit(cache=True)
def _where_it_goes_on(courses, known, leaps, own, rides):
    """Mark in `rides` (M, M) that marker i may go on under label j where one leaps to where the other was going.

    Unless the distances of marker i are against it.
    """
    frames, count = leaps.shape
    nobody = np.zeros(count, np.bool_)
    for t in range(1, frames):
        for j in range(count):
            appears = courses.last[t, j] != t - 1
            if np.isnan(courses.markers[t, j, 0]) or not (leaps[t, j] > LEAPS or appears):
                continue
            for i in range(count):
                gone = np.isnan(courses.markers[t, i, 0])
                late = t - courses.last[t, i] > RECENT * courses.rate
                if i == j or rides[i, j] or not (gone or leaps[t, i] > LEAPS) or courses.last[t, i] < 0 or late:
                    continue
                if leap(courses, t, i, j) < MEETS:
                    off = contradiction(courses.markers, known, t, j, i, nobody, 1.0)
                    rides[i, j] = off <= own[t, j] + WRONG


def _where_it_fits(courses: Courses, known: Distances, own: np.ndarray, rides: np.ndarray) -> None:
    """Mark in `rides` (M, M) that marker i may ride on label j where its samples keep i's distances and not j's."""
    seen = ~np.isnan(courses.markers[..., 0])
    for j in range(own.shape[1]):
        for first, last in runs(seen[:, j] & (own[:, j] > WRONG)):
            if last - first + 1 < LONGEST * courses.rate:
                continue
            looks = np.unique(np.linspace(first, last, LOOKS).astype(int))
            fit = _fits(courses.markers, known, looks, j)
            rides[:, j] |= (fit < BETTER * own[looks, j].mean()) & (own[looks].mean(0) > WRONG)
            rides[j, j] = False


@njit(cache=True)
def _fits(markers, known, looks, label):
    """-> (M,) how badly the samples under a label contradict each marker's distances on average."""
    count = markers.shape[1]
    nobody, fit = np.zeros(count, np.bool_), np.zeros(count)
    for m in range(count):
        for t in looks:
            fit[m] += contradiction(markers, known, t, label, m, nobody, 1.0) / len(looks)
    return fit
