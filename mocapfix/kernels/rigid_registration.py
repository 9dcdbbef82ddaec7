"""Rigid registration of point clouds, compiled: weighted cross-covariances and the rotation that fits them best.

`compute_nearest_rotation` solves for the rotation by an eigenvector, for any cloud; `solve_wahba` in closed form, for clouds
that are wider than a line, and `fit_rotation` by whichever applies. `stats.rigid_alignment` has NumPy wrappers for whole takes.
"""

import math

import numpy as np

from mocapfix.kernels.compilation import compile_inner_kernel, compile_kernel
from mocapfix.kernels.lie import convert_quaternion_to_matrix, orthonormalise_rotation
from mocapfix.kernels.small_matrices import (
    copy_array,
    load_single_matrix,
    multiply_matrices,
    multiply_vector,
    store_matrix,
    transpose_matrix,
)

MAX_JACOBI_SWEEPS = 10  # Jacobi's method converges quadratically, in four or five
MAX_OFF_DIAGONAL_RATIO_SQUARED = 1e-32  # of an off-diagonal entry to the diagonal, squared: below it the entry is rounding error
MIN_WEIGHT_SUM = 1e-12  # added to a sum of weights, so that a frame without points divides by more than zero
MIN_CLOUD_WIDTH_RATIO = 1e-6  # of a determinant to the cloud's size cubed: below it the cloud counts as a line
MAX_NEWTON_STEPS = 50  # of the search for the quartic's root
NEWTON_TOLERANCE = 1e-15  # of a Newton step to the root: below it the search ends


@compile_inner_kernel
def compute_weighted_means(points, model, weight, mean_points, mean_model):
    """Write the weighted means (3,) of one frame's `points` (K, 3) and of the `model` (K, 3)."""
    total = MIN_WEIGHT_SUM
    for a in range(3):
        mean_points[a], mean_model[a] = 0.0, 0.0
    for k in range(len(weight)):
        if weight[k] > 0:
            total += weight[k]
            for a in range(3):
                mean_points[a] += weight[k] * points[k, a]
                mean_model[a] += weight[k] * model[k, a]
    for a in range(3):
        mean_points[a] /= total
        mean_model[a] /= total


@compile_inner_kernel
def accumulate_cross_covariance(points, model, weight, mean_points, mean_model, cross):
    """Write the weighted sum (3, 3) of the outer products of points - mean_points and model - mean_model, of one frame."""
    for a in range(3):
        for b in range(3):
            cross[a, b] = 0.0
    for k in range(len(weight)):
        if weight[k] > 0:
            for a in range(3):
                lever = weight[k] * (points[k, a] - mean_points[a])
                for b in range(3):
                    cross[a, b] += lever * (model[k, b] - mean_model[b])


@compile_inner_kernel
def compute_nearest_rotation(cross, m, vectors, out):
    """Write into `out` (3, 3) the rotation that maximises trace(out' cross).

    Its quaternion is the eigenvector of a symmetric 4 x 4 matrix with the largest eigenvalue (Horn 1987, "Closed-form solution
    of absolute orientation using unit quaternions"), so that the result is a rotation for any cloud.
    `m` and `vectors` (4, 4) are overwritten.
    """
    xx, yy, zz = cross[0, 0], cross[1, 1], cross[2, 2]
    m[0, 0], m[1, 1], m[2, 2], m[3, 3] = xx + yy + zz, xx - yy - zz, yy - xx - zz, zz - xx - yy
    m[0, 1], m[0, 2], m[0, 3] = cross[2, 1] - cross[1, 2], cross[0, 2] - cross[2, 0], cross[1, 0] - cross[0, 1]
    m[1, 2], m[1, 3], m[2, 3] = cross[0, 1] + cross[1, 0], cross[2, 0] + cross[0, 2], cross[1, 2] + cross[2, 1]
    for i in range(4):
        for j in range(4):
            vectors[i, j] = 1.0 if i == j else 0.0
    for _ in range(MAX_JACOBI_SWEEPS):
        converged = True
        for i in range(3):
            for j in range(i + 1, 4):
                if m[i, j] ** 2 > MAX_OFF_DIAGONAL_RATIO_SQUARED * (m[i, i] ** 2 + m[j, j] ** 2):
                    _apply_jacobi_rotation(m, vectors, i, j)
                    converged = False
        if converged:
            break
    best = 0
    for i in range(1, 4):
        if m[i, i] > m[best, best]:
            best = i
    q = vectors[best]  # w first
    store_matrix(convert_quaternion_to_matrix(q[1], q[2], q[3], q[0]), out.reshape((1, 3, 3)), 0)


@compile_inner_kernel
def _apply_jacobi_rotation(m, vectors, i, j):
    """Rotate the axes i < j so that m[i, j] becomes 0; only the upper triangle of `m` is kept, eigenvectors are rows."""
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


