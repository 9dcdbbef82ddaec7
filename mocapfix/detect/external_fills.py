"""Fills of other programs: samples that no camera measured.

`detect_virtual_samples` reads them from the file's own marks. `detect_polynomial_fills` finds samples on an exact line,
parabola or cubic. No polynomial fits a measured tenth of a second to the file's resolution, because cameras have noise and
bodies do not move along polynomials. In a file of coarse integers a longer stretch is needed to tell the two apart, and for
a marker at rest it is impossible.

Such samples are no evidence for the solve. Whether they are as good as this program's own estimates is decided after the
fill.
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
from mocapfix.stats.sequences import find_runs
from mocapfix.take import Take

POLYNOMIAL_NAMES = {1: "line", 2: "parabola", 3: "cubic"}
# Number of samples beyond those that every polynomial of the degree fits.
MIN_EXTRA_SAMPLES = 4
# Multiples of the shortest stretch that are tried until measured samples can be told apart.
STRETCH_LENGTH_FACTORS = (1, 2, 4)
# Number of stretches of a marker, evenly spread, at which the length is tested, and the quantile of their misfits that is used.
MAX_SAMPLED_STRETCHES = 50
SMALL_MISFIT_QUANTILE = 0.1
# Smallest median of these quantiles over the markers, in multiples of the file's resolution.
MIN_MEASURED_MISFIT_RESOLUTIONS = 4.0
# Time before and after a stretch with which it is compared, and the quantile of the misfits there that is used.
COMPARISON_WINDOW_S = 1.0
COMPARISON_QUANTILE = 0.25
# Smallest misfit of the samples around a stretch, in multiples of the file's resolution.
MIN_NEARBY_MISFIT_RESOLUTIONS = 8.0
# A marker that travels less over a stretch, in multiples of the file's resolution, is at rest.
MIN_TRAVEL_RESOLUTIONS = 100.0


def detect_virtual_samples(take: Take) -> list[Fault]:
    """Detect the samples that no camera captured according to the file, and that this program did not fill.

    Returns:
        One fault for each stretch, ordered by marker and first frame. Its severity is the distance in metres between the
        stretch's first and last sample.
    """
    if take.uncaptured is None:
        return []
    is_virtual = take.uncaptured & take.measured
    faults: list[Fault] = []
    for m, label in enumerate(take.bare_labels):
        for first, last in find_runs(is_virtual[:, m]):
            travel_m = float(np.linalg.norm(take.markers[last, m] - take.markers[first, m]))
            duration = f"{(last - first + 1) / take.rate:.2f} s"
            reason = f"According to the file, no camera captured {label} for {duration}: another program filled it."
            faults.append(Fault("computed", m, first, last, travel_m, reason))
    return faults


def detect_polynomial_fills(take: Take, min_duration_s: float = 0.1) -> list[Fault]:
    """Detect the stretches of at least `min_duration_s` that lie exactly on a line, parabola or cubic.

    Returns:
        One fault for each stretch, without the measured samples that it connects, ordered by marker and first frame. Its
        severity is the misfit in metres of such a polynomial to the samples around the stretch.
    """
    resolution = estimate_resolution(take.markers)
    faults: list[Fault] = []
    for degree in POLYNOMIAL_NAMES:
        min_length = max(degree + 1 + MIN_EXTRA_SAMPLES, round(min_duration_s * take.rate))
        length = _choose_stretch_length(take.markers, degree, resolution, min_length)
        if length:
            for m in range(len(take.labels)):
                faults += _detect_marker_fills(take, m, degree, length, resolution)
    return _remove_overlapping_fills(faults)


def _detect_marker_fills(take: Take, marker: int, degree: int, length: int, resolution: float) -> Iterator[Fault]:
    path = take.markers[:, marker]
    for first, last in find_exact_stretches(path, degree, length, resolution):
        if np.ptp(path[first : last + 1], axis=0).max() <= MIN_TRAVEL_RESOLUTIONS * resolution:
            continue
        misfit_m = _estimate_nearby_misfit(path, degree, first, last, round(COMPARISON_WINDOW_S * take.rate))
        if misfit_m > MIN_NEARBY_MISFIT_RESOLUTIONS * resolution:
            first, last = trim_measured_ends(take.visible[:, marker], first, last)
            duration_s, label = (last - first + 1) / take.rate, take.bare_labels[marker]
            fill = f"{label} lies on an exact {POLYNOMIAL_NAMES[degree]} for {duration_s:.2f} s, as other programs fill gaps"
            reason = f"{fill}; the measured samples around it deviate from one by {misfit_m * 1e3:.2g} mm."
            yield Fault("straight", marker, first, last, misfit_m, reason, 1 - resolution / misfit_m)


def _choose_stretch_length(markers: np.ndarray, degree: int, resolution: float, length: int) -> int:
    """Choose the number of samples at which measured stretches differ from exact ones, 0 if the largest factor is too short."""
    for longer in (factor * length for factor in STRETCH_LENGTH_FACTORS if len(markers) >= factor * length):
        starts = np.unique(np.linspace(0, len(markers) - longer, MAX_SAMPLED_STRETCHES).astype(int))
        misfits = [compute_polynomial_misfits(markers[:, m], degree, longer, starts) for m in range(markers.shape[1])]
        small = [np.quantile(each[~np.isnan(each)], SMALL_MISFIT_QUANTILE) for each in misfits if not np.isnan(each).all()]
        if small and np.median(small) > MIN_MEASURED_MISFIT_RESOLUTIONS * resolution:
            return longer
    return 0


def _estimate_nearby_misfit(path: np.ndarray, degree: int, first: int, last: int, window: int) -> float:
    """Estimate the misfit in metres of such a polynomial to stretches of the same length within `window` frames.

    Infinite if there are none.
    """
    length = last - first + 1
    starts = np.arange(max(0, first - length - window), min(len(path) - length, last + window) + 1)
    misfit = compute_polynomial_misfits(path, degree, length, starts[np.abs(starts - first) > length // 2])
    misfit = misfit[~np.isnan(misfit)]
    return float(np.quantile(misfit, COMPARISON_QUANTILE)) if len(misfit) else np.inf


def _remove_overlapping_fills(faults: list[Fault]) -> list[Fault]:
    """Keep the longest of the fills that overlap, and of equally long ones that of the lowest degree."""
    known_frames: dict[int, set[int]] = {}
    kept: list[Fault] = []
    for fault in sorted(faults, key=lambda fault: fault.first - fault.last):
        frames = range(fault.first, fault.last + 1)
        known = known_frames.setdefault(fault.marker, set())
        if 2 * len(known.intersection(frames)) < len(frames):
            known.update(frames)
            kept.append(fault)
    return sorted(kept, key=lambda fault: (fault.marker, fault.first))
