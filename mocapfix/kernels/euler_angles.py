"""Euler angles about any axes in any order, and their rotation matrices.

R = R_axes[0](angles[0]) R_axes[1](angles[1]) ...: the first rotation is the outermost, as BVH channels are listed.
Source: Shuster 1993, "A survey of attitude representations", for the orders; for gimbal lock see `_solve_three_angles`.
"""

import math

import numpy as np

from mocapfix.kernels.compilation import compile_inner_kernel, compile_kernel
from mocapfix.kernels.small_matrices import load_single_matrix, multiply_matrices, store_matrix, transpose_matrix

MIN_GIMBAL_COSINE = 1e-7  # cosine of the middle angle; below it only the sum or difference of the outer angles is known
MAX_ANGLE_FIT_ROUNDS = 30  # of fitting one angle after the other, for joints with fewer than three axes
ANGLE_TOLERANCE_RAD = 1e-12  # total change of a fit's round; below it the fit has converged


@compile_kernel
def compute_euler_matrices(angles, axes):
    """Return (T, 3, 3) rotations of angles (T, D) in radians about axes (D,), each 0, 1 or 2; NaN where an angle is NaN."""
    out = np.empty((len(angles), 3, 3))
    for t in range(len(angles)):
        _compose_rotation(angles[t], axes, out[t])
    return out


@compile_inner_kernel
def _compose_rotation(angles, axes, out):
    for a in range(3):
        for b in range(3):
            out[a, b] = 1.0 if a == b else 0.0
    for d in range(len(axes)):
        _rotate_about_axis(out, axes[d], angles[d])


@compile_inner_kernel
def _rotate_about_axis(m, axis, angle):
    """Replace m by m @ R_axis(angle)."""
    sine, cosine = math.sin(angle), math.cos(angle)
    j, k = (axis + 1) % 3, (axis + 2) % 3
    for row in range(3):
        a, b = m[row, j], m[row, k]
        m[row, j], m[row, k] = cosine * a + sine * b, cosine * b - sine * a


@compile_kernel
def compute_continuous_euler_angles(rotations, axes, start):
    """Return (T, D) radians about `axes` (D,) of rotations (T, 3, 3), each frame's nearest to the frame before.

    The first frame's angles are the nearest to `start` (D,). About three different axes two triples give the same rotation,
    (a, b, c) and (a + pi, pi - b, c + pi), each up to full turns; the nearer one is chosen. Look-ahead cannot improve on this,
    as the cost of a step does not depend on earlier choices. With fewer axes (a knee's one) the angles of the nearest rotation
    are returned.
    """
    out = np.empty((len(rotations), len(axes)))
    current = start.copy()
    three = len(axes) == 3 and axes[0] != axes[1] and axes[1] != axes[2] and axes[0] != axes[2]
    for t in range(len(rotations)):
        if three:
            _solve_three_angles(rotations[t], axes, current)
        else:
            _fit_angles(rotations[t], axes, current)
        for d in range(len(axes)):
            out[t, d] = current[d]
    return out


@compile_inner_kernel
def _solve_three_angles(r, axes, current):
    """Replace `current` (3,) by the angles of rotation `r` that are nearest to it.

    In gimbal lock only the sum (or difference) of the outer angles is known: both take half of its change.
    """
    i, j, k = axes[0], axes[1], axes[2]
    parity = 1.0 if (i + 1) % 3 == j else -1.0
    cosine = math.hypot(r[i, i], r[i, j])
    middle = math.atan2(parity * r[i, k], cosine)
    if cosine < MIN_GIMBAL_COSINE:
        side = parity if middle > 0 else -parity
        change = _wrap_angle(math.atan2(parity * r[k, j], r[j, j]) - (current[0] + side * current[2]))
        current[0] += change / 2
        current[1] += _wrap_angle(middle - current[1])
        current[2] += side * change / 2
        return
    first, last = math.atan2(-parity * r[j, k], r[k, k]), math.atan2(-parity * r[i, j], r[i, i])
    da, db, dc = _wrap_angle(first - current[0]), _wrap_angle(middle - current[1]), _wrap_angle(last - current[2])
    ea, eb = _wrap_angle(first + np.pi - current[0]), _wrap_angle(np.pi - middle - current[1])
    ec = _wrap_angle(last + np.pi - current[2])
    if ea * ea + eb * eb + ec * ec < da * da + db * db + dc * dc:
        da, db, dc = ea, eb, ec
    current[0] += da
    current[1] += db
    current[2] += dc


@compile_inner_kernel
def _fit_angles(r, axes, current):
    """Replace `current` (D,) by the angles of the rotation nearest to `r`: coordinate descent, each angle in closed form."""
    before, after, remaining = np.empty((3, 3)), np.empty((3, 3)), np.empty((1, 3, 3))
    for _ in range(MAX_ANGLE_FIT_ROUNDS if len(axes) > 1 else 1):
        change = 0.0
        for d in range(len(axes)):
            _compose_rotation(current[:d], axes[:d], before)
            _compose_rotation(current[d + 1 :], axes[d + 1 :], after)
            rest = multiply_matrices(transpose_matrix(load_single_matrix(before)), load_single_matrix(r))
            store_matrix(multiply_matrices(rest, transpose_matrix(load_single_matrix(after))), remaining, 0)
            j, k = (axes[d] + 1) % 3, (axes[d] + 2) % 3
            angle = math.atan2(remaining[0, k, j] - remaining[0, j, k], remaining[0, j, j] + remaining[0, k, k])
            step = _wrap_angle(angle - current[d])
            current[d] += step
            change += abs(step)
        if change < ANGLE_TOLERANCE_RAD:
            return


@compile_inner_kernel
def _wrap_angle(angle):
    """Return the equivalent angle within half a turn of zero."""
    return angle - 2 * np.pi * np.round(angle / (2 * np.pi))
