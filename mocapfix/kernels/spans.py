"""Which way a body's bones point, frame by frame, compiled: what joints tell a network of how the bones are twisted."""

from typing import NamedTuple

import numpy as np
from numba import njit

from mocapfix.kernels.small import matrix, times, transposed
from mocapfix.kernels.twist_swing import dot, plus, square_root, swing


class Spans(NamedTuple):
    """P straight lines between joints, bones most of them; those before a span come before it."""

    start: np.ndarray  # (P,) joint
    end: np.ndarray  # (P,) joint
    before: np.ndarray  # (P,) the span that ends where this one starts, -1 for none
    rest: np.ndarray  # (P, 3) metres: from start to end where nothing is turned


@njit(cache=True, nogil=True)
def direct_frames(spans, positions, turns, directions, first, stop):
    """Write directions (T, 2, P, 3), single precision: each span's in the root's axes, at length 1, and the same turned back
    as the span before has swung. What is left of the second is the next joint's own turn, after a twist of the bone before:
    a knee bends in one plane only, so where its shin points to the side, the thigh is twisted.

    positions (T, J, 3) metres; turns (T, 3, 3) of the root; a span is 0 where one of its joints, or the root's turn, is NaN,
    and where it has no length. The second is 0 too where the span before is.
    """
    for t in range(first, stop):
        back = transposed(matrix(turns, t))
        for p in range(len(spans.start)):
            here = _directed(back, positions[t], spans.start[p], spans.end[p])
            q, left = spans.before[p], (0.0, 0.0, 0.0)
            if q >= 0:
                way = directions[t, 0, q, 0], directions[t, 0, q, 1], directions[t, 0, q, 2]
                if dot(way, way) > 0.5:
                    rest = spans.rest[q, 0], spans.rest[q, 1], spans.rest[q, 2]
                    left = times(transposed(swing(rest, way)), here[0], here[1], here[2])
            for a in range(3):
                directions[t, 0, p, a], directions[t, 1, p, a] = here[a], left[a]


@njit(cache=True)
def _directed(back, places, start, end):
    """-> the unit vector between two joints, turned by `back`; 0 where there is none."""
    a, b = (places[start, 0], places[start, 1], places[start, 2]), (places[end, 0], places[end, 1], places[end, 2])
    away = plus(b, -1.0, a)
    x, y, z = times(back, away[0], away[1], away[2])
    length = square_root(x * x + y * y + z * z)
    if length > 0.0:  # neither 0 nor NaN
        return x / length, y / length, z / length
    return 0.0, 0.0, 0.0
