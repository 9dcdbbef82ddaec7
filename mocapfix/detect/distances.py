"""What a take tells of each marker's distances to the others, and how badly a sample contradicts them.

Two markers of one segment keep their distance; which ones do, and how well, is learnt from the take itself (Ringer & Lasenby
2004, "A procedure for automatically estimating model parameters in optical motion capture"). A sample under the wrong label
breaks the distances to its label's partners and keeps those to another's. Each partner has one limited vote, so that one that
is itself off, or mislabelled, cannot outvote the others.
"""

from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.special import ndtri

PARTNERS = 8  # of one marker, at most
LOOSE = 0.03  # metres: a distance that varies by more tells little of which marker is which
STEADY = 0.003  # metres: by which even a distance on one rigid segment varies
BROKEN = 3.0  # standard deviations from which on a distance is wholly broken
LEARNING = 300  # frames at most, evenly spread, from which the distances are learnt
FEWEST = 20  # of these in which both were seen; all of fewer
MOST = 0.55  # of these frames must be right, whatever the rest


class Distances(NamedTuple):
    """The distances that each of M markers keeps to its K steadiest partners.

    partner    (M, K) int, steadiest first; -1 where there are fewer
    length     (M, K) metres
    tolerance  (M, K) metres from which on a distance is broken
    """

    partner: np.ndarray
    length: np.ndarray
    tolerance: np.ndarray


def learnt(markers: np.ndarray, most: float = MOST) -> Distances:
    """-> the distances that markers (T, M, 3), in metres, NaN where not seen, keep over `most` (0..1) of the take."""
    count = markers.shape[1]
    middle, spread = usual(markers, most)
    order = np.argsort(spread, axis=1, kind="stable")[:, :PARTNERS]
    rows = np.arange(count)[:, None]
    steady = spread[rows, order] < LOOSE
    tolerance = BROKEN * np.hypot(np.where(steady, spread[rows, order], 0), STEADY)
    return Distances(np.where(steady, order, -1), np.where(steady, middle[rows, order], 0), tolerance)


def usual(markers: np.ndarray, most: float) -> tuple[np.ndarray, np.ndarray]:
    """-> centre and robust standard deviation (M, M) of the distances of markers (T, M, 3), metres; infinite where hardly seen.

    Those of the shortest interval that holds `most` of the frames, so that it does not matter how far off the others are.
    """
    frames, count = markers.shape[:2]
    centre, spread = np.full((count, count), np.inf), np.full((count, count), np.inf)
    some = markers[np.unique(np.linspace(0, frames - 1, LEARNING).astype(int))] if frames else markers
    for i in range(1, count):
        distance = np.sort(np.linalg.norm(some[:, i, None] - some[:, :i], axis=-1), axis=0)  # NaN comes last
        seen = (~np.isnan(distance)).sum(0)
        for j in np.flatnonzero(seen >= max(2, min(FEWEST, len(some)))):
            held = int(np.ceil(most * seen[j]))
            width = distance[held - 1 : seen[j], j] - distance[: seen[j] - held + 1, j]
            start = int(np.argmin(width))
            centre[i, j] = centre[j, i] = distance[start, j] + width[start] / 2
            spread[i, j] = spread[j, i] = width[start] / 2 / ndtri((1 + most) / 2)  # as of a normal distribution
    return centre, spread


@njit(cache=True)
def contradiction(markers, known, frame, label, marker, left_out, chance):
    """-> 0..1: how badly the sample under `label` fits as the `marker`, on its partners' weighted average.

    `known` are the Distances. Partners that are `left_out` (M,) have no vote. Those not seen vote `chance`: 1 where labels are
    compared, for a marker that may be anywhere explains what is seen no better than chance does.
    """
    against, votes = 0.0, 0.0
    for k in range(known.partner.shape[1]):
        p = known.partner[marker, k]
        if p < 0 or left_out[p] or p == label:
            continue
        square = 0.0
        for x in range(3):
            square += (markers[frame, label, x] - markers[frame, p, x]) ** 2
        weight = 1 / known.tolerance[marker, k] ** 2
        votes += weight
        off = (np.sqrt(square) - known.length[marker, k]) / known.tolerance[marker, k]
        against += weight * (chance if np.isnan(square) else min(1.0, off * off))
    return against / votes if votes else chance


@njit(cache=True)
def own_contradictions(markers, known, chance):
    """-> (T, M) 0..1: how badly each sample fits under its own label."""
    frames, count = markers.shape[:2]
    nobody = np.zeros(count, np.bool_)
    own = np.empty((frames, count))
    for t in range(frames):
        for m in range(count):
            own[t, m] = contradiction(markers, known, t, m, m, nobody, chance)
    return own
