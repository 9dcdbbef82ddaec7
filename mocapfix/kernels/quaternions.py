"""One joint's rotations over time, as quaternions (x, y, z, w) without sign flips, and back.

`extract_joint_quaternions` and `store_joint_quaternions` access the joint's matrices in the array of all joints, which is too
large to copy for a long take.
"""

import math

import numpy as np

from mocapfix.kernels.compilation_cache import compile_inner_kernel, compile_kernel
from mocapfix.kernels.lie import convert_matrix_to_quaternion, convert_quaternion_to_matrix
from mocapfix.kernels.small_matrices import load_matrix, store_matrix

MIN_VECTOR_LENGTH = 1e-12  # a quaternion's vector part shorter than this has no direction


@compile_kernel
def extract_joint_quaternions(rotations, joint, known):
    """Return (T, 4) quaternions of rotations[:, joint] (T, J, 3, 3), their signs chosen for continuity.

    Of the two signs the one nearer to the last `known` (T,) frame is chosen; before the first known frame, the one nearer to
    that frame. If no frame is known, all count as known.
    """
    frames, none_known = len(rotations), True
    for t in range(frames):
        none_known = none_known and not known[t]
    out = np.empty((frames, 4))
    reference = 0
    for t in range(frames - 1, -1, -1):
        x, y, z, w = convert_matrix_to_quaternion(load_matrix(rotations[t], joint))
        length = math.sqrt(x * x + y * y + z * z + w * w)
        out[t, 0], out[t, 1], out[t, 2], out[t, 3] = x / length, y / length, z / length, w / length
        if none_known or known[t]:
            reference = t
    for t in range(frames):
        product = 0.0
        for a in range(4):
            product += out[t, a] * out[reference, a]
        if product < 0:
            for a in range(4):
                out[t, a] = -out[t, a]
        if none_known or known[t]:
            reference = t
    return out


@compile_kernel
def store_joint_quaternions(quaternions, joint, rotations):
    """Write quaternions (T, 4) of any length but 0 into rotations[:, joint] (T, J, 3, 3) as matrices."""
    for t in range(len(quaternions)):
        x, y, z, w = quaternions[t, 0], quaternions[t, 1], quaternions[t, 2], quaternions[t, 3]
        store_matrix(convert_quaternion_to_matrix(x, y, z, w), rotations[t], joint)


@compile_inner_kernel
def compute_relative_rotation_vectors(quaternions, reference):
    """Return (T, 3) rotation vectors (radians, length at most pi) of quaternions (T, 4) relative to `reference` (4,).

    All quaternions have unit length; the vector v stands for exp(v) reference.
    """
    out = np.empty((len(quaternions), 3))
    a, b, c, d = -reference[0], -reference[1], -reference[2], reference[3]
    for t in range(len(quaternions)):
        x, y, z, w = quaternions[t, 0], quaternions[t, 1], quaternions[t, 2], quaternions[t, 3]
        i, j, k = w * a + x * d + y * c - z * b, w * b - x * c + y * d + z * a, w * c + x * b - y * a + z * d
        real = w * d - x * a - y * b - z * c
        sign = -1.0 if real < 0 else 1.0
        length = math.sqrt(i * i + j * j + k * k)
        factor = 2 * sign if length < MIN_VECTOR_LENGTH else 2 * sign * math.atan2(length, abs(real)) / length
        out[t, 0], out[t, 1], out[t, 2] = factor * i, factor * j, factor * k
    return out
