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

from numba import njit, types
from numba.extending import overload


@njit(cache=True)
def of_frame(array, t):
    """-> what `array` says of frame t: it has a row for each frame, or one for all."""
    return array[min(t, len(array) - 1)]


def add(term, t, scale2, tree, pose, system):
    """-> the term's cost; compiled code only (each kind's own function takes its place)."""
    raise NotImplementedError(f"{type(term).__name__} is no term")


def adds(kind):
    """Say that a function adds terms of `kind`."""

    def register(function):
        @overload(add)
        def choose(term, t, scale2, tree, pose, system):
            named = isinstance(term, types.NamedTuple | types.NamedUniTuple)
            return function if named and term.instance_class is kind else None

        return function

    return register
