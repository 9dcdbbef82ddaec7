"""The demo's table: how far each way of filling lies from the truth of a composed take."""

import numpy as np
from scipy.interpolate import make_interp_spline

from mocapfix.pipeline import CleaningResult
from mocapfix.stats.runs import find_runs
from mocapfix.synthetic import SyntheticTake

MIN_ARM_MARKERS = 6  # markers lost at once: an arm's
MAX_SHORT_GAP_S = 0.5  # seconds: half of all gaps are shorter, nine tenths of what is missing lies in longer ones


def interpolate_markers(markers: np.ndarray, degree: int) -> np.ndarray:
    """-> markers (T, M, 3) with interior gaps filled in time alone, by a spline; at the ends the nearest is held."""
    frames, out = np.arange(len(markers)), markers.copy()
    for m in range(markers.shape[1]):
        seen = ~np.isnan(markers[:, m, 0])
        if not 4 < seen.sum() < len(markers):
            continue
        inside = np.clip(frames[~seen], frames[seen][0], frames[seen][-1])
        out[~seen, m] = make_interp_spline(frames[seen], markers[seen, m], k=degree)(inside)
    return out


def compute_fill_errors(truth: SyntheticTake, result: CleaningResult) -> dict[str, dict[str, float]]:
    """-> way of filling: damage: root mean square error in mm. Ways: linear, cubic, mocapfix."""
    long = np.zeros_like(truth.missing_mask)
    for m in range(truth.missing_mask.shape[1]):
        for first, last in find_runs(truth.missing_mask[:, m]):
            long[first : last + 1, m] = (last - first + 1) / truth.rate >= MAX_SHORT_GAP_S
    arm = long & (long.sum(1) >= MIN_ARM_MARKERS)[:, None]
    damage = {
        f"gaps under {MAX_SHORT_GAP_S:g} s": truth.missing_mask & ~long,
        f"one marker lost for {MAX_SHORT_GAP_S:g} s and more": long & ~arm,
        "a whole arm lost": arm,
        "spikes": truth.spike_mask & ~truth.missing_mask,
    }
    ways = {"linear": interpolate_markers(truth.damaged_positions, 1), "cubic": interpolate_markers(truth.damaged_positions, 3)}
    ways["mocapfix"] = result.take.markers
    return {
        way: {name: compute_rms_error_mm(markers, truth, where) for name, where in damage.items()}
        for way, markers in ways.items()
    }


def compute_rms_error_mm(markers: np.ndarray, truth: SyntheticTake, mask: np.ndarray) -> float:
    """-> root mean square distance from the truth, mm, over the samples `where` (T, M) that are there."""
    distance = np.linalg.norm(markers - truth.marker_positions, axis=-1)[mask] * 1e3
    return float(np.sqrt(np.nanmean(distance**2)))
