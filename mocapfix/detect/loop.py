"""The detection loop: labels are corrected and faults are detected, until nothing new is found.

`detect_on_trajectories` uses the trajectories alone, `detect_on_body` compares them with the solved body. Labels come first,
since a label error looks like every other fault; then swaps before spikes, and spikes before gaps. A correction can uncover
further faults, so detection is repeated after it.
"""

from dataclasses import replace

from mocapfix.detect.body_checks import detect_epoch_faults, find_unconfirmed_shifts
from mocapfix.detect.fragments import detect_fragments
from mocapfix.detect.keypoint_trajectories import detect_on_keypoints
from mocapfix.detect.label_swaps import detect_label_swaps
from mocapfix.detect.mislabelled import detect_mislabelled
from mocapfix.detect.round_memory import RoundMemory
from mocapfix.detect.sample_faults import detect_sample_faults
from mocapfix.detect.trajectory_segments import find_namesakes
from mocapfix.errors import TakeError
from mocapfix.faults import (
    EXTERNAL_FILL_KINDS,
    LABEL_KINDS,
    MIN_LABEL_CONFIDENCE,
    REPLACED_SAMPLE_KINDS,
    Fault,
    Faults,
    Fragment,
    build_fault_mask,
)
from mocapfix.options import CleanOptions
from mocapfix.repair.relabel import join_fragments, relabel_samples, undo_label_exchanges
from mocapfix.review.corrections import list_label_corrections, list_marked_faults
from mocapfix.state import CleaningState, DetectionState
from mocapfix.take import Take

MIN_VISIBLE_MARKERS = 3
"""Inliers in at least one frame: fewer do not determine the position of anything."""


def check_visible_markers(state: CleaningState) -> None:
    """Raise TakeError if no frame shows enough markers after the detection."""
    if state.detection.inlier_mask.sum(1).max() < MIN_VISIBLE_MARKERS:
        raise TakeError(
            f"{state.original_take.name}: no frame shows {MIN_VISIBLE_MARKERS} markers, so nothing can be estimated; "
            "check the labels and the export."
        )


def detect_on_trajectories(state: CleaningState, options: CleanOptions) -> CleaningState:
    """Detect faults in the trajectories of the original take and correct its labels. Sets `detection` of the state.

    The corrections of a reviewer come first. Raises TakeError for corrections of keypoints.
    """
    if state.marker_set and state.marker_set.point_sd:
        if state.review.corrections:
            name = state.original_take.name
            raise TakeError(f"{name}: corrections in a changes file are for markers, and these are keypoints; remove them.")
        return detect_on_keypoints(state, options)
    label_faults = list_label_corrections(state.review.corrections)
    take = relabel_samples(state.original_take, label_faults)
    if state.marker_set:
        found = detect_mislabelled(take, state.marker_set, state.known_subject)
        mislabelled = [fault for fault in found if state.accepts_fault(fault)]
        take = undo_label_exchanges(take, mislabelled)
        label_faults += mislabelled
    for _ in range(options.detect.max_rounds):
        fragments = [fault for fault in detect_fragments(take) if state.accepts_fault(fault)]
        joined = join_fragments(take, fragments)
        swaps = [
            fault
            for fault in detect_label_swaps(joined.masked(joined.measured))
            if state.accepts_fault(fault) and fault.confidence >= MIN_LABEL_CONFIDENCE
        ]
        # A fragment that was not joined is detected again in each round.
        label_faults = [*(fault for fault in label_faults if not _is_unused_fragment(fault)), *fragments, *swaps]
        take = undo_label_exchanges(joined, swaps)
        if not swaps:
            break
    sample_faults = detect_remaining_faults(take, state, options)
    replaced_kinds = (*REPLACED_SAMPLE_KINDS, *EXTERNAL_FILL_KINDS) if options.fill.refill else REPLACED_SAMPLE_KINDS
    return replace(state, detection=DetectionState(take, tuple(label_faults), sample_faults, replaced_kinds))


def detect_on_body(state: CleaningState, options: CleanOptions) -> CleaningState:
    """Detect what does not fit the solved body and correct labels again.

    Returns the state with a new `detection`, or the very same state where nothing new is found.
    """
    detection, body = state.detection, state.body
    if body is None or (state.marker_set and state.marker_set.point_sd):
        return state  # what would be a fault of a marker is within the errors of keypoints
    unconfirmed_shifts = (*detection.unconfirmed_shifts, *find_unconfirmed_shifts(detection, body))
    known = {_identify_fault(fault) for fault in detection.faults.items}
    new_faults = [
        fault
        for fault in detect_epoch_faults(detection, body, options.detect)
        if state.accepts_fault(fault) and _identify_fault(fault) not in known
    ]
    swaps = [fault for fault in new_faults if fault.kind in LABEL_KINDS]
    is_swapped = build_fault_mask(swaps, detection.take.visible.shape)
    others = [fault for fault in new_faults if fault.kind not in LABEL_KINDS and not fault.meets_mask(is_swapped)]
    if not swaps and not others and len(unconfirmed_shifts) == len(detection.unconfirmed_shifts):
        return state
    take = undo_label_exchanges(detection.take, swaps)
    body_faults = (*(fault for fault in detection.body_faults if not fault.meets_mask(is_swapped)), *others)
    if swaps:
        remaining = detect_remaining_faults(take, state, options)
        sample_faults = remaining.add_faults(body_faults)
    else:
        sample_faults = detection.sample_faults.add_faults(others)
    rejected = {_identify_fault(fault) for fault in unconfirmed_shifts}
    confirmed = tuple(fault for fault in sample_faults.items if _identify_fault(fault) not in rejected)
    label_faults = (*detection.label_faults, *swaps)
    advanced = DetectionState(take, label_faults, Faults(confirmed), detection.replaced_kinds, body_faults, unconfirmed_shifts)
    return replace(state, detection=advanced, calibration=None if swaps else state.calibration)


def detect_remaining_faults(take: Take, state: CleaningState, options: CleanOptions) -> Faults:
    """Detect the faults of the samples of a take with correct labels, and add those that a reviewer marked.

    Samples that are to be replaced are set aside and detection is repeated, since they may hide others. Otherwise a second
    cleaning would find new faults. Markers whose labels name fragments of other markers are not judged.
    """
    donors, memory = find_namesakes(take), RoundMemory()
    known = Faults().add_faults(list_marked_faults(state.review.corrections))
    for _ in range(options.detect.max_rounds):
        remaining = replace(take, computed=take.visible & ~take.measured | known.compute_faulty_mask(take))
        faults = [
            fault
            for fault in detect_sample_faults(remaining, state.marker_set, options.detect, memory).items
            if fault.marker not in donors and state.accepts_fault(fault)
        ]
        replaced = [fault for fault in faults if fault.kind in REPLACED_SAMPLE_KINDS]
        others = Faults(tuple(fault for fault in faults if fault.kind not in REPLACED_SAMPLE_KINDS))
        known = others.add_faults((*known.select_kinds(*REPLACED_SAMPLE_KINDS), *replaced))
        if not replaced:
            break
    return known


def _is_unused_fragment(fault: Fault) -> bool:
    return isinstance(fault, Fragment) and fault.relation in ("other", "doubles")


def _identify_fault(fault: Fault) -> tuple[object, ...]:
    """Return what two detections of the same fault have in common: the kind, the markers and the frames."""
    return fault.kind, fault.markers, fault.first, fault.last
