"""The rotation that lays one cloud on another, in closed form without an eigenvector, compiled."""

import math

import numpy as np
from numba import njit

from mocapfix.kernels.lie import convert_quaternion_to_matrix, orthonormalise_rotation
from mocapfix.kernels.small_matrices import multiply_matrices, store_matrix, transpose_matrix

# MERGED: mocapfix.kernels.attitude
MIN_CLOUD_WIDTH_RATIO = 1e-6  # of its size cubed: a cloud nearer to a line than that is taken for one
MAX_NEWTON_STEPS, NEWTON_TOLERANCE = 50, 1e-15  # of Newton's method at most; of the root: it has been found


@njit(cache=True)
def solve_wahba(b):
    """-> whether the cloud is more than a line, and the rotation that maximises trace(R' b), in closed form.

    Markley 1993, "Attitude determination using vector observations: a fast optimal matrix algorithm"; the largest root of its
    quartic by Newton's method from above.
    """
    cof = (
        b[4] * b[8] - b[5] * b[7], b[5] * b[6] - b[3] * b[8], b[3] * b[7] - b[4] * b[6],
        b[2] * b[7] - b[1] * b[8], b[0] * b[8] - b[2] * b[6], b[1] * b[6] - b[0] * b[7],
        b[1] * b[5] - b[2] * b[4], b[2] * b[3] - b[0] * b[5], b[0] * b[4] - b[1] * b[3],
    )  # fmt: skip
    norm, minors = 0.0, 0.0
    for n in range(9):
        norm += b[n] * b[n]
        minors += cof[n] * cof[n]
    det = b[0] * cof[0] + b[1] * cof[1] + b[2] * cof[2]
    # with s the singular values, the last of the sign of det: root = sum s, root^2 = norm + 2 sum s_i s_j, which squared is
    # minors + 2 det root; and root^2 <= 3 norm, so that this is not below it, and it itself for a plane
    root = math.sqrt(norm + 2 * math.sqrt(minors + 2 * max(det, 0.0) * math.sqrt(3 * norm)))
    for _ in range(MAX_NEWTON_STEPS):
        rest = root * root - norm
        slope = 4 * (root * rest - 2 * det)
        step = (rest * rest - 8 * root * det - 4 * minors) / slope if slope > 0 else 0.0
        root -= step
        if step <= NEWTON_TOLERANCE * root:
            break
    kappa = 0.5 * (root * root - norm)
    zeta = kappa * root - det
    if not zeta > MIN_CLOUD_WIDTH_RATIO * norm * math.sqrt(norm):
        return False, b
    cubed, c = multiply_matrices(b, multiply_matrices(transpose_matrix(b), b)), kappa + norm
    return True, orthonormalise_rotation((
        c * b[0] + root * cof[0] - cubed[0], c * b[1] + root * cof[1] - cubed[1], c * b[2] + root * cof[2] - cubed[2],
        c * b[3] + root * cof[3] - cubed[3], c * b[4] + root * cof[4] - cubed[4], c * b[5] + root * cof[5] - cubed[5],
        c * b[6] + root * cof[6] - cubed[6], c * b[7] + root * cof[7] - cubed[7], c * b[8] + root * cof[8] - cubed[8],
    ))  # fmt: skip


# MERGED: mocapfix.kernels.rigid
# The rigid motion that lays one cloud of points on another, frame by frame: weighted sums and the rotation they ask for.
MAX_JACOBI_SWEEPS = 10  # of Jacobi's method at most: it converges quadratically, in four or five
MAX_OFF_DIAGONAL_RATIO_SQUARED = 1e-32  # squared share of an off-diagonal entry that is rounding


