"""Computed: samples that no camera saw, by the file's own account; another program put them there.

They are no evidence. Whether they are as good as what the others tell is found out when these are asked.
"""

from collections.abc import Iterator

import numpy as np

from mocapfix.detect.exact_samples import (
    compute_polynomial_misfits,
    estimate_resolution,
    find_exact_stretches,
    trim_measured_ends,
)
from mocapfix.faults import Fault
from mocapfix.stats.runs import find_runs
from mocapfix.take import Take


# MERGED: mocapfix.detect.computed
def detect_virtual_samples(take: Take) -> list[Fault]:
    """-> every stretch without cameras that this program did not put there, by marker and first frame; severity is the way that
    the marker goes from its first sample to its last, in metres."""
    if take.uncaptured is None:
        return []
    blind, faults = take.uncaptured & take.measured, []
    for m, label in enumerate(take.bare_labels):
        for first, last in find_runs(blind[:, m]):
            way = float(np.linalg.norm(take.markers[last, m] - take.markers[first, m]))
            seconds = f"{(last - first + 1) / take.rate:.2f} s"
            reason = f"No camera saw {label} for {seconds}, by the file itself: another program put these samples there."
            faults.append(Fault("computed", m, first, last, way, reason))
    return faults


# MERGED: mocapfix.detect.straight
# Straight: samples on one exact line, parabola or cubic, as other tools fill gaps.
#
# Through any measured tenth of a second a cubic runs past the samples by far more than the file's last digit, for cameras
# are not exact and bodies not smooth. Where it hits them all, they were computed. In a file of coarse integers that takes a
# longer stretch to tell, and of a marker at rest nothing can be told.
POLYNOMIAL_NAMES = {1: "line", 2: "parabola", 3: "cubic"}
MIN_EXTRA_SAMPLES = 4  # samples more than such a polynomial hits anyway
STRETCH_LENGTH_FACTORS = (1, 2, 4)  # times the shortest stretch: what is tried until measured samples can be told
MAX_SAMPLED_STRETCHES, SMALL_MISFIT_QUANTILE = (
    50,
    0.1,
)  # stretches of a marker, evenly spread, and the part of them that may be as exact by chance
MIN_MEASURED_MISFIT_RESOLUTIONS = (
    4.0  # times the last digit: what the polynomial misses the others of half of the markers by at least
)
COMPARISON_WINDOW_S = 1.0  # seconds before and after a stretch from which it is known how exact the marker is there
COMPARISON_QUANTILE = 0.25  # of the stretches there may be as exact, by other fills or by chance
MIN_NEARBY_MISFIT_RESOLUTIONS = 8.0  # times the last digit: what the polynomial misses the others there by at least
MIN_TRAVEL_RESOLUTIONS = 100.0  # times the last digit: what a marker goes at least, or it stands rather than goes straight


def detect_polynomial_fills(take: Take, min_duration_s: float = 0.1) -> list[Fault]:
    """-> exactly straight stretches of `shortest` seconds or longer, without the samples that they join, by marker and frame."""
    digit = estimate_resolution(take.markers)
    faults = []
    for degree in POLYNOMIAL_NAMES:
        length = _choose_stretch_length(
            take.markers, degree, digit, max(degree + 1 + MIN_EXTRA_SAMPLES, round(min_duration_s * take.rate))
        )
        if length:
            for m in range(len(take.labels)):
                faults += _detect_marker_fills(take, m, degree, length, digit)
    return _remove_overlapping_fills(faults)


def _detect_marker_fills(take: Take, marker: int, degree: int, length: int, resolution: float) -> Iterator[Fault]:
    path = take.markers[:, marker]
    for first, last in find_exact_stretches(path, degree, length, resolution):
        if np.ptp(path[first : last + 1], axis=0).max() > MIN_TRAVEL_RESOLUTIONS * resolution:
            usual = _estimate_nearby_misfit(path, degree, first, last, round(COMPARISON_WINDOW_S * take.rate))
            if usual > MIN_NEARBY_MISFIT_RESOLUTIONS * resolution:
                first, last = trim_measured_ends(take.visible[:, marker], first, last)
                seconds, name = (last - first + 1) / take.rate, take.bare_labels[marker]
                why = f"{name} lies on an exact {POLYNOMIAL_NAMES[degree]} for {seconds:.2f} s, as other programs fill gaps"
                reason = f"{why}; what was measured thereabouts is {usual * 1e3:.2g} mm off one."
                yield Fault("straight", marker, first, last, usual, reason, 1 - resolution / usual)


def _choose_stretch_length(markers: np.ndarray, degree: int, resolution: float, length: int) -> int:
    """-> how many samples a stretch needs so that measured ones can be told, 0 where that is more than LONGER says."""
    for longer in (longer * length for longer in STRETCH_LENGTH_FACTORS if len(markers) >= longer * length):
        starts = np.unique(np.linspace(0, len(markers) - longer, MAX_SAMPLED_STRETCHES).astype(int))
        missed = [compute_polynomial_misfits(markers[:, m], degree, longer, starts) for m in range(markers.shape[1])]
        quiet = [np.quantile(each[~np.isnan(each)], SMALL_MISFIT_QUANTILE) for each in missed if not np.isnan(each).all()]
        if quiet and np.median(quiet) > MIN_MEASURED_MISFIT_RESOLUTIONS * resolution:
            return longer
    return 0


def _estimate_nearby_misfit(path: np.ndarray, degree: int, first: int, last: int, window: int) -> float:
    """-> metres: by how much such a polynomial misses most samples `about` the stretch (frames), over a stretch as long.

    Infinite where there are none.
    """
    length = last - first + 1
    starts = np.arange(max(0, first - length - window), min(len(path) - length, last + window) + 1)
    missed = compute_polynomial_misfits(path, degree, length, starts[np.abs(starts - first) > length // 2])
    missed = missed[~np.isnan(missed)]
    return float(np.quantile(missed, COMPARISON_QUANTILE)) if len(missed) else np.inf


def _remove_overlapping_fills(faults: list[Fault]) -> list[Fault]:
    """-> the longest of those that overlap, by marker and first frame; of two as long, the one of the lower degree."""
    told: dict[int, set[int]] = {}
    kept = []
    for fault in sorted(faults, key=lambda fault: fault.first - fault.last):
        frames = range(fault.first, fault.last + 1)
        known = told.setdefault(fault.marker, set())
        if 2 * len(known.intersection(frames)) < len(frames):
            known.update(frames)
            kept.append(fault)
    return sorted(kept, key=lambda fault: (fault.marker, fault.first))
