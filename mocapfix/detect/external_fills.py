"""Fills of other programs: samples that no camera measured.

`detect_virtual_samples` reads them from the file's own marks. The other detectors find samples that follow a polynomial
exactly. A measured marker has noise of some tenths of a millimetre, and its coordinates have a last digit: no polynomial fits a
tenth of a second of them to the file's resolution. In a file of coarse integers a longer stretch is needed to tell the two
apart, and for a marker at rest it is impossible.

A frozen marker keeps one value while its neighbours move. In a file of coarse integers the markers of a body at rest are
constant as well, but then their neighbours move by a few of these integers at most.

Such samples are no evidence for the solve. Whether they are as good as this program's own estimates is decided after the fill.
"""

from collections.abc import Iterator
from functools import lru_cache

import numpy as np
from jaxtyping import Float, Int
from numpy.lib.stride_tricks import sliding_window_view

from mocapfix.detect.noise import RoundMemory
from mocapfix.model.faults import Fault
from mocapfix.model.take import Take
from mocapfix.stats.sequences import compute_float_resolution, estimate_resolution, find_runs, sample_evenly


def compute_polynomial_misfits(
    paths: Float[np.ndarray, "T *M 3"], degree: int, length: int, starts: Int[np.ndarray, " S"]
) -> Float[np.ndarray, " S *M"]:
    """Compute by how much the best polynomial misses any of the `length` samples from each start on.

    Args:
        paths: World positions in metres, NaN where missing, which makes the misfit NaN.
        length: Number of samples of a stretch.
        starts: Index of the first sample of each stretch.

    Returns:
        The largest absolute residual of a coordinate in metres.
    """
    return _measure_misfits(sliding_window_view(paths, length, axis=0)[starts], degree)


def _measure_misfits(stretches: np.ndarray, degree: int) -> np.ndarray:
    """Measure the misfits (...) of stretches (..., 3, length), as `compute_polynomial_misfits`."""
    basis = _build_polynomial_basis(degree, stretches.shape[-1])
    return np.abs(stretches - stretches @ basis @ basis.T).max((-2, -1))


@lru_cache(maxsize=64)
def _build_polynomial_basis(degree: int, length: int) -> Float[np.ndarray, "length terms"]:
    """Build orthonormal columns that span the polynomials of a degree over `length` samples."""
    return np.linalg.qr(np.vander(np.linspace(-1, 1, length), degree + 1))[0]


def find_exact_stretches(path: Float[np.ndarray, "T 3"], degree: int, length: int, resolution: float) -> list[tuple[int, int]]:
    """Return the longest stretches (first, last) of at least `length` samples that one polynomial fits to the resolution in m."""
    if len(path) < length:
        return []
    # The finite difference of order degree + 1, with samples as far apart as fit, vanishes for such a polynomial.
    # It rejects most stretches before the polynomial is fitted.
    spacing, order = (length - 1) // (degree + 1), degree + 1
    start_count = len(path) - length + 1
    candidates = np.arange(start_count)
    for coordinate in path.T:
        difference, weight = np.zeros(start_count), 1.0
        for k in range(order + 1):
            difference += weight * coordinate[k * spacing : k * spacing + start_count]
            weight *= -(order - k) / (k + 1)
        candidates = candidates[np.abs(difference[candidates]) <= 2**order * resolution]
        if not len(candidates):
            return []
    is_exact = np.zeros(start_count, bool)
    is_exact[candidates] = compute_polynomial_misfits(path, degree, length, candidates) <= resolution
    stretches = ((first, last + length - 1) for first, last in find_runs(is_exact))
    return [(a, b) for a, b in stretches if _measure_misfits(path[a : b + 1].T, degree) <= resolution]


POLYNOMIAL_NAMES = {1: "line", 2: "parabola", 3: "cubic"}
MIN_STRETCH_S = 0.1  # duration of the shortest stretch
MIN_EXTRA_SAMPLES = 4  # number of samples beyond those that every polynomial of the degree fits
STRETCH_LENGTH_FACTORS = (1, 2, 4)  # multiples of the shortest stretch that are tried until measured samples can be told apart
# Number of stretches of a marker, evenly spread, at which the length is tested, and the quantile of their misfits that is used.
MAX_SAMPLED_STRETCHES = 50
SMALL_MISFIT_QUANTILE = 0.1
MIN_MEASURED_MISFIT_RESOLUTIONS = 4.0  # smallest median of these quantiles over the markers, in resolutions of the file
# Time before and after a stretch with which it is compared, and the quantile of the misfits there that is used.
COMPARISON_WINDOW_S = 1.0
COMPARISON_QUANTILE = 0.25
MIN_NEARBY_MISFIT_RESOLUTIONS = 8.0  # smallest misfit of the samples around a stretch, in multiples of the file's resolution
MIN_TRAVEL_RESOLUTIONS = 100.0  # a marker that travels less over a stretch, in multiples of the file's resolution, is at rest


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


