"""Gaps: the stretches in which a marker is not seen."""

import numpy as np

from mocapfix.faults import Fault
from mocapfix.take import Take, runs


def found(take: Take) -> list[Fault]:
    """-> every gap, leading gap and trailing gap, and every marker that is absent throughout, by marker and first frame."""
    return [_gap(take, m, first, last) for m in range(len(take.labels)) for first, last in runs(~take.seen[:, m])]


def _gap(take: Take, marker: int, first: int, last: int) -> Fault:
    label, seconds = take.bare_labels[marker], (last - first + 1) / take.rate
    leads, trails = first == 0, last == take.frames - 1
    if leads and trails:
        return Fault("absent", marker, first, last, np.nan, f"{label} is never seen in this take.")
    if leads:
        return Fault("leading gap", marker, first, last, np.nan, f"{label} is not seen for the take's first {seconds:.2f} s.")
    if trails:
        return Fault("trailing gap", marker, first, last, np.nan, f"{label} is not seen for the take's last {seconds:.2f} s.")
    moved = float(np.linalg.norm(take.markers[last + 1, marker] - take.markers[first - 1, marker]))
    return Fault("gap", marker, first, last, moved, f"{label} is not seen for {seconds:.2f} s and moves {moved * 1e3:.0f} mm meanwhile.")
