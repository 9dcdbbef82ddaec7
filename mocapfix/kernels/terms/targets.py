"""A mean pose: joint rotations to be near to, about some axes more than about others."""

from typing import NamedTuple

import numpy as np

from mocapfix.kernels.rotation import left_jacobian_inverse, logarithm
from mocapfix.kernels.small import matrix, product, times, transposed
from mocapfix.kernels.terms.contract import adds, of_frame


class Targets(NamedTuple):
    """Residual: the rotation vector from each target to the joint, in the parent's axes, less the one it is to be.

    One pose for all frames, or one per frame, and likewise how strongly it pulls: not at all where the information is zero.
    """

    rotations: np.ndarray  # (1 or T, J, 3, 3)
    information: np.ndarray  # (1 or T, J, 3, 3) 1/rad^2, symmetric
    vectors: np.ndarray = np.zeros((0, 3))  # (J, 3) radians, the same for all frames; (0, 3) for zero


@adds(Targets)
def add(term, t, scale2, tree, pose, system):
    """Add the pull to each free joint's own turn. -> cost

    A turn w of the joint in world axes changes its residual r by J(r) parent' w, J the logarithm's derivative.
    """
    rotations, informations = of_frame(term.rotations, t), of_frame(term.information, t)
    rotation, local = pose.rotation, pose.local
    parents, free, own, b, cost = tree.parents, tree.free, system.own, system.b, 0.0
    for j in range(len(parents)):
        information = matrix(informations, j)
        if not free[j] or information[0] + information[4] + information[8] == 0.0:
            continue
        x, y, z, c = logarithm(product(matrix(local, j), transposed(matrix(rotations, j))))
        through = left_jacobian_inverse(x, y, z, c)
        if j:
            through = product(through, transposed(matrix(rotation, parents[j])))
        if len(term.vectors):
            x, y, z = x - term.vectors[j, 0], y - term.vectors[j, 1], z - term.vectors[j, 2]
        back = transposed(through)
        stiff = product(back, product(information, through))
        px, py, pz = times(information, x, y, z)
        cost += 0.5 * (px * x + py * y + pz * z)
        bx, by, bz = times(back, px, py, pz)
        b[j, 0] += bx
        b[j, 1] += by
        b[j, 2] += bz
        for a in range(3):
            own[j, a, 0] += stiff[3 * a]
            own[j, a, 1] += stiff[3 * a + 1]
            own[j, a, 2] += stiff[3 * a + 2]
    return cost