def detect_polynomial_fills(take: Take, memory: RoundMemory | None = None) -> list[Fault]:
    """Detect the stretches of at least MIN_STRETCH_S that lie exactly on a line, parabola or cubic.

    Returns:
        One fault for each stretch, without the measured samples that it connects, ordered by marker and first frame. Its
        severity is the misfit in metres of such a polynomial to the samples around the stretch.
    """
    resolution = estimate_resolution(take.markers)
    faults: list[Fault] = []
    for degree in POLYNOMIAL_NAMES:
        min_length = max(degree + 1 + MIN_EXTRA_SAMPLES, round(MIN_STRETCH_S * take.rate))
        length = _choose_stretch_length(take, degree, resolution, min_length)
        if length:
            stretches = _find_exact_stretches(take, degree, length, resolution, memory or RoundMemory())
            faults += _select_fills(take, degree, stretches, resolution)
    return _remove_overlapping_fills(faults)


def _find_exact_stretches(
    take: Take, degree: int, length: int, resolution: float, memory: RoundMemory
) -> list[tuple[int, int, int]]:
    """Find the marker, the first and the last frame of each stretch, as `find_exact_stretches`."""
    found = memory.recall(
        ("stretches", degree, length, resolution),
        take.visible,
        lambda m: find_exact_stretches(take.markers[:, m], degree, length, resolution),
        can_appear=False,
    )
    return [(m, first, last) for m, stretches in enumerate(found) for first, last in stretches]


def _select_fills(take: Take, degree: int, stretches: list[tuple[int, int, int]], resolution: float) -> Iterator[Fault]:
    for marker, first, last in stretches:
        path = take.markers[:, marker]
        if np.ptp(path[first : last + 1], axis=0).max() <= MIN_TRAVEL_RESOLUTIONS * resolution:
            continue
        misfit_m = _estimate_nearby_misfit(path, degree, first, last, round(COMPARISON_WINDOW_S * take.rate))
        if misfit_m > MIN_NEARBY_MISFIT_RESOLUTIONS * resolution:
            # The measured samples that a fill connects are its ends; next to a gap it connects to nothing.
            first += int(first > 0 and take.visible[first - 1, marker])
            last -= int(last + 1 < take.frame_count and take.visible[last + 1, marker])
            duration_s, label = (last - first + 1) / take.rate, take.bare_labels[marker]
            fill = f"{label} lies on an exact {POLYNOMIAL_NAMES[degree]} for {duration_s:.2f} s, as other programs fill gaps"
            reason = f"{fill}; the measured samples around it deviate from one by {misfit_m * 1e3:.2g} mm."
            yield Fault("straight", marker, first, last, misfit_m, reason, 1 - resolution / misfit_m)


def _choose_stretch_length(take: Take, degree: int, resolution: float, length: int) -> int:
    """Choose the number of samples at which measured stretches differ from exact ones, 0 if the largest factor is too short."""
    for longer in (factor * length for factor in STRETCH_LENGTH_FACTORS if take.frame_count >= factor * length):
        starts = sample_evenly(take.frame_count - longer + 1, MAX_SAMPLED_STRETCHES)
        misfit_m = np.sort(compute_polynomial_misfits(take.markers, degree, longer, starts), axis=0)  # NaN sorts last
        known = [each[:count] for each, count in zip(misfit_m.T, (~np.isnan(misfit_m)).sum(0), strict=True) if count]
        small_m = [np.interp(SMALL_MISFIT_QUANTILE * (len(each) - 1), np.arange(len(each)), each) for each in known]
        if small_m and np.median(small_m) > MIN_MEASURED_MISFIT_RESOLUTIONS * resolution:
            return longer
    return 0


def _estimate_nearby_misfit(path: np.ndarray, degree: int, first: int, last: int, window: int) -> float:
    """Estimate the misfit (m) of such a polynomial to other stretches within `window` frames, infinite without any."""
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


