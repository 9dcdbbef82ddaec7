"""The Gauss-Newton direction by the usual dense method: one Jacobian of all measurements, its product, a Cholesky solve.

This is SCOPE's "dense unconstrained formulation" (Eq. 11 and section A.1) in O(K^3) + O(K^2 N), with its fastest implementation:
the Jacobian in compiled code, the product by BLAS (syrk), the solve by LAPACK (posv).
"""

# Compiled functions take arrays of any type, which numba infers.
# pyright: reportUnknownParameterType=false, reportMissingParameterType=false

import time

import numpy as np
from jaxtyping import Float
from numba import njit
from scipy.linalg.blas import dgemv, dsyrk  # pyright: ignore[reportAttributeAccessIssue]  # not in the stubs
from scipy.linalg.lapack import dposv  # pyright: ignore[reportAttributeAccessIssue]  # not in the stubs

from mocapfix.bench.scope_scenes import DIRECTION_DAMPING, ScopeScene
from mocapfix.kernels.normal_equations import allocate_equations, linearise_terms
from mocapfix.kernels.small_matrices import load_matrix, multiply_vector


class DenseSolver:
    """The dense direction of one scene, with preallocated arrays.

    The unknowns (6 + 3 K + P,) are rotation and translation of the root, rotations of the joints in world axes, and the shape
    parameters.
    """

    def __init__(self, scene: ScopeScene) -> None:
        joint_count, shape_count = len(scene.tree.parents), len(scene.tree.shape_basis)
        self.scene, self.tracking_system = scene, allocate_equations(joint_count, shape_count, None)
        self.jacobian = np.empty((scene.measurement_count, 3 + 3 * joint_count + shape_count))
        self.residual = np.empty(scene.measurement_count)
        self.shape_motion = np.zeros((shape_count, joint_count, 3))

    def compute_direction(self) -> Float[np.ndarray, " X"]:
        """Return the Gauss-Newton step."""
        tree, points, views, directions, tracking, pose = self.scene
        write_jacobian(tree, (points, views, directions), pose, self.shape_motion, self.jacobian, self.residual)
        transposed = self.jacobian.T  # column-major, as Fortran expects
        curvature, gradient = dsyrk(1.0, transposed, lower=1), dgemv(1.0, transposed, self.residual)
        add_dense_tracking_term(tree, (tracking,), pose, self.tracking_system, curvature, gradient)
        return -dposv(curvature, gradient, lower=1, overwrite_a=1, overwrite_b=1)[1]

    def time_direction(self) -> float:
        """Return the processor time of one direction in seconds."""
        started = time.thread_time()
        self.compute_direction()
        return time.thread_time() - started


@njit(cache=True)
def write_shape_motion(tree, rotation, shape_motion):
    """Write the derivatives (P, J, 3) of joint positions with respect to the shape parameters, in the world."""
    for p in range(len(shape_motion)):
        for j in range(1, len(tree.parents)):
            parent, axis = tree.parents[j], tree.shape_basis[p, j]
            x, y, z = multiply_vector(load_matrix(rotation, parent), axis[0], axis[1], axis[2])
            shape_motion[p, j, 0] = shape_motion[p, parent, 0] + x
            shape_motion[p, j, 1] = shape_motion[p, parent, 1] + y
            shape_motion[p, j, 2] = shape_motion[p, parent, 2] + z


@njit(cache=True)
def write_jacobian_row(pose_of_tree, shape_motion, j, point, derivatives, out):
    """Write one row of the Jacobian, of a value that depends on the position of a point and the rotation of body j.

    `pose_of_tree` is the tree and its joint positions, `point` the position from the root, and `derivatives` those with respect
    to rotation and position.
    """
    (tree, position), (x, y, z), (turn, shift) = pose_of_tree, point, derivatives
    out[:] = 0.0
    tx, ty, tz = y * shift[2] - z * shift[1], z * shift[0] - x * shift[2], x * shift[1] - y * shift[0]
    tx, ty, tz = turn[0] + tx, turn[1] + ty, turn[2] + tz
    unknowns, shapes, end = len(out), len(shape_motion), j
    while j > 0:  # a joint rotates all its descendants about its position
        dx, dy, dz = position[j, 0] - position[0, 0], position[j, 1] - position[0, 1], position[j, 2] - position[0, 2]
        out[3 + 3 * j] = tx + dz * shift[1] - dy * shift[2]
        out[4 + 3 * j] = ty + dx * shift[2] - dz * shift[0]
        out[5 + 3 * j] = tz + dy * shift[0] - dx * shift[1]
        j = tree.parents[j]
    out[0], out[1], out[2], out[3], out[4], out[5] = tx, ty, tz, shift[0], shift[1], shift[2]
    for p in range(shapes):
        s = shape_motion[p, end]
        out[unknowns - shapes + p] = shift[0] * s[0] + shift[1] * s[1] + shift[2] * s[2]


