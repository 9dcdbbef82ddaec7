"""Ghosts: a label that leaps to a place where none of the markers is, and comes back or not.

A label is its own marker or elsewhere. The cheapest course through these two states pays for leaps and for broken distances while
it is the marker, and a flat rate while it is elsewhere (compare exchanges); a label that goes on smoothly changes
nothing. What lasts no longer than a spike is one. A place that moves with the segment and is not left again is no ghost,
for there the marker itself may have been moved. Swaps are to be undone first, or both labels look like ghosts.
"""

import numpy as np

from mocapfix.detect import continuity, distances
from mocapfix.detect.continuity import own_leaps
from mocapfix.detect.distances import Distances, own_contradictions
from mocapfix.detect.exchanges import NEVER, SMOOTH, TELLING, cheapest
from mocapfix.faults import Fault
from mocapfix.take import Take, runs

MOST = 0.8  # of the take in which a marker is where it should: more than for swaps, for a pose that is rare is no ghost
CHANGE = 0.5  # leaps: the price of going elsewhere, and of coming back
ELSEWHERE = 0.5  # contradiction by its partners that a label elsewhere pays for, whatever they say
LEAST_GAIN = 1.0  # leaps: what explains less is none
JUDGES = 3  # steadiest partners, the median of whose distances says how far off it is


def found(take: Take, smallest: float = 0.03, longest_spike: float = 0.05) -> list[Fault]:
    """-> the ghosts, by marker and first frame: off by at least `smallest` metres and longer than `longest_spike` seconds."""
    if take.frames < 2 or not take.labels:
        return []
    courses, known = continuity.of(take.markers, take.rate), distances.learnt(take.markers, MOST)
    leaps, off = own_leaps(courses), own_contradictions(courses.markers, known, ELSEWHERE)
    ghosts = []
    for m in range(len(take.labels)):
        seen = np.flatnonzero(take.seen[:, m])
        step, stay = _costs(leaps[seen, m], off[seen, m], np.diff(seen, prepend=-1) == 1, take.rate)
        course = cheapest(step, stay) if len(seen) else np.zeros(0, int)
        for a, b in runs(course == 1):
            frames = seen[a : b + 1]
            error, sway = _misplaced(take.markers[frames], known, m)
            stays = b == len(seen) - 1 or a == 0
            if len(frames) > longest_spike * take.rate and error > smallest and not (stays and sway < smallest / 3):
                t = np.arange(max(a, 1), min(b + 2, len(seen)))
                gain = float((step[t, 0, 0] - step[t, course[t - 1], course[t]]).sum() + (stay[a : b + 1] @ [1, -1]).sum())
                if gain > LEAST_GAIN:
                    ghosts.append(_ghost(take, m, int(frames[0]), int(frames[-1]), error, gain, stays))
    return ghosts


def _costs(leaps: np.ndarray, off: np.ndarray, follows: np.ndarray, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """-> step (N, 2, 2) and stay (N, 2), in leaps, for N samples that are seen, of which some follow the one before at once."""
    step = np.broadcast_to(leaps[:, None, None], (len(leaps), 2, 2)).copy()
    step[:, [0, 1], [1, 0]] = (CHANGE + NEVER * (follows & (leaps < SMOOTH)))[:, None]
    return step, np.stack([off, np.full(len(off), ELSEWHERE)], 1) / (TELLING * rate)


def _misplaced(markers: np.ndarray, known: Distances, marker: int) -> tuple[float, float]:
    """-> metres by which the distances to the steadiest partners are wrong, and by which they sway; NaN where none is seen."""
    judges = known.partner[marker, :JUDGES]
    judges = judges[judges >= 0]
    error = np.linalg.norm(markers[:, [marker]] - markers[:, judges], axis=-1) - known.length[marker, : len(judges)]
    error = error[:, ~np.isnan(error).any(0)]
    if not error.size:
        return float("nan"), float("nan")
    return float(np.median(np.abs(error).max(1))), float(error.std(0).max())


def _ghost(take: Take, marker: int, first: int, last: int, error: float, gain: float, stays: bool) -> Fault:
    label, frames = take.bare_labels[marker], last - first + 1
    where = f"{label} is {error * 1e3:.0f} mm off its segment for {frames / take.rate:.2f} s ({frames} frames)"
    reason = f"{where}, where no marker is{'' if stays else ', and comes back'}."
    return Fault("ghost", marker, first, last, error, reason, float(1 - np.exp(-gain)))
