"""Rotation vectors and matrices inside compiled loops (outside them: scipy.spatial.transform)."""

import math

from numba import njit


@njit(cache=True)
def exponential(x, y, z, out):
    """Write the rotation matrix of the rotation vector (x, y, z), radians, into `out` (3, 3). Rodrigues' formula."""
    angle2 = x * x + y * y + z * z
    if angle2 < 1e-8:
        s, c = 1 - angle2 / 6, 0.5 - angle2 / 24
    else:
        angle = math.sqrt(angle2)
        s, c = math.sin(angle) / angle, (1 - math.cos(angle)) / angle2
    out[0, 0], out[0, 1], out[0, 2] = 1 - c * (y * y + z * z), c * x * y - s * z, c * x * z + s * y
    out[1, 0], out[1, 1], out[1, 2] = c * x * y + s * z, 1 - c * (x * x + z * z), c * y * z - s * x
    out[2, 0], out[2, 1], out[2, 2] = c * x * z - s * y, c * y * z + s * x, 1 - c * (x * x + y * y)


@njit(cache=True)
def logarithm(m, out):
    """Write the rotation vector (radians, length at most pi) of the matrix `m` (3, 3) into `out` (3,).

    Through the quaternion with the largest component first, so that it holds near the identity and near half a turn.
    """
    trace = m[0, 0] + m[1, 1] + m[2, 2]
    if trace > m[0, 0] and trace > m[1, 1] and trace > m[2, 2]:
        w, x, y, z = 1 + trace, m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    elif m[0, 0] >= m[1, 1] and m[0, 0] >= m[2, 2]:
        w, x, y, z = m[2, 1] - m[1, 2], 1 + 2 * m[0, 0] - trace, m[0, 1] + m[1, 0], m[0, 2] + m[2, 0]
    elif m[1, 1] >= m[2, 2]:
        w, x, y, z = m[0, 2] - m[2, 0], m[0, 1] + m[1, 0], 1 + 2 * m[1, 1] - trace, m[1, 2] + m[2, 1]
    else:
        w, x, y, z = m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], 1 + 2 * m[2, 2] - trace
    if w < 0:
        w, x, y, z = -w, -x, -y, -z
    length = math.sqrt(x * x + y * y + z * z)
    factor = 2 / w if length < 1e-12 * w else 2 * math.atan2(length, w) / length
    out[0], out[1], out[2] = factor * x, factor * y, factor * z


@njit(cache=True)
def left_jacobian_inverse(r, out):
    """Write J (3, 3) with log(exp(d) exp(r)) = r + J d to first order in d (Sola, Deray, Atchuthan 2018, Eq. 146)."""
    x, y, z = r[0], r[1], r[2]
    angle2 = x * x + y * y + z * z
    if angle2 < 1e-6:
        c = 1 / 12 + angle2 / 720
    else:
        angle = math.sqrt(angle2)
        half = 0.5 * angle
        c = (1 - half * math.cos(half) / max(math.sin(half), 1e-9)) / angle2
    out[0, 0], out[0, 1], out[0, 2] = 1 - c * (y * y + z * z), c * x * y + 0.5 * z, c * x * z - 0.5 * y
    out[1, 0], out[1, 1], out[1, 2] = c * x * y - 0.5 * z, 1 - c * (x * x + z * z), c * y * z + 0.5 * x
    out[2, 0], out[2, 1], out[2, 2] = c * x * z + 0.5 * y, c * y * z - 0.5 * x, 1 - c * (x * x + y * y)


@njit(cache=True)
def multiply(a, b, out):
    """Write a @ b (3, 3) into `out`, which is neither of them."""
    for i in range(3):
        for j in range(3):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]


@njit(cache=True)
def orthonormalise(m):
    """Make the columns of `m` (3, 3), nearly a rotation, orthonormal again, in place (Gram-Schmidt)."""
    length = math.sqrt(m[0, 0] ** 2 + m[1, 0] ** 2 + m[2, 0] ** 2)
    for a in range(3):
        m[a, 0] /= length
    along = m[0, 0] * m[0, 1] + m[1, 0] * m[1, 1] + m[2, 0] * m[2, 1]
    for a in range(3):
        m[a, 1] -= along * m[a, 0]
    length = math.sqrt(m[0, 1] ** 2 + m[1, 1] ** 2 + m[2, 1] ** 2)
    for a in range(3):
        m[a, 1] /= length
    m[0, 2] = m[1, 0] * m[2, 1] - m[2, 0] * m[1, 1]
    m[1, 2] = m[2, 0] * m[0, 1] - m[0, 0] * m[2, 1]
    m[2, 2] = m[0, 0] * m[1, 1] - m[1, 0] * m[0, 1]
