"""Which changes are worth a picture: of every kind the worst, and then the worst of all."""

import numpy as np

from mocapfix.changes import Change
from mocapfix.faults import MISSING, Fault
from mocapfix.show.cleaning import Cleaning

PICTURES = 12
TRAVELLED = (*MISSING, "segment lost", "computed")  # whose severity is how far the marker went, not how far off it was


def worst(cleaning: Cleaning) -> list[tuple[Change, Fault]]:
    """-> at most PICTURES changes that were made, the worst first, the worst of each kind among them."""
    ordered = sorted(cleaning.made, key=lambda pair: -_weight(*pair, cleaning.before.rate))
    of_kind: dict[str, int] = {}
    for n, (change, _) in enumerate(ordered):
        of_kind.setdefault(change.kind, n)
    others = (n for n in range(len(ordered)) if n not in of_kind.values())
    return [ordered[n] for n in sorted([*of_kind.values(), *others][:PICTURES])]


def _weight(change: Change, fault: Fault, rate: float) -> float:
    """-> metre-seconds (a radian is as a metre): for how long it lasts, how far off the samples were, how unsure they are now."""
    off = 0.0 if fault.kind in TRAVELLED or np.isnan(fault.severity) else fault.severity
    unsure = (change.predicted_mm or 0.0) / 1e3
    return (fault.last - fault.first + 1) / rate * (off + unsure)
