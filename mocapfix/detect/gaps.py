"""Gaps: the stretches in which a marker is not seen."""

import numpy as np

from mocapfix.faults import Fault
from mocapfix.take import Take, runs


def found(take: Take) -> list[Fault]:
    """-> every gap, leading gap and trailing gap, and every marker that is absent throughout, by marker and first frame."""
    labels, missing = take.bare_labels, ~take.seen
    return [_gap(take, label, m, first, last) for m, label in enumerate(labels) for first, last in runs(missing[:, m])]


def _gap(take: Take, label: str, marker: int, first: int, last: int) -> Fault:
    seconds, moved = (last - first + 1) / take.rate, np.nan
    match first == 0, last == take.frames - 1:
        case True, True:
            kind, reason = "absent", "is never seen in this take."
        case True, False:
            kind, reason = "leading gap", f"is not seen for the take's first {seconds:.2f} s."
        case False, True:
            kind, reason = "trailing gap", f"is not seen for the take's last {seconds:.2f} s."
        case _:
            moved = float(np.linalg.norm(take.markers[last + 1, marker] - take.markers[first - 1, marker]))
            kind, reason = "gap", f"is not seen for {seconds:.2f} s and moves {moved * 1e3:.0f} mm meanwhile."
    return Fault(kind, marker, first, last, moved, f"{label} {reason}")
