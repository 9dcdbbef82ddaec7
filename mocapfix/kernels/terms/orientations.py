"""Measured directions of bones, and measured orientations of bodies."""

from typing import NamedTuple

import numpy as np

from mocapfix.kernels.lie import compute_left_jacobian_inverse, compute_logarithm
from mocapfix.kernels.small_matrices import load_matrix, multiply_matrices, multiply_vector, transpose_matrix
from mocapfix.kernels.terms.contract import GEMAN_MCCLURE, compute_robust_loss, register_term


class DirectionTerm(NamedTuple):
    """Residual: (direction of the bone - measured) / standard deviation, both unit vectors, so in radians while small.

    SCOPE's part orientation field (Eq. 5).
    """

    joints: np.ndarray  # (D,) the joint whose body the bone belongs to
    bone_axes: np.ndarray  # (D, 3) unit vector along the bone, in its joint's axes
    measured: np.ndarray  # (T, D, 3) unit vector, in the world; anything where the weight is 0
    weight: np.ndarray  # (T, D) 1 / rad^2; 0 for a missing sample
    loss: int = GEMAN_MCCLURE


@register_term(DirectionTerm)
def add_direction_term(term, t, scale2, tree, pose, equations):
    """Add the directions to the curvature and gradient of their bodies' rotations. Returns the cost."""
    h, g, cost = equations.h, equations.g, 0.0
    for k in range(len(term.joints)):
        precision = term.weight[t, k]
        if precision == 0.0:
            continue
        j = term.joints[k]
        axis = term.bone_axes[k]
        x, y, z = multiply_vector(load_matrix(pose.rotation, j), axis[0], axis[1], axis[2])
        mx, my, mz = term.measured[t, k, 0], term.measured[t, k, 1], term.measured[t, k, 2]
        square = (x - mx) ** 2 + (y - my) ** 2 + (z - mz) ** 2
        if not square < np.inf:
            continue
        loss, weight = compute_robust_loss(term.loss, precision * square, scale2)
        cost += loss
        w = precision * weight
        h[j, 0, 0] += w * (y * y + z * z)
        h[j, 1, 0] -= w * x * y
        h[j, 1, 1] += w * (x * x + z * z)
        h[j, 2, 0] -= w * x * z
        h[j, 2, 1] -= w * y * z
        h[j, 2, 2] += w * (x * x + y * y)
        g[j, 0] -= w * (y * mz - z * my)  # d x (d - measured) = -d x measured
        g[j, 1] -= w * (z * mx - x * mz)
        g[j, 2] -= w * (x * my - y * mx)
    return cost


class OrientationTerm(NamedTuple):
    """Residual: the rotation vector from the measured orientation to the body's, over its standard deviation.

    Orientations are measured by an inertial sensor or a rigid cluster of markers.
    """

    joints: np.ndarray  # (O,)
    measured: np.ndarray  # (T, O, 3, 3) rotations, in the world; anything where the weight is 0
    weight: np.ndarray  # (T, O) 1 / rad^2; 0 for a missing sample
    loss: int = GEMAN_MCCLURE


@register_term(OrientationTerm)
def add_orientation_term(term, t, scale2, tree, pose, equations):
    """Add the orientations to the curvature and gradient of their bodies' rotations. Returns the cost."""
    h, g, measured, cost = equations.h, equations.g, term.measured[t], 0.0
    for k in range(len(term.joints)):
        precision = term.weight[t, k]
        if precision == 0.0:
            continue
        j = term.joints[k]
        error = multiply_matrices(load_matrix(pose.rotation, j), transpose_matrix(load_matrix(measured, k)))
        x, y, z, c = compute_logarithm(error)
        square = x * x + y * y + z * z
        if not square < np.inf:
            continue
        loss, weight = compute_robust_loss(term.loss, precision * square, scale2)
        cost += loss
        w = precision * weight
        jacobian = compute_left_jacobian_inverse(x, y, z, c)
        curvature = multiply_matrices(transpose_matrix(jacobian), jacobian)
        for a in range(3):
            for b in range(a + 1):
                h[j, a, b] += w * curvature[3 * a + b]
        g[j, 0] += w * x  # the logarithm's derivative maps its own vector to itself
        g[j, 1] += w * y
        g[j, 2] += w * z
    return cost
