"""One number that depends on all joints at once, as MNN-IK's naturalness does (Eq. 3.3, the scalar g).

The paper puts a squared norm into the residual vector, so that the energy carries its square: one dense row of rank one. The
number and its gradient are handed in at a pose and asked again between solves.
"""

import math
from typing import NamedTuple

import numpy as np

from mocapfix.kernels.rotation import left_jacobian_inverse, logarithm
from mocapfix.kernels.small import matrix, product, times, transposed
from mocapfix.kernels.terms.contract import adds


class Whole(NamedTuple):
    """Residual: (value + sum over joints of gradient . rotation vector from `at` to the joint) / standard deviation."""

    value: np.ndarray  # (T,)
    gradient: np.ndarray  # (T, J, 3) per radian, in the parents' axes
    at: np.ndarray  # (T, J, 3, 3) the local rotations where value and gradient were taken
    weight: np.ndarray  # (T,) one over the variance; 0 for none


@adds(Whole)
def add(term, t, scale2, tree, pose, system):
    """Write the row. -> cost"""
    m = system.written[0]
    system.written[0] += 1
    if term.weight[t] == 0.0:
        return 0.0
    root, total, gradient, at = math.sqrt(term.weight[t]), term.value[t], term.gradient[t], term.at[t]
    for j in range(len(tree.parents)):
        if not tree.free[j]:
            continue
        x, y, z, c = logarithm(product(matrix(pose.local, j), transposed(matrix(at, j))))
        total += gradient[j, 0] * x + gradient[j, 1] * y + gradient[j, 2] * z
        back = transposed(left_jacobian_inverse(x, y, z, c))
        if j:
            back = product(matrix(pose.rotation, tree.parents[j]), back)
        gx, gy, gz = times(back, gradient[j, 0], gradient[j, 1], gradient[j, 2])
        row = system.rows_own[m]
        row[j, 0], row[j, 1], row[j, 2] = root * gx, root * gy, root * gz
    system.away[m] = root * total
    return 0.5 * system.away[m] ** 2
