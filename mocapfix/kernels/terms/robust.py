"""How far-off residuals lose their say."""

import math

import numpy as np
from numba import njit

GEMAN_MCCLURE, HUBER = 0, 1


@njit(cache=True)
def robust(loss, square, scale2):
    """-> cost and weight of a squared, normalised residual s^2: a loss, and its derivative to 1/2 s^2.

    Geman & McClure (1987): 1/2 c^2 s^2 / (c^2 + s^2); a far-off sample hardly counts.
    Huber (1964): 1/2 s^2 up to c, then c s - 1/2 c^2; a far-off sample pulls, but no harder than one at c.
    scale2 = c^2, infinite for plain least squares. Solving with wide scales first and narrow ones last (annealing) keeps
    a far-off start from losing sound samples.
    """
    if scale2 == np.inf:
        return 0.5 * square, 1.0
    if loss == HUBER:
        if square <= scale2:
            return 0.5 * square, 1.0
        ratio = math.sqrt(scale2 / square)
        return scale2 * (1.0 / ratio - 0.5), ratio
    part = scale2 / (scale2 + square)
    return 0.5 * square * part, part * part
