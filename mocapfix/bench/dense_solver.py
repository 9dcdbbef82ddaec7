"""The direction as it is mostly computed: one Jacobian of all measurements to all unknowns, its product, a Cholesky solve.

SCOPE's "dense unconstrained formulation" (Eq. 11 and section A.1), in O(K^3) + O(K^2 N), by what is fastest for it: the
Jacobian filled in compiled code, the product by BLAS (syrk), the solve by LAPACK (posv).
"""

import time

import numpy as np
from numba import njit
from scipy.linalg.blas import dgemv, dsyrk  # pyright: ignore[reportAttributeAccessIssue]
from scipy.linalg.lapack import dposv  # pyright: ignore[reportAttributeAccessIssue]

from mocapfix.bench.scope_scenes import DIRECTION_DAMPING, ScopeScene
from mocapfix.kernels.normal_equations import allocate_equations, linearise_terms
from mocapfix.kernels.small_matrices import load_matrix, multiply_vector


class DenseSolver:
    """The direction of one scene, its arrays made once.

    Unknowns x (6 + 3 K + P,): the root's turn and shift, every joint's turn, all in world axes, the shape parameters.
    """

    def __init__(self, scene: ScopeScene) -> None:
        joints, shapes = len(scene.tree.parents), len(scene.tree.shape_basis)
        self.scene, self.tracking_system = scene, allocate_equations(joints, shapes, None)
        self.jacobian, self.residual = (
            np.empty((scene.measurement_count, 3 + 3 * joints + shapes)),
            np.empty(scene.measurement_count),
        )
        self.shape_motion = np.zeros((shapes, joints, 3))

    def compute_direction(self) -> np.ndarray:
        """-> x, the Gauss-Newton step."""
        tree, points, views, directions, pull, pose = self.scene
        write_jacobian(tree, points, views, directions, pose, self.shape_motion, self.jacobian, self.residual)
        across = self.jacobian.T  # column-major, as Fortran wants it
        curvature, gradient = dsyrk(1.0, across, lower=1), dgemv(1.0, across, self.residual)
        add_dense_tracking_term(tree, (pull,), pose, self.tracking_system, curvature, gradient)
        return -dposv(curvature, gradient, lower=1, overwrite_a=1, overwrite_b=1)[1]

    def time_direction(self) -> float:
        """-> what one direction costs the processor."""
        started = time.thread_time()
        self.compute_direction()
        return time.thread_time() - started


@njit(cache=True)
def write_shape_motion(tree, rotation, stretch):
    """Write how every joint moves in the world (P, J, 3) with each shape parameter."""
    for p in range(len(stretch)):
        for j in range(1, len(tree.parents)):
            up, by = tree.parents[j], tree.shape_basis[p, j]
            x, y, z = multiply_vector(load_matrix(rotation, up), by[0], by[1], by[2])
            stretch[p, j, 0] = stretch[p, up, 0] + x
            stretch[p, j, 1] = stretch[p, up, 1] + y
            stretch[p, j, 2] = stretch[p, up, 2] + z


@njit(cache=True)
def write_jacobian_row(tree, position, stretch, j, x, y, z, turn, shift, out):
    """Write one row of the Jacobian: of a number that changes with a body's turn, and with the shift of a point of it.

    The point is (x, y, z) from the origin; `turn` is what a turn of body j about it does, `shift` the point's own shift.
    """
    out[:] = 0.0
    tx, ty, tz = y * shift[2] - z * shift[1], z * shift[0] - x * shift[2], x * shift[1] - y * shift[0]
    tx, ty, tz = turn[0] + tx, turn[1] + ty, turn[2] + tz
    unknowns, shapes, end = len(out), len(stretch), j
    while j > 0:  # a joint turns all below it about its own place
        dx, dy, dz = position[j, 0] - position[0, 0], position[j, 1] - position[0, 1], position[j, 2] - position[0, 2]
        out[3 + 3 * j] = tx + dz * shift[1] - dy * shift[2]
        out[4 + 3 * j] = ty + dx * shift[2] - dz * shift[0]
        out[5 + 3 * j] = tz + dy * shift[0] - dx * shift[1]
        j = tree.parents[j]
    out[0], out[1], out[2], out[3], out[4], out[5] = tx, ty, tz, shift[0], shift[1], shift[2]
    for p in range(shapes):
        s = stretch[p, end]
        out[unknowns - shapes + p] = shift[0] * s[0] + shift[1] * s[1] + shift[2] * s[2]


