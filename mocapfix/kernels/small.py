"""Inverses of the small symmetric matrices that the sweep meets."""

import math

from numba import njit


@njit(cache=True)
def inverse_3(m, out):
    """Write the inverse of the positive definite `m` (3, 3) into `out`."""
    c00 = m[1, 1] * m[2, 2] - m[1, 2] * m[2, 1]
    c01 = m[0, 2] * m[2, 1] - m[0, 1] * m[2, 2]
    c02 = m[0, 1] * m[1, 2] - m[0, 2] * m[1, 1]
    d = 1.0 / (m[0, 0] * c00 + m[1, 0] * c01 + m[2, 0] * c02)
    out[0, 0], out[0, 1], out[0, 2] = c00 * d, c01 * d, c02 * d
    out[1, 0] = out[0, 1]
    out[1, 1] = (m[0, 0] * m[2, 2] - m[0, 2] * m[2, 0]) * d
    out[1, 2] = (m[0, 2] * m[1, 0] - m[0, 0] * m[1, 2]) * d
    out[2, 0], out[2, 1] = out[0, 2], out[1, 2]
    out[2, 2] = (m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0]) * d


@njit(cache=True)
def cholesky_inverse_6(m):
    """Invert the positive definite `m` (6, 6) in place. A direction that nothing holds gets a tiny curvature."""
    for j in range(6):
        for i in range(j, 6):
            total = m[i, j]
            for c in range(j):
                total -= m[i, c] * m[j, c]
            m[i, j] = math.sqrt(max(total, 1e-9)) if i == j else total / m[j, j]
    for j in range(6):  # the lower triangle's inverse
        m[j, j] = 1.0 / m[j, j]
        for i in range(j + 1, 6):
            total = 0.0
            for c in range(j, i):
                total -= m[i, c] * m[c, j]
            m[i, j] = total / m[i, i]
    for i in range(6):  # L^-T L^-1, column by column: row i needs only rows at and below it
        for j in range(i + 1):
            total = 0.0
            for c in range(i, 6):
                total += m[c, i] * m[c, j]
            m[i, j] = total
    for i in range(6):
        for j in range(i + 1, 6):
            m[i, j] = m[j, i]
