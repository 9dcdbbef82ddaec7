"""Fragments: trajectories that go on under another label (`*12`, `C_123`, `RBAC-1`).

A piece of such a trajectory continues the marker that is missing while it is seen and whose fingerprint it bears: the distances
to the markers of its segment, the side of them it lies on, and a course that leads on to it and from it. Each is measured in its
own standard deviations; their squares add up to a cost, and costs to odds (Bayes' rule), among the markers it could be and the
marker it is none of. The surest go first: what they fill is then no longer missing, and tells of the next.
"""

import numpy as np

from mocapfix.detect.courses import AGREES, course
from mocapfix.detect.fingerprints import Fingerprints
from mocapfix.detect.pieces import Piece, meet, pieces
from mocapfix.detect.verdicts import Match, continues, double, other, short, summed_up
from mocapfix.faults import Fragment
from mocapfix.take import Take

NONE = 20.0  # the cost at which a piece may as well be none of the markers
WORST = 4.5  # standard deviations from which on distances or side alone speak against a marker
NAMED = 0.5  # times the deviations from the marker whose name a piece bears
UNKNOWN = 3.0  # the cost of distances that nobody can tell
USUAL = 1.0  # that of a course that nobody can tell
SURE = 0.9  # odds from which on a piece is joined
SHORTEST = 0.015  # seconds: a shorter piece tells nothing
REACH, ALONE = 0.3, 0.05  # seconds over which a course tells anything, and over which it tells enough alone


def found(take: Take) -> list[Fragment]:
    """-> what the pieces of the take's unlabelled trajectories, and of markers named twice, are; by donor and first frame.

    A piece is joined where the odds are high that it is one marker and no other: a marker is given one piece at a time, and
    several one after the other. Every piece that is not joined is accounted for as well.
    """
    loose, markers = pieces(take), take.markers.copy()
    donors = {piece.donor for piece in loose if piece.donor < len(take.labels)}
    markers[:, list(donors)] = np.nan  # a piece must not speak for itself
    receivers = np.setdiff1d(np.flatnonzero(take.seen.any(0)), list(donors))
    told = [_at_once(piece, take, receivers) for piece in loose]
    while open_ := [i for i, fragment in enumerate(told) if fragment is None]:
        prints = Fingerprints(markers)
        weighed = {i: matches(loose[i], markers, take.rate, prints, receivers) for i in open_}
        joined = _joined(weighed, loose, markers)
        for i in joined or open_:
            decided = continues if joined else other
            told[i] = decided(loose[i], weighed[i], odds(weighed[i]), take)
    return summed_up([fragment for fragment in told if fragment])


def _at_once(piece: Piece, take: Take, receivers: np.ndarray) -> Fragment | None:
    """-> what a piece is, where that can be told from itself and the markers seen."""
    if (len(piece.frames) - 1) / take.rate < SHORTEST:
        return short(piece, take)
    seen = receivers[take.seen[np.ix_(piece.frames, receivers)].all(0)]
    apart = np.median(np.linalg.norm(take.markers[np.ix_(piece.frames, seen)] - piece.points[:, None], axis=-1), axis=0)
    if apart.min(initial=np.inf) > AGREES:
        return None
    return double(piece, int(seen[apart.argmin()]), float(apart.min()), take)


def matches(piece: Piece, markers: np.ndarray, rate: float, prints: Fingerprints, receivers: np.ndarray) -> list[Match]:
    """-> how the piece would do as each of the `receivers` that is missing meanwhile, the likeliest first; one that bears a
    marker's name is no other's.

    markers (T, M, 3) metres, NaN where missing; receivers (R,) indices of those that may be given a piece
    """
    if piece.namesake >= 0:
        receivers = np.array([piece.namesake])
    missing = np.isnan(markers[np.ix_(piece.frames, receivers)][..., 0]).any(0)
    each = [_match(piece, m, markers[:, m], rate, prints) for m in receivers[missing].tolist()]
    return sorted(each, key=lambda match: (match.cost, match.off))


def _match(piece: Piece, marker: int, path: np.ndarray, rate: float, prints: Fingerprints) -> Match:
    scale = NAMED if piece.namesake == marker else 1.0
    like = prints.likeness(piece.frames, piece.points, marker)
    along = scale**2 * course(piece, path, rate, REACH if like else ALONE)
    if like is None:
        return Match(marker, np.inf if np.isnan(along) else UNKNOWN + along, np.nan, ())
    distance, side = scale * like.distance, scale * like.side
    cost = distance**2 + side**2 + (USUAL if np.isnan(along) else along)
    return Match(marker, np.inf if max(distance, side) > WORST else cost, like.off, like.partners)


def odds(weighed: list[Match]) -> float:
    """-> 0..1: that the piece is the first of the markers, rather than another or none."""
    costs = np.array([match.cost for match in weighed] + [NONE])
    return float(1 / np.exp((costs[0] - costs) / 2).sum()) if weighed and np.isfinite(costs[0]) else 0.0


def _joined(weighed: dict[int, list[Match]], loose: list[Piece], markers: np.ndarray) -> list[int]:
    """-> the pieces that are surely a marker's, one at a time, the cheapest first; joined to markers (T, M, 3) in place."""
    sure = [i for i, each in weighed.items() if odds(each) >= SURE]
    joined: list[int] = []
    for i in sorted(sure, key=lambda i: weighed[i][0].cost):
        piece, marker = loose[i], weighed[i][0].marker
        if not any(weighed[j][0].marker == marker and meet(loose[j], piece) for j in joined):
            joined.append(i)
            free = np.isnan(markers[piece.frames, marker, 0])
            markers[piece.frames[free], marker] = piece.points[free]
    return joined
