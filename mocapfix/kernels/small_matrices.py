"""Small dense matrices inside compiled loops: 3 x 3 matrices as tuples of nine numbers, and the inverses the sweep needs.

A tuple lives in registers and needs no allocation, unlike an array.
"""

import math

from mocapfix.kernels.compilation import compile_inner_kernel, compile_kernel

SUM_FASTMATH_FLAGS = {"reassoc", "contract"}  # allow the compiler to reorder and vectorise long sums of products


@compile_inner_kernel
def load_matrix(m, j):
    """Return matrix `j` of the stack m (J, 3, 3) as nine numbers, row by row."""
    return (m[j, 0, 0], m[j, 0, 1], m[j, 0, 2], m[j, 1, 0], m[j, 1, 1], m[j, 1, 2], m[j, 2, 0], m[j, 2, 1], m[j, 2, 2])


@compile_inner_kernel
def load_single_matrix(m):
    """Return the matrix m (3, 3) as nine numbers."""
    return (m[0, 0], m[0, 1], m[0, 2], m[1, 0], m[1, 1], m[1, 2], m[2, 0], m[2, 1], m[2, 2])


@compile_inner_kernel
def multiply_matrices(a, b):
    """Return a @ b."""
    return (
        a[0] * b[0] + a[1] * b[3] + a[2] * b[6], a[0] * b[1] + a[1] * b[4] + a[2] * b[7], a[0] * b[2] + a[1] * b[5] + a[2] * b[8],
        a[3] * b[0] + a[4] * b[3] + a[5] * b[6], a[3] * b[1] + a[4] * b[4] + a[5] * b[7], a[3] * b[2] + a[4] * b[5] + a[5] * b[8],
        a[6] * b[0] + a[7] * b[3] + a[8] * b[6], a[6] * b[1] + a[7] * b[4] + a[8] * b[7], a[6] * b[2] + a[7] * b[5] + a[8] * b[8],
    )  # fmt: skip


@compile_inner_kernel
def transpose_matrix(a):
    """Return a.T."""
    return (a[0], a[3], a[6], a[1], a[4], a[7], a[2], a[5], a[8])


@compile_inner_kernel
def multiply_vector(a, x, y, z):
    """Return a @ (x, y, z)."""
    return a[0] * x + a[1] * y + a[2] * z, a[3] * x + a[4] * y + a[5] * z, a[6] * x + a[7] * y + a[8] * z


@compile_inner_kernel(fastmath=SUM_FASTMATH_FLAGS)
def multiply_rows(rows, x):
    """Return rows (3, N) @ x (N,)."""
    a, b, c = 0.0, 0.0, 0.0
    for p in range(len(x)):
        a += rows[0, p] * x[p]
        b += rows[1, p] * x[p]
        c += rows[2, p] * x[p]
    return a, b, c


@compile_inner_kernel
def store_matrix(a, out, j):
    """Write nine numbers into matrix `j` of the stack `out` (J, 3, 3)."""
    out[j, 0, 0], out[j, 0, 1], out[j, 0, 2] = a[0], a[1], a[2]
    out[j, 1, 0], out[j, 1, 1], out[j, 1, 2] = a[3], a[4], a[5]
    out[j, 2, 0], out[j, 2, 1], out[j, 2, 2] = a[6], a[7], a[8]


@compile_inner_kernel
def invert_symmetric_3x3(m, j):
    """Invert matrix `j` of the stack m (J, 3, 3), symmetric and positive definite, in place.

    Returns L (l10, l20, l21) and the inverse of D of the factorisation L D L'. Cofactors would lose twice the digits. A zero
    pivot (an axis without any information) has inverse zero, so that the joint does not rotate about that axis.
    """
    d0 = m[j, 0, 0]
    i0 = 1.0 / d0 if d0 > 0.0 else 0.0
    l10, l20 = m[j, 1, 0] * i0, m[j, 2, 0] * i0
    d1 = m[j, 1, 1] - m[j, 1, 0] * l10
    i1 = 1.0 / d1 if d1 > 0.0 else 0.0
    schur = m[j, 2, 1] - m[j, 2, 0] * l10
    l21 = schur * i1
    d2 = m[j, 2, 2] - m[j, 2, 0] * l20 - schur * l21
    i2 = 1.0 / d2 if d2 > 0.0 else 0.0
    k20 = l10 * l21 - l20  # of L's inverse
    m02, m12 = k20 * i2, -l21 * i2
    m01 = -l10 * i1 - l21 * m02
    m[j, 0, 0], m[j, 1, 1], m[j, 2, 2] = i0 + l10 * l10 * i1 + k20 * m02, i1 - l21 * m12, i2
    m[j, 0, 1] = m[j, 1, 0] = m01
    m[j, 0, 2] = m[j, 2, 0] = m02
    m[j, 1, 2] = m[j, 2, 1] = m12
    return l10, l20, l21, i0, i1, i2


