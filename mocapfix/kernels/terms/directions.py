"""Where bones point, seen without their place: SCOPE's part orientation field (Eq. 5)."""

from typing import NamedTuple

import numpy as np

from mocapfix.kernels.small import matrix, times
from mocapfix.kernels.terms.contract import adds
from mocapfix.kernels.terms.robust import GEMAN_MCCLURE, robust


class Directions(NamedTuple):
    """Residual: (direction of the bone - seen) / standard deviation, both of length one, so in radians while small."""

    joints: np.ndarray  # (D,) the body that the bone belongs to
    along: np.ndarray  # (D, 3) the bone in its joint's axes, length one
    seen: np.ndarray  # (T, D, 3) length one; anything where the weight is 0
    weight: np.ndarray  # (T, D) 1 / rad^2; 0 where not seen
    loss: int = GEMAN_MCCLURE


@adds(Directions)
def add(term, t, scale2, tree, pose, system):
    """Add the directions to the curvature and gradient of their bodies' turns. -> cost"""
    h, g, cost = system.h, system.g, 0.0
    for k in range(len(term.joints)):
        trust = term.weight[t, k]
        if trust == 0.0:
            continue
        j = term.joints[k]
        x, y, z = times(matrix(pose.rotation, j), term.along[k, 0], term.along[k, 1], term.along[k, 2])
        sx, sy, sz = term.seen[t, k, 0], term.seen[t, k, 1], term.seen[t, k, 2]
        square = (x - sx) ** 2 + (y - sy) ** 2 + (z - sz) ** 2
        if not square < np.inf:
            continue
        part, weight = robust(term.loss, trust * square, scale2)
        cost += part
        w = trust * weight
        h[j, 0, 0] += w * (y * y + z * z)
        h[j, 1, 0] -= w * x * y
        h[j, 1, 1] += w * (x * x + z * z)
        h[j, 2, 0] -= w * x * z
        h[j, 2, 1] -= w * y * z
        h[j, 2, 2] += w * (x * x + y * y)
        g[j, 0] -= w * (y * sz - z * sy)  # the direction itself has no turn about itself: d x (d - seen) = -d x seen
        g[j, 1] -= w * (z * sx - x * sz)
        g[j, 2] -= w * (x * sy - y * sx)
    return cost