@njit(cache=True)
def write_jacobian(tree, points, views, directions, pose, stretch, jacobian, residual):
    """Write the Jacobian (N, 6 + 3 K + P) and the residuals (N,) of all measurements, over their standard deviations."""
    position, rotation, row, still, turn, shift = pose.position, pose.rotation, 0, np.zeros(3), np.zeros(3), np.zeros(3)
    write_shape_motion(tree, rotation, stretch)
    for n in range(len(points.joints)):
        j, place, root = points.joints[n], points.offsets[n], np.sqrt(points.weight[0, n])
        x, y, z = multiply_vector(load_matrix(rotation, j), place[0], place[1], place[2])
        at = (x + position[j, 0], y + position[j, 1], z + position[j, 2])
        for a in range(3):
            shift[0], shift[1], shift[2] = 0.0, 0.0, 0.0
            shift[a] = root
            residual[row] = root * (at[a] - points.measured[0, n, a])
            write_jacobian_row(tree, position, stretch, j, at[0] - position[0, 0], at[1] - position[0, 1], at[2] - position[0, 2],
                  still, shift, jacobian[row])  # fmt: skip
            row += 1
    for n in range(len(views.joints)):
        j, place, root = views.joints[n], views.offsets[n], np.sqrt(views.weight[0, n])
        x, y, z = multiply_vector(load_matrix(rotation, j), place[0], place[1], place[2])
        x, y, z = x + position[j, 0], y + position[j, 1], z + position[j, 2]
        m, origin = views.rotation[views.cameras[n]], views.translation[views.cameras[n]]
        image = multiply_vector(load_matrix(views.rotation, views.cameras[n]), x, y, z)
        depth = image[2] + origin[2]
        for a in range(2):
            seen = (image[a] + origin[a]) / depth
            for c in range(3):
                shift[c] = root * (m[a, c] - seen * m[2, c]) / depth
            residual[row] = root * (seen - views.measured[0, n, a])
            write_jacobian_row(tree, position, stretch, j, x - position[0, 0], y - position[0, 1], z - position[0, 2],
                  still, shift, jacobian[row])  # fmt: skip
            row += 1
    shift[0], shift[1], shift[2] = 0.0, 0.0, 0.0
    for n in range(len(directions.joints)):
        j, along, root = directions.joints[n], directions.bone_axes[n], np.sqrt(directions.weight[0, n])
        d = multiply_vector(load_matrix(rotation, j), along[0], along[1], along[2])
        for a in range(3):  # a turn w moves the direction by w x d
            b, c = (a + 1) % 3, (a + 2) % 3
            turn[a], turn[b], turn[c] = 0.0, root * d[c], -root * d[b]
            residual[row] = root * (d[a] - directions.measured[0, n, a])
            write_jacobian_row(tree, position, stretch, j, 0.0, 0.0, 0.0, turn, shift, jacobian[row])
            row += 1


@njit(cache=True)
def add_dense_tracking_term(tree, terms, pose, system, curvature, gradient):
    """Add the pull of every joint to its target, and the damping that the sweep has, too."""
    linearise_terms(tree, terms, 0, np.inf, pose, system)
    for j in range(len(tree.parents)):
        at = 3 + 3 * j if j else 0
        for a in range(3):
            gradient[at + a] += system.g_joint[j, a] if j else system.g[0, a]
            for c in range(a + 1):
                curvature[at + a, at + c] += system.h_joint[j, a, c]
    for i in range(len(gradient)):
        curvature[i, i] += DIRECTION_DAMPING
