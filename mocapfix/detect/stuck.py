"""Stuck: a marker held at one value while its neighbours move on, as other tools fill gaps.

Held means to the last digit of a 32-bit float. In a file of coarse integers a body at rest holds its markers, too; but then
the markers that keep their distance to it rest with it, to a few of these integers.
"""

import numpy as np

from mocapfix.detect.exactness import float_digit, last_digit, stretches
from mocapfix.detect.neighbours import looseness
from mocapfix.faults import Fault
from mocapfix.take import Take

ASKED = 3  # of the neighbours seen meanwhile, those that keep their distance to the marker best
FEWEST = 4  # samples
REST = 50.0  # times the last digit of what the file shows: what the neighbours of a marker at rest may go


def found(take: Take, shortest: float = 0.1, smallest: float = 0.002) -> list[Fault]:
    """-> every stretch of `shortest` seconds or longer in which a marker is held while its neighbours go `smallest` metres or
    farther, by marker and first frame."""
    digit, length = float_digit(take.markers), max(FEWEST, round(shortest * take.rate))
    held = [(m, *s) for m in range(len(take.labels)) for s in stretches(take.markers[:, m], 0, length, digit)]
    if not held:
        return []
    smallest = max(smallest, REST * last_digit(take.markers))
    near = np.argsort(looseness(take.markers, take.rate), axis=1)[:, :-1]
    faults = []
    for marker, first, last in held:
        gone = _gone(take.markers[first : last + 1, near[marker]])
        if len(gone) and gone.min() >= smallest:
            faults.append(_fault(take, marker, first, last, gone, smallest))
    return faults


def _gone(markers: np.ndarray) -> np.ndarray:
    """-> metres: how far the first few of `markers` (T, M, 3) that are seen at least half the time go from where they began."""
    near = markers[:, (~np.isnan(markers[..., 0])).mean(0) >= 0.5][:, :ASKED]
    began = near[(~np.isnan(near[..., 0])).argmax(0), np.arange(near.shape[1])]
    return np.nanmax(np.linalg.norm(near - began, axis=-1), axis=0)


def _fault(take: Take, marker: int, first: int, last: int, gone: np.ndarray, smallest: float) -> Fault:
    first += int(first > 0 and take.seen[first - 1, marker])  # the value that is held was measured
    severity, seconds = float(np.median(gone)), (last - first + 1) / take.rate
    meanwhile = f"while the markers about it go {severity * 1e3:.0f} mm"
    reason = f"{take.bare_labels[marker]} is held at one value for {seconds:.2f} s {meanwhile}."
    return Fault("stuck", marker, first, last, severity, reason, 1 - smallest / (smallest + float(gone.min())))
