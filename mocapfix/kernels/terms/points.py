"""Measured positions of points on the body: markers on a joint's segment, or joints themselves (offset zero)."""

from typing import NamedTuple

import numpy as np

from mocapfix.kernels.terms.contract import GEMAN_MCCLURE, compute_robust_loss, register_term

MAX_POINT_DISTANCE_M = 1e6  # from the body; samples farther away, infinite or NaN are ignored


class PointTerm(NamedTuple):
    """Residual: (position of the point - measured) / standard deviation, three numbers, robust together."""

    joints: np.ndarray  # (K,)
    offsets: np.ndarray  # (K, 3) metres, in the joint's axes
    measured: np.ndarray  # (T, K, 3) metres, in the world; anything where the weight is 0
    weight: np.ndarray  # (T, K) 1 / m^2; 0 for a missing sample
    loss: int = GEMAN_MCCLURE


@register_term(PointTerm)
def add_point_term(term, t, scale2, tree, pose, equations):
    """Add the points to the curvature and gradient of their bodies' twists. Returns the cost."""
    h, g, position, rotation, measured = equations.h, equations.g, pose.position, pose.rotation, term.measured
    ox, oy, oz = position[0, 0], position[0, 1], position[0, 2]
    cost = 0.0
    for k in range(len(term.joints)):
        precision = term.weight[t, k]
        if precision == 0.0:
            continue
        j = term.joints[k]
        a, b, c = term.offsets[k, 0], term.offsets[k, 1], term.offsets[k, 2]
        x = position[j, 0] + rotation[j, 0, 0] * a + rotation[j, 0, 1] * b + rotation[j, 0, 2] * c
        y = position[j, 1] + rotation[j, 1, 0] * a + rotation[j, 1, 1] * b + rotation[j, 1, 2] * c
        z = position[j, 2] + rotation[j, 2, 0] * a + rotation[j, 2, 1] * b + rotation[j, 2, 2] * c
        ex, ey, ez = x - measured[t, k, 0], y - measured[t, k, 1], z - measured[t, k, 2]
        square = ex * ex + ey * ey + ez * ez
        if not square < MAX_POINT_DISTANCE_M * MAX_POINT_DISTANCE_M:
            continue
        loss, weight = compute_robust_loss(term.loss, precision * square, scale2)
        cost += loss
        w = precision * weight
        x, y, z = x - ox, y - oy, z - oz
        wx, wy, wz = w * x, w * y, w * z
        h[j, 0, 0] += wy * y + wz * z
        h[j, 1, 0] -= wx * y
        h[j, 1, 1] += wx * x + wz * z
        h[j, 2, 0] -= wx * z
        h[j, 2, 1] -= wy * z
        h[j, 2, 2] += wx * x + wy * y
        h[j, 3, 1] += wz
        h[j, 3, 2] -= wy
        h[j, 4, 0] -= wz
        h[j, 4, 2] += wx
        h[j, 5, 0] += wy
        h[j, 5, 1] -= wx
        h[j, 3, 3] += w
        h[j, 4, 4] += w
        h[j, 5, 5] += w
        g[j, 0] += wy * ez - wz * ey
        g[j, 1] += wz * ex - wx * ez
        g[j, 2] += wx * ey - wy * ex
        g[j, 3] += w * ex
        g[j, 4] += w * ey
        g[j, 5] += w * ez
    return cost