@njit(cache=True)
def write_jacobian(tree, terms, pose, shape_motion, jacobian, residual):
    """Write the Jacobian (N, 6 + 3 K + P) and the residuals (N,) of all measurements, in units of their standard deviations."""
    points, views, directions = terms
    position, rotation, row, zero, turn, shift = pose.position, pose.rotation, 0, np.zeros(3), np.zeros(3), np.zeros(3)
    write_shape_motion(tree, rotation, shape_motion)
    for n in range(len(points.joints)):
        j, offset, scale = points.joints[n], points.offsets[n], np.sqrt(points.weight[0, n])
        x, y, z = multiply_vector(load_matrix(rotation, j), offset[0], offset[1], offset[2])
        point = (x + position[j, 0], y + position[j, 1], z + position[j, 2])
        for a in range(3):
            shift[0], shift[1], shift[2] = 0.0, 0.0, 0.0
            shift[a] = scale
            residual[row] = scale * (point[a] - points.measured[0, n, a])
            from_root = (point[0] - position[0, 0], point[1] - position[0, 1], point[2] - position[0, 2])
            write_jacobian_row((tree, position), shape_motion, j, from_root, (zero, shift), jacobian[row])
            row += 1
    for n in range(len(views.joints)):
        j, offset, scale = views.joints[n], views.offsets[n], np.sqrt(views.weight[0, n])
        x, y, z = multiply_vector(load_matrix(rotation, j), offset[0], offset[1], offset[2])
        x, y, z = x + position[j, 0], y + position[j, 1], z + position[j, 2]
        m, origin = views.rotation[views.cameras[n]], views.translation[views.cameras[n]]
        image = multiply_vector(load_matrix(views.rotation, views.cameras[n]), x, y, z)
        depth = image[2] + origin[2]
        for a in range(2):
            projected = (image[a] + origin[a]) / depth
            for c in range(3):
                shift[c] = scale * (m[a, c] - projected * m[2, c]) / depth
            residual[row] = scale * (projected - views.measured[0, n, a])
            from_root = (x - position[0, 0], y - position[0, 1], z - position[0, 2])
            write_jacobian_row((tree, position), shape_motion, j, from_root, (zero, shift), jacobian[row])
            row += 1
    shift[0], shift[1], shift[2] = 0.0, 0.0, 0.0
    for n in range(len(directions.joints)):
        j, axis, scale = directions.joints[n], directions.bone_axes[n], np.sqrt(directions.weight[0, n])
        d = multiply_vector(load_matrix(rotation, j), axis[0], axis[1], axis[2])
        for a in range(3):  # a rotation w moves the direction by w x d
            b, c = (a + 1) % 3, (a + 2) % 3
            turn[a], turn[b], turn[c] = 0.0, scale * d[c], -scale * d[b]
            residual[row] = scale * (d[a] - directions.measured[0, n, a])
            write_jacobian_row((tree, position), shape_motion, j, (0.0, 0.0, 0.0), (turn, shift), jacobian[row])
            row += 1


@njit(cache=True)
def add_dense_tracking_term(tree, terms, pose, system, curvature, gradient):
    """Add the tracking term of every joint, and the damping of the sweep."""
    linearise_terms(tree, terms, 0, np.inf, pose, system)
    for j in range(len(tree.parents)):
        row = 3 + 3 * j if j else 0
        for a in range(3):
            gradient[row + a] += system.g_joint[j, a] if j else system.g[0, a]
            for c in range(a + 1):
                curvature[row + a, row + c] += system.h_joint[j, a, c]
    for i in range(len(gradient)):
        curvature[i, i] += DIRECTION_DAMPING
