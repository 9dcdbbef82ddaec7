"""How far joints turn: soft walls about ranges of each joint's rotation vector."""

from typing import NamedTuple

import numpy as np

from mocapfix.kernels.rotation import left_jacobian_inverse, logarithm
from mocapfix.kernels.small import matrix, product, times, transposed
from mocapfix.kernels.terms.contract import adds


class Limits(NamedTuple):
    """Residual: how far the rotation vector from the middle to the joint, in the parent's axes, lies outside its range.

    Nothing inside; outside, the excess over its standard deviation, axis by axis.
    """

    middle: np.ndarray  # (J, 3, 3) rotations
    low: np.ndarray  # (J, 3) radians; -inf for none
    high: np.ndarray  # (J, 3) radians; inf for none
    weight: float  # 1 / rad^2


@adds(Limits)
def add(term, t, scale2, tree, pose, system):
    """Add the excess to each free joint's own turn. -> cost"""
    parents, own, b, cost = tree.parents, system.own, system.b, 0.0
    for j in range(1, len(parents)):
        if not tree.free[j] or term.weight == 0.0:
            continue
        x, y, z, c = logarithm(product(matrix(pose.local, j), transposed(matrix(term.middle, j))))
        ex = max(x - term.high[j, 0], 0.0) + min(x - term.low[j, 0], 0.0)
        ey = max(y - term.high[j, 1], 0.0) + min(y - term.low[j, 1], 0.0)
        ez = max(z - term.high[j, 2], 0.0) + min(z - term.low[j, 2], 0.0)
        if ex == 0.0 and ey == 0.0 and ez == 0.0:
            continue
        cost += 0.5 * term.weight * (ex * ex + ey * ey + ez * ez)
        through = product(left_jacobian_inverse(x, y, z, c), transposed(matrix(pose.rotation, parents[j])))
        px, py, pz = times(transposed(through), ex, ey, ez)
        b[j, 0] += term.weight * px
        b[j, 1] += term.weight * py
        b[j, 2] += term.weight * pz
        wx = term.weight if ex != 0.0 else 0.0
        wy = term.weight if ey != 0.0 else 0.0
        wz = term.weight if ez != 0.0 else 0.0
        for a in range(3):
            for d in range(3):
                own[j, a, d] += (
                    wx * through[a] * through[d] + wy * through[3 + a] * through[3 + d] + wz * through[6 + a] * through[6 + d]
                )
    return cost
