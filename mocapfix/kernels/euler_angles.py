"""Euler angles about any axes in any order, and the matrices they mean.

R = R_axes[0](angles[0]) R_axes[1](angles[1]) ...: the first is the outermost, as the channels of a BVH are listed.
Source: Shuster 1993, "A survey of attitude representations", for the orders; gimbal lock as said at `_closed`.
"""

import math

import numpy as np
from numba import njit

MIN_GIMBAL_COSINE = 1e-7  # cosine of the middle angle below which the outer ones cannot be told apart
MAX_ANGLE_FIT_ROUNDS = 30  # of fitting one angle after the other, where a joint is not free in all three


@njit(cache=True)
def compute_euler_matrices(angles, axes):
    """-> (T, 3, 3) rotations, of angles (T, D) in radians about axes (D,), each 0, 1 or 2; NaN where an angle is NaN."""
    out = np.empty((len(angles), 3, 3))
    for t in range(len(angles)):
        _compose_rotation(angles[t], axes, out[t])
    return out


@njit(cache=True)
def _compose_rotation(angles, axes, out):
    out[:] = 0.0
    out[0, 0] = out[1, 1] = out[2, 2] = 1.0
    for d in range(len(axes)):
        _rotate_about_axis(out, axes[d], angles[d])


@njit(cache=True)
def _rotate_about_axis(m, axis, angle):
    """m becomes m @ R_axis(angle)."""
    sine, cosine = math.sin(angle), math.cos(angle)
    j, k = (axis + 1) % 3, (axis + 2) % 3
    for row in range(3):
        a, b = m[row, j], m[row, k]
        m[row, j], m[row, k] = cosine * a + sine * b, cosine * b - sine * a


@njit(cache=True)
def compute_continuous_euler_angles(rotations, axes, start):
    """-> (T, D) radians about `axes` (D,), of rotations (T, 3, 3), each frame's nearest to the one before, the first's to
    `start` (D,).

    About three different axes two triples turn alike, (a, b, c) and (a + pi, pi - b, c + pi), each up to whole turns: the
    nearer is taken. No look-ahead would do better, for what a step costs does not depend on which was taken before. With
    fewer axes (a knee's one) the angles are those whose rotation comes nearest to what is asked.
    """
    out = np.empty((len(rotations), len(axes)))
    near = start.copy()
    three = len(axes) == 3 and axes[0] != axes[1] and axes[1] != axes[2] and axes[0] != axes[2]
    for t in range(len(rotations)):
        if three:
            _solve_three_angles(rotations[t], axes, near)
        else:
            _fit_angles(rotations[t], axes, near)
        out[t] = near
    return out


@njit(cache=True)
def _solve_three_angles(r, axes, near):
    """Put into `near` (3,) the triple of rotation `r` that is nearest to it."""
    i, j, k = axes[0], axes[1], axes[2]
    way = 1.0 if (i + 1) % 3 == j else -1.0
    cosine = math.hypot(r[i, i], r[i, j])
    middle = math.atan2(way * r[i, k], cosine)
    if cosine < MIN_GIMBAL_COSINE:
        # Only a + c (or a - c) is known: both angles share the change.
        side = way if middle > 0 else -way
        change = _wrap_angle(math.atan2(way * r[k, j], r[j, j]) - (near[0] + side * near[2]))
        near[0] += change / 2
        near[1] += _wrap_angle(middle - near[1])
        near[2] += side * change / 2
        return
    first, last = math.atan2(-way * r[j, k], r[k, k]), math.atan2(-way * r[i, j], r[i, i])
    da, db, dc = _wrap_angle(first - near[0]), _wrap_angle(middle - near[1]), _wrap_angle(last - near[2])
    ea, eb, ec = _wrap_angle(first + np.pi - near[0]), _wrap_angle(np.pi - middle - near[1]), _wrap_angle(last + np.pi - near[2])
    if ea * ea + eb * eb + ec * ec < da * da + db * db + dc * dc:
        da, db, dc = ea, eb, ec
    near[0] += da
    near[1] += db
    near[2] += dc


@njit(cache=True)
def _fit_angles(r, axes, near):
    """Put into `near` (D,) angles about any axes that come nearest to rotation `r`: each in turn the best, given the others."""
    before, after = np.empty((3, 3)), np.empty((3, 3))
    for _ in range(MAX_ANGLE_FIT_ROUNDS if len(axes) > 1 else 1):
        moved = 0.0
        for d in range(len(axes)):
            _compose_rotation(near[:d], axes[:d], before)
            _compose_rotation(near[d + 1 :], axes[d + 1 :], after)
            left = before.T @ np.ascontiguousarray(r) @ after.T
            j, k = (axes[d] + 1) % 3, (axes[d] + 2) % 3
            step = _wrap_angle(math.atan2(left[k, j] - left[j, k], left[j, j] + left[k, k]) - near[d])
            near[d] += step
            moved += abs(step)
        if moved < 1e-12:
            return


@njit(cache=True)
def _wrap_angle(angle):
    """The same angle within half a turn of zero."""
    return angle - 2 * np.pi * np.round(angle / (2 * np.pi))
