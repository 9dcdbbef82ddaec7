"""The Schur complement of shared shape unknowns: each frame's pose is eliminated from it by the sweep.

SCOPE's shape parameters (Eqs. 1 and 60-64), for markers: Q = P + 3 K + 3 F unknowns. The first P change joints' offsets and
markers' offsets along given deformations, linearly. The next 3 K are the K markers' offsets themselves, in their joints' axes.
The last 3 F are the mean pose of the frames: the rotation of each of F joints from its target, in its parent's axes.

`solve.minimise.compute_shared_responses` runs these loops; `subject.refinement` sums over frames.
"""

import numpy as np
from numba import njit

from mocapfix.kernels import sweep
from mocapfix.kernels.compilation import compile_inner_kernel, compile_kernel
from mocapfix.kernels.forward_kinematics import compute_forward_kinematics
from mocapfix.kernels.lie import compute_left_jacobian_inverse, compute_logarithm
from mocapfix.kernels.normal_equations import linearise_terms
from mocapfix.kernels.small_matrices import (
    clear_array,
    copy_array,
    load_matrix,
    multiply_matrices,
    multiply_vector,
    store_matrix,
    transpose_matrix,
)
from mocapfix.kernels.terms.contract import compute_robust_loss
from mocapfix.kernels.workspace import allocate_workspace, load_pose


@compile_inner_kernel
def compute_shape_shift(deformations, p, points, parents, rotation, joint_shift, marker_shift):
    """Write the shift of joints (J, 3) and markers (K, 3), in world axes, by the p-th deformation with all rotations fixed."""
    for a in range(3):
        joint_shift[0, a] = 0.0
    for j in range(1, len(joint_shift)):
        r = rotation[parents[j]]
        x, y, z = deformations.joint_offsets[p, j]
        for a in range(3):
            joint_shift[j, a] = joint_shift[parents[j], a] + r[a, 0] * x + r[a, 1] * y + r[a, 2] * z
    for k in range(len(marker_shift)):
        j = points.joints[k]
        x, y, z = deformations.marker_offsets[p, k]
        for a in range(3):
            marker_shift[k, a] = joint_shift[j, a] + rotation[j, a, 0] * x + rotation[j, a, 1] * y + rotation[j, a, 2] * z


@compile_inner_kernel
def compute_marker_gradient(points, lever, marker_weight, shift, g):
    """Write the gradient on the bodies' twists, g (J, 6), of markers shifted by `shift` (K, 3)."""
    clear_array(g)
    for k in range(len(shift)):
        w, j = marker_weight[k], points.joints[k]
        x, y, z = lever[k, 0], lever[k, 1], lever[k, 2]
        ex, ey, ez = shift[k, 0], shift[k, 1], shift[k, 2]
        g[j, 0] += w * (y * ez - z * ey)
        g[j, 1] += w * (z * ex - x * ez)
        g[j, 2] += w * (x * ey - y * ex)
        g[j, 3] += w * ex
        g[j, 4] += w * ey
        g[j, 5] += w * ez


@compile_inner_kernel
def compute_joint_responses(twist, lever_arm, shift, out):
    """Write the shifts of the joints (J, 3): their own `shift` (J, 3) plus the motion by their bodies' twists (J, 6)."""
    for j in range(len(twist)):
        x, y, z = lever_arm[j, 0], lever_arm[j, 1], lever_arm[j, 2]
        out[j, 0] = shift[j, 0] + twist[j, 3] + twist[j, 1] * z - twist[j, 2] * y
        out[j, 1] = shift[j, 1] + twist[j, 4] + twist[j, 2] * x - twist[j, 0] * z
        out[j, 2] = shift[j, 2] + twist[j, 5] + twist[j, 0] * y - twist[j, 1] * x


@compile_inner_kernel
def compute_marker_responses(joints, twist, lever, shift, rotation, out):
    """Write the shifts of the markers (K, 3) in the axes of their joints: their own `shift` plus the motion by the twists."""
    for m in range(len(joints)):
        j = joints[m]
        x, y, z = lever[m, 0], lever[m, 1], lever[m, 2]
        sx = shift[m, 0] + twist[j, 3] + twist[j, 1] * z - twist[j, 2] * y
        sy = shift[m, 1] + twist[j, 4] + twist[j, 2] * x - twist[j, 0] * z
        sz = shift[m, 2] + twist[j, 5] + twist[j, 0] * y - twist[j, 1] * x
        for a in range(3):
            out[m, a] = rotation[j, 0, a] * sx + rotation[j, 1, a] * sy + rotation[j, 2, a] * sz


@compile_inner_kernel
def compute_marker_errors(points, t, scale2, lever_arm, pose, lever, error, marker_weight):
    """Write frame t's markers relative to the common origin, their errors (K, 3) and robust weights (K,)."""
    rotation = pose.rotation
    for k in range(len(lever)):
        j, square, weight = points.joints[k], 0.0, points.weight[t, k]
        for a in range(3):
            lever[k, a] = lever_arm[j, a]
            for c in range(3):
                lever[k, a] += rotation[j, a, c] * points.offsets[k, c]
            error[k, a] = pose.position[0, a] + lever[k, a] - points.measured[t, k, a] if weight > 0 else 0.0
            square += error[k, a] ** 2
        marker_weight[k] = weight * compute_robust_loss(points.loss, weight * square, scale2)[1]


