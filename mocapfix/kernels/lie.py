"""Rotation vectors, quaternions and matrices inside compiled loops, and kernels for many of them.

Matrices are tuples of nine numbers, row by row, as in `small_matrices`.

One joint's rotations over time, as quaternions (x, y, z, w) without sign flips, and back.

`extract_joint_quaternions` and `store_joint_quaternions` access the joint's matrices in the array of all joints, which is too
large to copy for a long take.
"""

import math

import numpy as np

from mocapfix.kernels.compilation import compile_inner_kernel, compile_kernel
from mocapfix.kernels.small_matrices import load_matrix, store_matrix

MIN_TILT_SINE = 1e-3  # radians: a body closer to upside down than this has no tilt axis; x is taken


@compile_inner_kernel
def compute_exponential(x, y, z):
    """Return the rotation matrix of the rotation vector (x, y, z), radians. Rodrigues' formula."""
    angle2 = x * x + y * y + z * z
    if angle2 < 1e-8:
        s, c = 1 - angle2 / 6, 0.5 - angle2 / 24
    else:
        angle = math.sqrt(angle2)
        s, c = math.sin(angle) / angle, (1 - math.cos(angle)) / angle2
    return assemble_rotation(x, y, z, s, c)


@compile_inner_kernel
def compute_retraction(x, y, z):
    """Return Cayley's rotation, by 2 atan(length / 2): equal to `compute_exponential` to second order, without a sine."""
    s = 1.0 / (1.0 + 0.25 * (x * x + y * y + z * z))
    return assemble_rotation(x, y, z, s, 0.5 * s)


@compile_inner_kernel
def assemble_rotation(x, y, z, s, c):
    """Return I + s [v]x + c [v]x^2 for v = (x, y, z)."""
    return (
        1 - c * (y * y + z * z), c * x * y - s * z, c * x * z + s * y,
        c * x * y + s * z, 1 - c * (x * x + z * z), c * y * z - s * x,
        c * x * z - s * y, c * y * z + s * x, 1 - c * (x * x + y * y),
    )  # fmt: skip


@compile_inner_kernel
def convert_matrix_to_quaternion(m):
    """Return x, y, z, w of the rotation matrix `m` (nine numbers, row by row); w >= 0, the length is arbitrary.

    The largest component is computed from the diagonal and the others from it, so that the result is accurate near half a
    turn too.
    """
    trace = m[0] + m[4] + m[8]
    if trace > m[0] and trace > m[4] and trace > m[8]:
        w, x, y, z = 1 + trace, m[7] - m[5], m[2] - m[6], m[3] - m[1]
    elif m[0] >= m[4] and m[0] >= m[8]:
        w, x, y, z = m[7] - m[5], 1 + 2 * m[0] - trace, m[1] + m[3], m[2] + m[6]
    elif m[4] >= m[8]:
        w, x, y, z = m[2] - m[6], m[1] + m[3], 1 + 2 * m[4] - trace, m[5] + m[7]
    else:
        w, x, y, z = m[3] - m[1], m[2] + m[6], m[5] + m[7], 1 + 2 * m[8] - trace
    if w < 0:
        w, x, y, z = -w, -x, -y, -z
    return x, y, z, w


@compile_inner_kernel
def convert_quaternion_to_matrix(x, y, z, w):
    """Return the rotation matrix of a quaternion of any length but 0."""
    s = 2 / (x * x + y * y + z * z + w * w)
    return assemble_rotation(x, y, z, s * w, s)


@compile_inner_kernel
def compute_logarithm(m):
    """Return the rotation vector (radians, length at most pi) of the matrix `m`, and the fourth argument of
    `compute_left_jacobian_inverse`.

    Computed from the quaternion, so that it is accurate near the identity and near half a turn. The fourth number is
    (1 - a cot a) / (2 a)^2 for half the angle, a.
    """
    x, y, z, w = convert_matrix_to_quaternion(m)
    length = math.sqrt(x * x + y * y + z * z)
    if length < 1e-3 * w:  # atan t = t - t^3 / 3 + t^5 / 5 - ...
        t2 = (length / w) ** 2
        factor, c = 2 * (1 - t2 / 3 + t2 * t2 / 5) / w, 1 / 12 + t2 / 180
    else:
        half = math.atan2(length, w)
        factor, c = 2 * half / length, (1 - half * w / length) / (4 * half * half)
    return factor * x, factor * y, factor * z, c


