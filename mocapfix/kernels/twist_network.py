"""A small network of fully connected layers, frame by frame, compiled, in single precision.

A library for matrix products has threads of its own, which wait for ours and ours for them: that costs several times as much.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from mocapfix.kernels.small_matrices import load_matrix, multiply_vector, transpose_matrix
from mocapfix.kernels.swing_twist import add_scaled, compute_dot, compute_square_root, compute_swing

# MERGED: mocapfix.kernels.layers
SINGLE_PRECISION_ZERO = np.float32(0)


@njit(cache=True, nogil=True)
def evaluate_layer_frames(weights, biases, inputs, outputs, first, stop):
    """Write outputs (T, M) that L layers make of inputs (T, N) in the frames first..stop - 1.

    weights, offsets  L matrices, inputs by outputs, and L vectors; between layers what is negative becomes 0
    """
    widest, last = 0, len(weights) - 1
    for k in range(last):
        widest = max(widest, len(biases[k]))
    rows = np.empty((len(weights), widest), np.float32)
    for t in range(first, stop):
        row = inputs[t]
        for k in range(last):
            _evaluate_layer(weights[k], biases[k], row, rows[k], True)
            row = rows[k]
        _evaluate_layer(weights[last], biases[last], row, outputs[t], False)


@njit(cache=True, fastmath=True)
def _evaluate_layer(weights, offsets, row, out, bent):
    inputs, outputs = weights.shape
    for o in range(outputs):
        out[o] = offsets[o]
    for i in range(inputs):
        value = row[i]
        if value != SINGLE_PRECISION_ZERO:  # half of them are
            for o in range(outputs):
                out[o] += value * weights[i, o]
    if bent:
        for o in range(outputs):
            out[o] = max(out[o], SINGLE_PRECISION_ZERO)


# MERGED: mocapfix.kernels.spans
# Which way a body's bones point, frame by frame, compiled: what joints tell a network of how the bones are twisted.
class BoneLines(NamedTuple):
    """P straight lines between joints, bones most of them; those before a span come before it."""

    start: np.ndarray  # (P,) joint
    end: np.ndarray  # (P,) joint
    previous: np.ndarray  # (P,) the span that ends where this one starts, -1 for none
    rest_vector: np.ndarray  # (P, 3) metres: from start to end where nothing is turned


@njit(cache=True, nogil=True)
def compute_bone_direction_frames(spans, positions, turns, directions, first, stop):
    """Write directions (T, 2, P, 3), single precision: each span's in the root's axes, at length 1, and the same turned back
    as the span before has swung. What is left of the second is the next joint's own turn, after a twist of the bone before:
    a knee bends in one plane only, so where its shin points to the side, the thigh is twisted.

    positions (T, J, 3) metres; turns (T, 3, 3) of the root; a span is 0 where one of its joints, or the root's turn, is NaN,
    and where it has no length. The second is 0 too where the span before is.
    """
    for t in range(first, stop):
        back = transpose_matrix(load_matrix(turns, t))
        for p in range(len(spans.start)):
            here = _compute_direction(back, positions[t], spans.start[p], spans.end[p])
            q, left = spans.previous[p], (0.0, 0.0, 0.0)
            if q >= 0:
                way = directions[t, 0, q, 0], directions[t, 0, q, 1], directions[t, 0, q, 2]
                if compute_dot(way, way) > 0.5:
                    rest = spans.rest_vector[q, 0], spans.rest_vector[q, 1], spans.rest_vector[q, 2]
                    left = multiply_vector(transpose_matrix(compute_swing(rest, way)), here[0], here[1], here[2])
            for a in range(3):
                directions[t, 0, p, a], directions[t, 1, p, a] = here[a], left[a]


@njit(cache=True)
def _compute_direction(back, places, start, end):
    """-> the unit vector between two joints, turned by `back`; 0 where there is none."""
    a, b = (places[start, 0], places[start, 1], places[start, 2]), (places[end, 0], places[end, 1], places[end, 2])
    away = add_scaled(b, -1.0, a)
    x, y, z = multiply_vector(back, away[0], away[1], away[2])
    length = compute_square_root(x * x + y * y + z * z)
    if length > 0.0:  # neither 0 nor NaN
        return x / length, y / length, z / length
    return 0.0, 0.0, 0.0
