"""How sure a pose is: the covariance of every body from the factors of the sweep, root to leaves.

Exact to second order at the pose, in time linear in joints and markers.
"""

import numpy as np
from numba import njit

from mocapfix.kernels import low_rank, sweep
from mocapfix.kernels.forward_kinematics import compute_forward_kinematics
from mocapfix.kernels.normal_equations import linearise_terms
from mocapfix.kernels.workspace import allocate_workspace, load_pose


@njit(cache=True)
def propagate_covariance(tree, system, f, spread, turn_variance):
    """Write each body's twist covariance (J, 6, 6) into `spread`, from what `sweep.factor` left.

    twist_i = (I - S gain') twist_parent + S turn',  the remaining turn' having covariance `inverse`; as though the shared
    unknowns were known and no row told anything.
    turn_variance (J,) out: each joint's turn, the mean over its three axes; 0 where a joint is not free.
    """
    gain, arm = f.gain, system.arm
    s, cross = np.zeros((6, 3)), np.empty((3, 6))
    for a in range(3):
        s[a, a] = 1.0
    turned = np.empty((3, 3))
    for a in range(6):
        for c in range(6):
            spread[0, a, c] = f.h[0, a, c]
    turn_variance[0] = (f.h[0, 0, 0] + f.h[0, 1, 1] + f.h[0, 2, 2]) / 3
    for i in range(1, len(tree.parents)):
        p = tree.parents[i]
        turn_variance[i] = 0.0
        x, y, z = arm[i, 0], arm[i, 1], arm[i, 2]
        s[3, 1], s[3, 2], s[4, 0], s[4, 2], s[5, 0], s[5, 1] = -z, y, z, -x, -y, x
        if tree.free[i]:
            for a in range(3):  # cross = covariance of (turn, parent's twist); turned = covariance of turn
                for c in range(6):
                    cross[a, c] = 0.0
                    for e in range(6):
                        cross[a, c] -= gain[i, e, a] * spread[p, e, c]
            for a in range(3):
                for c in range(3):
                    turned[a, c] = f.joint_inverse[i, a, c]
                    for e in range(6):
                        turned[a, c] -= cross[a, e] * gain[i, e, c]
                turn_variance[i] += turned[a, a] / 3
        for a in range(6):
            for c in range(a + 1):
                total = spread[p, a, c]
                if tree.free[i]:
                    for e in range(3):
                        total += s[a, e] * cross[e, c] + s[c, e] * cross[e, a]
                        for d in range(3):
                            total += s[a, e] * turned[e, d] * s[c, d]
                spread[i, a, c] = total
                spread[i, c, a] = total


@njit(cache=True)
def add_outer_products(sign, twist, turn, spread, turn_variance):
    """Add to the covariances, or take away, what one step (J, 6), (J, 3) of one standard deviation spreads."""
    for j in range(len(turn)):
        for a in range(6):
            for c in range(6):
                spread[j, a, c] += sign * twist[j, a] * twist[j, c]
        for a in range(3):
            turned = twist[0, a] if j == 0 else turn[j, a]
            turn_variance[j] += sign * turned * turned / 3


@njit(cache=True)
def add_shared_covariance(tree, work, spread, turn_variance):
    """Add what is open because the shared unknowns are.

    With L L' their curvature, all poses eliminated, a pull by a column of L moves them, and the pose with them, by one
    standard deviation of one independent part.
    """
    step, factor = work.step, work.factors.shared
    for c in range(len(step.shared)):
        for d in range(len(step.shared)):
            step.shared[d] = factor[d, c] if d >= c else 0.0
        work.g.fill(0)
        work.b.fill(0)
        sweep.solve_tree(tree, work.system, work.factors, work.g, work.b, step)
        add_outer_products(1.0, step.twist, step.turn, spread, turn_variance)


