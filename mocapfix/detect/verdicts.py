"""What a piece of a trajectory is held to be, and why, in a sentence for a technician."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Literal

import numpy as np

from mocapfix.detect.courses import AGREES, smoother
from mocapfix.detect.pieces import Piece
from mocapfix.faults import Fragment
from mocapfix.take import Take

STILL = 0.005  # metres: what does not move at all moves no more
RIDES = 0.015  # metres: by which the distances of what rides on the body to its nearest markers vary
LONG = 0.25  # seconds: what is seen for less shows too little of how it moves

Relation = Literal["continues", "replaces", "doubles", "other"]


@dataclass(frozen=True)
class Match:
    """How a piece would do as a marker: at what cost (infinite: not at all), how far its distances to the `partners`, by whom
    that is told, are off in metres; without partners its course alone tells.
    """

    marker: int
    cost: float
    off: float
    partners: tuple[int, ...]


def continues(piece: Piece, weighed: Sequence[Match], odds: float, take: Take) -> Fragment:
    """-> a piece that goes on as the marker it matches best."""
    match, why = weighed[0], "it begins or ends where that ends or begins"
    if match.partners:
        why = f"its distances to {_names(match.partners, take)} stay within {_mm(match.off)} of that marker's"
    reason = f"{_donor(piece, take)} goes on as {take.bare_labels[match.marker]} for {_long(piece, take)}: {why}."
    return _fragment("continues", piece, match.marker, match.off, odds, reason)


def other(piece: Piece, weighed: Sequence[Match], odds: float, take: Take) -> Fragment:
    """-> a piece that is none of the markers that are missing meanwhile, or not surely one."""
    labels, confidence = take.bare_labels, 1 - odds
    likely = [match for match in weighed if np.isfinite(match.cost)]
    known = [match for match in weighed if match.partners]
    if len(likely) > 1:
        why = f"{labels[likely[0].marker]} and {labels[likely[1].marker]} are missing meanwhile, and it may be either"
    elif likely:
        why = f"{labels[likely[0].marker]} is missing meanwhile, but that it is this one is not sure"
    elif known:
        best = min(known, key=lambda match: match.off)
        off = f"{_mm(best.off)} off that marker's distances to {_names(best.partners, take)}"
        why = f"the likeliest of those missing meanwhile is {labels[best.marker]}, and it is {off}"
    elif weighed:
        why, confidence = f"while {labels[weighed[0].marker]} is missing nothing tells where that is", 0.5
    elif piece.namesake >= 0:
        why = f"{labels[piece.namesake]} is seen meanwhile, elsewhere"
    else:
        why = f"none is missing meanwhile; {_nature(piece, take)}"
    reason = f"{_donor(piece, take)} continues no marker in its {_long(piece, take)}: {why}."
    return _fragment("other", piece, piece.donor, np.nan, confidence, reason)


def double(piece: Piece, marker: int, off: float, take: Take) -> Fragment:
    """-> a piece that lies, by the median, `off` metres beside a marker that is seen as well."""
    reason = f"{_donor(piece, take)} is {take.bare_labels[marker]} a second time for {_long(piece, take)}, {_mm(off)} beside it"
    better = smoother(piece, take.markers[:, marker], take.rate)
    relation, end = ("replaces", ", and leads on more smoothly before and after.") if better else ("doubles", ".")
    return _fragment(relation, piece, marker, off, 1 - 0.5 * off / AGREES, reason + end)


def short(piece: Piece, take: Take) -> Fragment:
    """-> a piece that shows too little."""
    reason = f"{_donor(piece, take)} is seen for {_long(piece, take)}, too short to tell of what."
    return _fragment("other", piece, piece.donor, np.nan, 0.5, reason)


def summed_up(fragments: Sequence[Fragment]) -> list[Fragment]:
    """-> the fragments, those of one donor in a row that are none of the markers as one, by the longest one's reason."""
    told = []
    for (relation, _), group in groupby(fragments, key=lambda fragment: (fragment.relation, fragment.donor)):
        each = list(group)
        if relation == "other" and len(each) > 1:
            longest = max(each, key=lambda fragment: fragment.last - fragment.first)
            reason = f"{longest.reason[:-1]}; so with its {len(each)} pieces in a row."
            each = [replace(longest, first=each[0].first, last=each[-1].last, reason=reason)]
        told += each
    return told


def _nature(piece: Piece, take: Take) -> str:
    """-> what kind of thing a piece shows, from how it moves."""
    if (len(piece.frames) - 1) / take.rate < LONG:
        return "it is seen for too short to tell how it moves"
    if np.ptp(piece.points, axis=0).max() < STILL:
        return "it stands still"
    spread = np.std(np.linalg.norm(take.markers[piece.frames] - piece.points[:, None], axis=-1), axis=0)
    near = [m for m in np.argsort(spread).tolist() if m != piece.donor][:3]  # NaN, of a marker not seen throughout, comes last
    if len(near) == 3 and spread[near[-1]] < RIDES:
        return f"it rides on the body with {_names(near, take)}"
    return "it moves by itself"


def _fragment(relation: Relation, piece: Piece, marker: int, severity: float, confidence: float, reason: str) -> Fragment:
    first, last = int(piece.frames[0]), int(piece.frames[-1])
    return Fragment("fragment", marker, first, last, severity, reason, confidence, donor=piece.donor, relation=relation)


def _donor(piece: Piece, take: Take) -> str:
    if piece.donor < len(take.labels):
        return take.bare_labels[piece.donor]
    return take.unlabelled.bare_labels[piece.donor - len(take.labels)] if take.unlabelled else ""


def _names(markers: Sequence[int], take: Take) -> str:
    *first, last = [take.bare_labels[m] for m in markers]
    return f"{', '.join(first)} and {last}"


def _mm(metres: float) -> str:
    return f"{metres * 1e3:.0f} mm"


def _long(piece: Piece, take: Take) -> str:
    count = int(piece.frames[-1] - piece.frames[0]) + 1
    if count >= 0.1 * take.rate:
        return f"{count / take.rate:.2f} s"
    return f"{count} frame{'s' if count > 1 else ''}"
