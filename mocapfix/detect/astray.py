"""Astray: samples that lie where the solved body cannot have their marker.

A marker's path on its segment is cut where it leaps, in sight or within a gap, and a piece between two cuts is judged as
a whole: it is astray where it lies far from the marker's usual place, beside how far it may; and by less where the marker
leaps there and back in sight, for the body leans towards a marker for as long as that is elsewhere. What comes there slowly
is no piece of its own: that is skin, or a marker badly calibrated, and no fault of the samples. What leaps once and then
keeps its place on the segment is a marker that was moved.

The body leans towards what is astray, so that sound samples around look wrong, too: only the worst of what is astray at one
time is believed, and then the body is asked again.
"""

from dataclasses import dataclass

import numpy as np

from mocapfix.detect.off_body import OffBody
from mocapfix.faults import Fault, Moved
from mocapfix.take import Take

STEP, DRIFT, SETTLED = 0.010, 0.4, 0.04  # metres, m/s, and the seconds after which skin carries a marker no farther
SLACK, BEND = 0.010, 100.0  # metres and m/s2: what a marker on a body misses a straight course by, and in its time squared
SURE = 6.0  # standard deviations
LEANS = 2.5  # standard deviations: for what leaps there and back
MOST = 0.4  # of a marker's samples: where more are astray nobody knows where the marker sits
BROKEN = 0.4  # of the markers seen: where more are far off the body is astray, and none of them can be judged
WORST = 0.5  # of the worst: what is astray by less at the same time may be so for the worst's sake
STAYS, STEADY = 1.0, 2.5  # seconds, and standard deviations: for how long and how well a moved marker keeps its place


@dataclass(frozen=True)
class Piece:
    """What one marker's label drew on its segment without a leap.

    frames    (N,) indices into the take
    distance  metres from the marker's usual place, the median, or by which it leaps there and back
    score     the distance in standard deviations, the median
    stays     does it keep its place to the marker's last frame, or from the first?
    """

    marker: int
    frames: np.ndarray
    distance: float
    score: float
    stays: bool = False

    @property
    def first(self) -> int:
        return int(self.frames[0])

    @property
    def last(self) -> int:
        return int(self.frames[-1])


def pieces(off: OffBody, rate: float, smallest: float) -> list[Piece]:
    """-> the pieces that are astray by at least `smallest` metres, by marker and first frame."""
    distance = off.distance
    seen, wrong = ~np.isnan(distance), distance > SURE * off.sd
    told = seen & (wrong.sum(1) <= BROKEN * seen.sum(1))[:, None]
    leaps, found = _leaps(off.measured, rate), []
    for k in range(distance.shape[1]):
        frames = np.flatnonzero(told[:, k])
        cut = _unbroken(off, k, frames, leaps[:, k], rate)
        astray = [each for piece in cut if (each := _judged(off, k, piece, frames, leaps[:, k], rate, smallest))]
        if sum(len(piece.frames) for piece in astray) < MOST * len(frames):
            found += astray
    return found


def worst(astray: list[Piece]) -> list[Piece]:
    """-> those that are not there for another's sake, which is astray at the same time and by much more."""
    chosen: list[Piece] = []
    for piece in sorted(astray, key=lambda each: -each.score):
        if not any(piece.score < WORST * other.score and meet(piece, other) for other in chosen):
            chosen.append(piece)
    return chosen


def meet(one: Piece | Fault, other: Piece | Fault) -> bool:
    """Are the two at one time?"""
    return one.first <= other.last and other.first <= one.last


def fault(piece: Piece, take: Take, longest_spike: float) -> Fault:
    """-> a piece that is astray as a marker that was moved, a ghost, or, up to `longest_spike` seconds, a spike."""
    label, count = take.bare_labels[piece.marker], piece.last - piece.first + 1
    sure = piece.score / SURE
    confidence = sure / (1 + sure)
    if piece.stays:
        first = piece.first if piece.first > 0 and not take.seen[piece.last + 1 :, piece.marker].any() else piece.last + 1
        reason = (
            f"{label} is knocked by {piece.distance * 1e3:.0f} mm and stays there: so far from it the body had it on its segment."
        )
        return Moved("moved", piece.marker, first, take.frames - 1, piece.distance, reason, confidence, settled=first)
    where = f"{label} lies {piece.distance * 1e3:.0f} mm from where the body has it, {piece.score:.0f} standard deviations"
    reason = f"{where}, for {count / take.rate:.2f} s ({count} frame{'s' if count > 1 else ''})."
    kind = "spike" if count <= longest_spike * take.rate else "ghost"
    return Fault(kind, piece.marker, piece.first, piece.last, piece.distance, reason, confidence)


def _judged(
    off: OffBody, marker: int, piece: np.ndarray, frames: np.ndarray, leaps: np.ndarray, rate: float, smallest: float
) -> Piece | None:
    """-> the samples `piece` (N,) of all that are told, `frames`, if they are astray."""
    path, sd = off.path[:, marker], off.sd[piece, marker]
    distance = np.linalg.norm(path[piece], axis=1)
    far, score = float(np.median(distance)), float(np.median(distance / sd))
    excursion = _excursion(path, leaps, int(piece[0]), int(piece[-1]) + 1)
    if not (far > smallest and score > SURE) and not (excursion > smallest and score > LEANS):
        return None
    sway = float(np.median(np.linalg.norm(path[piece] - np.median(path[piece], axis=0), axis=1) / sd))
    at_end = piece[0] == frames[0] or piece[-1] == frames[-1]
    stays = bool(at_end and len(piece) >= STAYS * rate and sway < STEADY)
    return Piece(marker, piece, max(far, excursion), score, stays)


def _unbroken(off: OffBody, marker: int, frames: np.ndarray, leaps: np.ndarray, rate: float) -> list[np.ndarray]:
    """-> the `frames` (N,) at which a marker is seen, cut where its path on the segment leaps.

    In sight the marker itself must leap there, too (T,): else it is the body that does.
    """
    if not len(frames):
        return []
    step = np.linalg.norm(np.diff(off.path[frames, marker], axis=0), axis=1)
    far = step > STEP + DRIFT * np.minimum(np.diff(frames) / rate, SETTLED)
    return np.split(frames, np.flatnonzero(far & (leaps[frames[1:]] | (np.diff(frames) > 1))) + 1)


def _leaps(markers: np.ndarray, rate: float) -> np.ndarray:
    """-> (T, K) bool: is the step from the frame before unlike the step before it, the one after it and the mean of both?

    markers  (T, K, 3) metres; where neither is known it may be
    """
    step = np.full((len(markers) + 2, *markers.shape[1:]), np.nan)
    step[1 : len(markers)] = np.diff(markers, axis=0)
    before, own, after = step[:-2], step[1:-1], step[2:]
    miss = [np.linalg.norm(own - other, axis=-1) for other in (before, after, (before + after) / 2)]
    leaps = ~(np.fmin.reduce(miss) < SLACK + BEND / rate**2)
    return np.concatenate([np.ones_like(leaps[:1]), leaps[:-1]])


def _excursion(path: np.ndarray, leaps: np.ndarray, first: int, stop: int) -> float:
    """-> metres by which a marker leaps in `first` and back in `stop`, the lesser; 0 where it does not, or not in sight."""
    if first == 0 or stop == len(path) or not (leaps[first] and leaps[stop]):
        return 0.0
    into, back = path[first] - path[first - 1], path[stop] - path[stop - 1]
    return float(np.nan_to_num(min(np.linalg.norm(into), np.linalg.norm(back))))
