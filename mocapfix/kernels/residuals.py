"""The terms of the pose solve: each adds its cost, gradient and curvature to the bodies or joints it touches."""

import numpy as np
from numba import njit

from mocapfix.kernels.rotation import left_jacobian_inverse, logarithm, multiply


@njit(cache=True)
def geman_mcclure(square, scale2):
    """-> cost and weight of a squared, normalised residual: 1/2 c^2 s^2 / (c^2 + s^2) and its derivative to 1/2 s^2.

    Geman & McClure (1987); `scale2` = c^2, infinite for plain least squares.
    """
    if scale2 == np.inf:
        return 0.5 * square, 1.0
    part = scale2 / (scale2 + square)
    return 0.5 * square * part, part * part


@njit(cache=True)
def markers(joints, places, seen, inverse_variance, scale2, position, rotation, h, g):
    """Marker positions, weighted and robust. -> cost; adds to each body's h (J, 6, 6) and g (J, 6).

    seen      (K, 3) metres: measured positions, whatever where inverse_variance is 0
    inverse_variance  (K,) 1 / m^2
    scale2    squared Geman-McClure scale in units of the markers' standard deviation
    """
    cost = 0.0
    ox, oy, oz = position[0, 0], position[0, 1], position[0, 2]
    for k in range(len(joints)):
        if inverse_variance[k] == 0.0:
            continue
        j = joints[k]
        r, p, c = rotation[j], position[j], places[k]
        x = p[0] + r[0, 0] * c[0] + r[0, 1] * c[1] + r[0, 2] * c[2]
        y = p[1] + r[1, 0] * c[0] + r[1, 1] * c[1] + r[1, 2] * c[2]
        z = p[2] + r[2, 0] * c[0] + r[2, 1] * c[1] + r[2, 2] * c[2]
        ex, ey, ez = x - seen[k, 0], y - seen[k, 1], z - seen[k, 2]
        part, weight = geman_mcclure(inverse_variance[k] * (ex * ex + ey * ey + ez * ez), scale2)
        cost += part
        w = inverse_variance[k] * weight
        x, y, z = x - ox, y - oy, z - oz
        hj, gj = h[j], g[j]
        hj[0, 0] += w * (y * y + z * z)
        hj[1, 1] += w * (x * x + z * z)
        hj[2, 2] += w * (x * x + y * y)
        hj[1, 0] -= w * x * y
        hj[2, 0] -= w * x * z
        hj[2, 1] -= w * y * z
        hj[3, 1] += w * z
        hj[3, 2] -= w * y
        hj[4, 0] -= w * z
        hj[4, 2] += w * x
        hj[5, 0] += w * y
        hj[5, 1] -= w * x
        hj[3, 3] += w
        hj[4, 4] += w
        hj[5, 5] += w
        gj[0] += w * (y * ez - z * ey)
        gj[1] += w * (z * ex - x * ez)
        gj[2] += w * (x * ey - y * ex)
        gj[3] += w * ex
        gj[4] += w * ey
        gj[5] += w * ez
    for j in range(len(h)):  # the markers' part is symmetric: the upper triangle mirrors the lower
        for a in range(6):
            for b in range(a):
                h[j, b, a] = h[j, a, b]
    return cost


@njit(cache=True)
def marker_cost(joints, places, seen, inverse_variance, scale2, position, rotation):
    """-> the cost of `markers` alone."""
    cost = 0.0
    for k in range(len(joints)):
        if inverse_variance[k] == 0.0:
            continue
        j = joints[k]
        square = 0.0
        for a in range(3):
            e = position[j, a] - seen[k, a]
            for c in range(3):
                e += rotation[j, a, c] * places[k, c]
            square += e * e
        cost += geman_mcclure(inverse_variance[k] * square, scale2)[0]
    return cost


@njit(cache=True)
def joint_target(local, target, information, parent_rotation, own, b, derive):
    """The pull of a joint's local rotation to a target. -> cost; with `derive` also adds to own (3, 3) and b (3,).

    The residual is r = log(local target'), in the parent's axes, its cost 1/2 r' information r. A turn w of the joint
    in world axes changes r by J(r) parent_rotation' w.
    """
    relative, r, jacobian, through = np.empty((3, 3)), np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    multiply(local, target.T, relative)
    logarithm(relative, r)
    pull = np.empty(3)
    cost = 0.0
    for a in range(3):
        pull[a] = information[a, 0] * r[0] + information[a, 1] * r[1] + information[a, 2] * r[2]
        cost += 0.5 * pull[a] * r[a]
    if derive:
        left_jacobian_inverse(r, jacobian)
        multiply(jacobian, parent_rotation.T, through)
        for a in range(3):
            for c in range(3):
                b[a] += through[c, a] * pull[c]
            for d in range(3):
                total = 0.0
                for c in range(3):
                    for e in range(3):
                        total += through[c, a] * information[c, e] * through[e, d]
                own[a, d] += total
    return cost
