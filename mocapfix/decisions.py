"""Decisions: which of the changes to a take are made in the end, and which are taken back."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mocapfix.change_file import Decided
from mocapfix.changes import Change, concerned, differs, made, of_labels, samples
from mocapfix.faults import LABELS, MISSING, OTHERS_FILLS, PLACES, REPLACED, SURE, Fault, Fragment
from mocapfix.looks import Looked
from mocapfix.mend import JOINED, put_back, relabelled
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
    made_of = [fault for fault in looked.faults.items if _mended(fault)]
    asked = [f for f in made_of if _asked(f, only) and _free(f, touch) and not _agrees(f, looked, whole)]
    decision = {id(f): next((each.decision for each in decided if each.about(f)), "accept") for f in asked}
    accepted = [fault for fault in asked if decision[id(fault)] == "accept"]
    declined = [fault for fault in asked if decision[id(fault)] != "accept"]
    after = _without(before, looked, whole, [f for f in made_of if decision.get(id(f)) != "accept"])
    taken_back = [
        (replace(change, decision=decision[id(fault)], samples=0, after=change.before), fault)
        for change, fault in made(before, looked.take, whole, declined, body, ways)
    ]
    told = sorted((*made(before, looked.take, after, accepted, body, ways), *taken_back), key=lambda each: _place(each[1]))
    gone = [each.as_change() for each in decided if not any(each.about(fault) for _, fault in taken_back)]
    return after, (*(change for change, _ in told), *gone)


def _without(before: Take, looked: Looked, whole: Take, refused: list[Fault]) -> Take:
    """-> the mended take without what is refused: labels first, for where they are not changed nothing else is either."""
    labelled = relabelled(before, [fault for fault in looked.labels if fault not in refused])
    where = np.zeros(before.seen.shape, bool)
    for fault in refused:
        if not of_labels(fault):
            where |= samples(fault, looked.take)
    after = put_back(put_back(whole, looked.take, where), labelled, differs(looked.take, labelled))
    return replace(after, unlabelled=labelled.unlabelled)


def _mended(fault: Fault) -> bool:
    """Does anything come of it? Some only say what others are of, and what is not sure of labels is only told."""
    if isinstance(fault, Fragment):
        return fault.relation in JOINED
    return fault.confidence >= SURE if fault.kind in LABELS else fault.kind in (*MISSING, *REPLACED, *OTHERS_FILLS, *PLACES)


def _place(fault: Fault) -> tuple[int, int]:
    return fault.marker, fault.first


def _asked(fault: Fault, only: Sequence[str]) -> bool:
    """Is the fault of a kind to be mended? A marker's new place is no change to it."""
    return not only or fault.kind in PLACES or ("gap" if fault.kind in MISSING else fault.kind) in only


def _free(fault: Fault, touch: np.ndarray) -> bool:
    """May all of its samples be touched, where it is about whose they are?"""
    return not of_labels(fault) or bool(touch[fault.frames][:, concerned(fault, touch.shape[1])].all())


def _agrees(fault: Fault, looked: Looked, whole: Take) -> bool:
    """Is it another program's fill that is as good as ours?"""
    if fault.kind not in OTHERS_FILLS or whole.deviation is None:
        return False
    frames, m = fault.frames, fault.marker
    apart, sure = whole.markers[frames, m] - looked.take.markers[frames, m], whole.deviation[frames, m]
    known = ~np.isnan(sure)
    allowed = np.maximum(3 * (AGREES * sure[known]) ** 2, NEAR**2)
    return not known.any() or bool((apart[known] ** 2).sum() < allowed.sum())
