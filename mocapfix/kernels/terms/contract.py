"""What a term is: a named tuple of arrays, and a compiled function that adds it to a frame's quadratic model.

    add(term, t, scale2, tree, pose, system) -> cost

    term     the term's own data, over all frames
    t        the frame
    scale2   the robust scale now, squared, in standard deviations
    pose     where the linearisation is, its world joints written
    system   the model, added to: lower triangles of h, whole matrices of `own`

The cost is half the sum of squares of the residuals, each over its standard deviation, the model its Gauss-Newton
expansion about the pose. A term that touches one body adds to that body's h and g, one on a joint's own turn to `own`
and b, one on several bodies at once a row (`rows`); one on the unknowns that all joints share to `shared` and the crosses.
"""

import math

import numpy as np
from numba import njit, types
from numba.extending import overload


# MERGED: mocapfix.kernels.terms.contract
@njit(cache=True)
def select_frame(array, t):
    """-> what `array` says of frame t: it has a row for each frame, or one for all."""
    return array[min(t, len(array) - 1)]


def add_term(term, t, scale2, tree, pose, system):
    """-> the term's cost; compiled code only (each kind's own function takes its place)."""
    raise NotImplementedError(f"{type(term).__name__} is no term")


def register_term(kind):
    """Say that a function adds terms of `kind`."""

    def register(function):
        @overload(add_term)
        def choose(term, t, scale2, tree, pose, system):
            named = isinstance(term, types.NamedTuple | types.NamedUniTuple)
            return function if named and term.instance_class is kind else None

        return function

    return register


# MERGED: mocapfix.kernels.terms.robust
# How far-off residuals lose their say.
GEMAN_MCCLURE, HUBER = 0, 1


@njit(cache=True)
def compute_robust_loss(loss, square, scale2):
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