MAX_FRAME_PAIRS = 300  # number of pairs of frames, evenly spread, from which the changes of distances are learned
MIN_VISIBLE_FRAME_PAIRS = 20  # number of these pairs in which both markers must be visible
DISTANCE_CHANGE_INTERVAL_S = 1.0  # time between the frames of a pair, or half the take if that is shorter
# Quantile of the changes that is returned: about one standard deviation of a normal distribution.
DISTANCE_CHANGE_QUANTILE = 0.84
MAX_COMPARED_NEIGHBOURS = 3
MIN_NEIGHBOUR_TRAVEL_M = 0.002  # distance that each compared neighbour travels
MIN_FROZEN_SAMPLES = 4  # number of samples of the shortest stretch
MIN_NEIGHBOUR_TRAVEL_RESOLUTIONS = 50.0  # travel of the neighbours of a marker at rest, in multiples of the file's resolution


def detect_frozen(take: Take, memory: RoundMemory | None = None) -> list[Fault]:
    """Detect stretches in which a marker keeps one value while its neighbours move.

    Returns:
        The faults, ordered by marker and first frame. Their severity is the median travel of the neighbours in metres.
    """
    resolution = compute_float_resolution(take.markers)
    length = max(MIN_FROZEN_SAMPLES, round(MIN_STRETCH_S * take.rate))
    stretches = _find_exact_stretches(take, 0, length, resolution, memory or RoundMemory())
    if not stretches:
        return []
    min_travel_m = max(MIN_NEIGHBOUR_TRAVEL_M, MIN_NEIGHBOUR_TRAVEL_RESOLUTIONS * estimate_resolution(take.markers))
    neighbours = np.argsort(estimate_distance_changes(take.markers, take.rate), axis=1)[:, :-1]
    faults: list[Fault] = []
    for marker, first, last in stretches:
        markers = take.markers[first : last + 1, neighbours[marker]]
        near = markers[:, (~np.isnan(markers[..., 0])).mean(0) >= 0.5][:, :MAX_COMPARED_NEIGHBOURS]
        start = near[(~np.isnan(near[..., 0])).argmax(0), np.arange(near.shape[1])]
        travel_m = np.nanmax(np.linalg.norm(near - start, axis=-1), axis=0)
        if not len(travel_m) or travel_m.min() < min_travel_m:
            continue
        first += int(first > 0 and take.visible[first - 1, marker])  # the first sample of the constant value was measured
        severity, duration_s = float(np.median(travel_m)), (last - first + 1) / take.rate
        label, confidence = take.bare_labels[marker], 1 - min_travel_m / (min_travel_m + float(travel_m.min()))
        reason = f"{label} keeps one value for {duration_s:.2f} s while its neighbours move by {severity * 1e3:.0f} mm."
        faults.append(Fault("stuck", marker, first, last, severity, reason, confidence))
    return faults


def estimate_distance_changes(markers: Float[np.ndarray, "T M 3"], rate: float) -> Float[np.ndarray, "M M"]:
    """Estimate by how much the distances between markers change within a second.

    Unlike the standard deviation of a distance, this ignores a marker that moves on its segment once, and responds to
    joints and skin.

    Returns:
        The usual change in metres. Infinite for markers that are hardly ever visible together, and for a marker and itself.
    """
    frames, count = markers.shape[:2]
    usual_change = np.full((count, count), np.inf)
    lag = min(round(DISTANCE_CHANGE_INTERVAL_S * rate), frames // 2)
    starts = sample_evenly(frames - lag, MAX_FRAME_PAIRS) if lag else np.zeros(0, int)
    before, after = markers[starts], markers[starts + lag]
    for i in range(1, count):
        old, new = (np.linalg.norm(sample[:, :i] - sample[:, i, None], axis=-1) for sample in (before, after))
        change = np.sort(np.abs(new - old), axis=0)  # NaN sorts last
        visible_count = (~np.isnan(change)).sum(0)
        others = np.flatnonzero(visible_count >= min(MIN_VISIBLE_FRAME_PAIRS, max(2, len(starts))))
        row = np.rint(DISTANCE_CHANGE_QUANTILE * (visible_count[others] - 1)).astype(int)
        usual_change[i, others] = usual_change[others, i] = change[row, others]
    return usual_change
