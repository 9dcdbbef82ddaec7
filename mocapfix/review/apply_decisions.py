"""The last stage: decide which changes are applied, revert the others, record all of them, and update computed points.

A point that a program computed from markers was recognised as a function of these. It is computed where it is missing, as a
fill. Where it has a sample and its parents were changed, it is computed again on request only, and so are points that were
recognised by their names.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.io.changes_file import Review, ReviewIndex, list_label_corrections
from mocapfix.labels.fragments import relabel_samples
from mocapfix.model.changes import (
    Decided,
    Filled,
    affects_labels,
    build_affected_mask,
    build_changes,
    compare_samples,
    compute_editable_mask,
    find_unfilled_runs,
    list_affected_markers,
)
from mocapfix.model.detected import Detected
from mocapfix.model.faults import (
    EXTERNAL_FILL_KINDS,
    JOINED_RELATIONS,
    LABEL_KINDS,
    MIN_LABEL_CONFIDENCE,
    MISSING_KINDS,
    REPLACED_SAMPLE_KINDS,
    SHIFT_KINDS,
    Fault,
    Fragment,
)
from mocapfix.model.take import ComputedPoints, Take
from mocapfix.options import CleanOptions, FillOptions
from mocapfix.stats.point_function_search import find_point_functions
from mocapfix.stats.sequences import estimate_resolution

# A fill of another program stays as it is if it agrees with the estimate within either of these.
MAX_AGREEMENT_SD = 3.0
MAX_AGREEMENT_DISTANCE_M = 0.010


def apply_decisions(original: Take, filled: Filled, review: Review, options: CleanOptions, *, is_smoothed: bool) -> Decided:
    """Apply the accepted changes and revert the others.

    A change is reverted if `options.detect.repair_kinds` names kinds and its kind is not one of them, if it is a label change
    with samples that must not be edited, if another program's fill agrees with the estimate, or if a reviewer rejected it.

    Args:
        original: The take as it was read.
        filled: The same without faults and gaps.
        review: What a reviewer decided.
        options: Those of detection and filling.
        is_smoothed: Whether samples without faults are smoothed as well.
    """
    detected, is_editable = filled.detected, compute_editable_mask(original, options.fill)
    corrections = list_label_corrections(review.corrections)
    repairable = [fault for fault in detected.faults.items if _is_repairable(fault)]
    considered = [
        fault
        for fault in repairable
        if (_is_requested(fault, options.detect.repair_kinds) or fault in corrections)
        and _is_editable(fault, is_editable)
        and not _matches_estimate(fault, detected, filled.take)
    ]
    reviewed = ReviewIndex(review.declined)
    decisions = {
        id(fault): next((each.entry.decision for each in reviewed.find_matches(fault)), "accept") for fault in considered
    }
    accepted = [fault for fault in considered if decisions[id(fault)] == "accept"]
    declined = [fault for fault in considered if decisions[id(fault)] != "accept"]
    reverted = [fault for fault in repairable if decisions.get(id(fault)) != "accept"]
    cleaned = _revert_faults(original, detected, filled.take, reverted)
    if is_smoothed:
        cleaned = _smooth_kept_samples(cleaned, detected.take, is_editable)
    body_markers, methods = filled.body_markers, filled.methods
    declined_changes = [
        (replace(change, decision=decisions[id(fault)], samples=0, after=change.before), fault)
        for change, fault in build_changes(original, detected.take, filled.take, declined, body_markers, methods)
    ]
    accepted_changes = build_changes(original, detected.take, cleaned, accepted, body_markers, methods)
    changes = sorted((*accepted_changes, *declined_changes), key=lambda each: (each[1].marker, each[1].first))
    found = {id(each) for _, fault in declined_changes for each in reviewed.find_matches(fault)}
    not_found = [each.to_change() for each in review.declined if id(each) not in found]
    reasons = np.where(filled.take.visible, "its change was not applied", filled.unfilled_reasons)
    all_changes, runs = (*(change for change, _ in changes), *not_found), find_unfilled_runs(cleaned, reasons)
    return Decided(detected, cleaned, all_changes, runs, filled.rigid_groups)


def revert_samples(repaired: Take, original: Take, revert_mask: Bool[np.ndarray, "T M"]) -> Take:
    """Return the repaired take with the samples in `revert_mask` as they are in the original, and all others unchanged."""
    return replace(
        repaired,
        markers=np.where(revert_mask[..., None], original.markers, repaired.markers),
        relabelled_points=np.where(revert_mask, original.source_points, repaired.source_points),
        sample_sd=None if repaired.sample_sd is None else np.where(revert_mask, np.nan, repaired.sample_sd),
        computed=np.where(revert_mask, original.visible & ~original.measured, repaired.visible & ~repaired.measured),
    )


def _revert_faults(original: Take, detected: Detected, repaired: Take, faults: list[Fault]) -> Take:
    """Return the repaired take without the repairs of some faults.

    Where a label change is reverted, the repairs of the samples concerned are reverted too.
    """
    reverted_label_faults = {id(fault) for fault in faults if affects_labels(fault)}
    relabelled = relabel_samples(original, [fault for fault in detected.label_faults if id(fault) not in reverted_label_faults])
    revert_mask = build_affected_mask([fault for fault in faults if not affects_labels(fault)], detected.take)
    without_samples = revert_samples(repaired, detected.take, revert_mask)
    without_labels = revert_samples(without_samples, relabelled, compare_samples(detected.take, relabelled))
    return replace(without_labels, unlabelled=relabelled.unlabelled)


def _smooth_kept_samples(cleaned: Take, smoothed: Take, editable_mask: Bool[np.ndarray, "T M"]) -> Take:
    """Return the cleaned take with the smoothed positions of the samples that are the file's own."""
    is_kept = cleaned.measured & smoothed.visible & (cleaned.source_points == smoothed.source_points) & editable_mask
    is_kept &= np.isnan(cleaned.estimated_sd)
    return replace(cleaned, markers=np.where(is_kept[..., None], smoothed.markers, cleaned.markers))


