"""Stuck: a marker held at one value while its neighbours move on, as other tools fill gaps.

Held means to the last digit of a 32-bit float. In a file of coarse integers a body at rest holds its markers, too; but then
the markers that keep their distance to it rest with it, to a few of these integers.
"""

import numpy as np

from mocapfix.detect.exact_samples import compute_float_resolution, estimate_resolution, find_exact_stretches
from mocapfix.detect.marker_distances import estimate_distance_changes
from mocapfix.faults import Fault
from mocapfix.take import Take

MAX_COMPARED_NEIGHBOURS = 3  # of the neighbours seen meanwhile, those that keep their distance to the marker best
MIN_FROZEN_SAMPLES = 4  # samples
MIN_NEIGHBOUR_TRAVEL_RESOLUTIONS = (
    50.0  # times the last digit of what the file shows: what the neighbours of a marker at rest may go
)


def detect_frozen(take: Take, min_duration_s: float = 0.1, min_neighbour_travel_m: float = 0.002) -> list[Fault]:
    """-> every stretch of `shortest` seconds or longer in which a marker is held while its neighbours go `smallest` metres or
    farther, by marker and first frame."""
    digit, length = compute_float_resolution(take.markers), max(MIN_FROZEN_SAMPLES, round(min_duration_s * take.rate))
    held = [(m, *s) for m in range(len(take.labels)) for s in find_exact_stretches(take.markers[:, m], 0, length, digit)]
    if not held:
        return []
    min_neighbour_travel_m = max(min_neighbour_travel_m, MIN_NEIGHBOUR_TRAVEL_RESOLUTIONS * estimate_resolution(take.markers))
    near = np.argsort(estimate_distance_changes(take.markers, take.rate), axis=1)[:, :-1]
    faults = []
    for marker, first, last in held:
        gone = _measure_neighbour_travel(take.markers[first : last + 1, near[marker]])
        if len(gone) and gone.min() >= min_neighbour_travel_m:
            faults.append(_build_frozen_fault(take, marker, first, last, gone, min_neighbour_travel_m))
    return faults


def _measure_neighbour_travel(markers: np.ndarray) -> np.ndarray:
    """-> metres: how far the first few of `markers` (T, M, 3) that are seen at least half the time go from where they began."""
    near = markers[:, (~np.isnan(markers[..., 0])).mean(0) >= 0.5][:, :MAX_COMPARED_NEIGHBOURS]
    began = near[(~np.isnan(near[..., 0])).argmax(0), np.arange(near.shape[1])]
    return np.nanmax(np.linalg.norm(near - began, axis=-1), axis=0)


def _build_frozen_fault(
    take: Take, marker: int, first: int, last: int, neighbour_travel_m: np.ndarray, min_neighbour_travel_m: float
) -> Fault:
    first += int(first > 0 and take.visible[first - 1, marker])  # the value that is held was measured
    severity, seconds = float(np.median(neighbour_travel_m)), (last - first + 1) / take.rate
    meanwhile = f"while the markers about it go {severity * 1e3:.0f} mm"
    reason = f"{take.bare_labels[marker]} is held at one value for {seconds:.2f} s {meanwhile}."
    return Fault(
        "stuck",
        marker,
        first,
        last,
        severity,
        reason,
        1 - min_neighbour_travel_m / (min_neighbour_travel_m + float(neighbour_travel_m.min())),
    )
