"""Decisions: which of the changes to a take are made in the end, and which are taken back."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mocapfix.changes import Change, affects_labels, build_affected_mask, build_changes, compare_samples, list_affected_markers
from mocapfix.detect.loop import DetectionState
from mocapfix.faults import (
    EXTERNAL_FILL_KINDS,
    LABEL_KINDS,
    MIN_LABEL_CONFIDENCE,
    MISSING_KINDS,
    REPLACED_SAMPLE_KINDS,
    SHIFT_KINDS,
    Fault,
    Fragment,
)
from mocapfix.repair.relabel import JOINED_RELATIONS, relabel_samples
from mocapfix.report.review_file import ReviewedChange
from mocapfix.take import Take

# MERGED: mocapfix.decisions
MAX_AGREEMENT_SD, MAX_AGREEMENT_DISTANCE_M = (
    3.0,
    0.010,
)  # standard deviations, metres: another program's fill that lies so near to the estimate stays as it is


def apply_decisions(
    before: Take,
    detection: DetectionState,
    repaired: Take,
    body_markers: np.ndarray | None,
    fill_methods: np.ndarray,
    editable_mask: np.ndarray,
    kinds: Sequence[str],
    reviewed: Sequence[ReviewedChange],
) -> tuple[Take, tuple[Change, ...]]:
    """-> the take with the changes that are to be made, and an entry for each, also for those that were decided against.

    before, looked, whole  the take as it was read, with its labels right, and with everything mended
    body     (T, M, 3) metres: where the solved body has the markers; None without one
    ways     (T, M) how each sample was found that was filled, "" for others
    touch    (T, M) bool: what may be touched; a change of labels all of whose samples may not is not made
    only     the kinds that are mended, a gap's for all that is missing; none: all
    """
    made_of = [fault for fault in detection.faults.items if _is_repairable(fault)]
    asked = [
        f
        for f in made_of
        if _is_requested(f, kinds) and _is_editable(f, editable_mask) and not _matches_estimate(f, detection, repaired)
    ]
    decision = {id(f): next((each.decision for each in reviewed if each.matches(f)), "accept") for f in asked}
    accepted = [fault for fault in asked if decision[id(fault)] == "accept"]
    declined = [fault for fault in asked if decision[id(fault)] != "accept"]
    after = _revert_faults(before, detection, repaired, [f for f in made_of if decision.get(id(f)) != "accept"])
    taken_back = [
        (replace(change, decision=decision[id(fault)], samples=0, after=change.before), fault)
        for change, fault in build_changes(before, detection.take, repaired, declined, body_markers, fill_methods)
    ]
    told = sorted(
        (*build_changes(before, detection.take, after, accepted, body_markers, fill_methods), *taken_back),
        key=lambda each: _get_sort_key(each[1]),
    )
    gone = [each.to_change() for each in reviewed if not any(each.matches(fault) for _, fault in taken_back)]
    return after, (*(change for change, _ in told), *gone)


def _revert_faults(before: Take, detection: DetectionState, repaired: Take, refused: list[Fault]) -> Take:
    """-> the mended take without what is refused: labels first, for where they are not changed nothing else is either."""
    labelled = relabel_samples(before, [fault for fault in detection.label_faults if fault not in refused])
    where = np.zeros(before.visible.shape, bool)
    for fault in refused:
        if not affects_labels(fault):
            where |= build_affected_mask(fault, detection.take)
    after = revert_samples(revert_samples(repaired, detection.take, where), labelled, compare_samples(detection.take, labelled))
    return replace(after, unlabelled=labelled.unlabelled)


def _is_repairable(fault: Fault) -> bool:
    """Does anything come of it? Some only say what others are of, and what is not sure of labels is only told."""
    if isinstance(fault, Fragment):
        return fault.relation in JOINED_RELATIONS
    return (
        fault.confidence >= MIN_LABEL_CONFIDENCE
        if fault.kind in LABEL_KINDS
        else fault.kind in (*MISSING_KINDS, *REPLACED_SAMPLE_KINDS, *EXTERNAL_FILL_KINDS, *SHIFT_KINDS)
    )


def _get_sort_key(fault: Fault) -> tuple[int, int]:
    return fault.marker, fault.first


def _is_requested(fault: Fault, kinds: Sequence[str]) -> bool:
    """Is the fault of a kind to be mended? A marker's new place is no change to it."""
    return not kinds or fault.kind in SHIFT_KINDS or ("gap" if fault.kind in MISSING_KINDS else fault.kind) in kinds


def _is_editable(fault: Fault, editable_mask: np.ndarray) -> bool:
    """May all of its samples be touched, where it is about whose they are?"""
    return not affects_labels(fault) or bool(
        editable_mask[fault.frame_slice][:, list_affected_markers(fault, editable_mask.shape[1])].all()
    )


def _matches_estimate(fault: Fault, detection: DetectionState, repaired: Take) -> bool:
    """Is it another program's fill that is as good as ours?"""
    if fault.kind not in EXTERNAL_FILL_KINDS or repaired.sample_sd is None:
        return False
    frames, m = fault.frame_slice, fault.marker
    apart, sure = repaired.markers[frames, m] - detection.take.markers[frames, m], repaired.sample_sd[frames, m]
    known = ~np.isnan(sure)
    allowed = np.maximum(3 * (MAX_AGREEMENT_SD * sure[known]) ** 2, MAX_AGREEMENT_DISTANCE_M**2)
    return not known.any() or bool((apart[known] ** 2).sum() < allowed.sum())


# MERGED: mocapfix.mend.refused
# Changes that are not to be made, taken back.
def revert_samples(repaired: Take, original: Take, revert_mask: np.ndarray) -> Take:
    """-> the cleaned take with the samples `where` (T, M) as they were before, and no other touched."""
    return replace(
        repaired,
        markers=np.where(revert_mask[..., None], original.markers, repaired.markers),
        relabelled_points=np.where(revert_mask, original.source_points, repaired.source_points),
        sample_sd=None if repaired.sample_sd is None else np.where(revert_mask, np.nan, repaired.sample_sd),
        computed=np.where(revert_mask, original.visible & ~original.measured, repaired.visible & ~repaired.measured),
    )
