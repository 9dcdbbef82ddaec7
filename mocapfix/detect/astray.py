"""Astray: samples that lie where the solved body cannot have their marker.

A marker's path on its segment is cut where it leaps, in sight or within a gap. A piece between two cuts is judged as a
whole: it is astray where it lies far from the marker's usual place, beside how far it may; and by less where the marker
leaps there and back in sight, for the body leans towards a single marker for as long as that is elsewhere. What comes there slowly is no piece of its own: that is skin, or a marker badly calibrated, and no fault of the
samples. The body leans towards what is astray, so that sound samples around look wrong, too: only the worst of what is
astray at one time is believed, and then the body is asked again.
"""

from dataclasses import dataclass

import numpy as np

from mocapfix.detect.off_body import OffBody
from mocapfix.faults import Fault
from mocapfix.take import Take

STEP, DRIFT, SETTLED = 0.010, 0.4, 0.04  # metres, m/s, and the seconds after which skin carries a marker no farther
SURE = 6.0  # standard deviations
SLACK, BEND = 0.010, 100.0  # metres and m/s2: what a marker on a body misses a straight course by, and in its time squared
LEANS = 2.5  # standard deviations: for what leaps there and back, for the body leans towards it
MOST = 0.4  # of a marker's samples: what is astray for longer is where the marker sits
BROKEN = 0.4  # of the markers seen: where more are far off, the body is astray and none of them can be judged
WORST = 0.5  # of the worst: what is astray by less at the same time may be so for the worst's sake


@dataclass(frozen=True)
class Piece:
    """What one marker's label drew on its segment without a leap.

    frames    (N,) indices into the take
    distance  metres from the marker's usual place, the median, or by which it leaps there and back
    score     in standard deviations, the median
    """

    marker: int
    frames: np.ndarray
    distance: float
    score: float

    @property
    def first(self) -> int:
        return int(self.frames[0])

    @property
    def last(self) -> int:
        return int(self.frames[-1])


def pieces(off: OffBody, rate: float, smallest: float) -> list[Piece]:
    """-> the pieces that are astray by at least `smallest` metres."""
    found, distance = [], off.distance
    seen, astray = ~np.isnan(distance), distance > SURE * off.sd
    told = seen & (astray.sum(1) <= BROKEN * seen.sum(1))[:, None]
    leaps = _leaps(off.measured, rate)
    for k in range(distance.shape[1]):
        frames = np.flatnonzero(told[:, k])
        for piece in _unbroken(frames, off.path[:, k], leaps[:, k], rate):
            far = float(np.median(distance[piece, k]))
            score = float(np.median(distance[piece, k] / off.sd[piece, k]))
            excursion = _excursion(off.path[:, k], leaps[:, k], int(piece[0]), int(piece[-1]) + 1)
            sure = score > SURE and far > smallest or score > LEANS and excursion > smallest
            if sure and len(piece) < MOST * len(frames):
                found.append(Piece(k, piece, max(far, excursion), score))
    return found


def _leaps(markers: np.ndarray, rate: float) -> np.ndarray:
    """-> (T, K) bool: is the step from the frame before unlike the step before it, the one after it and the mean of both?

    markers  (T, K, 3) metres; what is not known is no reason to say that there is no leap
    """
    step = np.full((len(markers) + 2, *markers.shape[1:]), np.nan)
    step[1:-2] = np.diff(markers, axis=0)
    before, own, after = step[:-2], step[1:-1], step[2:]
    off = [np.linalg.norm(own - other, axis=-1) for other in (before, after, (before + after) / 2)]
    return np.roll(~(np.fmin.reduce(off) < SLACK + BEND / rate**2), 1, axis=0)


def _excursion(path: np.ndarray, leaps: np.ndarray, first: int, stop: int) -> float:
    """-> metres by which a marker leaps in `first` and back in `stop`, the lesser; 0 where it does not, or not in sight."""
    if first == 0 or stop == len(path) or not (leaps[first] and leaps[stop]):
        return 0.0
    into, back = path[first] - path[first - 1], path[stop] - path[stop - 1]
    return float(np.nan_to_num(min(np.linalg.norm(into), np.linalg.norm(back))))


def worst(astray: list[Piece]) -> list[Piece]:
    """-> those that are not there for another's sake, which is astray at the same time and by much more."""
    chosen: list[Piece] = []
    for piece in sorted(astray, key=lambda each: -each.score):
        if not any(piece.score < WORST * other.score and meet(piece, other) for other in chosen):
            chosen.append(piece)
    return chosen


def fault(piece: Piece, take: Take, longest_spike: float) -> Fault:
    """-> a piece that is astray as a ghost, or as a spike where it lasts no longer than `longest_spike` seconds."""
    label, count = take.bare_labels[piece.marker], piece.last - piece.first + 1
    where = f"{label} lies {piece.distance * 1e3:.0f} mm from where the body has it, {piece.score:.0f} standard deviations"
    reason = f"{where}, for {count / take.rate:.2f} s ({count} frame{'s' if count > 1 else ''})."
    kind = "spike" if count <= longest_spike * take.rate else "ghost"
    sure = piece.score / SURE
    return Fault(kind, piece.marker, piece.first, piece.last, piece.distance, reason, sure / (1 + sure))


def _unbroken(frames: np.ndarray, path: np.ndarray, leaps: np.ndarray, rate: float) -> list[np.ndarray]:
    """-> the `frames` (N,) at which a path (T, 3) on a segment is seen, cut where it leaps.

    In sight the marker itself must leap there, too (T,): else it is the body that does.
    """
    if not len(frames):
        return []
    lag, step = np.diff(frames) / rate, np.linalg.norm(np.diff(path[frames], axis=0), axis=1)
    hidden = np.diff(frames) > 1
    cuts = (step > STEP + DRIFT * np.minimum(lag, SETTLED)) & (leaps[frames[1:]] | hidden)
    return np.split(frames, np.flatnonzero(cuts) + 1)


def meet(one: Piece | Fault, other: Piece | Fault) -> bool:
    """Are the two at one time?"""
    return one.first <= other.last and other.first <= one.last
