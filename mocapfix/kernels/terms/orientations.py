"""Where bones point, seen without their place: SCOPE's part orientation field (Eq. 5)."""

from typing import NamedTuple

import numpy as np

from mocapfix.kernels.lie import compute_left_jacobian_inverse, compute_logarithm
from mocapfix.kernels.small_matrices import load_matrix, multiply_matrices, multiply_vector, transpose_matrix
from mocapfix.kernels.terms.contract import GEMAN_MCCLURE, compute_robust_loss, register_term


# MERGED: mocapfix.kernels.terms.directions
class DirectionTerm(NamedTuple):
    """Residual: (direction of the bone - seen) / standard deviation, both of length one, so in radians while small."""

    joints: np.ndarray  # (D,) the body that the bone belongs to
    bone_axes: np.ndarray  # (D, 3) the bone in its joint's axes, length one
    measured: np.ndarray  # (T, D, 3) length one; anything where the weight is 0
    weight: np.ndarray  # (T, D) 1 / rad^2; 0 where not seen
    loss: int = GEMAN_MCCLURE


@register_term(DirectionTerm)
def add_direction_term(term, t, scale2, tree, pose, system):
    """Add the directions to the curvature and gradient of their bodies' turns. -> cost"""
    h, g, cost = system.h, system.g, 0.0
    for k in range(len(term.joints)):
        trust = term.weight[t, k]
        if trust == 0.0:
            continue
        j = term.joints[k]
        x, y, z = multiply_vector(load_matrix(pose.rotation, j), term.bone_axes[k, 0], term.bone_axes[k, 1], term.bone_axes[k, 2])
        sx, sy, sz = term.measured[t, k, 0], term.measured[t, k, 1], term.measured[t, k, 2]
        square = (x - sx) ** 2 + (y - sy) ** 2 + (z - sz) ** 2
        if not square < np.inf:
            continue
        part, weight = compute_robust_loss(term.loss, trust * square, scale2)
        cost += part
        w = trust * weight
        h[j, 0, 0] += w * (y * y + z * z)
        h[j, 1, 0] -= w * x * y
        h[j, 1, 1] += w * (x * x + z * z)
        h[j, 2, 0] -= w * x * z
        h[j, 2, 1] -= w * y * z
        h[j, 2, 2] += w * (x * x + y * y)
        g[j, 0] -= w * (y * sz - z * sy)  # the direction itself has no turn about itself: d x (d - seen) = -d x seen
        g[j, 1] -= w * (z * sx - x * sz)
        g[j, 2] -= w * (x * sy - y * sx)
    return cost


# MERGED: mocapfix.kernels.terms.orientations
# Orientations of bodies, as an inertial sensor or a rigid cluster of markers tells them.
class OrientationTerm(NamedTuple):
    """Residual: the rotation vector from the orientation seen to the body's, over its standard deviation."""

    joints: np.ndarray  # (O,)
    measured: np.ndarray  # (T, O, 3, 3) rotations, in the world; anything where the weight is 0
    weight: np.ndarray  # (T, O) 1 / rad^2; 0 where not seen
    loss: int = GEMAN_MCCLURE


@register_term(OrientationTerm)
def add_orientation_term(term, t, scale2, tree, pose, system):
    """Add the orientations to the curvature and gradient of their bodies' turns. -> cost"""
    h, g, seen, cost = system.h, system.g, term.measured[t], 0.0
    for k in range(len(term.joints)):
        trust = term.weight[t, k]
        if trust == 0.0:
            continue
        j = term.joints[k]
        x, y, z, c = compute_logarithm(multiply_matrices(load_matrix(pose.rotation, j), transpose_matrix(load_matrix(seen, k))))
        square = x * x + y * y + z * z
        if not square < np.inf:
            continue
        part, weight = compute_robust_loss(term.loss, trust * square, scale2)
        cost += part
        w = trust * weight
        jacobian = compute_left_jacobian_inverse(x, y, z, c)
        curvature = multiply_matrices(transpose_matrix(jacobian), jacobian)
        for a in range(3):
            for b in range(a + 1):
                h[j, a, b] += w * curvature[3 * a + b]
        g[j, 0] += w * x  # the logarithm's derivative leaves its own vector as it is
        g[j, 1] += w * y
        g[j, 2] += w * z
    return cost
