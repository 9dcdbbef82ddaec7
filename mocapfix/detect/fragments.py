"""Fragments: trajectories that go on under another label (`*12`, `C_123`, `RBAC-1`).

A piece of such a trajectory continues the marker that is missing while it is seen and whose fingerprint it bears: the distances
to the markers of its segment, the side of them it lies on, and a course that leads on to it and from it. Each is measured in its
own standard deviations; their squares add up to a cost, and costs to odds (Bayes' rule), among the markers it could be and the
marker it is none of. The surest go first: what they fill is then no longer missing, and tells of the next.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from mocapfix.detect.fingerprints import Fingerprints
from mocapfix.detect.pieces import Piece, meet, onward, pieces
from mocapfix.take import Take

NONE = 12.0  # the cost at which a piece may as well be none of the markers
WORST = 3.5  # standard deviations in any one respect, from which on it is none
NAMED = 6.0  # what bearing the marker's name saves
UNKNOWN = 3.0  # cost of distances that nobody can tell
SURE = 0.9  # odds from which on a piece is joined
SHORTEST = 0.015  # seconds: a shorter piece tells nothing
AGREES = 0.010  # metres: the same marker twice lies no farther from itself
COURSE, SWERVE = 0.002, 2.5  # metres, m/s2: a course misses by one and, after t seconds, the other times t squared
REACH = 0.3  # seconds over which a course tells anything
LAST = 20  # samples of a course
ROUNDS = 8

Kind = Literal["continues", "replaces", "doubles", "other"]


@dataclass(frozen=True)
class Fragment:
    """What one piece of a trajectory is.

    kind        "continues" a marker that is missing then; "doubles" one that is seen as well; "replaces" one, being its
                double and the smoother of both; "other": none of the markers
    donor       index into the take's labels or, from their number on, into those of its unlabelled trajectories
    marker      index of the marker it belongs to; -1 for none
    first, last indices into the take, inclusive: the piece from its first to its last sample
    severity    metres: how far its distances to the marker's neighbours are from the usual, or it lies from its double; NaN
                where that is not known
    confidence  0..1
    reason      one sentence for a technician
    """

    kind: Kind
    donor: int
    marker: int
    first: int
    last: int
    severity: float
    confidence: float
    reason: str


@dataclass(frozen=True)
class Match:
    """How well a piece would do as a marker: the lower the cost the better; `off` metres, and the markers that tell."""

    marker: int
    cost: float
    off: float
    partners: tuple[int, ...]


def found(take: Take) -> list[Fragment]:
    """-> what each piece of the unlabelled and doubly labelled trajectories is, by donor and first frame.

    A take's `markers` are those of the file, `unlabelled` the trajectories that nobody named.
    """
    loose, markers = pieces(take), take.markers.copy()
    receivers = np.setdiff1d(np.flatnonzero(take.seen.any(0)), [piece.donor for piece in loose])
    known = {i: _short(piece, take) or _double(piece, take, receivers) for i, piece in enumerate(loose)}
    decided = {i: fragment for i, fragment in known.items() if fragment}
    for _ in range(ROUNDS):
        rest = [i for i in range(len(loose)) if i not in decided]
        if not rest:
            break
        prints = Fingerprints(markers)
        weighed = {i: matches(loose[i], markers, take.rate, prints, receivers) for i in rest}
        joined = _surest(weighed, loose, markers)
        decided |= {i: _continues(loose[i], match, sure, take) for i, (match, sure) in joined.items()}
        if not joined:
            decided |= {i: _other(loose[i], each, take) for i, each in weighed.items()}
    return [decided[i] for i in sorted(decided)]


def matches(piece: Piece, markers: np.ndarray, rate: float, prints: Fingerprints, receivers: np.ndarray) -> list[Match]:
    """-> how the piece would do as each marker (T, M, 3) that is missing meanwhile, the likeliest first."""
    missing = np.isnan(markers[np.ix_(piece.frames, receivers)][..., 0]).any(0)
    each = [_match(piece, m, markers[:, m], rate, prints) for m in receivers[missing].tolist()]
    return sorted(each, key=lambda match: (match.cost, match.off))


def _match(piece: Piece, marker: int, path: np.ndarray, rate: float, prints: Fingerprints) -> Match:
    course = _course(piece, path, rate)
    like = prints.likeness(piece.frames, piece.points, marker)
    if like is None:
        return Match(marker, UNKNOWN + course if np.isfinite(course) else np.inf, np.nan, ())
    if np.isinf(course) or max(like.distance, like.side) > WORST:
        return Match(marker, np.inf, like.off, like.partners)
    cost = like.distance**2 + like.side**2 + (1.0 if np.isnan(course) else course)
    return Match(marker, cost - NAMED * (piece.namesake == marker), like.off, like.partners)


def _course(piece: Piece, path: np.ndarray, rate: float) -> float:
    """-> the cost of going from the marker's path (T, 3) to the piece and back: mean square of the standard deviations, a
    bad end counting WORST; NaN where neither end is near, infinite where both are seen and apart.
    """
    seen = ~np.isnan(path[:, 0])
    both = seen[piece.frames]
    if both.any():
        apart = float(np.median(np.linalg.norm(piece.points[both] - path[piece.frames[both]], axis=1)))
        return (2 * apart / AGREES) ** 2 if apart <= AGREES else np.inf
    near, ends = np.flatnonzero(seen), []
    turn = np.searchsorted(near, piece.frames[0])
    early, late = near[max(0, turn - LAST) : turn], near[turn : turn + LAST]
    if len(early) and (piece.frames[0] - early[-1]) / rate <= REACH:
        ends.append(onward(early, path[early], piece.frames, piece.points, rate))
    if len(late) and (late[0] - piece.frames[-1]) / rate <= REACH:
        ends.append(onward(piece.frames, piece.points, late, path[late], rate))
    return float(np.mean([min(WORST, off / (COURSE + SWERVE * t**2)) ** 2 for off, t in ends])) if ends else np.nan


def _surest(weighed: dict[int, list[Match]], loose: list[Piece], markers: np.ndarray) -> dict[int, tuple[Match, float]]:
    """-> the pieces of which one marker is sure, and the odds; they are joined to the markers (T, M, 3) in place."""
    joined: dict[int, tuple[Match, float]] = {}
    for i in sorted((i for i, each in weighed.items() if each), key=lambda i: weighed[i][0].cost):
        match, piece = weighed[i][0], loose[i]
        free = np.isnan(markers[piece.frames, match.marker, 0])
        taken = any(j for j, (other, _) in joined.items() if other.marker == match.marker and meet(loose[j], piece))
        if (sure := odds(weighed[i])) >= SURE and not taken:
            joined[i] = match, sure
            markers[piece.frames[free], match.marker] = piece.points[free]
            if piece.donor < markers.shape[1]:
                markers[piece.frames, piece.donor] = np.nan
    return joined


def odds(weighed: list[Match]) -> float:
    """-> 0..1: that the piece is the first of the markers rather than another or none."""
    costs = np.array([match.cost for match in weighed] + [NONE])
    return float(1 / np.exp((costs[0] - costs) / 2).sum()) if np.isfinite(costs[0]) else 0.0


def _continues(piece: Piece, match: Match, sure: float, take: Take) -> Fragment:
    told = f"keeps its distances to {_names(match.partners, take)} within {match.off * 1e3:.0f} mm" if match.partners else (
        "goes on where that ends or begins"
    )
    reason = f"{_donor(piece, take)} goes on as {take.bare_labels[match.marker]} for {_long(piece, take)}: it {told}."
    return _fragment("continues", piece, match.marker, match.off, sure, reason)


def _other(piece: Piece, weighed: list[Match], take: Take) -> Fragment:
    name, labels = _donor(piece, take), take.bare_labels
    known = [match for match in weighed if match.partners]
    likely = [match for match in weighed if np.isfinite(match.cost)]
    if not weighed:
        why, sure = "no marker is missing meanwhile", 1.0
    elif len(likely) > 1 and likely[1].cost < NONE:
        why, sure = f"{labels[likely[0].marker]} and {labels[likely[1].marker]} are missing and it may be either", 1 - odds(weighed)
    elif likely:
        why, sure = f"it might be {labels[likely[0].marker]}, which is missing, but not surely", 1 - odds(weighed)
    elif known:
        best = min(known, key=lambda match: match.off)
        why = f"of those missing {labels[best.marker]} is the likeliest, and it is {best.off * 1e3:.0f} mm off that one's distances to {_names(best.partners, take)}"
        sure = 1.0
    else:
        why, sure = f"nothing tells its place on the body while {labels[weighed[0].marker]} is missing", 0.5
    return _fragment("other", piece, -1, np.nan, sure, f"{name} continues no marker for {_long(piece, take)}: {why}.")


def _short(piece: Piece, take: Take) -> Fragment | None:
    if (len(piece.frames) - 1) / take.rate >= SHORTEST:
        return None
    return _fragment("other", piece, -1, np.nan, 0.5, f"{_donor(piece, take)} is seen for {_long(piece, take)}, too short to tell of what.")


def _double(piece: Piece, take: Take, receivers: np.ndarray) -> Fragment | None:
    apart = np.linalg.norm(take.markers[np.ix_(piece.frames, receivers)] - piece.points[:, None], axis=-1)
    whole = np.flatnonzero(~np.isnan(apart).any(0))
    if not len(whole):
        return None
    each = np.median(apart[:, whole], axis=0)
    off, marker = float(each.min()), int(receivers[whole[each.argmin()]])
    if off > AGREES:
        return None
    reason = f"{_donor(piece, take)} is {take.bare_labels[marker]} a second time for {_long(piece, take)}, {off * 1e3:.0f} mm beside it."
    return _fragment("doubles", piece, marker, off, 1 - off / AGREES / 2, reason)


def _fragment(kind: Kind, piece: Piece, marker: int, severity: float, confidence: float, reason: str) -> Fragment:
    return Fragment(kind, piece.donor, marker, int(piece.frames[0]), int(piece.frames[-1]), severity, confidence, reason)


def _donor(piece: Piece, take: Take) -> str:
    of_file = [*take.bare_labels, *(take.unlabelled.bare_labels if take.unlabelled else ())]
    return of_file[piece.donor]


def _names(markers: tuple[int, ...], take: Take) -> str:
    *first, last = [take.bare_labels[m] for m in markers]
    return f"{', '.join(first)} and {last}"


def _long(piece: Piece, take: Take) -> str:
    count = int(piece.frames[-1] - piece.frames[0]) + 1
    return f"{count} frame{'s' if count > 1 else ''}" if count < 0.1 * take.rate else f"{count / take.rate:.2f} s"
