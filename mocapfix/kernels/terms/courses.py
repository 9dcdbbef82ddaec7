"""Where each joint's course through time leads it, or where it starts from: a pull as strong about every axis."""

from typing import NamedTuple

import numpy as np

from mocapfix.kernels.rotation import left_jacobian_inverse, logarithm
from mocapfix.kernels.small import matrix, product, times, transposed
from mocapfix.kernels.terms.contract import adds, of_frame


class Courses(NamedTuple):
    """Residual: the rotation vector from the course to each joint, and the root's distance, over their standard deviations.

    One pose for all frames, or one per frame, and likewise how strongly it pulls. A joint of weight zero is not pulled.
    """

    rotations: np.ndarray  # (1 or T, J, 3, 3)
    weight: np.ndarray  # (1 or T, J) 1/rad^2
    root: np.ndarray  # (1 or T, 3) metres
    root_weight: np.ndarray  # (1 or T,) 1/m^2; 0 for none


@adds(Courses)
def add(term, t, scale2, tree, pose, system):
    """Add the pull to each free joint's own turn, and to the root's shift. -> cost"""
    rotations, weight, rotation, local = of_frame(term.rotations, t), of_frame(term.weight, t), pose.rotation, pose.local
    parents, free, own, b, cost = tree.parents, tree.free, system.own, system.b, 0.0
    for j in range(len(parents)):
        w = weight[j]
        if not free[j] or w == 0.0:
            continue
        x, y, z, c = logarithm(product(matrix(local, j), transposed(matrix(rotations, j))))
        cost += 0.5 * w * (x * x + y * y + z * z)
        through = left_jacobian_inverse(x, y, z, c)
        if j:  # the logarithm's derivative leaves its own vector as it is
            back = matrix(rotation, parents[j])
            x, y, z = times(back, x, y, z)
            through = product(through, transposed(back))
        stiff = product(transposed(through), through)
        b[j, 0] += w * x
        b[j, 1] += w * y
        b[j, 2] += w * z
        for a in range(3):
            own[j, a, 0] += w * stiff[3 * a]
            own[j, a, 1] += w * stiff[3 * a + 1]
            own[j, a, 2] += w * stiff[3 * a + 2]
    w, root = of_frame(term.root_weight, t), of_frame(term.root, t)
    for a in range(3):
        e = pose.position[0, a] - root[a]
        cost += 0.5 * w * e * e
        system.g[0, 3 + a] += w * e
        system.h[0, 3 + a, 3 + a] += w
    return cost
