"""Decisions: which of the changes to a take are made in the end, and which are taken back."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mocapfix.change_file import Decided
from mocapfix.changes import Change, concerned, made
from mocapfix.faults import LABELS, MISSING, OTHERS_FILLS, PLACES, Fault, Fragment
from mocapfix.looks import Looked
from mocapfix.mend import put_back
from mocapfix.take import Take

AGREES, NEAR = 3.0, 0.010  # standard deviations, metres: another program's fill that lies so near to the estimate stays as it is


def taken(
    before: Take,
    looked: Looked,
    whole: Take,
    body: np.ndarray | None,
    ways: np.ndarray,
    touch: np.ndarray,
    only: Sequence[str],
    decided: Sequence[Decided],
) -> tuple[Take, tuple[Change, ...]]:
    """-> the take with the changes that are to be made, and an entry for each, also for those that were decided against.

    before, looked, whole  the take as it was read, with its labels right, and with everything mended
    body     (T, M, 3) metres: where the solved body has the markers; None without one
    ways     (T, M) how each sample was found that was filled, "" for others
    touch    (T, M) bool: what may be touched; a change of labels all of whose samples may not is not made
    only     the kinds that are mended, a gap's for all that is missing; none: all
    """
    asked, refused, told = [], [], []
    for fault in looked.faults.items:
        wanted = _asked(fault, only) and _free(fault, touch) and not _agrees(fault, looked, whole)
        (asked if wanted else refused).append(fault)
    for change, fault in made(before, whole, asked, body, ways):
        decision = next((each.decision for each in decided if each.about(fault)), "accept")
        if decision != "accept":
            refused.append(fault)
            change = replace(change, decision=decision, samples=0, after=change.before)
        told.append(change)
    known = {(change.kind, change.markers, change.first) for change in told}
    gone = [
        change for change in (each.as_change() for each in decided) if (change.kind, change.markers, change.first) not in known
    ]
    relabelled = [fault for fault in refused if _of_labels(fault)]
    after = put_back(whole, looked.take, [fault for fault in refused if not _of_labels(fault)])
    return put_back(after, before, relabelled), (*told, *gone)


def _asked(fault: Fault, only: Sequence[str]) -> bool:
    """Is the fault of a kind to be mended? A marker's new place is no change to it."""
    return not only or fault.kind in PLACES or ("gap" if fault.kind in MISSING else fault.kind) in only


def _free(fault: Fault, touch: np.ndarray) -> bool:
    """May all of its samples be touched, where it is about whose they are?"""
    return not _of_labels(fault) or bool(touch[fault.frames][:, concerned(fault, touch.shape[1])].all())


def _of_labels(fault: Fault) -> bool:
    return fault.kind in LABELS or isinstance(fault, Fragment)


def _agrees(fault: Fault, looked: Looked, whole: Take) -> bool:
    """Is it another program's fill that is as good as ours?"""
    if fault.kind not in OTHERS_FILLS or whole.deviation is None:
        return False
    frames, m = fault.frames, fault.marker
    apart, sure = whole.markers[frames, m] - looked.take.markers[frames, m], whole.deviation[frames, m]
    known = ~np.isnan(sure)
    allowed = np.maximum(3 * (AGREES * sure[known]) ** 2, NEAR**2)
    return not known.any() or bool((apart[known] ** 2).sum() < allowed.sum())