@njit(cache=True)
def subtract_row_information(tree, work, answers, spread, turn_variance):
    """Take away what the rows tell (Woodbury, as in low_rank): Y (L L')^-1 Y', the columns of Y the answers to the rows."""
    if answers is None:
        return
    low_rank.compute_row_responses(tree, work.system, work.factors, work.g, answers)
    for m in range(len(answers.twist)):
        twist, turn = answers.twist[m], answers.turn[m]
        for n in range(m):
            for j in range(len(turn)):
                for a in range(6):
                    twist[j, a] -= answers.capacitance[m, n] * answers.twist[n, j, a]
                for a in range(3):
                    turn[j, a] -= answers.capacitance[m, n] * answers.turn[n, j, a]
        for j in range(len(turn)):
            for a in range(6):
                twist[j, a] /= answers.capacitance[m, m]
            for a in range(3):
                turn[j, a] /= answers.capacitance[m, m]
        add_outer_products(-1.0, twist, turn, spread, turn_variance)


@njit(cache=True)
def compute_point_sd(v, j, x, y, z):
    """-> the standard deviation per axis of the point of body j that lies (x, y, z) from the origin; v (J, 6, 6) covariances."""
    total = v[j, 3, 3] + v[j, 4, 4] + v[j, 5, 5]  # trace of [-[x]x, I] v [-[x]x, I]'
    total += 2 * (z * v[j, 3, 1] - y * v[j, 3, 2] + x * v[j, 4, 2] - z * v[j, 4, 0] + y * v[j, 5, 0] - x * v[j, 5, 1])
    total += (y * y + z * z) * v[j, 0, 0] + (x * x + z * z) * v[j, 1, 1] + (x * x + y * y) * v[j, 2, 2]
    total -= 2 * (x * y * v[j, 0, 1] + x * z * v[j, 0, 2] + y * z * v[j, 1, 2])
    return np.sqrt(max(total, 0.0) / 3)


@njit(cache=True, nogil=True)
def compute_uncertainty_frames(
    tree, terms, scale2, rows, root, local, shared, marker_sd, joint_sd, joint_var, root_var, first, stop
):
    """The uncertainty of the poses of frames first..stop, whose first term is the markers' Points; rows: how many the terms
    write.

    marker_sd (T, K) and joint_sd (T, J) metres, joint_var (T, J) rad^2, of the joints' turns ([:, 0]: the root's), and
    root_var (T,) m^2, of the root's place, out; all per axis.
    """
    joints, points = local.shape[1], terms[0]
    work, spread = allocate_workspace(joints, shared.shape[1], rows), np.empty((joints, 6, 6))
    arm, rotation = work.system.lever_arm, work.pose.rotation
    for t in range(first, stop):
        load_pose(root, local, shared, t, work.pose)
        compute_forward_kinematics(tree, work.pose)
        linearise_terms(tree, terms, t, scale2, work.pose, work.system)
        sweep.factorise_tree(tree, work.system, sweep.MIN_INFORMATION, work.factors)
        propagate_covariance(tree, work.system, work.factors, spread, joint_var[t])
        add_shared_covariance(tree, work, spread, joint_var[t])
        subtract_row_information(tree, work, work.row_responses, spread, joint_var[t])
        root_var[t] = (spread[0, 3, 3] + spread[0, 4, 4] + spread[0, 5, 5]) / 3
        for j in range(joints):
            joint_sd[t, j] = compute_point_sd(spread, j, arm[j, 0], arm[j, 1], arm[j, 2])
        for k in range(len(points.joints)):
            j = points.joints[k]
            a, b, c = points.places[k, 0], points.places[k, 1], points.places[k, 2]
            x = arm[j, 0] + rotation[j, 0, 0] * a + rotation[j, 0, 1] * b + rotation[j, 0, 2] * c
            y = arm[j, 1] + rotation[j, 1, 0] * a + rotation[j, 1, 1] * b + rotation[j, 1, 2] * c
            z = arm[j, 2] + rotation[j, 2, 0] * a + rotation[j, 2, 1] * b + rotation[j, 2, 2] * c
            marker_sd[t, k] = compute_point_sd(spread, j, x, y, z)
