"""Samples that follow a rule to the last digit: cameras do not measure such, other tools' fills leave them.

A measured marker trembles by some tenths of a millimetre, and the number that says where it is has a last digit. Samples
held at one value, or laid on a line or a cubic, follow these to that digit.
"""

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from mocapfix.take import runs

FLOAT = 2.0**-23  # of a coordinate: the last digit of the 32-bit floats in which files keep them
SOME = 50_000  # steps looked at, evenly spread, to tell whether all coordinates are multiples of one number
LOW = (2e-4, 2e-3, 1e-2)  # of the steps are smaller than one that may be the number, one multiple of itself
SHARE, NEAR = 0.9, 0.1  # of the steps that lie so near a multiple, as a part of it, where chance would lay one in five


def last_digit(markers: np.ndarray) -> float:
    """-> metres: the smallest difference that the coordinates of `markers` (T, M, 3) show.

    A file of integers keeps multiples of its scale, and so does what was converted from one, whatever it says of itself.
    """
    digit = float_digit(markers)
    steps = np.abs(np.diff(markers, axis=0)).ravel()
    steps = steps[steps > digit]
    if len(steps) == 0:
        return digit
    steps = steps[np.linspace(0, len(steps) - 1, min(SOME, len(steps))).astype(int)]
    for smallest in np.quantile(steps, LOW):
        off = np.abs(steps / smallest - np.rint(steps / smallest))
        if (off < NEAR).mean() > SHARE:
            return float(smallest)
    return digit


def float_digit(markers: np.ndarray) -> float:
    """-> metres: what the last digit of a 32-bit float is worth at the farthest of `markers` (T, M, 3)."""
    return FLOAT * float(np.nanmax(np.abs(markers), initial=0.0))


def misses(path: np.ndarray, degree: int, length: int, starts: np.ndarray) -> np.ndarray:
    """-> (S,) metres: by how much the nearest polynomial misses any of the `length` samples from each of `starts` (S,) on.

    path  (T, 3) metres, NaN where not seen, which makes what is missed NaN
    """
    basis = np.linalg.qr(np.vander(np.linspace(-1, 1, length), degree + 1))[0]
    left = np.eye(length) - basis @ basis.T
    return np.abs(sliding_window_view(path, length, axis=0)[starts] @ left).max((1, 2))


def stretches(path: np.ndarray, degree: int, length: int, digit: float) -> list[tuple[int, int]]:
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
    able = np.flatnonzero(np.abs(contrast).max(1) <= 2**order * digit)
    hit = np.zeros(len(contrast), bool)
    hit[able] = misses(path, degree, length, able) <= digit
    long = ((first, last + length - 1) for first, last in runs(hit))
    return [(a, b) for a, b in long if misses(path[a : b + 1], degree, b - a + 1, np.zeros(1, int))[0] <= digit]


def between(seen: np.ndarray, first: int, last: int) -> tuple[int, int]:
    """-> first, last without the measured samples that a fill joins; beside a gap (`seen` (T,)) or the take's ends are none."""
    joined = first > 0 and seen[first - 1]
    joins = last + 1 < len(seen) and seen[last + 1]
    return first + int(joined), last - int(joins)
