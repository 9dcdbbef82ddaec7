"""Frozen markers: a marker keeps one value while its neighbours move, as some programs fill gaps.

The value is constant to the resolution of a 32-bit float. In a file of coarse integers the markers of a body at rest are
constant as well, but then their neighbours move by a few of these integers at most.
"""

import numpy as np

from mocapfix.detect.exact_samples import compute_float_resolution, estimate_resolution, find_exact_stretches
from mocapfix.detect.marker_distances import estimate_distance_changes
from mocapfix.faults import Fault
from mocapfix.take import Take

# Number of visible neighbours, those with the steadiest distances, whose travel is compared.
MAX_COMPARED_NEIGHBOURS = 3
# Number of samples of the shortest stretch.
MIN_FROZEN_SAMPLES = 4
# Travel of the neighbours of a marker at rest, in multiples of the file's resolution.
MIN_NEIGHBOUR_TRAVEL_RESOLUTIONS = 50.0


def detect_frozen(take: Take, min_duration_s: float = 0.1, min_neighbour_travel_m: float = 0.002) -> list[Fault]:
    """Detect stretches in which a marker keeps one value while its neighbours move.

    Args:
        take: The measured samples.
        min_duration_s: Duration of the shortest stretch.
        min_neighbour_travel_m: Distance that each compared neighbour travels.

    Returns:
        The faults, ordered by marker and first frame. Their severity is the median travel of the neighbours in metres.
    """
    resolution = compute_float_resolution(take.markers)
    length = max(MIN_FROZEN_SAMPLES, round(min_duration_s * take.rate))
    stretches = [
        (m, first, last)
        for m in range(len(take.labels))
        for first, last in find_exact_stretches(take.markers[:, m], 0, length, resolution)
    ]
    if not stretches:
        return []
    min_travel_m = max(min_neighbour_travel_m, MIN_NEIGHBOUR_TRAVEL_RESOLUTIONS * estimate_resolution(take.markers))
    neighbours = np.argsort(estimate_distance_changes(take.markers, take.rate), axis=1)[:, :-1]
    faults: list[Fault] = []
    for marker, first, last in stretches:
        travel_m = _measure_neighbour_travel(take.markers[first : last + 1, neighbours[marker]])
        if len(travel_m) and travel_m.min() >= min_travel_m:
            faults.append(_build_frozen_fault(take, marker, (first, last), travel_m, min_travel_m))
    return faults


def _measure_neighbour_travel(markers: np.ndarray) -> np.ndarray:
    """Measure how far, in metres, the first few markers (T, M, 3) that are visible at least half the time travel."""
    near = markers[:, (~np.isnan(markers[..., 0])).mean(0) >= 0.5][:, :MAX_COMPARED_NEIGHBOURS]
    start = near[(~np.isnan(near[..., 0])).argmax(0), np.arange(near.shape[1])]
    return np.nanmax(np.linalg.norm(near - start, axis=-1), axis=0)


def _build_frozen_fault(
    take: Take, marker: int, interval: tuple[int, int], neighbour_travel_m: np.ndarray, min_travel_m: float
) -> Fault:
    first, last = interval
    first += int(first > 0 and take.visible[first - 1, marker])  # the first sample of the constant value was measured
    severity, duration_s = float(np.median(neighbour_travel_m)), (last - first + 1) / take.rate
    label = take.bare_labels[marker]
    reason = f"{label} keeps one value for {duration_s:.2f} s while its neighbours move by {severity * 1e3:.0f} mm."
    confidence = 1 - min_travel_m / (min_travel_m + float(neighbour_travel_m.min()))
    return Fault("stuck", marker, first, last, severity, reason, confidence)
