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

# MERGED: mocapfix.detect.distances
MAX_DISTANCE_PARTNERS = 8  # of one marker, at most
MAX_PARTNER_SD_M = 0.03  # metres: a distance that varies by more tells little of which marker is which
MIN_DISTANCE_SD_M = 0.003  # metres: by which even a distance on one rigid segment varies
BROKEN_DISTANCE_SD = 3.0  # standard deviations from which on a distance is wholly broken
MAX_DISTANCE_FRAMES = 300  # frames at most, evenly spread, from which the distances are learnt
MIN_JOINT_FRAMES = 20  # of these in which both were seen; all of fewer
MIN_CORRECT_FRACTION = 0.55  # of these frames must be right, whatever the rest


class MarkerDistances(NamedTuple):
    """The distances that each of M markers keeps to its K steadiest partners.

    partner    (M, K) int, steadiest first; -1 where there are fewer
    length     (M, K) metres
    tolerance  (M, K) metres from which on a distance is broken
    """

    partner: np.ndarray
    length_m: np.ndarray
    tolerance_m: np.ndarray


def estimate_distances(markers: np.ndarray, min_correct_fraction: float = MIN_CORRECT_FRACTION) -> MarkerDistances:
    """-> the distances that markers (T, M, 3), in metres, NaN where not seen, keep over `most` (0..1) of the take."""
    count = markers.shape[1]
    middle, spread = estimate_distance_statistics(markers, min_correct_fraction)
    order = np.argsort(spread, axis=1, kind="stable")[:, :MAX_DISTANCE_PARTNERS]
    rows = np.arange(count)[:, None]
    steady = spread[rows, order] < MAX_PARTNER_SD_M
    tolerance = BROKEN_DISTANCE_SD * np.hypot(np.where(steady, spread[rows, order], 0), MIN_DISTANCE_SD_M)
    return MarkerDistances(np.where(steady, order, -1), np.where(steady, middle[rows, order], 0), tolerance)


def estimate_distance_statistics(markers: np.ndarray, min_correct_fraction: float) -> tuple[np.ndarray, np.ndarray]:
    """-> centre and robust standard deviation (M, M) of the distances of markers (T, M, 3), metres; infinite where hardly seen.

    Those of the shortest interval that holds `most` of the frames, so that it does not matter how far off the others are.
    """
    frames, count = markers.shape[:2]
    centre, spread = np.full((count, count), np.inf), np.full((count, count), np.inf)
    some = markers[np.unique(np.linspace(0, frames - 1, MAX_DISTANCE_FRAMES).astype(int))] if frames else markers
    for i in range(1, count):
        distance = np.sort(np.linalg.norm(some[:, i, None] - some[:, :i], axis=-1), axis=0)  # NaN comes last
        seen = (~np.isnan(distance)).sum(0)
        for j in np.flatnonzero(seen >= max(2, min(MIN_JOINT_FRAMES, len(some)))):
            held = int(np.ceil(min_correct_fraction * seen[j]))
            width = distance[held - 1 : seen[j], j] - distance[: seen[j] - held + 1, j]
            start = int(np.argmin(width))
            centre[i, j] = centre[j, i] = distance[start, j] + width[start] / 2
            spread[i, j] = spread[j, i] = width[start] / 2 / ndtri((1 + min_correct_fraction) / 2)  # as of a normal distribution
    return centre, spread


@njit(cache=True)
def compute_contradiction(markers, distances, frame, label, marker, is_excluded, unseen_vote):
    """-> 0..1: how badly the sample under `label` fits as the `marker`, on its partners' weighted average.

    `known` are the Distances. Partners that are `left_out` (M,) have no vote. Those not seen vote `chance`: 1 where labels are
    compared, for a marker that may be anywhere explains what is seen no better than chance does.
    """
    against, votes = 0.0, 0.0
    for k in range(distances.partner.shape[1]):
        p = distances.partner[marker, k]
        if p < 0 or is_excluded[p] or p == label:
            continue
        square = 0.0
        for x in range(3):
            square += (markers[frame, label, x] - markers[frame, p, x]) ** 2
        weight = 1 / distances.tolerance_m[marker, k] ** 2
        votes += weight
        off = (np.sqrt(square) - distances.length_m[marker, k]) / distances.tolerance_m[marker, k]
        against += weight * (unseen_vote if np.isnan(square) else min(1.0, off * off))
    return against / votes if votes else unseen_vote


@njit(cache=True)
def compute_own_contradictions(markers, distances, unseen_vote):
    """-> (T, M) 0..1: how badly each sample fits under its own label."""
    frames, count = markers.shape[:2]
    nobody = np.zeros(count, np.bool_)
    own = np.empty((frames, count))
    for t in range(frames):
        for m in range(count):
            own[t, m] = compute_contradiction(markers, distances, t, m, m, nobody, unseen_vote)
    return own


# MERGED: mocapfix.detect.neighbours
# Which markers keep their distance to which: those on one segment, learnt from the take itself.
#
# Two markers of one rigid thing keep their distance over the whole take (Ringer & Lasenby 2004, "A procedure for automatically
# estimating model parameters in optical motion capture"). Asked is by how much a distance changes within a second: that is deaf
# to a marker that moves on its segment once, and hears what joints and skin do.
MAX_FRAME_PAIRS = 300  # pairs of frames at most, evenly spread, from which distances are learnt
MIN_VISIBLE_FRAME_PAIRS = 20  # of these in which both markers must be seen
DISTANCE_CHANGE_INTERVAL_S = 1.0  # seconds; half of a take that is shorter than two
DISTANCE_CHANGE_QUANTILE = 0.84  # of the changes are smaller: a normal distribution's standard deviation, about


def estimate_distance_changes(markers: np.ndarray, rate: float) -> np.ndarray:
    """-> (M, M) metres: by how much the distance of two markers usually changes in a second; infinite where hardly known.

    Infinite, too, for a marker and itself.

    markers  (T, M, 3) metres, NaN where not believed; rate in Hz
    """
    frames, count = markers.shape[:2]
    loose = np.full((count, count), np.inf)
    lag = min(round(DISTANCE_CHANGE_INTERVAL_S * rate), frames // 2)
    starts = np.unique(np.linspace(0, frames - lag - 1, MAX_FRAME_PAIRS).astype(int)) if lag else np.zeros(0, int)
    before, after = markers[starts], markers[starts + lag]
    for i in range(1, count):
        was, is_now = (np.linalg.norm(some[:, :i] - some[:, i, None], axis=-1) for some in (before, after))
        change = np.sort(np.abs(is_now - was), axis=0)  # NaN comes last
        known = (~np.isnan(change)).sum(0)
        others = np.flatnonzero(known >= min(MIN_VISIBLE_FRAME_PAIRS, max(2, len(starts))))
        usual = np.rint(DISTANCE_CHANGE_QUANTILE * (known[others] - 1)).astype(int)
        loose[i, others] = loose[others, i] = change[usual, others]
    return loose
