"""The Levenberg-Marquardt solve of one frame's pose, and of many frames in parallel.

Damping and acceptance follow Lourakis' levmar, as MNN-IK's Algorithm 1 does; each direction comes from the sweep. The solve
ends when the cost is rounding error only, or when the decrease that a step predicts is negligible: gradient and step are then
small, measured in standard deviations, so that metres and radians compare.
"""

import math

from numba import njit

from mocapfix.kernels import sweep
from mocapfix.kernels.compilation import compile_inner_kernel, compile_kernel
from mocapfix.kernels.forward_kinematics import apply_step, compute_forward_kinematics
from mocapfix.kernels.normal_equations import allocate_workspace, copy_pose, linearise_terms, load_pose, store_pose
from mocapfix.kernels.small_matrices import copy_array
from mocapfix.model.motion import FrameStatus

# Numba compiles these as plain integers.
CONVERGED = int(FrameStatus.CONVERGED)
ITERATION_LIMIT = int(FrameStatus.ITERATION_LIMIT)
EXACT = int(FrameStatus.EXACT)
UNCONSTRAINED = int(FrameStatus.UNCONSTRAINED)

INITIAL_DAMPING_RATIO = 1e-5  # initial damping over the largest curvature, for good starts (levmar: 1e-3 for poor ones)
MIN_COST_DECREASE = 1e-3  # a predicted decrease of the cost (half a sum of squares in standard deviations) below it is negligible
MIN_COST = 1e-12  # a cost below it is rounding error


@compile_inner_kernel
def compute_array_dot(a, b):
    """Return the sum of products of two contiguous arrays of one shape."""
    flat, other = a.reshape(-1), b.reshape(-1)
    total = 0.0
    for i in range(len(flat)):
        total += flat[i] * other[i]
    return total


@compile_inner_kernel
def find_largest_curvature(equations):
    """Return the largest diagonal entry of the curvature, or 1 if that is larger.

    The entries are those of the root's twist, which moves every body, of the terms on joints' own rotations, and of the shared
    unknowns. What markers contribute to a joint's rotation they contribute to the root's, too.
    """
    largest = 1.0
    for a in range(6):
        total = 0.0
        for j in range(len(equations.h)):
            total += equations.h[j, a, a]
        largest = max(largest, total)
    for j in range(len(equations.h_joint)):
        for a in range(3):
            largest = max(largest, equations.h_joint[j, a, a])
    for p in range(len(equations.h_shared)):
        largest = max(largest, equations.h_shared[p, p])
    return largest


@compile_inner_kernel
def is_constrained(equations):
    """Return whether any term constrains the pose."""
    for j in range(len(equations.h)):
        for a in range(6):
            if equations.h[j, a, a] > 0.0:
                return True
        for a in range(3):
            if equations.h_joint[j, a, a] > 0.0:
                return True
    rows = compute_array_dot(equations.row_twist, equations.row_twist)
    return rows + compute_array_dot(equations.row_joint, equations.row_joint) > 0.0


@njit(inline="always")
def compute_direction(tree, work, damping):
    """Write the damped Gauss-Newton step of the workspace's equations. Returns the decrease of the cost that it predicts."""
    equations, step, g, g_joint = work.equations, work.step, work.g, work.g_joint
    sweep.factorise_tree(tree, equations, damping, work.factors)
    copy_array(equations.g, g)
    copy_array(equations.g_joint, g_joint)
    copy_array(equations.g_shared, step.shared)
    sweep.add_row_gradient(equations, work.row_responses, g, g_joint)
    sweep.solve_tree(tree, equations, work.factors, g, g_joint, step)
    sweep.apply_rows(tree, equations, work.factors, work.row_responses, g, step)
    decrease = sweep.compute_row_decrease(equations, work.row_responses, step)
    decrease -= (
        compute_array_dot(equations.g, step.twist)
        + compute_array_dot(equations.g_joint, step.joint_turn)
        + compute_array_dot(equations.g_shared, step.shared)
    )
    size = (
        compute_array_dot(step.twist[0], step.twist[0])
        + compute_array_dot(step.joint_turn, step.joint_turn)
        + compute_array_dot(step.shared, step.shared)
    )
    return 0.5 * (damping * size + decrease)


