"""Where each joint's course through time leads it, or where it starts from: a pull as strong about every axis."""

from typing import NamedTuple

import numpy as np

from mocapfix.kernels.lie import compute_left_jacobian_inverse, compute_logarithm
from mocapfix.kernels.small_matrices import load_matrix, multiply_matrices, multiply_vector, transpose_matrix
from mocapfix.kernels.terms.contract import register_term, select_frame


# MERGED: mocapfix.kernels.terms.courses
class TrackingTerm(NamedTuple):
    """Residual: the rotation vector from the course to each joint, and the root's distance, over their standard deviations.

    One pose for all frames, or one per frame, and likewise how strongly it pulls. A joint of weight zero is not pulled.
    """

    rotations: np.ndarray  # (1 or T, J, 3, 3)
    weight: np.ndarray  # (1 or T, J) 1/rad^2
    root: np.ndarray  # (1 or T, 3) metres
    root_weight: np.ndarray  # (1 or T,) 1/m^2; 0 for none


@register_term(TrackingTerm)
def add_tracking_term(term, t, scale2, tree, pose, system):
    """Add the pull to each free joint's own turn, and to the root's shift. -> cost"""
    rotations, weight, rotation, local = select_frame(term.rotations, t), select_frame(term.weight, t), pose.rotation, pose.local
    parents, free, own, b, cost = tree.parents, tree.free, system.own, system.b, 0.0
    for j in range(len(parents)):
        w = weight[j]
        if not free[j] or w == 0.0:
            continue
        x, y, z, c = compute_logarithm(multiply_matrices(load_matrix(local, j), transpose_matrix(load_matrix(rotations, j))))
        cost += 0.5 * w * (x * x + y * y + z * z)
        through = compute_left_jacobian_inverse(x, y, z, c)
        if j:  # the logarithm's derivative leaves its own vector as it is
            back = load_matrix(rotation, parents[j])
            x, y, z = multiply_vector(back, x, y, z)
            through = multiply_matrices(through, transpose_matrix(back))
        stiff = multiply_matrices(transpose_matrix(through), through)
        b[j, 0] += w * x
        b[j, 1] += w * y
        b[j, 2] += w * z
        for a in range(3):
            own[j, a, 0] += w * stiff[3 * a]
            own[j, a, 1] += w * stiff[3 * a + 1]
            own[j, a, 2] += w * stiff[3 * a + 2]
    w, root = select_frame(term.root_weight, t), select_frame(term.root, t)
    for a in range(3):
        e = pose.position[0, a] - root[a]
        cost += 0.5 * w * e * e
        system.g[0, 3 + a] += w * e
        system.h[0, 3 + a, 3 + a] += w
    return cost


# MERGED: mocapfix.kernels.terms.limits
# How far joints turn: soft walls about ranges of each joint's rotation vector.
class JointLimitTerm(NamedTuple):
    """Residual: how far the rotation vector from the middle to the joint, in the parent's axes, lies outside its range.

    Nothing inside; outside, the excess over its standard deviation, axis by axis.
    """

    reference: np.ndarray  # (J, 3, 3) rotations
    low: np.ndarray  # (J, 3) radians; -inf for none
    high: np.ndarray  # (J, 3) radians; inf for none
    weight: float  # 1 / rad^2


@register_term(JointLimitTerm)
def add_joint_limit_term(term, t, scale2, tree, pose, system):
    """Add the excess to each free joint's own turn. -> cost"""
    parents, own, b, cost = tree.parents, system.own, system.b, 0.0
    for j in range(1, len(parents)):
        if not tree.free[j] or term.weight == 0.0:
            continue
        x, y, z, c = compute_logarithm(
            multiply_matrices(load_matrix(pose.local, j), transpose_matrix(load_matrix(term.reference, j)))
        )
        ex = max(x - term.high[j, 0], 0.0) + min(x - term.low[j, 0], 0.0)
        ey = max(y - term.high[j, 1], 0.0) + min(y - term.low[j, 1], 0.0)
        ez = max(z - term.high[j, 2], 0.0) + min(z - term.low[j, 2], 0.0)
        if ex == 0.0 and ey == 0.0 and ez == 0.0:
            continue
        cost += 0.5 * term.weight * (ex * ex + ey * ey + ez * ez)
        through = multiply_matrices(
            compute_left_jacobian_inverse(x, y, z, c), transpose_matrix(load_matrix(pose.rotation, parents[j]))
        )
        px, py, pz = multiply_vector(transpose_matrix(through), ex, ey, ez)
        b[j, 0] += term.weight * px
        b[j, 1] += term.weight * py
        b[j, 2] += term.weight * pz
        wx = term.weight if ex != 0.0 else 0.0
        wy = term.weight if ey != 0.0 else 0.0
        wz = term.weight if ez != 0.0 else 0.0
        for a in range(3):
            for d in range(3):
                own[j, a, d] += (
                    wx * through[a] * through[d] + wy * through[3 + a] * through[3 + d] + wz * through[6 + a] * through[6 + d]
                )
    return cost


# MERGED: mocapfix.kernels.terms.targets
# A mean pose: joint rotations to be near to, about some axes more than about others.
class PosePriorTerm(NamedTuple):
    """Residual: the rotation vector from each target to the joint, in the parent's axes, less the one it is to be.

    One pose for all frames, or one per frame, and likewise how strongly it pulls: not at all where the information is zero.
    """

    rotations: np.ndarray  # (1 or T, J, 3, 3)
    information: np.ndarray  # (1 or T, J, 3, 3) 1/rad^2, symmetric
    mean_vectors: np.ndarray = np.zeros((0, 3))  # (J, 3) radians, the same for all frames; (0, 3) for zero


@register_term(PosePriorTerm)
def add_pose_prior_term(term, t, scale2, tree, pose, system):
    """Add the pull to each free joint's own turn. -> cost

    A turn w of the joint in world axes changes its residual r by J(r) parent' w, J the logarithm's derivative.
    """
    rotations, informations = select_frame(term.rotations, t), select_frame(term.information, t)
    rotation, local = pose.rotation, pose.local
    parents, free, own, b, cost = tree.parents, tree.free, system.own, system.b, 0.0
    for j in range(len(parents)):
        information = load_matrix(informations, j)
        if not free[j] or information[0] + information[4] + information[8] == 0.0:
            continue
        x, y, z, c = compute_logarithm(multiply_matrices(load_matrix(local, j), transpose_matrix(load_matrix(rotations, j))))
        through = compute_left_jacobian_inverse(x, y, z, c)
        if j:
            through = multiply_matrices(through, transpose_matrix(load_matrix(rotation, parents[j])))
        if len(term.mean_vectors):
            x, y, z = x - term.mean_vectors[j, 0], y - term.mean_vectors[j, 1], z - term.mean_vectors[j, 2]
        back = transpose_matrix(through)
        stiff = multiply_matrices(back, multiply_matrices(information, through))
        px, py, pz = multiply_vector(information, x, y, z)
        cost += 0.5 * (px * x + py * y + pz * z)
        bx, by, bz = multiply_vector(back, px, py, pz)
        b[j, 0] += bx
        b[j, 1] += by
        b[j, 2] += bz
        for a in range(3):
            own[j, a, 0] += stiff[3 * a]
            own[j, a, 1] += stiff[3 * a + 1]
            own[j, a, 2] += stiff[3 * a + 2]
    return cost
