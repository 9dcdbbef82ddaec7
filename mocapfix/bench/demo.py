"""The demo's table: how far each way of filling lies from the truth of a composed take."""

import numpy as np
from scipy.interpolate import make_interp_spline

from mocapfix.pipeline import Result
from mocapfix.synthetic import Truth
from mocapfix.take import runs

ARM = 6  # markers lost at once: an arm's
SHORT = 0.5  # seconds: half of all gaps are shorter, nine tenths of what is missing lies in longer ones


def interpolated(markers: np.ndarray, degree: int) -> np.ndarray:
    """-> markers (T, M, 3) with interior gaps filled in time alone, by a spline; at the ends the nearest is held."""
    frames, out = np.arange(len(markers)), markers.copy()
    for m in range(markers.shape[1]):
        seen = ~np.isnan(markers[:, m, 0])
        if not 4 < seen.sum() < len(markers):
            continue
        inside = np.clip(frames[~seen], frames[seen][0], frames[seen][-1])
        out[~seen, m] = make_interp_spline(frames[seen], markers[seen, m], k=degree)(inside)
    return out


def errors(truth: Truth, result: Result) -> dict[str, dict[str, float]]:
    """-> way of filling: damage: root mean square error in mm. Ways: linear, cubic, mocapfix."""
    long = np.zeros_like(truth.struck)
    for m in range(truth.struck.shape[1]):
        for first, last in runs(truth.struck[:, m]):
            long[first : last + 1, m] = (last - first + 1) / truth.rate >= SHORT
    arm = long & (long.sum(1) >= ARM)[:, None]
    damage = {
        f"gaps under {SHORT:g} s": truth.struck & ~long,
        f"one marker lost for {SHORT:g} s and more": long & ~arm,
        "a whole arm lost": arm,
        "spikes": truth.moved & ~truth.struck,
    }
    ways = {"linear": interpolated(truth.damaged, 1), "cubic": interpolated(truth.damaged, 3)}
    ways["mocapfix"] = result.take.markers
    return {way: {name: rms(markers, truth, where) for name, where in damage.items()} for way, markers in ways.items()}


def rms(markers: np.ndarray, truth: Truth, where: np.ndarray) -> float:
    """-> root mean square distance from the truth, mm, over the samples `where` (T, M) that are there."""
    distance = np.linalg.norm(markers - truth.markers, axis=-1)[where] * 1e3
    return float(np.sqrt(np.nanmean(distance**2)))