def _is_repairable(fault: Fault) -> bool:
    """Return whether a fault leads to a change. Uncertain label faults and unused fragments are only reported."""
    if isinstance(fault, Fragment):
        return fault.relation in JOINED_RELATIONS
    if fault.kind in LABEL_KINDS:
        return fault.confidence >= MIN_LABEL_CONFIDENCE
    return fault.kind in (*MISSING_KINDS, *REPLACED_SAMPLE_KINDS, *EXTERNAL_FILL_KINDS, *SHIFT_KINDS)


def _is_requested(fault: Fault, kinds: tuple[str, ...]) -> bool:
    """Return whether the fault is of a kind to be repaired. Marker shifts, which change no sample, and marked stretches are."""
    return not kinds or fault.kind in (*SHIFT_KINDS, "marked") or ("gap" if fault.kind in MISSING_KINDS else fault.kind) in kinds


def _is_editable(fault: Fault, editable_mask: Bool[np.ndarray, "T M"]) -> bool:
    """Return whether all samples of a label fault may be edited; True for other faults."""
    if not affects_labels(fault):
        return True
    return bool(editable_mask[fault.frame_slice][:, list_affected_markers(fault, editable_mask.shape[1])].all())


def _matches_estimate(fault: Fault, detected: Detected, repaired: Take) -> bool:
    """Return whether the fault is another program's fill that agrees with the estimate."""
    if fault.kind not in EXTERNAL_FILL_KINDS or repaired.sample_sd is None:
        return False
    frames, m = fault.frame_slice, fault.marker
    distance = repaired.markers[frames, m] - detected.take.markers[frames, m]
    sd = repaired.sample_sd[frames, m]
    is_known = ~np.isnan(sd)
    allowed = np.maximum(3 * (MAX_AGREEMENT_SD * sd[is_known]) ** 2, MAX_AGREEMENT_DISTANCE_M**2)
    return not is_known.any() or bool((distance[is_known] ** 2).sum() < allowed.sum())


def update_computed_points(original: Take, cleaned: Take, options: FillOptions) -> Take:
    """Return the cleaned take with its computed points filled and, if `options` ask for it, computed again.

    Their `sample_sd` is the largest of their parents'; where these were measured it is 0.
    """
    computed = cleaned.computed_points
    if computed is None:
        return cleaned
    if options.update_computed:
        computed = find_missing_functions(original, computed)
    points, is_editable = computed.take, compute_editable_mask(computed.take, options)
    positions, sd_m = points.markers.copy(), np.full(points.visible.shape, np.nan)
    is_changed = ~np.all((original.markers == cleaned.markers) | np.isnan(original.markers), axis=-1)
    is_changed |= original.visible != cleaned.visible
    column = {int(point): m for m, point in enumerate(cleaned.point_indices)}
    for c, function in enumerate(computed.functions):
        if function is None or not all(parent in column for parent in function.parents):
            continue
        parents = np.array([column[parent] for parent in function.parents])
        is_updated = is_editable[:, c] & (~points.visible[:, c] | (options.update_computed & is_changed[:, parents].any(1)))
        if computed.evidence[c] == "name" and not options.update_computed:
            continue
        new = function.evaluate(cleaned.markers[is_updated][:, parents])
        is_known = ~np.isnan(new).any(-1)
        frames = np.flatnonzero(is_updated)[is_known]
        positions[frames, c] = new[is_known]
        sd_m[frames, c] = _get_parent_sd(cleaned, frames, parents)
    updated = replace(computed, take=points.replace_markers(positions, sd_m))
    return replace(cleaned, computed_points=updated)


def find_missing_functions(take: Take, computed: ComputedPoints) -> ComputedPoints:
    """Return the computed points with the functions of those that were recognised by their names, where these are exact."""
    points = np.concatenate([take.markers, computed.take.markers], axis=1)
    count, is_unknown = len(take.labels), np.array([function is None for function in computed.functions], bool)
    is_candidate = np.r_[np.zeros(count, bool), is_unknown & computed.take.visible.any(0)]
    is_parent = np.r_[take.visible.any(0), np.zeros(len(is_unknown), bool)]
    found = find_point_functions(points, estimate_resolution(points), is_candidate, is_parent)
    functions = list(computed.functions)
    for point, function in found.items():
        parents = tuple(int(take.point_indices[parent]) for parent in function.parents)
        functions[point - count] = replace(function, parents=parents)
    return replace(computed, functions=tuple(functions))


def _get_parent_sd(take: Take, frames: Int[np.ndarray, " N"], parents: Int[np.ndarray, " n"]) -> Float[np.ndarray, " N"]:
    if take.sample_sd is None:
        return np.zeros(len(frames))
    return np.nan_to_num(take.sample_sd[frames[:, None], parents]).max(1)
