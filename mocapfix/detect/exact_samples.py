"""Samples that follow a rule to the last digit: cameras do not measure such, other tools' fills leave them.

A measured marker trembles by some tenths of a millimetre, and the number that says where it is has a last digit. Samples
held at one value, or laid on a line or a cubic, follow these to that digit.
"""

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from mocapfix.stats.runs import find_runs

FLOAT32_RESOLUTION = 2.0**-23  # of a coordinate: the last digit of the 32-bit floats in which files keep them
MAX_SAMPLED_STEPS = 50_000  # steps looked at, evenly spread, to tell whether all coordinates are multiples of one number
STEP_QUANTILES = (2e-4, 2e-3, 1e-2)  # of the steps are smaller than one that may be the number, one multiple of itself
MIN_MULTIPLE_FRACTION, MULTIPLE_TOLERANCE = (
    0.9,
    0.1,
)  # of the steps that lie so near a multiple, as a part of it, where chance would lay one in five


def estimate_resolution(markers: np.ndarray) -> float:
    """-> metres: the smallest difference that the coordinates of `markers` (T, M, 3) show.

    A file of integers keeps multiples of its scale, and so does what was converted from one, whatever it says of itself.
    """
    digit = compute_float_resolution(markers)
    steps = np.abs(np.diff(markers, axis=0)).ravel()
    steps = steps[steps > digit]
    if len(steps) == 0:
        return digit
    steps = steps[np.linspace(0, len(steps) - 1, min(MAX_SAMPLED_STEPS, len(steps))).astype(int)]
    for smallest in np.quantile(steps, STEP_QUANTILES):
        off = np.abs(steps / smallest - np.rint(steps / smallest))
        if (off < MULTIPLE_TOLERANCE).mean() > MIN_MULTIPLE_FRACTION:
            return float(smallest)
    return digit


def compute_float_resolution(markers: np.ndarray) -> float:
    """-> metres: what the last digit of a 32-bit float is worth at the farthest of `markers` (T, M, 3)."""
    return FLOAT32_RESOLUTION * float(np.nanmax(np.abs(markers), initial=0.0))


def compute_polynomial_misfits(path: np.ndarray, degree: int, length: int, starts: np.ndarray) -> np.ndarray:
    """-> (S,) metres: by how much the nearest polynomial misses any of the `length` samples from each of `starts` (S,) on.

    path  (T, 3) metres, NaN where not seen, which makes what is missed NaN
    """
    basis = np.linalg.qr(np.vander(np.linspace(-1, 1, length), degree + 1))[0]
    left = np.eye(length) - basis @ basis.T
    return np.abs(sliding_window_view(path, length, axis=0)[starts] @ left).max((1, 2))


def find_exact_stretches(path: np.ndarray, degree: int, length: int, resolution: float) -> list[tuple[int, int]]:
    """-> the longest stretches (first, last) of at least `length` samples that one polynomial hits to the last digit.

    path (T, 3) metres, NaN where not seen; digit in metres
    """
    if len(path) < length:
        return []
    apart, order = (length - 1) // (degree + 1), degree + 1
    contrast = path[: len(path) - length + 1].copy()  # the difference of the order that makes nothing of such a polynomial
    weight = 1.0
    for k in range(1, order + 1):
        weight *= -(order - k + 1) / k
        contrast += weight * path[k * apart : k * apart + len(contrast)]
    able = np.flatnonzero(np.abs(contrast).max(1) <= 2**order * resolution)
    hit = np.zeros(len(contrast), bool)
    hit[able] = compute_polynomial_misfits(path, degree, length, able) <= resolution
    long = ((first, last + length - 1) for first, last in find_runs(hit))
    return [
        (a, b)
        for a, b in long
        if compute_polynomial_misfits(path[a : b + 1], degree, b - a + 1, np.zeros(1, int))[0] <= resolution
    ]


def trim_measured_ends(visible: np.ndarray, first: int, last: int) -> tuple[int, int]:
    """-> first, last without the measured samples that a fill joins; beside a gap (`seen` (T,)) or the take's ends are none."""
    joined = first > 0 and visible[first - 1]
    joins = last + 1 < len(visible) and visible[last + 1]
    return first + int(joined), last - int(joins)
