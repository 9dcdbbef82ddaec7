"""What poses cost, without moving them."""

import math

from numba import njit

from mocapfix.kernels import low_rank, sweep
from mocapfix.kernels.forward_kinematics import apply_step, compute_forward_kinematics, copy_array
from mocapfix.kernels.normal_equations import linearise_terms
from mocapfix.kernels.workspace import allocate_workspace, copy_pose, load_pose, store_pose


# MERGED: mocapfix.kernels.cost
@njit(cache=True, nogil=True)
def compute_cost_frames(tree, terms, frames, scale2, rows, root, local, shared, cost):
    """Write into cost (F,) what the terms say of some `frames` (F,): half the sum of squares, robust where a term is."""
    work = allocate_workspace(local.shape[1], shared.shape[1], rows)
    for i in range(len(frames)):
        t = frames[i]
        load_pose(root, local, shared, t, work.pose)
        compute_forward_kinematics(tree, work.pose)
        cost[i] = linearise_terms(tree, terms, t, scale2, work.pose, work.system)


# MERGED: mocapfix.kernels.levenberg
# The Levenberg-Marquardt solve of one frame's pose, and of many frames in parallel.
#
# Damping and acceptance follow Lourakis' levmar, as MNN-IK's Algorithm 1 does; each direction comes from the sweep. It ends
# where the cost is nothing but rounding, or where the fall that a step promises no longer matters: gradient and step are then
# small, measured by what they are worth in standard deviations, so that metres and radians compare.
STATUS_CONVERGED, STATUS_ITERATION_LIMIT, STATUS_EXACT, STATUS_UNCONSTRAINED = 0, 1, 4, 5  # indices into motion.STATUS
INITIAL_DAMPING_RATIO = (
    1e-5  # initial damping over the largest diagonal entry: starts are near (levmar: 1e-3 where they may be far)
)
MIN_COST_DECREASE = 1e-3  # a predicted fall of the cost (half a sum of squares in standard deviations) that no longer matters
MIN_COST = 1e-12  # a cost that is nothing but rounding


@njit(cache=True)
def compute_array_dot(a, b):
    """-> the sum of products of two contiguous arrays of one shape."""
    flat, other = a.reshape(-1), b.reshape(-1)
    total = 0.0
    for i in range(len(flat)):
        total += flat[i] * other[i]
    return total


@njit(cache=True)
def find_largest_curvature(system):
    """-> the largest diagonal entry of the curvature, or 1: of the root's twist, which moves every body, of what holds joints'
    own turns, of the shared unknowns. What markers say of a joint's turn they say of the root's, too.
    """
    entry = 1.0
    for a in range(6):
        total = 0.0
        for j in range(len(system.h)):
            total += system.h[j, a, a]
        entry = max(entry, total)
    for j in range(len(system.h_joint)):
        for a in range(3):
            entry = max(entry, system.h_joint[j, a, a])
    for p in range(len(system.shared)):
        entry = max(entry, system.shared[p, p])
    return entry


@njit(cache=True)
def is_constrained(system):
    """-> whether anything says where the pose should be."""
    for j in range(len(system.h)):
        for a in range(6):
            if system.h[j, a, a] > 0.0:
                return True
        for a in range(3):
            if system.h_joint[j, a, a] > 0.0:
                return True
    return compute_array_dot(system.rows, system.rows) + compute_array_dot(system.row_joint, system.row_joint) > 0.0


@njit(inline="always")
def compute_direction(tree, work, mu):
    """Write the damped Gauss-Newton step of the work's system. -> the fall of the cost that the damped model promises"""
    system, step, g, b = work.system, work.step, work.g, work.b
    sweep.factorise_tree(tree, system, mu, work.factors)
    copy_array(system.g, g)
    copy_array(system.b, b)
    copy_array(system.g_shared, step.shared)
    low_rank.add_row_gradient(system, work.answers, g, b)
    sweep.solve_tree(tree, system, work.factors, g, b, step)
    low_rank.apply_rows(tree, system, work.factors, work.answers, g, step)
    fall = low_rank.compute_row_decrease(system, work.answers, step)
    fall -= (
        compute_array_dot(system.g, step.twist)
        + compute_array_dot(system.b, step.turn)
        + compute_array_dot(system.g_shared, step.shared)
    )
    size = (
        compute_array_dot(step.twist[0], step.twist[0])
        + compute_array_dot(step.turn, step.turn)
        + compute_array_dot(step.shared, step.shared)
    )
    return 0.5 * (mu * size + fall)


