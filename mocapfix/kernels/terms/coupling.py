"""Distances between two points of the body, on one segment or on two: hands that hold a stick, a marker pair's spacing."""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from mocapfix.kernels.lie import compute_left_jacobian_inverse, compute_logarithm
from mocapfix.kernels.small_matrices import load_matrix, multiply_matrices, multiply_vector, transpose_matrix
from mocapfix.kernels.terms.contract import register_term, select_frame

# MERGED: mocapfix.kernels.terms.distances
MIN_POINT_DISTANCE_M = 1e-9  # metres: nearer points have no direction from one to the other


class DistanceTerm(NamedTuple):
    """Residual: (distance between the points - length) / standard deviation; each a row on top of the sweep."""

    joints: np.ndarray  # (D, 2) whose bodies carry the points
    offsets: np.ndarray  # (D, 2, 3) metres, in the joints' axes
    length: np.ndarray  # (1 or T, D) metres
    weight: np.ndarray  # (1 or T, D) 1 / m^2; 0 for none


@njit(cache=True)
def compute_end_position(term, k, e, pose):
    """-> where end e of distance k lies from the origin, the root's place."""
    j, place, position = term.joints[k, e], term.offsets[k, e], pose.position
    x, y, z = multiply_vector(load_matrix(pose.rotation, j), place[0], place[1], place[2])
    return x + position[j, 0] - position[0, 0], y + position[j, 1] - position[0, 1], z + position[j, 2] - position[0, 2]


@register_term(DistanceTerm)
def add_distance_term(term, t, scale2, tree, pose, system):
    """Write one row for each distance. -> cost"""
    length, weight, cost = select_frame(term.length, t), select_frame(term.weight, t), 0.0
    for k in range(len(term.joints)):
        m = system.row_count[0]
        system.row_count[0] += 1
        if weight[k] == 0.0:
            continue
        ends = (compute_end_position(term, k, 0, pose), compute_end_position(term, k, 1, pose))
        ux, uy, uz = ends[1][0] - ends[0][0], ends[1][1] - ends[0][1], ends[1][2] - ends[0][2]
        distance = math.sqrt(ux * ux + uy * uy + uz * uz)
        root = math.sqrt(weight[k])
        system.away[m] = root * (distance - length[k])
        cost += 0.5 * system.away[m] ** 2
        scale = root / max(distance, MIN_POINT_DISTANCE_M)
        for e in range(2):
            ux, uy, uz = -ux, -uy, -uz  # the first end pulls back, the second ahead
            row, j = system.rows[m], term.joints[k, e]
            x, y, z = ends[e]
            row[j, 0] += scale * (y * uz - z * uy)
            row[j, 1] += scale * (z * ux - x * uz)
            row[j, 2] += scale * (x * uy - y * ux)
            row[j, 3] += scale * ux
            row[j, 4] += scale * uy
            row[j, 5] += scale * uz
    return cost


# MERGED: mocapfix.kernels.terms.whole
# One number that depends on all joints at once, as MNN-IK's naturalness does (Eq. 3.3, the scalar g).
#
# The paper puts a squared norm into the residual vector, so that the energy carries its square: one dense row of rank one. The
# number and its gradient are handed in at a pose and asked again between solves.
class ScalarTerm(NamedTuple):
    """Residual: (value + sum over joints of gradient . rotation vector from `at` to the joint) / standard deviation."""

    value: np.ndarray  # (T,)
    gradient: np.ndarray  # (T, J, 3) per radian, in the parents' axes
    reference: np.ndarray  # (T, J, 3, 3) the local rotations where value and gradient were taken
    weight: np.ndarray  # (T,) one over the variance; 0 for none


@register_term(ScalarTerm)
def add_scalar_term(term, t, scale2, tree, pose, system):
    """Write the row. -> cost"""
    m = system.row_count[0]
    system.row_count[0] += 1
    if term.weight[t] == 0.0:
        return 0.0
    root, total, gradient, at = math.sqrt(term.weight[t]), term.value[t], term.gradient[t], term.reference[t]
    for j in range(len(tree.parents)):
        if not tree.free[j]:
            continue
        x, y, z, c = compute_logarithm(multiply_matrices(load_matrix(pose.local, j), transpose_matrix(load_matrix(at, j))))
        total += gradient[j, 0] * x + gradient[j, 1] * y + gradient[j, 2] * z
        back = transpose_matrix(compute_left_jacobian_inverse(x, y, z, c))
        if j:
            back = multiply_matrices(load_matrix(pose.rotation, tree.parents[j]), back)
        gx, gy, gz = multiply_vector(back, gradient[j, 0], gradient[j, 1], gradient[j, 2])
        row = system.row_joint[m]
        row[j, 0], row[j, 1], row[j, 2] = root * gx, root * gy, root * gz
    system.away[m] = root * total
    return 0.5 * system.away[m] ** 2