@compile_inner_kernel
def compute_left_jacobian_inverse(x, y, z, c):
    """Return J: log(exp(d) exp(r)) = r + J d to first order; r, c from `compute_logarithm` (Sola et al. 2018, Eq. 146)."""
    return (
        1 - c * (y * y + z * z), c * x * y + 0.5 * z, c * x * z - 0.5 * y,
        c * x * y - 0.5 * z, 1 - c * (x * x + z * z), c * y * z + 0.5 * x,
        c * x * z + 0.5 * y, c * y * z - 0.5 * x, 1 - c * (x * x + y * y),
    )  # fmt: skip


@compile_inner_kernel
def compute_tilt(m):
    """Return x and z of the rotation vector of the tilt of `m`, and the matrix of its derivative.

    The tilt is `m` without its heading (a rotation about y after the tilt), so its axis is perpendicular to y and its y
    component zero. The derivative is to a rotation in the rotated axes; its row of y is zero.

    The up vector in the rotated axes determines the tilt: u = (z sin a, a cos a, -x sin a) / a for the angle a, and a rotation
    k changes u by u x k. Upside down, where any heading will do, the derivative about some axis is infinite.
    """
    ux, uy, uz = m[3], m[4], m[5]
    sine = math.hypot(ux, uz)
    if uy < 0.0 and sine < MIN_TILT_SINE:
        ux, uz, sine = 0.0, -MIN_TILT_SINE, MIN_TILT_SINE
    angle = math.atan2(sine, uy)
    if angle < 1e-3:  # a cot a = 1 - a^2 / 3 - a^4 / 45 - ...
        factor, along, c = 1 + angle * angle / 6, 1 - angle * angle / 3, 1 / 3 + angle * angle / 45
    else:
        factor = angle / sine
        along = factor * uy
        c = (1 - along) / (angle * angle)
    x, z = -factor * uz, factor * ux
    return x, z, (along + c * x * x, -z, c * x * z, 0.0, 0.0, 0.0, c * x * z, x, along + c * z * z)


@compile_inner_kernel
def orthonormalise_rotation(m):
    """Return `m`, nearly a rotation, with orthonormal rows (Gram-Schmidt)."""
    length = 1.0 / math.sqrt(m[0] * m[0] + m[1] * m[1] + m[2] * m[2])
    a, b, c = m[0] * length, m[1] * length, m[2] * length
    along = a * m[3] + b * m[4] + c * m[5]
    d, e, f = m[3] - along * a, m[4] - along * b, m[5] - along * c
    length = 1.0 / math.sqrt(d * d + e * e + f * f)
    d, e, f = d * length, e * length, f * length
    return a, b, c, d, e, f, b * f - c * e, c * d - a * f, a * e - b * d


@compile_kernel
def store_rotation_vectors(rotations, vectors):
    """Write the rotation vectors of rotations (N, 3, 3) into `vectors` (N, 3)."""
    for n in range(len(rotations)):
        vectors[n, 0], vectors[n, 1], vectors[n, 2], _ = compute_logarithm(load_matrix(rotations, n))


@compile_kernel
def store_vector_rotations(vectors, rotations):
    """Write the rotations of rotation vectors (N, 3) into `rotations` (N, 3, 3)."""
    for n in range(len(vectors)):
        store_matrix(compute_exponential(vectors[n, 0], vectors[n, 1], vectors[n, 2]), rotations, n)


@compile_kernel(nogil=True)
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


@compile_kernel(nogil=True)
def store_joint_quaternions(quaternions, joint, rotations):
    """Write quaternions (T, 4) of any length but 0 into rotations[:, joint] (T, J, 3, 3) as matrices."""
    for t in range(len(quaternions)):
        x, y, z, w = quaternions[t, 0], quaternions[t, 1], quaternions[t, 2], quaternions[t, 3]
        store_matrix(convert_quaternion_to_matrix(x, y, z, w), rotations[t], joint)