@njit(inline="always")
def solve_frame(tree, terms, t, scales2, damping_ratio, max_iterations, work):
    """Move the work's pose to where frame t's cost is least. -> status, iterations

    Every trial pose is linearised at once: most are accepted, and then the next step needs it. A step whose promise no
    longer matters is taken, but the terms are not asked again what it brought. Where nothing says where the pose should be,
    it stays.

    scales2  squared robust scales, wide to narrow: the solve runs through them, so that far-off starts are not cut off
    tau      initial damping over the largest curvature: small where the start is good
    most     iterations at each scale
    """
    pose, new, system = work.pose, work.new, work.system
    total, status = 0, STATUS_ITERATION_LIMIT
    compute_forward_kinematics(tree, pose)
    for scale2 in scales2:
        copy_pose(pose, new)
        status, iterations, cost, promised, mu, nu, trial = STATUS_ITERATION_LIMIT, 0, 0.0, 0.0, -1.0, 2.0, False
        while True:
            there = linearise_terms(tree, terms, t, scale2, new, system)
            if trial and there < cost:
                mu *= max(1 / 3, 1 - (2 * (cost - there) / promised - 1) ** 3)
                nu = 2.0
                copy_pose(new, pose)
            if iterations == max_iterations:
                break
            if trial and not there < cost:  # more careful, from where it was, where the model must be made again
                mu, nu, trial = mu * nu, nu * 2.0, False
                copy_pose(pose, new)
                continue
            if mu < 0.0:
                if not is_constrained(system):
                    return STATUS_UNCONSTRAINED, total
                mu = damping_ratio * find_largest_curvature(system)
            cost = there
            if cost < MIN_COST:
                status = STATUS_EXACT
                break
            iterations += 1
            promised = compute_direction(tree, work, mu)
            if not math.isfinite(promised):
                return STATUS_UNCONSTRAINED, total + iterations
            apply_step(tree, pose, work.step, new)
            compute_forward_kinematics(tree, new)
            if promised < MIN_COST_DECREASE:
                status = STATUS_CONVERGED
                if nu == 2.0:  # after a refusal not even a slight promise is believed unasked
                    copy_pose(new, pose)
                break
            trial = True
        total += iterations
    return status, total


@njit(cache=True)
def copy_joints_from_frame(root, local, shared, source, t, taken):
    """Give frame t what it takes from the pose of another."""
    for j in range(len(taken)):
        if taken[j]:
            copy_array(local[source, j], local[t, j])
    if taken[0]:
        copy_array(root[source], root[t])
        copy_array(shared[source], shared[t])


@njit(cache=True, nogil=True)
def solve_frames(
    tree, terms, solve_order, scales2, damping_ratio, max_iterations, rows, root, local, shared, status, iterations, first, stop
):
    """`solve_frame` on the chains first..stop of a plan: root (T, 3), local (T, J, 3, 3), shared (T, P) in place; status,
    iterations (T,) out. rows: how many the terms write, None where they write none.
    """
    work = allocate_workspace(local.shape[1], shared.shape[1], rows)
    for i in range(solve_order.chain_starts[first], solve_order.chain_starts[stop]):
        t, source = solve_order.order[i], solve_order.source[i]
        if source >= 0:
            copy_joints_from_frame(root, local, shared, source, t, solve_order.taken[min(t, len(solve_order.taken) - 1)])
        load_pose(root, local, shared, t, work.pose)
        status[t], iterations[t] = solve_frame(tree, terms, t, scales2, damping_ratio, max_iterations, work)
        store_pose(work.pose, root, local, shared, t)
