"""Orientations of bodies, as an inertial sensor or a rigid cluster of markers tells them."""

from typing import NamedTuple

import numpy as np

from mocapfix.kernels.rotation import left_jacobian_inverse, logarithm
from mocapfix.kernels.small import matrix, product, transposed
from mocapfix.kernels.terms.contract import adds
from mocapfix.kernels.terms.robust import GEMAN_MCCLURE, robust


class Orientations(NamedTuple):
    """Residual: the rotation vector from the orientation seen to the body's, over its standard deviation."""

    joints: np.ndarray  # (O,)
    seen: np.ndarray  # (T, O, 3, 3) rotations, in the world; anything where the weight is 0
    weight: np.ndarray  # (T, O) 1 / rad^2; 0 where not seen
    loss: int = GEMAN_MCCLURE


@adds(Orientations)
def add(term, t, scale2, tree, pose, system):
    """Add the orientations to the curvature and gradient of their bodies' turns. -> cost"""
    h, g, seen, cost = system.h, system.g, term.seen[t], 0.0
    for k in range(len(term.joints)):
        trust = term.weight[t, k]
        if trust == 0.0:
            continue
        j = term.joints[k]
        x, y, z, c = logarithm(product(matrix(pose.rotation, j), transposed(matrix(seen, k))))
        square = x * x + y * y + z * z
        if not square < np.inf:
            continue
        part, weight = robust(term.loss, trust * square, scale2)
        cost += part
        w = trust * weight
        jacobian = left_jacobian_inverse(x, y, z, c)
        curvature = product(transposed(jacobian), jacobian)
        for a in range(3):
            for b in range(a + 1):
                h[j, a, b] += w * curvature[3 * a + b]
        g[j, 0] += w * x  # the logarithm's derivative leaves its own vector as it is
        g[j, 1] += w * y
        g[j, 2] += w * z
    return cost
