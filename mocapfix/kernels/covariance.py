"""Pose uncertainty: the covariance of every body from the factors of the sweep, root to leaves.

Exact to second order at the pose, in time linear in joints and markers.
"""

import numpy as np

from mocapfix.kernels import sweep
from mocapfix.kernels.compilation import compile_inner_kernel, compile_kernel
from mocapfix.kernels.forward_kinematics import compute_forward_kinematics
from mocapfix.kernels.normal_equations import allocate_workspace, linearise_terms, load_pose
from mocapfix.kernels.small_matrices import clear_array


@compile_inner_kernel
def propagate_covariance(tree, equations, factors, covariance, rotation_variance):
    """Write each body's twist covariance (J, 6, 6) and each joint's rotation variance (J,), from the sweep's factors.

    twist_i = (I - S gain') twist_parent + S turn', where turn' has the covariance `joint_inverse`. The shared unknowns are
    taken as known, and rows are ignored.
    rotation_variance is the mean over a joint's three axes, 0 for a joint that is not free.
    """
    gain, lever_arm, inverse = factors.gain, equations.lever_arm, factors.joint_inverse
    s, cross = np.zeros((6, 3)), np.empty((3, 6))
    for a in range(3):
        s[a, a] = 1.0
    turn_covariance = np.empty((3, 3))
    for a in range(6):
        for c in range(6):
            covariance[0, a, c] = factors.h[0, a, c]
    rotation_variance[0] = (factors.h[0, 0, 0] + factors.h[0, 1, 1] + factors.h[0, 2, 2]) / 3
    for i in range(1, len(tree.parents)):
        p = tree.parents[i]
        rotation_variance[i] = 0.0
        x, y, z = lever_arm[i, 0], lever_arm[i, 1], lever_arm[i, 2]
        s[3, 1], s[3, 2], s[4, 0], s[4, 2], s[5, 0], s[5, 1] = -z, y, z, -x, -y, x
        if tree.free[i]:
            for a in range(3):  # cross: covariance of the joint's rotation and the parent's twist
                for c in range(6):
                    cross[a, c] = 0.0
                    for e in range(6):
                        cross[a, c] -= gain[i, e, a] * covariance[p, e, c]
            for a in range(3):
                for c in range(3):
                    turn_covariance[a, c] = inverse[i, a, c]
                    for e in range(6):
                        turn_covariance[a, c] -= cross[a, e] * gain[i, e, c]
                rotation_variance[i] += turn_covariance[a, a] / 3
        for a in range(6):
            for c in range(a + 1):
                total = covariance[p, a, c]
                if tree.free[i]:
                    for e in range(3):
                        total += s[a, e] * cross[e, c] + s[c, e] * cross[e, a]
                        for d in range(3):
                            total += s[a, e] * turn_covariance[e, d] * s[c, d]
                covariance[i, a, c] = total
                covariance[i, c, a] = total


@compile_inner_kernel
def add_outer_products(sign, twist, joint_turn, covariance, rotation_variance):
    """Add `sign` times the outer products of a step twist (J, 6), joint_turn (J, 3) to the covariances."""
    for j in range(len(joint_turn)):
        for a in range(6):
            for c in range(6):
                covariance[j, a, c] += sign * twist[j, a] * twist[j, c]
        for a in range(3):
            turn = twist[0, a] if j == 0 else joint_turn[j, a]
            rotation_variance[j] += sign * turn * turn / 3


@compile_inner_kernel
def add_shared_covariance(tree, work, covariance, rotation_variance):
    """Add the covariance due to the uncertainty of the shared unknowns.

    With L L' their curvature, all poses eliminated, a gradient equal to a column of L moves them, and the pose with them, by
    one standard deviation of one independent component.
    """
    step, factor = work.step, work.factors.shared_cholesky
    for c in range(len(step.shared)):
        for d in range(len(step.shared)):
            step.shared[d] = factor[d, c] if d >= c else 0.0
        clear_array(work.g)
        clear_array(work.g_joint)
        sweep.solve_tree(tree, work.equations, work.factors, work.g, work.g_joint, step)
        add_outer_products(1.0, step.twist, step.joint_turn, covariance, rotation_variance)


