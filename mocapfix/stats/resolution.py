"""The smallest difference that the coordinates of a file resolve."""

import numpy as np
from jaxtyping import Float

# Relative resolution of the 32-bit floats in which files store coordinates.
FLOAT32_RESOLUTION = 2.0**-23
# Number of steps, evenly spread, from which a common divisor of the coordinates is estimated.
MAX_SAMPLED_STEPS = 50_000
# Quantiles of the steps that may equal the common divisor once.
STEP_QUANTILES = (2e-4, 2e-3, 1e-2)
# Fraction of the steps that must be close to a multiple of the divisor (by chance: one in five), and how close, as a part of it.
MIN_MULTIPLE_FRACTION = 0.9
MULTIPLE_TOLERANCE = 0.1


def estimate_resolution(markers: Float[np.ndarray, "T M 3"]) -> float:
    """Estimate the smallest difference in metres that the coordinates of the markers resolve.

    A file of integers stores multiples of its scale, and so does a file that was converted from one, whatever its header says.
    """
    resolution = compute_float_resolution(markers)
    steps = np.abs(np.diff(markers, axis=0)).ravel()
    steps = steps[steps > resolution]
    if len(steps) == 0:
        return resolution
    steps = steps[np.linspace(0, len(steps) - 1, min(MAX_SAMPLED_STEPS, len(steps))).astype(int)]
    for divisor in np.quantile(steps, STEP_QUANTILES):
        remainder = np.abs(steps / divisor - np.rint(steps / divisor))
        if (remainder < MULTIPLE_TOLERANCE).mean() > MIN_MULTIPLE_FRACTION:
            return float(divisor)
    return resolution


def compute_float_resolution(markers: Float[np.ndarray, "T M 3"]) -> float:
    """Compute the resolution in metres of a 32-bit float at the largest coordinate of the markers."""
    return FLOAT32_RESOLUTION * float(np.nanmax(np.abs(markers), initial=0.0))
