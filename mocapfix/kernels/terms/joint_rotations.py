"""Terms on joints' own rotations: tracking a pose, a prior about a mean pose, and joint limits."""

import math
from typing import NamedTuple

import numpy as np

from mocapfix.kernels.lie import compute_left_jacobian_inverse, compute_logarithm
from mocapfix.kernels.small_matrices import load_matrix, multiply_matrices, multiply_vector, transpose_matrix
from mocapfix.kernels.terms.contract import HUBER, compute_robust_loss, register_term, select_frame


class TrackingTerm(NamedTuple):
    """Residual: rotation vectors from tracked rotations to the joints and the root's distance, over their standard deviations.

    The tracked pose is one for all frames, or one per frame, and so are the weights. A joint of weight zero is not tracked.
    """

    rotations: np.ndarray  # (1 or T, J, 3, 3) local rotations
    weight: np.ndarray  # (1 or T, J) 1/rad^2
    root: np.ndarray  # (1 or T, 3) metres
    root_weight: np.ndarray  # (1 or T,) 1/m^2; 0 for none


@register_term(TrackingTerm)
def add_tracking_term(term, t, scale2, tree, pose, equations):
    """Add the term to each free joint's own rotation, and to the root's position. Returns the cost."""
    rotations, weight = select_frame(term.rotations, t), select_frame(term.weight, t)
    parents, free, h_joint, g_joint, cost = tree.parents, tree.free, equations.h_joint, equations.g_joint, 0.0
    for j in range(len(parents)):
        w = weight[j]
        if not free[j] or w == 0.0:
            continue
        error = multiply_matrices(load_matrix(pose.local, j), transpose_matrix(load_matrix(rotations, j)))
        x, y, z, c = compute_logarithm(error)
        cost += 0.5 * w * (x * x + y * y + z * z)
        jacobian = compute_left_jacobian_inverse(x, y, z, c)
        if j:  # the logarithm's derivative maps its own vector to itself
            to_world = load_matrix(pose.rotation, parents[j])
            x, y, z = multiply_vector(to_world, x, y, z)
            jacobian = multiply_matrices(jacobian, transpose_matrix(to_world))
        curvature = multiply_matrices(transpose_matrix(jacobian), jacobian)
        g_joint[j, 0] += w * x
        g_joint[j, 1] += w * y
        g_joint[j, 2] += w * z
        for a in range(3):
            h_joint[j, a, 0] += w * curvature[3 * a]
            h_joint[j, a, 1] += w * curvature[3 * a + 1]
            h_joint[j, a, 2] += w * curvature[3 * a + 2]
    w, root = select_frame(term.root_weight, t), select_frame(term.root, t)
    for a in range(3):
        e = pose.position[0, a] - root[a]
        cost += 0.5 * w * e * e
        equations.g[0, 3 + a] += w * e
        equations.h[0, 3 + a, 3 + a] += w
    return cost


class PosePriorTerm(NamedTuple):
    """Residual: the rotation vector from each mean rotation to the joint, in the parent's axes, minus its mean vector.

    The mean pose is one for all frames, or one per frame, and so is the information; a joint of zero information is ignored.
    Each joint's three numbers are robust together (Huber): a few markers that agree then outweigh a pose that is rare.
    """

    rotations: np.ndarray  # (1 or T, J, 3, 3) local rotations
    information: np.ndarray  # (1 or T, J, 3, 3) 1/rad^2, symmetric
    mean_vectors: np.ndarray = np.zeros((0, 3))  # (J, 3) radians, the same for all frames; (0, 3) for zero
    huber_scale2: float = math.inf  # squared, in standard deviations; infinite for plain least squares


