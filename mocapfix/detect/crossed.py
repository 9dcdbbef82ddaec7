"""Crossed: labels that lie where the solved body has one another's markers.

What is astray under a label and lies well where the body has another marker, which is not seen there itself meanwhile, is
that marker. Where two labels, or three in a ring, are each other's they are exchanged, and so they are from leap to leap, for
a label that goes on smoothly has not changed its marker, even where the exchange led the body astray and others with it.
"""

from typing import NamedTuple

import numpy as np

from mocapfix.detect import continuity
from mocapfix.detect.astray import Piece
from mocapfix.detect.exchanges import SMOOTH
from mocapfix.detect.off_body import OffBody
from mocapfix.faults import Fault
from mocapfix.take import Take

FITS = 4.5  # standard deviations: so near to its place is a marker at home
BETTER = 0.4  # of its distance from its own marker's place: so near to another's it is that one, if that one is elsewhere
AT_HOME = 0.2  # of the time in which the other is seen at home at most, if it is elsewhere
TOGETHER = 0.5  # of the longer: for so long are two pieces astray together that are each other's
SHORTEST = 0.1  # seconds: what lies for less in the place of a marker that is not seen may do so by chance


class Carried(NamedTuple):
    """A piece that lies where the body has another marker, in standard deviations."""

    piece: Piece
    marker: int
    fit: float


def rings(off: OffBody, astray: list[Piece], take: Take) -> list[Fault]:
    """-> the exchanges of labels that explain what is `astray`, the surest first; none meets another."""
    at_home = off.distance < FITS * off.sd
    smooth = continuity.own_leaps(continuity.of(take.markers, take.rate)) < SMOOTH
    carried = [each for piece in astray for each in _others(off, at_home, piece)]
    found: list[Fault] = []
    for ring in sorted(_closed(carried, take), key=lambda ring: max(each.fit / each.piece.score for each in ring)):
        swap = _swap(ring, smooth, take)
        if not any(swap.meets(other) for other in found):
            found.append(swap)
    return found


def _others(off: OffBody, at_home: np.ndarray, piece: Piece) -> list[Carried]:
    """-> the markers whose places the samples of a piece fit, while they are not seen there themselves."""
    t = piece.frames
    away = np.linalg.norm(off.measured[t, piece.marker, None] - off.usual[t], axis=-1) / off.sd[t]
    fit = np.median(away, axis=0)
    fitting = (fit < BETTER * piece.score) & (at_home[t].mean(0) < AT_HOME)
    return [Carried(piece, int(k), float(fit[k])) for k in np.flatnonzero(fitting)]


def _closed(carried: list[Carried], take: Take) -> list[tuple[Carried, ...]]:
    """-> the rings: each label carries the marker whose label the next piece bears, the last the first one's.

    A marker that is not seen meanwhile may have been anywhere, also under the label of what lies in its place.
    """
    closed = []
    for one in carried:
        t, other = one.piece.frames, one.marker
        if one.fit < FITS and len(t) >= SHORTEST * take.rate and take.seen[t, other].mean() < AT_HOME:
            closed.append((one,))
        for two in carried:
            if two.piece.marker != other or not _together(one.piece, two.piece):
                continue
            if two.marker == one.piece.marker:
                closed.append((one, two))
            ends = [each for each in carried if each.piece.marker == two.marker and each.marker == one.piece.marker]
            closed += [(one, two, three) for three in ends if _together(one.piece, three.piece)]
    return closed


def _together(one: Piece, other: Piece) -> bool:
    both = min(one.last, other.last) - max(one.first, other.first) + 1
    return both > TOGETHER * max(one.last - one.first + 1, other.last - other.first + 1)


def _swap(ring: tuple[Carried, ...], smooth: np.ndarray, take: Take) -> Fault:
    """-> the labels of a ring as exchanged, from leap to leap."""
    markers = [ring[0].marker, *(each.piece.marker for each in (ring[0], *ring[:0:-1]))][: max(2, len(ring))]
    within = max(each.piece.first for each in ring), min(each.piece.last for each in ring)
    first, last = _stretched(*within, take.seen[:, markers], smooth[:, markers])
    worst = max(ring, key=lambda each: each.fit / each.piece.score)
    labels, times = [take.bare_labels[m] for m in markers], worst.piece.score / worst.fit
    far = float(np.mean([each.piece.distance for each in ring]))
    time = f"for {(last - first + 1) / take.rate:.2f} s ({last - first + 1} frames)"
    where = f"they lie {far * 1e3:.0f} mm from where the body has them, and {times:.1f} times nearer to one another's places"
    names = f"{', '.join(labels[:-1])} and {labels[-1]}"
    reason = f"{names} have exchanged their labels {time}: {where}."
    return Fault("swap", markers[0], first, last, far, reason, 1 - 1 / times, tuple(markers[1:]))


def _stretched(first: int, last: int, seen: np.ndarray, smooth: np.ndarray) -> tuple[int, int]:
    """-> the frames around first..last over which none of the labels (T, N) leaps or comes out of a gap."""
    goes_on = seen[1:] & seen[:-1] & smooth[1:]
    backward = np.all(goes_on | ~seen[:-1], axis=1) & seen[:-1].any(1)
    forward = np.all(goes_on | ~seen[1:], axis=1) & seen[1:].any(1)
    while first > 0 and backward[first - 1]:
        first -= 1
    while last < len(seen) - 1 and forward[last]:
        last += 1
    return first, last
