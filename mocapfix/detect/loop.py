"""The detection loop: labels are corrected and faults are detected, until nothing new is found.

`detect_on_trajectories` uses the trajectories alone, `detect_on_body` compares them with the solved body, and `detect_on_hands`
compares the labels of fingers with the hands that it carries. Labels come first, since a label error looks like every other
fault. Under correct labels `detect_sample_faults` detects the fills of other programs first, which are not judged; then spikes,
frozen values and jitter, and ghosts last, among the samples that are left. After a correction of labels the samples are judged
again.
"""

from dataclasses import replace

import numpy as np

from mocapfix.detect import body_outliers, external_fills, gaps, ghosts, marker_shifts, noise
from mocapfix.detect.body_outliers import is_body_wrong
from mocapfix.detect.keypoints import detect_on_keypoints
from mocapfix.detect.noise import RoundMemory
from mocapfix.errors import TakeError
from mocapfix.hands.finger_labels import find_finger_faults
from mocapfix.hands.finger_markers import find_finger_markers, select_carried
from mocapfix.labels.fragments import detect_fragments, join_fragments, relabel_samples
from mocapfix.labels.label_swaps import detect_label_swaps, detect_limb_exchanges, detect_mislabelled, undo_label_exchanges
from mocapfix.model.body_fit import BodyFit
from mocapfix.model.detected import Detected, find_namesakes
from mocapfix.model.faults import (
    EXTERNAL_FILL_KINDS,
    LABEL_KINDS,
    MIN_LABEL_CONFIDENCE,
    REPLACED_SAMPLE_KINDS,
    SHIFT_KINDS,
    Fault,
    FaultReview,
    Faults,
    Fragment,
    MarkerShift,
    build_fault_mask,
)
from mocapfix.model.marker_set import MarkerSet
from mocapfix.model.motion import Motion
from mocapfix.model.subject import Subject
from mocapfix.model.take import Take
from mocapfix.options import CleanOptions, DetectOptions
from mocapfix.solve.kinematics import predict_markers
from mocapfix.stats.marker_distances import estimate_distances

MIN_CONFIRMED_SHIFT_FRACTION = 0.6  # part of a measured shift by which the body's places before and after must differ


def detect_body_faults(
    subject_take: Take,
    solver_mask: np.ndarray,
    subject: Subject,
    motion: Motion,
    *,
    min_distance_m: float = 0.02,
    max_spike_duration_s: float = 0.05,
) -> list[Fault]:
    """Detect faults of markers, indices into the subject's, by their distances from the body; ordered by marker and first frame.

    A fault that a larger fault nearby explains is not reported; the next round of detection finds it if it remains. Neither are
    samples off the body where the other markers show that the body is wrong.

    Args:
        subject_take: The inliers in the order of the subject's K markers, NaN elsewhere.
        solver_mask: (T, K) bool, the samples that the solver used.
        min_distance_m: Smaller distances from the body are not faults.
        max_spike_duration_s: Longer outliers are ghosts, shorter ones spikes.
    """
    residuals = body_outliers.compute_body_residuals(subject_take, solver_mask, subject, motion)
    outliers = body_outliers.detect_body_outliers(residuals, subject_take.rate, min_distance_m)
    swaps = body_outliers.detect_body_label_swaps(residuals, outliers, subject_take)
    distances = estimate_distances(subject_take.markers)
    has_swap = np.any(build_fault_mask(swaps, subject_take.visible.shape), axis=1)
    single_outliers = [
        outlier
        for outlier in body_outliers.select_dominant_outliers(outliers)
        if not has_swap[outlier.first : outlier.last + 1].any() and not is_body_wrong(outlier, residuals, distances)
    ]
    faults = swaps + [body_outliers.build_outlier_fault(each, subject_take, max_spike_duration_s) for each in single_outliers]
    places = predict_markers(subject, (motion.root_position, motion.local_rotations))
    faults += body_outliers.detect_fallen_markers(subject_take, places)
    shifts = marker_shifts.detect_marker_shifts(residuals, subject, motion, subject_take.rate)
    faulty_markers = {marker for fault in faults for marker in fault.markers}
    shift_faults = [
        marker_shifts.build_shift_fault(shift, subject_take)
        for shift in marker_shifts.select_dominant_shifts(shifts, subject)
        if not any(marker_shifts.are_joints_adjacent(subject, shift.marker, marker) for marker in faulty_markers)
    ]
    return sorted(faults + shift_faults, key=lambda fault: (fault.marker, fault.first))


