"""The interface of a term, and the robust losses that terms share.

A term is a named tuple of arrays, and a compiled function that adds it to a frame's normal equations:

    add_term(term, t, scale2, tree, pose, equations) -> cost

    term       the term's own data, over all frames
    t          the frame
    scale2     the current robust scale, squared, in standard deviations
    pose       the pose of the linearisation, its forward kinematics computed
    equations  the model, added to: lower triangles of h, full matrices of h_joint

The cost is half the sum of squares of the residuals, each over its standard deviation; the model is its Gauss-Newton expansion
about the pose. A term on one body adds to that body's h and g, a term on a joint's own rotation to h_joint and g_joint, a term
that couples several bodies a row, and a term on the unknowns that all joints share to h_shared, g_shared and h_joint_shared.

A new term is a NamedTuple and a function with `@register_term(ItsClass)`, in a module of this folder that `__init__` imports.
"""

import math

import numpy as np
from numba import types
from numba.extending import overload

from mocapfix.kernels.compilation import compile_inner_kernel

GEMAN_MCCLURE = 0  # losses of `compute_robust_loss`
HUBER = 1


@compile_inner_kernel
def select_frame(array, t):
    """Return frame t's row of `array`, which has a row for each frame, or one for all."""
    return array[min(t, len(array) - 1)]


def add_term(term, t, scale2, tree, pose, equations):
    """Add a term and return its cost; in compiled code only, where each class's registered function replaces this one."""
    raise NotImplementedError(f"{type(term).__name__} is not a registered term")


def register_term(term_class):
    """Return a decorator that registers a function as the implementation of `add_term` for terms of a class."""

    def register(function):
        @overload(add_term, jit_options={"no_cfunc_wrapper": True})  # pyright: ignore[reportArgumentType]
        def choose(term, t, scale2, tree, pose, equations):
            is_named_tuple = isinstance(term, types.NamedTuple | types.NamedUniTuple)
            return function if is_named_tuple and term.instance_class is term_class else None

        return function

    return register


@compile_inner_kernel
def compute_robust_loss(loss, square, scale2):
    """Return cost and weight of a squared, normalised residual s^2: a loss, and its derivative to 1/2 s^2.

    Geman & McClure (1987): 1/2 c^2 s^2 / (c^2 + s^2); an outlier's weight tends to zero.
    Huber (1964): 1/2 s^2 up to c, then c s - 1/2 c^2; an outlier's gradient is bounded.
    scale2 = c^2, infinite for plain least squares. Solving with wide scales first and narrow ones last (annealing) keeps
    good samples from being rejected at a distant start.
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