def compute_cross_covariance(
    points: np.ndarray, model: np.ndarray, weight: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """-> cross (T, 3, 3) of points (T, K, 3) against places (K, 3) about their weighted means (T, 3), and these means.

    weight  (T, K); a point of weight 0 may be NaN
    """
    frames = len(points)
    cross, here, there = np.empty((frames, 3, 3)), np.empty((frames, 3)), np.empty((frames, 3))
    _compute_cross_covariance_frames(
        _make_contiguous(points), _make_contiguous(model), _make_contiguous(weight), cross, here, there
    )
    return cross, here, there


def fit_rotations(cross: np.ndarray) -> np.ndarray:
    """-> the rotations (T, 3, 3) that maximise trace(R' cross), never a reflection.

    cross  (T, 3, 3) sums of outer products, measured by model
    """
    turn = np.empty(cross.shape)
    _fit_rotation_frames(_make_contiguous(cross), turn)
    return turn


def transform_to_body_axes(points: np.ndarray, centre: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """-> points (T, K, 3) in the axes (T, 3, 3) that have their origin at `centre` (T, 3); NaN stays NaN."""
    placed = np.empty(points.shape)
    _transform_point_frames(_make_contiguous(points), _make_contiguous(centre), _make_contiguous(turn), placed)
    return placed


def _make_contiguous(array: np.ndarray) -> np.ndarray:
    """-> the array as the kernels want it, so that each is compiled once."""
    return np.ascontiguousarray(array, float)


@njit(cache=True)
def compute_weighted_means(seen, places, weight, here, there):
    """One frame: write the weighted means (3,) of points `seen` (K, 3) and of their `places` (K, 3)."""
    total = 1e-12
    for a in range(3):
        here[a], there[a] = 0.0, 0.0
    for k in range(len(weight)):
        if weight[k] > 0:
            total += weight[k]
            for a in range(3):
                here[a] += weight[k] * seen[k, a]
                there[a] += weight[k] * places[k, a]
    for a in range(3):
        here[a] /= total
        there[a] /= total


@njit(cache=True)
def accumulate_cross_covariance(seen, places, weight, here, there, cross):
    """One frame: write the weighted sum (3, 3) of the outer products of seen - here by places - there."""
    for a in range(3):
        for b in range(3):
            cross[a, b] = 0.0
    for k in range(len(weight)):
        if weight[k] > 0:
            for a in range(3):
                lever = weight[k] * (seen[k, a] - here[a])
                for b in range(3):
                    cross[a, b] += lever * (places[k, b] - there[b])


@njit(cache=True)
def compute_nearest_rotation(cross, m, vectors, out):
    """Write into `out` (3, 3) the rotation that maximises trace(out' cross).

    It is the one whose quaternion is the eigenvector of a symmetric 4 x 4 matrix with the largest eigenvalue (Horn 1987,
    "Closed-form solution of absolute orientation using unit quaternions"), so that it is a rotation whatever the cloud.
    `m` and `vectors` (4, 4) are written over.
    """
    xx, yy, zz = cross[0, 0], cross[1, 1], cross[2, 2]
    m[0, 0], m[1, 1], m[2, 2], m[3, 3] = xx + yy + zz, xx - yy - zz, yy - xx - zz, zz - xx - yy
    m[0, 1], m[0, 2], m[0, 3] = cross[2, 1] - cross[1, 2], cross[0, 2] - cross[2, 0], cross[1, 0] - cross[0, 1]
    m[1, 2], m[1, 3], m[2, 3] = cross[0, 1] + cross[1, 0], cross[2, 0] + cross[0, 2], cross[1, 2] + cross[2, 1]
    for i in range(4):
        for j in range(4):
            vectors[i, j] = 1.0 if i == j else 0.0
    for _ in range(MAX_JACOBI_SWEEPS):
        done = True
        for i in range(3):
            for j in range(i + 1, 4):
                if m[i, j] ** 2 > MAX_OFF_DIAGONAL_RATIO_SQUARED * (m[i, i] ** 2 + m[j, j] ** 2):
                    _apply_jacobi_rotation(m, vectors, i, j)
                    done = False
        if done:
            break
    best = 0
    for i in range(1, 4):
        if m[i, i] > m[best, best]:
            best = i
    q = vectors[best]  # w first
    store_matrix(convert_quaternion_to_matrix(q[1], q[2], q[3], q[0]), out.reshape((1, 3, 3)), 0)


@njit(cache=True)
def _apply_jacobi_rotation(m, vectors, i, j):
    """Turn the axes i < j so that m[i, j] becomes 0; only the upper triangle of `m` is kept, eigenvectors are rows."""
    half = (m[j, j] - m[i, i]) / (2 * m[i, j])
    tangent = math.copysign(1.0, half) / (abs(half) + math.sqrt(half * half + 1))
    c = 1 / math.sqrt(tangent * tangent + 1)
    s = tangent * c
    m[i, i] -= tangent * m[i, j]
    m[j, j] += tangent * m[i, j]
    m[i, j] = 0.0
    for k in range(4):
        if k != i and k != j:
            a, b = (min(i, k), max(i, k)), (min(j, k), max(j, k))
            m[a], m[b] = c * m[a] - s * m[b], s * m[a] + c * m[b]
        vectors[i, k], vectors[j, k] = c * vectors[i, k] - s * vectors[j, k], s * vectors[i, k] + c * vectors[j, k]


@njit(cache=True)
def _compute_cross_covariance_frames(seen, places, weight, cross, here, there):
    for t in range(len(seen)):
        compute_weighted_means(seen[t], places, weight[t], here[t], there[t])
        accumulate_cross_covariance(seen[t], places, weight[t], here[t], there[t], cross[t])


@njit(cache=True)
def _fit_rotation_frames(cross, turn):
    m, vectors = np.empty((4, 4)), np.empty((4, 4))
    for t in range(len(cross)):
        compute_nearest_rotation(cross[t], m, vectors, turn[t])


@njit(cache=True)
def _transform_point_frames(points, centre, turn, placed):
    for t in range(len(points)):
        for k in range(points.shape[1]):
            for a in range(3):
                total = 0.0
                for b in range(3):
                    total += (points[t, k, b] - centre[t, b]) * turn[t, b, a]
                placed[t, k, a] = total