def detect_epoch_faults(detected: Detected, body: BodyFit, options: DetectOptions) -> list[Fault]:
    """Detect faults against the body, with markers as indices into the take.

    Uncertain label swaps are left out, and so is what a burst of jitter that is already known meets, unless it lasts longer.
    """
    epochs = detected.epochs
    inliers, solver_take = (
        detected.select_columns(body.marker_columns, mask) for mask in (detected.inlier_mask, detected.solver_mask)
    )
    subject, used, least_m = body.extended_subject, solver_take.visible, options.min_spike_m
    spike_s, long = options.max_spike_duration_s, body_outliers.MIN_SHIFTED_DURATION_S * detected.take.rate
    faults = detect_body_faults(inliers, used, subject, body.motion, min_distance_m=least_m, max_spike_duration_s=spike_s)
    take_marker = [int(epochs.column_marker[column]) if column >= 0 else -1 for column in body.marker_columns]
    mapped = [
        replace(fault, marker=take_marker[fault.marker], other_markers=tuple(take_marker[m] for m in fault.other_markers))
        for fault in faults
    ]
    burst = build_fault_mask(detected.sample_faults.select_kinds("jitter"), detected.take.visible.shape)
    return [
        fault
        for fault in mapped
        if -1 not in fault.markers
        and not (fault.kind in LABEL_KINDS and fault.confidence < MIN_LABEL_CONFIDENCE)
        and (fault.kind in SHIFT_KINDS or not fault.meets_mask(burst) or (~burst[fault.frame_slice, fault.marker]).sum() > long)
    ]


def find_unconfirmed_shifts(detected: Detected, body: BodyFit) -> list[Fault]:
    """Return the marker shifts after which the body carries the marker where it did before: joint or skin moved there."""
    offsets = dict(zip(body.marker_columns.tolist(), body.extended_subject.marker_offsets, strict=True))
    unconfirmed: list[Fault] = []
    for fault in (each for each in detected.sample_faults.items if isinstance(each, MarkerShift) and each.marker in offsets):
        before, after = (detected.epochs.find_column(fault.marker, frame) for frame in (fault.first - 1, fault.settled_frame))
        change_m = np.linalg.norm(offsets[after] - offsets.get(before, np.inf)) if after in offsets else 0.0
        if not change_m >= MIN_CONFIRMED_SHIFT_FRACTION * fault.severity:
            unconfirmed.append(fault)
    return unconfirmed


DEFAULT_DETECT_OPTIONS = DetectOptions()


def detect_sample_faults(
    take: Take,
    marker_set: MarkerSet | None = None,
    options: DetectOptions = DEFAULT_DETECT_OPTIONS,
    memory: RoundMemory | None = None,
) -> Faults:
    """Detect the faults of the samples under each label. The labels have to be correct.

    Samples that a program filled are not judged. A spike within a burst of jitter is part of the burst.

    Args:
        memory: What earlier rounds on the same positions found. Only the samples that are set aside may differ.
    """
    memory, shape = memory or RoundMemory(), take.visible.shape
    virtual = external_fills.detect_virtual_samples(take)
    measured = take.masked(take.measured & ~build_fault_mask(virtual, shape))
    measured = measured.replace_markers(np.ascontiguousarray(measured.markers.swapaxes(0, 1)).swapaxes(0, 1))  # path after path
    all_spikes = noise.detect_spikes(measured, options.min_spike_m, options.max_spike_duration_s, memory)
    detectors = external_fills.detect_frozen, external_fills.detect_polynomial_fills
    exact = [fault for detect in detectors for fault in detect(measured, memory=memory)]
    is_usable = measured.visible & ~build_fault_mask([*all_spikes, *exact], shape)
    bursts = noise.detect_jitter(measured, is_usable, options.min_jitter_m, memory, all_spikes)
    has_jitter = build_fault_mask(bursts, shape)
    # a marker with bursts of jitter is not reported as noisy as well
    noisy = [fault for fault in noise.detect_noise(measured, memory) if not has_jitter[:, fault.marker].any()]
    isolated_spikes = [spike for spike in all_spikes if not has_jitter[spike.frame_slice, spike.marker].all()]
    lost = gaps.detect_lost_segments(take, marker_set) if marker_set else []
    faults = Faults((*gaps.detect_gaps(take, memory), *virtual, *lost, *noisy, *isolated_spikes, *exact, *bursts))
    is_sound = faults.compute_inlier_mask(measured) & ~build_fault_mask(exact, shape)
    return faults.add_faults(memory.recall_whole("ghosts", is_sound, lambda: ghosts.detect_ghosts(take.masked(is_sound))))


