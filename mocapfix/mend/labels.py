"""Exchanged labels, put right."""

from collections.abc import Iterable

from mocapfix.faults import LABELS, SURE, Fault
from mocapfix.mend.fragments import fragments
from mocapfix.take import Take


def labels(take: Take, faults: Iterable[Fault]) -> Take:
    """-> the take with every exchange of labels that is sure put right, in the order given; other faults are no matter."""
    for fault in faults:
        if fault.kind in LABELS and fault.confidence >= SURE:
            take = take.exchanged(fault.markers, fault.first, fault.last)
    return take


def relabelled(take: Take, faults: Iterable[Fault]) -> Take:
    """-> the take with exchanges put right and fragments joined, one after the other in the order given."""
    for fault in faults:
        take = labels(fragments(take, [fault]), [fault])
    return take
