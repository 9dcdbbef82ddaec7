"""Stretches of samples that follow a polynomial exactly, to the resolution of the file's coordinates."""

from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.lib.stride_tricks import sliding_window_view

from mocapfix.stats.sequences import find_runs


def compute_polynomial_misfits(
    path: Float[np.ndarray, "T 3"], degree: int, length: int, starts: Int[np.ndarray, " S"]
) -> Float[np.ndarray, " S"]:
    """Compute by how much the best polynomial misses any of the `length` samples from each start on.

    Args:
        path: World positions in metres, NaN where missing, which makes the misfit NaN.
        degree: Degree of the polynomial.
        length: Number of samples of a stretch.
        starts: Index of the first sample of each stretch.

    Returns:
        The largest absolute residual of a coordinate in metres.
    """
    residual = sliding_window_view(path, length, axis=0)[starts] @ _build_residual_projection(degree, length)
    return np.abs(residual).max((1, 2))


@lru_cache(maxsize=64)
def _build_residual_projection(degree: int, length: int) -> Float[np.ndarray, "length length"]:
    """Build the matrix that removes the best polynomial of a degree from `length` samples."""
    basis = np.linalg.qr(np.vander(np.linspace(-1, 1, length), degree + 1))[0]
    return np.eye(length) - basis @ basis.T


def find_exact_stretches(path: Float[np.ndarray, "T 3"], degree: int, length: int, resolution: float) -> list[tuple[int, int]]:
    """Find the longest stretches of at least `length` samples that one polynomial fits to the resolution.

    Args:
        path: World positions in metres, NaN where missing.
        degree: Degree of the polynomial.
        length: Smallest number of samples.
        resolution: Resolution of the coordinates in metres.

    Returns:
        The first and the last index of each stretch.
    """
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
    return [
        (a, b)
        for a, b in stretches
        if compute_polynomial_misfits(path[a : b + 1], degree, b - a + 1, np.zeros(1, int))[0] <= resolution
    ]


def trim_measured_ends(visible: Bool[np.ndarray, " T"], first: int, last: int) -> tuple[int, int]:
    """Return first, last without the measured samples that a fill connects.

    Next to a gap and at the ends of the take a fill connects to nothing, and nothing is removed there.
    """
    has_start = first > 0 and visible[first - 1]
    has_end = last + 1 < len(visible) and visible[last + 1]
    return first + int(has_start), last - int(has_end)
