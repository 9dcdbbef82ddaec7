"""The direction as it is mostly computed: one Jacobian of all measurements to all unknowns, its product, a Cholesky solve.

SCOPE's "dense unconstrained formulation" (Eq. 11 and section A.1), in O(K^3) + O(K^2 N), by what is fastest for it: the
Jacobian filled in compiled code, the product by BLAS (syrk), the solve by LAPACK (posv).
"""

import numpy as np
from numba import njit
from scipy.linalg.blas import dgemv, dsyrk  # pyright: ignore[reportAttributeAccessIssue]
from scipy.linalg.lapack import dposv  # pyright: ignore[reportAttributeAccessIssue]

from mocapfix.bench.scene import ORIENTATION, POINT, PROJECTION, ROWS, Scene, rows, stretched
from mocapfix.kernels.residuals import joint_target


class Dense:
    """The direction of one scene, its arrays made once.

    Unknowns x (6 + 3 K + P,): the root's turn and shift, every joint's turn, all in world axes, the shape parameters.
    """

    def __init__(self, scene: Scene) -> None:
        measured = (scene.points, scene.projections, scene.orientations)
        count = sum(each * len(group.joints) for each, group in zip(ROWS, measured, strict=True))
        self.scene, joints, shapes = scene, len(scene.local), len(scene.growth)
        self.jacobian, self.residual = np.empty((count, 3 + 3 * joints + shapes)), np.empty(count)
        self.stretch = np.empty((shapes, joints, 3))

    def direction(self) -> np.ndarray:
        """-> x (6 + 3 K + P,), the Gauss-Newton step."""
        fill(self.scene, self.stretch, self.jacobian, self.residual)
        across = self.jacobian.T  # column-major, as Fortran wants it
        curvature, gradient = dsyrk(1.0, across, lower=1), dgemv(1.0, across, self.residual)
        add_priors(self.scene, curvature, gradient)
        return -dposv(curvature, gradient, lower=1, overwrite_a=1, overwrite_b=1)[1]


@njit(cache=True)
def fill(scene, stretch, jacobian, residual):
    """Write the Jacobian (N, 6 + 3 K + P) and the residuals (N,) of all measurements."""
    jacobian.fill(0)
    stretched(scene, stretch)
    row = fill_kind(scene, POINT, scene.points, stretch, jacobian, residual, 0)
    row = fill_kind(scene, PROJECTION, scene.projections, stretch, jacobian, residual, row)
    fill_kind(scene, ORIENTATION, scene.orientations, stretch, jacobian, residual, row)


@njit(cache=True)
def fill_kind(scene, kind, measured, stretch, jacobian, residual, row):
    """Write the rows of one kind of measurements from `row` on. -> the row after them"""
    shapes, unknowns = len(stretch), jacobian.shape[1]
    by_place, by_twist, by_shape, error = np.empty((3, 3)), np.empty((3, 6)), np.empty((3, shapes)), np.empty(3)
    for n in range(len(measured.joints)):
        count = rows(scene, kind, measured, n, stretch, by_place, by_twist, by_shape, error)
        for a in range(count):
            out, (tx, ty, tz), (sx, sy, sz) = jacobian[row], by_twist[a, :3], by_twist[a, 3:]
            j = measured.joints[n]
            while j > 0:  # a joint turns all below it about its own place
                x = scene.position[j, 0] - scene.position[0, 0]
                y = scene.position[j, 1] - scene.position[0, 1]
                z = scene.position[j, 2] - scene.position[0, 2]
                out[3 + 3 * j] = tx + z * sy - y * sz
                out[4 + 3 * j] = ty + x * sz - z * sx
                out[5 + 3 * j] = tz + y * sx - x * sy
                j = scene.tree.parents[j]
            out[0], out[1], out[2], out[3], out[4], out[5] = tx, ty, tz, sx, sy, sz
            for p in range(shapes):
                out[unknowns - shapes + p] = by_shape[a, p]
            residual[row] = error[a]
            row += 1
    return row


@njit(cache=True)
def add_priors(scene, curvature, gradient):
    """Add the pull of every joint to its target, and a unit normal on each shape parameter (SCOPE, Eq. 5, terms 5 and 6)."""
    own, b, unturned = np.empty((3, 3)), np.empty(3), np.eye(3)
    for j in range(len(scene.local)):
        own.fill(0)
        b.fill(0)
        parent = scene.rotation[scene.tree.parents[j]] if j else unturned
        joint_target(scene.local[j], scene.pull.rotations[j], scene.pull.information[j], parent, own, b, True)
        at = 3 + 3 * j if j else 0
        for a in range(3):
            gradient[at + a] += b[a]
            for c in range(3):
                curvature[at + a, at + c] += own[a, c]
    for p in range(len(scene.growth)):
        curvature[len(curvature) - 1 - p, len(curvature) - 1 - p] += 1.0
