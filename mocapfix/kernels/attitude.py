"""The rotation that lays one cloud on another, in closed form without an eigenvector, compiled."""

import math

from numba import njit

from mocapfix.kernels.rotation import orthonormalised
from mocapfix.kernels.small import product, transposed

THIN = 1e-6  # of its size cubed: a cloud nearer to a line than that is taken for one
STEPS, ENOUGH = 50, 1e-15  # of Newton's method at most; of the root: it has been found


@njit(cache=True)
def attitude(b):
    """-> whether the cloud is more than a line, and the rotation that maximises trace(R' b), in closed form.

    Markley 1993, "Attitude determination using vector observations: a fast optimal matrix algorithm"; the largest root of its
    quartic by Newton's method from above.
    """
    cof = (
        b[4] * b[8] - b[5] * b[7], b[5] * b[6] - b[3] * b[8], b[3] * b[7] - b[4] * b[6],
        b[2] * b[7] - b[1] * b[8], b[0] * b[8] - b[2] * b[6], b[1] * b[6] - b[0] * b[7],
        b[1] * b[5] - b[2] * b[4], b[2] * b[3] - b[0] * b[5], b[0] * b[4] - b[1] * b[3],
    )  # fmt: skip
    norm, minors = 0.0, 0.0
    for n in range(9):
        norm += b[n] * b[n]
        minors += cof[n] * cof[n]
    det = b[0] * cof[0] + b[1] * cof[1] + b[2] * cof[2]
    # with s the singular values, the last of the sign of det: root = sum s, root^2 = norm + 2 sum s_i s_j, which squared is
    # minors + 2 det root; and root^2 <= 3 norm, so that this is not below it, and it itself for a plane
    root = math.sqrt(norm + 2 * math.sqrt(minors + 2 * max(det, 0.0) * math.sqrt(3 * norm)))
    for _ in range(STEPS):
        rest = root * root - norm
        slope = 4 * (root * rest - 2 * det)
        step = (rest * rest - 8 * root * det - 4 * minors) / slope if slope > 0 else 0.0
        root -= step
        if step <= ENOUGH * root:
            break
    kappa = 0.5 * (root * root - norm)
    zeta = kappa * root - det
    if not zeta > THIN * norm * math.sqrt(norm):
        return False, b
    cubed, c = product(b, product(transposed(b), b)), kappa + norm
    return True, orthonormalised((
        c * b[0] + root * cof[0] - cubed[0], c * b[1] + root * cof[1] - cubed[1], c * b[2] + root * cof[2] - cubed[2],
        c * b[3] + root * cof[3] - cubed[3], c * b[4] + root * cof[4] - cubed[4], c * b[5] + root * cof[5] - cubed[5],
        c * b[6] + root * cof[6] - cubed[6], c * b[7] + root * cof[7] - cubed[7], c * b[8] + root * cof[8] - cubed[8],
    ))  # fmt: skip
