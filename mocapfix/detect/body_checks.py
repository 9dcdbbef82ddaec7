"""Detection against the solved body: label swaps, spikes, ghosts and marker shifts that trajectories alone do not show."""

from dataclasses import replace

import numpy as np

from mocapfix.detect import body_label_swaps, body_outliers, marker_shifts
from mocapfix.detect.marker_distances import estimate_distances
from mocapfix.detect.outlier_evidence import is_body_wrong
from mocapfix.faults import LABEL_KINDS, MIN_LABEL_CONFIDENCE, SHIFT_KINDS, Fault, build_fault_mask
from mocapfix.motion import Motion
from mocapfix.options import DetectOptions
from mocapfix.state import BodyFit, DetectionState
from mocapfix.subject import Subject
from mocapfix.take import Take

# A marker's place after a shift must differ from its place before by at least this part of the measured shift.
MIN_CONFIRMED_SHIFT_FRACTION = 0.6


def detect_body_faults(
    subject_take: Take,
    solver_mask: np.ndarray,
    subject: Subject,
    motion: Motion,
    *,
    min_distance_m: float = 0.02,
    max_spike_duration_s: float = 0.05,
) -> list[Fault]:
    """Detect faults of markers by their distances from the solved body.

    A fault that a larger fault nearby explains is not reported; the next round of detection finds it if it remains. Neither are
    samples off the body where the other markers show that the body is wrong.

    Args:
        subject_take: the inliers in the order of the subject's K markers, NaN elsewhere.
        solver_mask: (T, K) bool, the samples that the solver used.
        subject: the subject.
        motion: its solved motion.
        min_distance_m: smaller distances from the body are not faults.
        max_spike_duration_s: longer outliers are ghosts, shorter ones spikes.

    Returns:
        Faults ordered by marker and first frame. Markers are indices into the subject's markers.
    """
    residuals = body_outliers.compute_body_residuals(subject_take, solver_mask, subject, motion)
    outliers = body_outliers.detect_body_outliers(residuals, subject_take.rate, min_distance_m)
    swaps = body_label_swaps.detect_body_label_swaps(residuals, outliers, subject_take)
    distances = estimate_distances(subject_take.markers)
    has_swap = np.any(build_fault_mask(swaps, subject_take.visible.shape), axis=1)
    single_outliers = [
        outlier
        for outlier in body_outliers.select_dominant_outliers(outliers)
        if not has_swap[outlier.first : outlier.last + 1].any() and not is_body_wrong(outlier, residuals, distances)
    ]
    faults = swaps + [body_outliers.build_outlier_fault(each, subject_take, max_spike_duration_s) for each in single_outliers]
    shifts = marker_shifts.detect_marker_shifts(residuals, subject, motion, subject_take.rate)
    faulty_markers = {marker for fault in faults for marker in fault.markers}
    shift_faults = [
        marker_shifts.build_shift_fault(shift, subject_take)
        for shift in marker_shifts.select_dominant_shifts(shifts, subject)
        if not any(marker_shifts.are_joints_adjacent(subject, shift.marker, marker) for marker in faulty_markers)
    ]
    return sorted(faults + shift_faults, key=lambda fault: (fault.marker, fault.first))


def detect_epoch_faults(detection: DetectionState, body: BodyFit, options: DetectOptions) -> list[Fault]:
    """Detect faults against the body, with markers as indices into the take.

    Uncertain label swaps are left out, and so is everything within a burst of jitter that is already known.
    """
    epochs = detection.epochs
    inliers, solver_take = (
        epochs.take.select(body.marker_columns, epochs.split_mask(mask))
        for mask in (detection.inlier_mask, detection.solver_mask)
    )
    faults = detect_body_faults(
        inliers,
        solver_take.visible,
        body.extended_subject,
        body.motion,
        min_distance_m=options.min_spike_m,
        max_spike_duration_s=options.max_spike_duration_s,
    )
    take_marker = [int(epochs.column_marker[column]) if column >= 0 else -1 for column in body.marker_columns]
    mapped = [
        replace(fault, marker=take_marker[fault.marker], other_markers=tuple(take_marker[m] for m in fault.other_markers))
        for fault in faults
    ]
    has_jitter = build_fault_mask(detection.sample_faults.select_kinds("jitter"), detection.take.visible.shape)
    return [
        fault
        for fault in mapped
        if -1 not in fault.markers
        and not (fault.kind in LABEL_KINDS and fault.confidence < MIN_LABEL_CONFIDENCE)
        and (fault.kind in SHIFT_KINDS or not fault.meets_mask(has_jitter))
    ]


def find_unconfirmed_shifts(detection: DetectionState, body: BodyFit) -> list[Fault]:
    """Return the marker shifts after which the body carries the marker where it did before.

    There the joint or the skin moved, not the marker.
    """
    offsets = {
        int(column): body.extended_subject.marker_offsets[k] for k, column in enumerate(body.marker_columns) if column >= 0
    }
    unconfirmed: list[Fault] = []
    for fault in detection.sample_faults.select_kinds(*SHIFT_KINDS):
        before, after = (detection.epochs.find_column(fault.marker, frame) for frame in (fault.first - 1, fault.last))
        if fault.marker not in offsets:
            continue
        if after in offsets:
            change_m = np.linalg.norm(offsets[after] - offsets.get(before, np.inf))
            if change_m >= MIN_CONFIRMED_SHIFT_FRACTION * fault.severity:
                continue
        unconfirmed.append(fault)
    return unconfirmed
