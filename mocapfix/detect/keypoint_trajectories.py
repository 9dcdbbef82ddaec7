"""Detection on the trajectories of 3-D keypoints: exchanged sides, outliers and noise, in place of the detectors of markers."""

from dataclasses import replace

import numpy as np

from mocapfix.detect import gaps
from mocapfix.detect.keypoint_noise import estimate_noise_sd, smooth_point
from mocapfix.detect.keypoint_swaps import detect_keypoint_swaps
from mocapfix.faults import Fault, FaultKind, Faults
from mocapfix.fill.gap_filling import compute_editable_mask
from mocapfix.options import CleanOptions
from mocapfix.repair.relabel import undo_label_exchanges
from mocapfix.state import CleaningState, DetectionState
from mocapfix.stats.sequences import find_runs
from mocapfix.take import Take

KEYPOINT_NOTE = (
    "The points are keypoints, not markers: the body was fitted to their smooth paths, less {noise_mm:.0f} mm of noise per axis "
    "(median over the points)."
)


def detect_on_keypoints(state: CleaningState, options: CleanOptions) -> CleaningState:
    """Correct exchanged sides, find outliers, and remove the noise of the take. Sets `detection` of the state."""
    assert state.marker_set is not None
    marker_set, original = state.marker_set, state.original_take
    noise_sd_m = estimate_noise_sd(original.markers)
    swaps = [fault for fault in detect_keypoint_swaps(original, marker_set, noise_sd_m) if state.accepts_fault(fault)]
    take = undo_label_exchanges(original, swaps)
    markers, is_editable = take.markers.copy(), compute_editable_mask(original, options.fill)
    outliers: list[Fault] = []
    for m in range(len(take.labels)):
        smoothed = smooth_point(take.markers[:, m], float(noise_sd_m[m]), take.rate, marker_set.point_sd)
        found = [
            _build_outlier_fault(take, m, first, last, smoothed.path, options.detect.max_spike_duration_s)
            for first, last in find_runs(smoothed.is_outlier)
        ]
        accepted = [fault for fault in found if state.accepts_fault(fault)]
        outliers += accepted
        is_smoothed = is_editable[:, m] & take.measured[:, m] & ~smoothed.is_outlier
        markers[is_smoothed, m] = smoothed.path[is_smoothed]
    take = take.replace_markers(markers)
    lost = gaps.detect_lost_segments(take, marker_set)
    missing = [fault for fault in (*gaps.detect_gaps(take), *lost) if state.accepts_fault(fault)]
    faults = Faults().add_faults([*missing, *outliers])
    note = KEYPOINT_NOTE.format(noise_mm=float(np.median(noise_sd_m)) * 1e3)
    return replace(state, detection=DetectionState(take, tuple(swaps), faults), notes=(*state.notes, note))


def _build_outlier_fault(take: Take, marker: int, first: int, last: int, path: np.ndarray, max_spike_duration_s: float) -> Fault:
    distance_m = float(np.linalg.norm(take.markers[first : last + 1, marker] - path[first : last + 1], axis=-1).max())
    count = last - first + 1
    kind: FaultKind = "spike" if count <= max(1, max_spike_duration_s * take.rate) else "ghost"
    reason = (
        f"{take.bare_labels[marker]} lies {distance_m * 1e3:.0f} mm off its path for {count} frame{'s' * (count > 1)}, more than "
        "its noise explains."
    )
    return Fault(kind, marker, first, last, distance_m, reason)