MIN_VISIBLE_MARKERS = 3  # inliers in at least one frame: fewer do not determine the position of anything


def check_visible_markers(detected: Detected) -> None:
    """Raise TakeError if no frame shows enough markers after the detection."""
    if detected.inlier_mask.sum(1).max() < MIN_VISIBLE_MARKERS:
        problem = f"no frame shows {MIN_VISIBLE_MARKERS} markers, so nothing can be estimated"
        if not detected.take.visible.any():
            problem = "all samples of its markers are missing (in a C3D, a residual below 0 says so)"
        raise TakeError(f"{detected.take.name}: {problem}; check the labels and the export.")


def detect_on_trajectories(
    take: Take, marker_set: MarkerSet | None, subject: Subject | None, review: FaultReview, options: CleanOptions
) -> Detected:
    """Detect faults in the trajectories of a take and correct its labels. The corrections of a reviewer come first."""
    if marker_set and marker_set.point_sd:
        return detect_on_keypoints(take, marker_set, review, options)
    label_faults = list(review.label_corrections)
    take = relabel_samples(take, label_faults)
    limbs = review.select(detect_limb_exchanges(take))
    take = undo_label_exchanges(take, limbs)
    label_faults += limbs
    if marker_set:
        mislabelled = review.select(detect_mislabelled(take, marker_set, subject))
        take = undo_label_exchanges(take, mislabelled)
        label_faults += mislabelled
    fingers = set[int]()  # whose labels `detect_on_hands` judges
    if marker_set and take.part is None:
        columns, hands = marker_set.find_columns(take.labels), find_finger_markers(marker_set.name, take.labels)
        is_shown = (columns >= 0) & take.visible[:, columns].any(0)
        for hand in select_carried(hands, marker_set.joints[is_shown]):
            fingers.update(hand.columns.tolist())
    for _ in range(options.detect.max_rounds):
        fragments = review.select([*detect_fragments(take)])
        joined = join_fragments(take, fragments)
        swaps = review.select(detect_label_swaps(joined.masked(joined.measured)))
        swaps = [fault for fault in swaps if fault.confidence >= MIN_LABEL_CONFIDENCE and not fingers.issuperset(fault.markers)]
        # a fragment that was not joined is detected again in each round
        kept = (each for each in label_faults if not (isinstance(each, Fragment) and each.relation in ("other", "doubles")))
        label_faults = [*kept, *fragments, *swaps]
        take = undo_label_exchanges(joined, swaps)
        if not swaps:
            break
    sample_faults = detect_remaining_faults(take, marker_set, review, options.detect)
    replaced_kinds = (*REPLACED_SAMPLE_KINDS, *EXTERNAL_FILL_KINDS) if options.fill.refill else REPLACED_SAMPLE_KINDS
    return Detected(take, tuple(label_faults), sample_faults, replaced_kinds)