@compile_inner_kernel
def compute_prior_errors(pose_prior, rotating, tree, pose, error, jacobian):
    """Write the rotation vectors (F, 3) from joints' prior targets to the joints, and their derivatives to world rotations.

    Args:
        rotating: (F,) indices of the joints that rotate.
        jacobian: (F, 3, 3) out.
    """
    for f in range(len(rotating)):
        j = rotating[f]
        target = load_matrix(pose_prior.rotations[0], j)
        x, y, z, c = compute_logarithm(multiply_matrices(load_matrix(pose.local, j), transpose_matrix(target)))
        to_parent = transpose_matrix(load_matrix(pose.rotation, tree.parents[j]))
        store_matrix(multiply_matrices(compute_left_jacobian_inverse(x, y, z, c), to_parent), jacobian, f)
        error[f, 0], error[f, 1], error[f, 2] = x, y, z
        for a in range(3 if len(pose_prior.mean_vectors) else 0):
            error[f, a] -= pose_prior.mean_vectors[j, a]


@compile_inner_kernel
def compute_prior_gradient(information, jacobian, a, out):
    """Write the gradient on a joint's rotation, `out` (3,), of a unit change of its prior's mean vector along axis `a`."""
    x, y, z = multiply_vector(transpose_matrix(jacobian), information[0, a], information[1, a], information[2, a])
    out[0], out[1], out[2] = -x, -y, -z


@njit(inline="always")
def eliminate_pose(
    tree, terms, t, deformations, rotating, scale2, only_errors, work, marker_weight, marker_shift, marker_response,
    prior_response, prior_information, joint_response,
):  # fmt: skip
    """Write one frame's `SharedResponses` at the workspace's pose. Returns the frame's cost.

    The first term must be the markers' PointTerm, the third the PosePriorTerm.

    Args:
        only_errors: Write of the responses only the last rows, the remaining errors: most of the time is spent on the others.
    """
    points, equations, step, rotation = terms[0], work.equations, work.step, work.pose.rotation
    lever_arm = equations.lever_arm
    joints, markers, dense, last = len(lever_arm), len(marker_weight), len(marker_shift), len(joint_response)
    prior_error, jacobian = np.empty((len(rotating), 3)), np.empty((len(rotating), 3, 3))
    lever, error, no_twist = np.empty((markers, 3)), np.empty((markers, 3)), np.zeros((joints, 6))
    joint_shift, shift = np.zeros((joints, 3)), np.zeros((markers, 3))
    compute_forward_kinematics(tree, work.pose)
    cost = linearise_terms(tree, terms, t, scale2, work.pose, equations)
    compute_marker_errors(points, t, scale2, lever_arm, work.pose, lever, error, marker_weight)
    compute_prior_errors(terms[2], rotating, tree, work.pose, prior_error, jacobian)
    sweep.factorise_tree(tree, equations, sweep.MIN_INFORMATION, work.factors)
    for q in range(len(marker_response)):
        k, f = (q - dense) // 3, (q - dense) // 3 - markers
        clear_array(joint_shift)
        clear_array(shift)
        if q < dense:
            compute_shape_shift(deformations, q, points, tree.parents, rotation, joint_shift, shift)
            compute_marker_responses(points.joints, no_twist, lever, shift, rotation, marker_shift[q])
        if only_errors and q < last:
            continue
        for a in range(3 if q >= dense and k < markers else 0):
            shift[k, a] = rotation[points.joints[k], a, (q - dense) % 3]
        if q < last:
            compute_marker_gradient(points, lever, marker_weight, shift, work.g)
            clear_array(work.g_joint)
            if f >= 0:
                compute_prior_gradient(
                    prior_information[f], load_matrix(jacobian, f), (q - dense) % 3, work.g_joint[rotating[f]]
                )  # fmt: skip
        else:  # the errors themselves, and with them the gradients of the other terms
            copy_array(error, shift)
            copy_array(equations.g, work.g)
            copy_array(equations.g_joint, work.g_joint)
        sweep.solve_tree(tree, equations, work.factors, work.g, work.g_joint, step)
        if q < last:
            compute_joint_responses(step.twist, lever_arm, joint_shift, joint_response[q])
        compute_marker_responses(points.joints, step.twist, lever, shift, rotation, marker_response[q])
        for i in range(len(rotating)):
            turn = step.joint_turn[rotating[i]]
            x, y, z = multiply_vector(load_matrix(jacobian, i), turn[0], turn[1], turn[2])
            prior_response[q, i, 0], prior_response[q, i, 1], prior_response[q, i, 2] = x, y, z
            for a in range(3 if q == last else 0):
                prior_response[q, i, a] += prior_error[i, a]
        if f >= 0 and q < last:
            prior_response[q, f, (q - dense) % 3] -= 1.0
    return cost


@compile_kernel(nogil=True)
def eliminate_pose_frames(
    tree, terms, deformations, rotating, scale2, only_errors, root, local, cost, marker_weight, marker_shift, marker_response,
    prior_response, prior_information, joint_response, first, stop,
):  # fmt: skip
    """Apply `eliminate_pose` to the frames first..stop - 1, each into its own row."""
    no_shared = np.zeros((len(root), 0))
    work = allocate_workspace(
        local.shape[1], no_shared.shape[1], None
    )  # a literal 0 has another type and would be compiled again
    for t in range(first, stop):
        load_pose(root, local, no_shared, t, work.pose)
        cost[t] = eliminate_pose(
            tree, terms, t, deformations, rotating, scale2, only_errors, work, marker_weight[t], marker_shift[t],
            marker_response[t], prior_response[t], prior_information, joint_response[t],
        )  # fmt: skip
