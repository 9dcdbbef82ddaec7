"""Crossed: labels that lie where the solved body has one another's markers.

What is astray under a label and lies well where the body has another marker, which is not seen there itself meanwhile, is
that marker. Where two labels, or three in a ring, are each other's they are exchanged.
"""

from typing import NamedTuple

import numpy as np

from mocapfix.detect.astray import Piece
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
    carried = [each for piece in astray for each in _others(off, at_home, piece)]
    found: list[Fault] = []
    for ring in sorted(_closed(carried, take), key=lambda ring: max(each.fit / each.piece.score for each in ring)):
        swap = _swap(ring, at_home, take)
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
            for three in carried:
                if three.piece.marker == two.marker and three.marker == one.piece.marker and _together(one.piece, three.piece):
                    closed.append((one, two, three))
    return closed


def _together(one: Piece, other: Piece) -> bool:
    both = min(one.last, other.last) - max(one.first, other.first) + 1
    return both > TOGETHER * max(one.last - one.first + 1, other.last - other.first + 1)


def _swap(ring: tuple[Carried, ...], at_home: np.ndarray, take: Take) -> Fault:
    """-> the labels of a ring as exchanged for as long as none of them is seen at home."""
    markers = [ring[0].marker, *(each.piece.marker for each in (ring[0], *ring[:0:-1]))][: max(2, len(ring))]
    home = at_home[:, markers].any(1)
    middle = max(each.piece.first for each in ring), min(each.piece.last for each in ring)
    first = min(each.piece.first for each in ring)
    last = max(each.piece.last for each in ring)
    first += max(np.flatnonzero(home[first : middle[0]]), default=-1) + 1
    last -= len(home[middle[1] + 1 : last + 1]) - min(np.flatnonzero(home[middle[1] + 1 : last + 1]), default=last - middle[1])
    worst = max(ring, key=lambda each: each.fit / each.piece.score)
    labels = [take.bare_labels[m] for m in markers]
    far = float(np.mean([each.piece.distance for each in ring]))
    where = f"they lie {far * 1e3:.0f} mm from where the body has them, and fit one another's places {worst.piece.score / worst.fit:.1f} times as well"
    time = f"for {(last - first + 1) / take.rate:.2f} s ({last - first + 1} frames)"
    reason = f"{' and '.join(labels)} have exchanged their labels {time}: {where}."
    return Fault("swap", markers[0], first, last, far, reason, 1 - worst.fit / worst.piece.score, tuple(markers[1:]))