@compile_inner_kernel
def subtract_row_information(tree, work, responses, covariance, rotation_variance):
    """Subtract the reduction of the covariance by the rows (Woodbury, as in sweep): Y (L L')^-1 Y', Y the row responses."""
    if responses is None:
        return
    sweep.compute_row_responses(tree, work.equations, work.factors, work.g, responses)
    cholesky = responses.capacitance
    for m in range(len(responses.twist)):
        twist, joint_turn = responses.twist[m], responses.joint_turn[m]
        for n in range(m):
            for j in range(len(joint_turn)):
                for a in range(6):
                    twist[j, a] -= cholesky[m, n] * responses.twist[n, j, a]
                for a in range(3):
                    joint_turn[j, a] -= cholesky[m, n] * responses.joint_turn[n, j, a]
        for j in range(len(joint_turn)):
            for a in range(6):
                twist[j, a] /= cholesky[m, m]
            for a in range(3):
                joint_turn[j, a] /= cholesky[m, m]
        add_outer_products(-1.0, twist, joint_turn, covariance, rotation_variance)


@compile_inner_kernel
def compute_point_sd(v, j, x, y, z):
    """Return the standard deviation per axis of the point (x, y, z), from the origin, of body j; v (J, 6, 6) covariances."""
    total = v[j, 3, 3] + v[j, 4, 4] + v[j, 5, 5]  # trace of [-[x]x, I] v [-[x]x, I]'
    total += 2 * (z * v[j, 3, 1] - y * v[j, 3, 2] + x * v[j, 4, 2] - z * v[j, 4, 0] + y * v[j, 5, 0] - x * v[j, 5, 1])
    total += (y * y + z * z) * v[j, 0, 0] + (x * x + z * z) * v[j, 1, 1] + (x * x + y * y) * v[j, 2, 2]
    total -= 2 * (x * y * v[j, 0, 1] + x * z * v[j, 0, 2] + y * z * v[j, 1, 2])
    return np.sqrt(max(total, 0.0) / 3)


@compile_kernel(nogil=True)
def compute_uncertainty_frames(
    tree, terms, scale2, rows, root, local, shared, marker_sd, joint_sd, rotation_variance, root_variance, first, stop
):
    """Write the uncertainty of the poses of frames first..stop - 1; the first term must be the markers' PointTerm.

    Args:
        rows: Number of rows that the terms write, None for none.
        marker_sd: (T, K) metres per axis, out.
        joint_sd: (T, J) metres per axis, out.
        rotation_variance: (T, J) rad^2 per axis, of the joints' rotations ([:, 0]: the root's), out.
        root_variance: (T,) m^2 per axis, of the root's position, out.
    """
    joints, points = local.shape[1], terms[0]
    work, covariance = allocate_workspace(joints, shared.shape[1], rows), np.empty((joints, 6, 6))
    lever_arm, rotation = work.equations.lever_arm, work.pose.rotation
    for t in range(first, stop):
        load_pose(root, local, shared, t, work.pose)
        compute_forward_kinematics(tree, work.pose)
        linearise_terms(tree, terms, t, scale2, work.pose, work.equations)
        sweep.factorise_tree(tree, work.equations, sweep.MIN_INFORMATION, work.factors)
        propagate_covariance(tree, work.equations, work.factors, covariance, rotation_variance[t])
        add_shared_covariance(tree, work, covariance, rotation_variance[t])
        subtract_row_information(tree, work, work.row_responses, covariance, rotation_variance[t])
        root_variance[t] = (covariance[0, 3, 3] + covariance[0, 4, 4] + covariance[0, 5, 5]) / 3
        for j in range(joints):
            joint_sd[t, j] = compute_point_sd(covariance, j, lever_arm[j, 0], lever_arm[j, 1], lever_arm[j, 2])
        for k in range(len(points.joints)):
            j = points.joints[k]
            a, b, c = points.offsets[k, 0], points.offsets[k, 1], points.offsets[k, 2]
            x = lever_arm[j, 0] + rotation[j, 0, 0] * a + rotation[j, 0, 1] * b + rotation[j, 0, 2] * c
            y = lever_arm[j, 1] + rotation[j, 1, 0] * a + rotation[j, 1, 1] * b + rotation[j, 1, 2] * c
            z = lever_arm[j, 2] + rotation[j, 2, 0] * a + rotation[j, 2, 1] * b + rotation[j, 2, 2] * c
            marker_sd[t, k] = compute_point_sd(covariance, j, x, y, z)
