"""Gaps: the stretches in which a marker is not seen.

A gap of a frame or two is a flicker: a moment's doubt of the cameras or of whoever labelled, of which nobody wants to hear
one by one. Each says how many there are of its marker, so that one can speak for all.
"""

import numpy as np

from mocapfix.faults import Fault, Kind
from mocapfix.take import Take, runs

FLICKER = 0.02  # seconds: how long a flicker lasts at most, but for one frame, which is always one


def found(take: Take) -> list[Fault]:
    """-> every gap, flicker, leading and trailing gap, and every marker that is absent throughout, by marker and first frame."""
    missing = ~take.seen
    return [fault for m in range(len(take.labels)) for fault in _of(take, m, runs(missing[:, m]))]


def _of(take: Take, marker: int, gaps: list[tuple[int, int]]) -> list[Fault]:
    """-> the faults that the gaps of one marker are."""
    kinds: list[Kind] = [_kind(take, first, last) for first, last in gaps]
    label, flickers = take.bare_labels[marker], kinds.count("flicker")
    faults = []
    for kind, (first, last) in zip(kinds, gaps, strict=True):
        moved = _moved(take, marker, first, last)
        reason = f"{label} {_reason(kind, last - first + 1, take.rate, moved, flickers)}"
        faults.append(Fault(kind, marker, first, last, moved, reason))
    return faults


def _kind(take: Take, first: int, last: int) -> Kind:
    match first == 0, last == take.frames - 1:
        case True, True:
            return "absent"
        case True, False:
            return "leading gap"
        case False, True:
            return "trailing gap"
        case _:
            return "flicker" if last - first + 1 <= max(1, FLICKER * take.rate) else "gap"


def _moved(take: Take, marker: int, first: int, last: int) -> float:
    """-> metres from the sample before a gap to the one after it, NaN where the take begins or ends in it."""
    if first == 0 or last == take.frames - 1:
        return float("nan")
    return float(np.linalg.norm(take.markers[last + 1, marker] - take.markers[first - 1, marker]))


def _reason(kind: Kind, frames: int, rate: float, moved: float, flickers: int) -> str:
    seconds = frames / rate
    match kind:
        case "absent":
            return "is never seen in this take."
        case "leading gap":
            return f"is not seen for the take's first {seconds:.2f} s."
        case "trailing gap":
            return f"is not seen for the take's last {seconds:.2f} s."
        case "flicker":
            often = f"one of its {flickers} flickers" if flickers > 1 else "its only flicker"
            return f"is not seen for {frames} frame{'s' * (frames > 1)} and moves {moved * 1e3:.0f} mm meanwhile, {often}."
        case _:
            return f"is not seen for {seconds:.2f} s and moves {moved * 1e3:.0f} mm meanwhile."
