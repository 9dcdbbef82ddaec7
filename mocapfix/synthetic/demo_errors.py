"""The table of the demo: the error of each method of filling on a composed take, by kind of damage."""

import numpy as np
from jaxtyping import Bool, Float
from scipy.interpolate import make_interp_spline

from mocapfix.result import CleaningResult
from mocapfix.stats.sequences import find_runs
from mocapfix.synthetic import SyntheticTake

MIN_ARM_MARKERS = 6  # missing at the same time: a whole arm
MAX_SHORT_GAP_S = 0.5  # half of all gaps are shorter; nine tenths of the missing samples are in longer gaps
SPLINE_DEGREES = (("linear", 1), ("cubic", 3))
MIN_SPLINE_SAMPLES = 5  # of a marker that is interpolated


def interpolate_markers(markers: Float[np.ndarray, "T M 3"], degree: int) -> Float[np.ndarray, "T M 3"]:
    """Return markers with gaps filled by a spline in time; at the ends of the take the nearest sample is repeated."""
    frames, filled = np.arange(len(markers)), markers.copy()
    for m in range(markers.shape[1]):
        is_visible = ~np.isnan(markers[:, m, 0])
        if not MIN_SPLINE_SAMPLES <= is_visible.sum() < len(markers):
            continue
        visible_frames = frames[is_visible]
        missing_frames = np.clip(frames[~is_visible], visible_frames[0], visible_frames[-1])
        filled[~is_visible, m] = make_interp_spline(visible_frames, markers[is_visible, m], k=degree)(missing_frames)
    return filled


def compute_fill_errors(truth: SyntheticTake, result: CleaningResult) -> dict[str, dict[str, float]]:
    """Return the root mean square error in mm by method (linear, cubic, mocapfix) and by kind of damage."""
    is_long = np.zeros_like(truth.missing_mask)
    for m in range(truth.missing_mask.shape[1]):
        for first, last in find_runs(truth.missing_mask[:, m]):
            is_long[first : last + 1, m] = (last - first + 1) / truth.rate >= MAX_SHORT_GAP_S
    is_arm = is_long & (is_long.sum(1) >= MIN_ARM_MARKERS)[:, None]
    damage = {
        f"gaps under {MAX_SHORT_GAP_S:g} s": truth.missing_mask & ~is_long,
        f"one marker lost for {MAX_SHORT_GAP_S:g} s and more": is_long & ~is_arm,
        "a whole arm lost": is_arm,
        "spikes": truth.spike_mask & ~truth.missing_mask,
    }
    methods = {degree_name: interpolate_markers(truth.damaged_positions, degree) for degree_name, degree in SPLINE_DEGREES}
    methods["mocapfix"] = result.take.markers
    return {
        method: {name: compute_rms_error_mm(markers, truth, mask) for name, mask in damage.items()}
        for method, markers in methods.items()
    }


def compute_rms_error_mm(markers: Float[np.ndarray, "T M 3"], truth: SyntheticTake, mask: Bool[np.ndarray, "T M"]) -> float:
    """Return the root mean square distance from the truth in mm over the visible samples in a mask."""
    distance_mm = np.linalg.norm(markers - truth.marker_positions, axis=-1)[mask] * 1e3
    return float(np.sqrt(np.nanmean(distance_mm**2)))
