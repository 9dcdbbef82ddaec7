"""The second look at a take, against the solved body: what its trajectories alone did not tell."""

import numpy as np

from mocapfix.detect import astray, crossed, off_body, shifted
from mocapfix.detect.astray import meet
from mocapfix.faults import Fault
from mocapfix.motion import Motion
from mocapfix.subject import Subject
from mocapfix.take import Take


def found(
    worn: Take,
    heard: np.ndarray,
    subject: Subject,
    motion: Motion,
    smallest: float = 0.02,
    longest_spike: float = 0.05,
) -> list[Fault]:
    """-> exchanged labels, ghosts, spikes and moves, by marker and first frame; what seems one because of a worse one waits.

    worn   the take's markers in the subject's order, NaN where not seen or not believed
    heard  (T, K) bool: the samples that the solve listened to
    smallest  metres: what lies off by less is none
    longest_spike  seconds: what lasts longer is a ghost
    """
    off = off_body.of(worn, heard, subject, motion)
    pieces = astray.pieces(off, worn.rate, smallest)
    swaps = crossed.rings(off, pieces, worn)
    lone = [piece for piece in astray.worst(pieces) if not any(meet(piece, swap) for swap in swaps)]
    ghosts = [astray.fault(piece, worn, longest_spike) for piece in lone]
    strays = swaps + ghosts
    moves = [
        shifted.fault(shift, worn)
        for shift in shifted.worst(shifted.shifts(off, subject, motion, worn.rate), subject)
        if not any(shifted.neighbours(subject, shift.marker, marker) for fault in strays for marker in fault.markers)
    ]
    return sorted(strays + moves, key=lambda fault: (fault.marker, fault.first))
