"""The compiled parts of the twist network: its inputs, the bones' directions frame by frame, and its layers."""

from typing import NamedTuple

import numpy as np

from mocapfix.kernels.compilation_cache import compile_inner_kernel, compile_kernel
from mocapfix.kernels.hybrik import add_scaled, compute_dot, compute_square_root, compute_swing
from mocapfix.kernels.small_matrices import load_matrix, multiply_vector, transpose_matrix

SINGLE_PRECISION_ZERO = np.float32(0)


class BoneLines(NamedTuple):
    """P straight lines between joints, most of them bones; a line comes after its predecessor."""

    start: np.ndarray  # (P,) joint
    end: np.ndarray  # (P,) joint
    previous: np.ndarray  # (P,) the line that ends at this one's start, -1 for none
    rest_vector: np.ndarray  # (P, 3) metres: from start to end in the rest pose


@compile_kernel(nogil=True)
def compute_bone_direction_frames(lines, positions, root_rotation, directions, first, stop):
    """Write directions (T, 2, P, 3), single precision, of the frames first..stop - 1.

    directions[:, 0] are the lines' unit vectors in the root's axes; directions[:, 1] the same with the swing of the previous
    line removed. The second depends on the next joint's own rotation and on the twist of the bone before: a knee bends in one
    plane only, so a shin that points sideways means a twisted thigh.

    positions      (T, J, 3) metres
    root_rotation  (T, 3, 3)

    A direction is 0 where one of its joints or the root's rotation is NaN, or its length is 0. The second is also 0 where the
    previous line's is.
    """
    for t in range(first, stop):
        to_root = transpose_matrix(load_matrix(root_rotation, t))
        for p in range(len(lines.start)):
            direction = _compute_direction(to_root, positions[t], lines.start[p], lines.end[p])
            q, unswung = lines.previous[p], (0.0, 0.0, 0.0)
            if q >= 0:
                previous = directions[t, 0, q, 0], directions[t, 0, q, 1], directions[t, 0, q, 2]
                if compute_dot(previous, previous) > 0.5:
                    rest = lines.rest_vector[q, 0], lines.rest_vector[q, 1], lines.rest_vector[q, 2]
                    from_swung = transpose_matrix(compute_swing(rest, previous))
                    unswung = multiply_vector(from_swung, direction[0], direction[1], direction[2])
            for a in range(3):
                directions[t, 0, p, a], directions[t, 1, p, a] = direction[a], unswung[a]


@compile_inner_kernel
def _compute_direction(to_root, positions, start, end):
    """Return the unit vector between two joints in the root's axes; 0 if there is none."""
    a = positions[start, 0], positions[start, 1], positions[start, 2]
    b = positions[end, 0], positions[end, 1], positions[end, 2]
    d = add_scaled(b, -1.0, a)
    x, y, z = multiply_vector(to_root, d[0], d[1], d[2])
    length = compute_square_root(x * x + y * y + z * z)
    if length > 0.0:  # neither 0 nor NaN
        return x / length, y / length, z / length
    return 0.0, 0.0, 0.0


@compile_kernel(nogil=True)
def evaluate_layer_frames(weights, biases, inputs, outputs, first, stop):
    """Write the outputs (T, M) of L fully connected layers for inputs (T, N) in the frames first..stop - 1.

    weights, biases  L matrices, inputs by outputs, and L vectors; between layers, rectified linear units

    A library for matrix products has threads of its own, which compete with ours and take several times as long.
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


@compile_inner_kernel(fastmath=True)
def _evaluate_layer(weights, biases, row, out, is_rectified):
    inputs, outputs = weights.shape
    for o in range(outputs):
        out[o] = biases[o]
    for i in range(inputs):
        value = row[i]
        if value != SINGLE_PRECISION_ZERO:  # about half of them are zero
            for o in range(outputs):
                out[o] += value * weights[i, o]
    if is_rectified:
        for o in range(outputs):
            out[o] = max(out[o], SINGLE_PRECISION_ZERO)