@register_term(PosePriorTerm)
def add_pose_prior_term(term, t, scale2, tree, pose, equations):
    """Add the term to each free joint's own rotation. Returns the cost.

    A rotation w of the joint in world axes changes its residual r by J(r) parent' w, J the logarithm's derivative.
    """
    rotations, informations = select_frame(term.rotations, t), select_frame(term.information, t)
    parents, free, h_joint, g_joint, cost = tree.parents, tree.free, equations.h_joint, equations.g_joint, 0.0
    for j in range(len(parents)):
        information = load_matrix(informations, j)
        if not free[j] or information[0] + information[4] + information[8] == 0.0:
            continue
        error = multiply_matrices(load_matrix(pose.local, j), transpose_matrix(load_matrix(rotations, j)))
        x, y, z, c = compute_logarithm(error)
        jacobian = compute_left_jacobian_inverse(x, y, z, c)
        if j:
            jacobian = multiply_matrices(jacobian, transpose_matrix(load_matrix(pose.rotation, parents[j])))
        if len(term.mean_vectors):
            x, y, z = x - term.mean_vectors[j, 0], y - term.mean_vectors[j, 1], z - term.mean_vectors[j, 2]
        transposed = transpose_matrix(jacobian)
        curvature = multiply_matrices(transposed, multiply_matrices(information, jacobian))
        px, py, pz = multiply_vector(information, x, y, z)
        loss, w = compute_robust_loss(HUBER, px * x + py * y + pz * z, term.huber_scale2)
        cost += loss
        gx, gy, gz = multiply_vector(transposed, px, py, pz)
        g_joint[j, 0] += w * gx
        g_joint[j, 1] += w * gy
        g_joint[j, 2] += w * gz
        for a in range(3):
            h_joint[j, a, 0] += w * curvature[3 * a]
            h_joint[j, a, 1] += w * curvature[3 * a + 1]
            h_joint[j, a, 2] += w * curvature[3 * a + 2]
    return cost


class JointLimitTerm(NamedTuple):
    """Residual: the excess of the rotation vector from a reference to the joint, in the parent's axes, over its range.

    Zero inside the range; outside, the excess over its standard deviation, axis by axis (soft limits).
    """

    reference: np.ndarray  # (J, 3, 3) local rotations
    low: np.ndarray  # (J, 3) radians; -inf for none
    high: np.ndarray  # (J, 3) radians; inf for none
    weight: float  # 1 / rad^2


@register_term(JointLimitTerm)
def add_joint_limit_term(term, t, scale2, tree, pose, equations):
    """Add the excess to each free joint's own rotation. Returns the cost."""
    parents, h_joint, g_joint, cost = tree.parents, equations.h_joint, equations.g_joint, 0.0
    for j in range(1, len(parents)):
        if not tree.free[j] or term.weight == 0.0:
            continue
        error = multiply_matrices(load_matrix(pose.local, j), transpose_matrix(load_matrix(term.reference, j)))
        x, y, z, c = compute_logarithm(error)
        ex = max(x - term.high[j, 0], 0.0) + min(x - term.low[j, 0], 0.0)
        ey = max(y - term.high[j, 1], 0.0) + min(y - term.low[j, 1], 0.0)
        ez = max(z - term.high[j, 2], 0.0) + min(z - term.low[j, 2], 0.0)
        if ex == 0.0 and ey == 0.0 and ez == 0.0:
            continue
        cost += 0.5 * term.weight * (ex * ex + ey * ey + ez * ez)
        to_parent = transpose_matrix(load_matrix(pose.rotation, parents[j]))
        jacobian = multiply_matrices(compute_left_jacobian_inverse(x, y, z, c), to_parent)
        gx, gy, gz = multiply_vector(transpose_matrix(jacobian), ex, ey, ez)
        g_joint[j, 0] += term.weight * gx
        g_joint[j, 1] += term.weight * gy
        g_joint[j, 2] += term.weight * gz
        wx = term.weight if ex != 0.0 else 0.0
        wy = term.weight if ey != 0.0 else 0.0
        wz = term.weight if ez != 0.0 else 0.0
        for a in range(3):
            for d in range(3):
                h_joint[j, a, d] += (
                    wx * jacobian[a] * jacobian[d]
                    + wy * jacobian[3 + a] * jacobian[3 + d]
                    + wz * jacobian[6 + a] * jacobian[6 + d]
                )
    return cost
