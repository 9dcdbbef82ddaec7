"""Terms that measure nothing: tracking of a pose, a prior about a mean pose, joint limits, distances, a function of all joints.

Those on joints' own rotations come first. Those after them couple several bodies: each residual adds a row on top of the sweep
(see `sweep`).
"""

import math
from typing import NamedTuple

import numpy as np

from mocapfix.kernels.compilation import compile_inner_kernel
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