@njit(inline="always")
def solve_frame(tree, terms, t, scales2, damping_ratio, max_iterations, work):
    """Move the workspace's pose to the minimum of frame t's cost. Returns status and iterations.

    Every trial pose is linearised at once: most are accepted, and then the next step needs the linearisation. A step whose
    predicted decrease is negligible is accepted without another linearisation. If no term constrains the pose, it stays.

    Args:
        scales2: Squared robust scales, wide to narrow: the solve runs through them, so that distant starts are not rejected.
        damping_ratio: Initial damping over the largest curvature: small for a good start.
        max_iterations: At each scale.
    """
    pose, trial_pose, equations = work.pose, work.trial_pose, work.equations
    total, status = 0, ITERATION_LIMIT
    compute_forward_kinematics(tree, pose)
    for scale2 in scales2:
        copy_pose(pose, trial_pose)
        status, iterations, cost, predicted = ITERATION_LIMIT, 0, 0.0, 0.0
        damping, growth, is_trial = -1.0, 2.0, False
        while True:
            trial_cost = linearise_terms(tree, terms, t, scale2, trial_pose, equations)
            if is_trial and trial_cost < cost:
                damping *= max(1 / 3, 1 - (2 * (cost - trial_cost) / predicted - 1) ** 3)
                growth = 2.0
                copy_pose(trial_pose, pose)
            if iterations == max_iterations:
                break
            if is_trial and not trial_cost < cost:  # rejected: more damping, and the model of the last pose again
                damping, growth, is_trial = damping * growth, growth * 2.0, False
                copy_pose(pose, trial_pose)
                continue
            if damping < 0.0:
                if not is_constrained(equations):
                    return UNCONSTRAINED, total
                damping = damping_ratio * find_largest_curvature(equations)
            cost = trial_cost
            if cost < MIN_COST:
                status = EXACT
                break
            iterations += 1
            predicted = compute_direction(tree, work, damping)
            if not math.isfinite(predicted):
                return UNCONSTRAINED, total + iterations
            apply_step(tree, pose, work.step, trial_pose)
            compute_forward_kinematics(tree, trial_pose)
            if predicted < MIN_COST_DECREASE:
                status = CONVERGED
                if growth == 2.0:  # after a rejection even a negligible step is not accepted unchecked
                    copy_pose(trial_pose, pose)
                break
            is_trial = True
        total += iterations
    return status, total


@compile_inner_kernel
def copy_joints_from_frame(root, local, shared, source, t, copied_joints):
    """Copy the joints marked in copied_joints (J,) from frame `source` to frame t; with the root, its position and shared."""
    for j in range(len(copied_joints)):
        if copied_joints[j]:
            copy_array(local[source, j], local[t, j])
    if copied_joints[0]:
        copy_array(root[source], root[t])
        copy_array(shared[source], shared[t])


@compile_kernel(nogil=True)
def solve_frames(
    tree, terms, solve_order, scales2, damping_ratio, max_iterations, rows, root, local, shared, status, iterations, first, stop
):
    """Apply `solve_frame` to the chains first..stop - 1 of a solve order, in place.

    Args:
        rows: Number of rows that the terms write, None for none.
        root: (T, 3), local (T, J, 3, 3), shared (T, P): in and out.
        status: (T,) out, as are iterations (T,).
    """
    work = allocate_workspace(local.shape[1], shared.shape[1], rows)
    for i in range(solve_order.chain_starts[first], solve_order.chain_starts[stop]):
        t, source = solve_order.frames[i], solve_order.start_frame[i]
        if source >= 0:
            copied_joints = solve_order.copied_joints[min(t, len(solve_order.copied_joints) - 1)]
            copy_joints_from_frame(root, local, shared, source, t, copied_joints)
        load_pose(root, local, shared, t, work.pose)
        status[t], iterations[t] = solve_frame(tree, terms, t, scales2, damping_ratio, max_iterations, work)
        store_pose(work.pose, root, local, shared, t)


@compile_kernel(nogil=True)
def compute_cost_frames(tree, terms, frames, scale2, rows, root, local, shared, cost):
    """Write into cost (F,) the cost of the terms in some `frames` (F,): half the sum of squares, robust for robust terms."""
    work = allocate_workspace(local.shape[1], shared.shape[1], rows)
    for i in range(len(frames)):
        t = frames[i]
        load_pose(root, local, shared, t, work.pose)
        compute_forward_kinematics(tree, work.pose)
        cost[i] = linearise_terms(tree, terms, t, scale2, work.pose, work.equations)