@compile_inner_kernel
def solve_wahba(b):
    """Return whether the cloud is wider than a line, and the rotation that maximises trace(R' b), in closed form.

    b is the cross-covariance, nine numbers. Markley 1993, "Attitude determination using vector observations: a fast optimal
    matrix algorithm"; the largest root of its quartic is found by Newton's method from above.
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
    # With s the singular values, the last with the sign of det: root = sum s and root^2 = norm + 2 sum s_i s_j, where the square
    # of that sum is minors + 2 det root. As root^2 <= 3 norm, the start is an upper bound, and equal to the root for a plane.
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


@compile_inner_kernel
def fit_rotation(cross, m, vectors, out):
    """Return the rotation, as nine numbers, that maximises trace(R' cross); `m`, `vectors` (4, 4) and `out` are overwritten."""
    is_wide, rotation = solve_wahba(load_single_matrix(cross))
    if not is_wide:
        compute_nearest_rotation(cross, m, vectors, out)
        rotation = load_single_matrix(out)
    return rotation


@compile_kernel
def compute_cross_covariance_frames(points, model, weight, cross, mean_points, mean_model):
    """Write cross-covariances (T, 3, 3) and weighted means (T, 3) of points (T, K, 3) and a model (K, 3)."""
    for t in range(len(points)):
        compute_weighted_means(points[t], model, weight[t], mean_points[t], mean_model[t])
        accumulate_cross_covariance(points[t], model, weight[t], mean_points[t], mean_model[t], cross[t])


@compile_kernel
def fit_rotation_frames(cross, rotation):
    """Write the nearest rotations (T, 3, 3) of cross-covariances (T, 3, 3)."""
    m, vectors = np.empty((4, 4)), np.empty((4, 4))
    for t in range(len(cross)):
        store_matrix(fit_rotation(cross[t], m, vectors, rotation[t]), rotation, t)


@compile_kernel(nogil=True)
def align_cluster_frames(markers, frames, cluster, weight, local, rotation, centre):
    """Write a cluster in axes that follow its mean shape, `local` (N, K, 3), and these axes: rotation (N, 3, 3), centre (N, 3).

    The shape is that of the first frame, and then the mean of all frames in the axes that follow that one.

    Args:
        markers: (M, T, 3).
        frames, cluster: The N frames, and the K markers of the cluster, which they show.
        weight: (K,), of each.
    """
    m, vectors, cross, lever = np.empty((4, 4)), np.empty((4, 4)), np.empty((1, 3, 3)), np.empty((len(cluster), 3))
    shape, share, total = np.empty((len(cluster), 3)), np.empty(len(cluster)), 0.0
    for k in range(len(cluster)):  # loops, since whole arrays compile the text of their errors
        copy_array(markers[cluster[k], frames[0]], shape[k])
        total += weight[k]
    for k in range(len(cluster)):
        share[k] = weight[k] / total
    for _ in range(2):
        for a in range(3):  # levers about the mean, so that the points need not be relative to theirs
            mean = 0.0
            for k in range(len(cluster)):
                mean += share[k] * shape[k, a]
            for k in range(len(cluster)):
                lever[k, a], shape[k, a] = share[k] * (shape[k, a] - mean), 0.0
        for n in range(len(frames)):
            cx = cy = cz = xx = xy = xz = yx = yy = yz = zx = zy = zz = 0.0  # an array would be written for every marker
            for k in range(len(cluster)):
                point, s, u, v, w = markers[cluster[k], frames[n]], share[k], lever[k, 0], lever[k, 1], lever[k, 2]
                x, y, z = point[0], point[1], point[2]
                cx, cy, cz = cx + s * x, cy + s * y, cz + s * z
                xx, xy, xz, yx, yy, yz = xx + x * u, xy + x * v, xz + x * w, yx + y * u, yy + y * v, yz + y * w
                zx, zy, zz = zx + z * u, zy + z * v, zz + z * w
            store_matrix((xx, xy, xz, yx, yy, yz, zx, zy, zz), cross, 0)
            centre[n, 0], centre[n, 1], centre[n, 2] = cx, cy, cz
            r = fit_rotation(cross[0], m, vectors, rotation[n])
            store_matrix(r, rotation, n)
            for k in range(len(cluster)):
                point = markers[cluster[k], frames[n]]
                x, y, z = multiply_vector(transpose_matrix(r), point[0] - cx, point[1] - cy, point[2] - cz)
                local[n, k, 0], local[n, k, 1], local[n, k, 2] = x, y, z
                shape[k, 0], shape[k, 1], shape[k, 2] = shape[k, 0] + x, shape[k, 1] + y, shape[k, 2] + z
        for k in range(len(cluster)):
            for a in range(3):
                shape[k, a] /= len(frames)


@compile_kernel
def transform_point_frames(points, origin, rotation, out):
    """Write world points (T, K, 3) in the axes rotation (T, 3, 3) about origin (T, 3)."""
    for t in range(len(points)):
        for k in range(points.shape[1]):
            for a in range(3):
                total = 0.0
                for b in range(3):
                    total += (points[t, k, b] - origin[t, b]) * rotation[t, b, a]
                out[t, k, a] = total