def detect_on_body(
    detected: Detected, body: BodyFit, marker_set: MarkerSet, review: FaultReview, options: DetectOptions
) -> Detected:
    """Detect what does not fit the solved body and correct labels again. Returns `detected` itself where nothing new is found."""
    if marker_set.point_sd:
        return detected  # what would be a fault of a marker is within the errors of keypoints
    unconfirmed_shifts = (*detected.unconfirmed_shifts, *find_unconfirmed_shifts(detected, body))
    known = {_identify_fault(fault) for fault in detected.faults.items}
    found = review.select(detect_epoch_faults(detected, body, options))
    new_faults = [fault for fault in found if _identify_fault(fault) not in known]
    swaps = [fault for fault in new_faults if fault.kind in LABEL_KINDS]
    is_swapped = build_fault_mask(swaps, detected.take.visible.shape)
    others = [fault for fault in new_faults if fault.kind not in LABEL_KINDS and not fault.meets_mask(is_swapped)]
    if not swaps and not others and len(unconfirmed_shifts) == len(detected.unconfirmed_shifts):
        return detected
    take = undo_label_exchanges(detected.take, swaps)
    body_faults = (*(fault for fault in detected.body_faults if not fault.meets_mask(is_swapped)), *others)
    if swaps:
        sample_faults = detect_remaining_faults(take, marker_set, review, options).add_faults(body_faults)
    else:
        sample_faults = detected.sample_faults.add_faults(others)
    rejected = {_identify_fault(fault) for fault in unconfirmed_shifts}
    confirmed = tuple(fault for fault in sample_faults.items if _identify_fault(fault) not in rejected)
    return replace(
        detected,
        take=take,
        label_faults=(*detected.label_faults, *swaps),
        sample_faults=Faults(confirmed),
        body_faults=body_faults,
        unconfirmed_shifts=unconfirmed_shifts,
    )


def detect_on_hands(
    detected: Detected, body: BodyFit, marker_set: MarkerSet, review: FaultReview, options: DetectOptions
) -> Detected:
    """Correct the labels of finger markers and find ghosts among them. Returns `detected` itself where it finds nothing."""
    is_judged = not marker_set.point_sd  # neighbouring fingers are as near as the noise of keypoints
    found = find_finger_faults(detected.take, body.subject, body.motion) if is_judged else []
    ghosts = [fault for fault in found if fault.kind == "ghost"]
    swaps = review.select([fault for fault in found if fault.kind != "ghost"])
    if not found:
        return detected
    take, changed = undo_label_exchanges(detected.take, swaps), {marker for fault in swaps for marker in fault.markers}
    sample_faults, before = detected.sample_faults, detected.take.markers
    if swaps:
        remaining = detect_remaining_faults(take, marker_set, review, options).items
        kept = (fault for fault in sample_faults.items if fault.marker not in changed)
        sample_faults = Faults().add_faults((*kept, *(fault for fault in remaining if fault.marker in changed)))
    is_known = sample_faults.compute_faulty_mask(take)
    for fault in ghosts:  # its label may be another one now
        is_same = (take.markers[fault.frame_slice] == before[fault.frame_slice, fault.marker][:, None]).all((0, 2))
        is_new = is_same & ~is_known[fault.frame_slice].all(0)
        sample_faults = sample_faults.add_faults(review.select([replace(fault, marker=int(m)) for m in np.flatnonzero(is_new)]))
    return replace(detected, take=take, label_faults=(*detected.label_faults, *swaps), sample_faults=sample_faults)


def detect_remaining_faults(take: Take, marker_set: MarkerSet | None, review: FaultReview, options: DetectOptions) -> Faults:
    """Detect the faults of the samples of a take with correct labels, and add those that a reviewer marked.

    Samples that are to be replaced are set aside and detection is repeated, since they may hide others. Otherwise a second
    cleaning would find new faults. Markers whose labels name fragments of other markers are not judged.
    """
    donors, memory = find_namesakes(take), RoundMemory()
    known = Faults().add_faults(review.marked_faults)
    for _ in range(options.max_rounds):
        remaining = replace(take, computed=take.visible & ~take.measured | known.compute_faulty_mask(take))
        found = detect_sample_faults(remaining, marker_set, options, memory).items
        faults = [fault for fault in found if fault.marker not in donors and review.accepts(fault)]
        replaced = [fault for fault in faults if fault.kind in REPLACED_SAMPLE_KINDS]
        others = Faults(tuple(fault for fault in faults if fault.kind not in REPLACED_SAMPLE_KINDS))
        known = others.add_faults((*known.select_kinds(*REPLACED_SAMPLE_KINDS), *replaced))
        if not replaced:
            break
    return known


def _identify_fault(fault: Fault) -> tuple[object, ...]:
    """Return what two detections of the same fault have in common: the kind, the markers and the frames."""
    return fault.kind, fault.markers, fault.first, fault.last
