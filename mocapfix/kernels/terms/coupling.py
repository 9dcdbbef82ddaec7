"""Terms that couple several bodies: distances between points, and a scalar function of all joints.

Each residual adds a row on top of the sweep (see `low_rank`).
"""

import math
from typing import NamedTuple

import numpy as np

from mocapfix.kernels.compilation_cache import compile_inner_kernel
from mocapfix.kernels.lie import compute_left_jacobian_inverse, compute_logarithm
from mocapfix.kernels.small_matrices import load_matrix, multiply_matrices, multiply_vector, transpose_matrix
from mocapfix.kernels.terms.contract import register_term, select_frame

MIN_POINT_DISTANCE_M = 1e-9  # points nearer than this have no direction from one to the other


class DistanceTerm(NamedTuple):
    """Residual: (distance between two points of the body - length) / standard deviation; a row each.

    The points may belong to one segment or to two: hands that hold a stick, a marker pair's spacing.
    """

    joints: np.ndarray  # (D, 2) each point's joint
    offsets: np.ndarray  # (D, 2, 3) metres, in the joints' axes
    length: np.ndarray  # (1 or T, D) metres
    weight: np.ndarray  # (1 or T, D) 1 / m^2; 0 for none


@compile_inner_kernel
def compute_end_position(term, k, e, pose):
    """Return the position of end e of distance k from the origin, which is the root's position."""
    j, offset, position = term.joints[k, e], term.offsets[k, e], pose.position
    x, y, z = multiply_vector(load_matrix(pose.rotation, j), offset[0], offset[1], offset[2])
    return x + position[j, 0] - position[0, 0], y + position[j, 1] - position[0, 1], z + position[j, 2] - position[0, 2]


@register_term(DistanceTerm)
def add_distance_term(term, t, scale2, tree, pose, equations):
    """Write one row for each distance. Returns the cost."""
    length, weight, cost = select_frame(term.length, t), select_frame(term.weight, t), 0.0
    for k in range(len(term.joints)):
        m = equations.row_count[0]
        equations.row_count[0] += 1
        if weight[k] == 0.0:
            continue
        ends = (compute_end_position(term, k, 0, pose), compute_end_position(term, k, 1, pose))
        ux, uy, uz = ends[1][0] - ends[0][0], ends[1][1] - ends[0][1], ends[1][2] - ends[0][2]
        distance = math.sqrt(ux * ux + uy * uy + uz * uz)
        inverse_sd = math.sqrt(weight[k])
        equations.row_residual[m] = inverse_sd * (distance - length[k])
        cost += 0.5 * equations.row_residual[m] ** 2
        scale = inverse_sd / max(distance, MIN_POINT_DISTANCE_M)
        for e in range(2):
            ux, uy, uz = -ux, -uy, -uz  # the gradient of the distance is opposite at the two ends
            row, j = equations.row_twist[m], term.joints[k, e]
            x, y, z = ends[e]
            row[j, 0] += scale * (y * uz - z * uy)
            row[j, 1] += scale * (z * ux - x * uz)
            row[j, 2] += scale * (x * uy - y * ux)
            row[j, 3] += scale * ux
            row[j, 4] += scale * uy
            row[j, 5] += scale * uz
    return cost


class ScalarTerm(NamedTuple):
    """Residual: (value + sum over joints of gradient . rotation vector from `reference` to the joint) / standard deviation.

    One number that depends on all joints, as MNN-IK's naturalness does (Eq. 3.3, the scalar g): the paper puts a squared norm
    into the residual vector, so that the energy contains its square, one dense row of rank one. The number and its gradient are
    computed at a pose and updated between solves.
    """

    value: np.ndarray  # (T,)
    gradient: np.ndarray  # (T, J, 3) per radian, in the parents' axes
    reference: np.ndarray  # (T, J, 3, 3) the local rotations at which value and gradient were computed
    weight: np.ndarray  # (T,) one over the variance; 0 for none


@register_term(ScalarTerm)
def add_scalar_term(term, t, scale2, tree, pose, equations):
    """Write the row. Returns the cost."""
    m = equations.row_count[0]
    equations.row_count[0] += 1
    if term.weight[t] == 0.0:
        return 0.0
    inverse_sd, total, gradient, reference = math.sqrt(term.weight[t]), term.value[t], term.gradient[t], term.reference[t]
    for j in range(len(tree.parents)):
        if not tree.free[j]:
            continue
        error = multiply_matrices(load_matrix(pose.local, j), transpose_matrix(load_matrix(reference, j)))
        x, y, z, c = compute_logarithm(error)
        total += gradient[j, 0] * x + gradient[j, 1] * y + gradient[j, 2] * z
        to_world = transpose_matrix(compute_left_jacobian_inverse(x, y, z, c))
        if j:
            to_world = multiply_matrices(load_matrix(pose.rotation, tree.parents[j]), to_world)
        gx, gy, gz = multiply_vector(to_world, gradient[j, 0], gradient[j, 1], gradient[j, 2])
        row = equations.row_joint[m]
        row[j, 0], row[j, 1], row[j, 2] = inverse_sd * gx, inverse_sd * gy, inverse_sd * gz
    equations.row_residual[m] = inverse_sd * total
    return 0.5 * equations.row_residual[m] ** 2


def count_rows(terms: tuple) -> int | None:
    """Return the number of rows that the terms write, an argument of `solve_frames` and others; None for no rows."""
    coupling = [term for term in terms if isinstance(term, DistanceTerm | ScalarTerm)]
    return sum(len(term.joints) if isinstance(term, DistanceTerm) else 1 for term in coupling) if coupling else None