@compile_inner_kernel(fastmath=SUM_FASTMATH_FLAGS)
def factor_cholesky(m):
    """Factor `m` (N, N) into L L', L in its lower triangle; a direction without information gets a tiny curvature."""
    for j in range(len(m)):
        for i in range(j, len(m)):
            total = 0.0
            for c in range(j):
                total += m[i, c] * m[j, c]
            total = m[i, j] - total
            m[i, j] = math.sqrt(max(total, 1e-9)) if i == j else total / m[j, j]


@compile_inner_kernel(fastmath=SUM_FASTMATH_FLAGS)
def solve_cholesky(m, x):
    """Solve L L' x = x in place, L from `factor_cholesky` in `m` (N, N); x (N,)."""
    for i in range(len(m)):
        total = 0.0
        for c in range(i):
            total += m[i, c] * x[c]
        x[i] = (x[i] - total) / m[i, i]
    for i in range(len(m) - 1, -1, -1):  # along rows of L, too
        x[i] /= m[i, i]
        for c in range(i):
            x[c] -= m[i, c] * x[i]


@compile_kernel(nogil=True)
def solve_banded(band, x):
    """Solve A x = x in place, x (N, R), A positive definite; A[i, j] for i <= j is band[-1 + i - j, j], which is overwritten."""
    width, count = len(band) - 1, band.shape[1]
    for j in range(count):  # Cholesky's factor above the diagonal
        first = max(0, j - width)
        for i in range(first, j + 1):
            total = band[width + i - j, j]
            for k in range(max(first, i - width), i):
                total -= band[width + k - i, i] * band[width + k - j, j]
            band[width + i - j, j] = math.sqrt(total) if i == j else total / band[width, i]
        for r in range(x.shape[1]):
            for k in range(first, j):
                x[j, r] -= band[width + k - j, j] * x[k, r]
            x[j, r] /= band[width, j]
    for j in range(count - 1, -1, -1):
        for r in range(x.shape[1]):
            x[j, r] /= band[width, j]
            for k in range(max(0, j - width), j):
                x[k, r] -= band[width + k - j, j] * x[j, r]


@compile_inner_kernel
def invert_cholesky(m):
    """Replace the factor that `factor_cholesky` wrote into `m` (N, N) by the matrix's inverse, both triangles, in place."""
    n = len(m)
    for j in range(n):  # the lower triangle's inverse
        m[j, j] = 1.0 / m[j, j]
        for i in range(j + 1, n):
            total = 0.0
            for c in range(j, i):
                total -= m[i, c] * m[c, j]
            m[i, j] = total / m[i, i]
    for i in range(n):  # L^-T L^-1, column by column: row i needs only rows at and below it
        for j in range(i + 1):
            total = 0.0
            for c in range(i, n):
                total += m[c, i] * m[c, j]
            m[i, j] = total
    for i in range(n):
        for j in range(i + 1, n):
            m[i, j] = m[j, i]


@compile_inner_kernel
def clear_array(array):
    """Set a contiguous array to zero. (`array.fill` compiles an assignment to a slice, and with it the text of its errors.)"""
    flat = array.reshape(-1)
    for i in range(len(flat)):
        flat[i] = 0.0


@compile_inner_kernel
def copy_array(source, target):
    """Copy `source` into `target`, both contiguous and of one shape."""
    flat, out = source.reshape(-1), target.reshape(-1)
    for i in range(len(flat)):
        out[i] = flat[i]
