"""Computed: samples that no camera saw, by the file's own account; another program put them there.

They are no evidence. Whether they are as good as what the others tell is found out when these are asked.
"""

import numpy as np

from mocapfix.faults import Fault
from mocapfix.take import Take, runs


def found(take: Take) -> list[Fault]:
    """-> every stretch without cameras that this program did not put there, by marker and first frame; severity is the way that
    the marker goes from its first sample to its last, in metres."""
    if take.blind is None:
        return []
    blind, faults = take.blind & take.measured, []
    for m, label in enumerate(take.bare_labels):
        for first, last in runs(blind[:, m]):
            way = float(np.linalg.norm(take.markers[last, m] - take.markers[first, m]))
            seconds = f"{(last - first + 1) / take.rate:.2f} s"
            reason = f"No camera saw {label} for {seconds}, by the file itself: another program put these samples there."
            faults.append(Fault("computed", m, first, last, way, reason))
    return faults
