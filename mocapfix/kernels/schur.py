"""The Schur complement of shared shape unknowns: each frame's pose is eliminated from it by the sweep.

SCOPE's shape parameters (Eqs. 1 and 60-64), for markers: U = 3 J + 3 K + 3 F unknowns. The first are the offsets of the J joints
in their parents' axes, the next those of the K markers in their joints' axes. The last 3 F are the mean pose of the frames: the
rotation of each of F joints from its target, in its parent's axes.

Each unknown is a column, and so are the remaining errors, the last one. Many columns are swept at a time, since the compiler
makes vector instructions of them. `solve.minimise.compute_shared_responses` runs these loops; `subject.refinement` sums them.
"""

from typing import NamedTuple

import numpy as np

from mocapfix.kernels import sweep
from mocapfix.kernels.compilation import compile_inner_kernel, compile_kernel
from mocapfix.kernels.forward_kinematics import compute_forward_kinematics
from mocapfix.kernels.lie import compute_left_jacobian_inverse, compute_logarithm
from mocapfix.kernels.normal_equations import allocate_workspace, linearise_terms, load_pose
from mocapfix.kernels.small_matrices import (
    clear_array,
    copy_array,
    load_matrix,
    multiply_matrices,
    store_matrix,
    transpose_matrix,
)
from mocapfix.kernels.terms.contract import compute_robust_loss

COLUMNS = 96  # swept at a time: shorter loops take longer to begin than to run


class ColumnWorkspace(NamedTuple):
    """Arrays for C columns of one frame, in world axes, of J joints and K markers."""

    joint_shift: np.ndarray  # (J, 3, C) shift of the joints with all rotations fixed
    marker_shift: np.ndarray  # (K, 3, C) the same of the markers; then with the motion by the twists
    torque: np.ndarray  # (J, 3, C) gradient on the bodies' rotations
    force: np.ndarray  # (J, 3, C) gradient on the velocities of their points at the origin
    turn: np.ndarray  # (J, 3, C) gradient on the joints' own rotations; then these
    spin: np.ndarray  # (J, 3, C) the bodies' rotations by which the pose adapts
    velocity: np.ndarray  # (J, 3, C) the velocities of their points at the origin


@compile_kernel
def add_product(factor, m, rows, out):
    """Add `factor` m @ rows, nine numbers and (3, C), to `out` (3, C). With few rows at a time the compiler can vectorise."""
    for a in range(3):
        x, y, z = factor * m[3 * a], factor * m[3 * a + 1], factor * m[3 * a + 2]
        for c in range(rows.shape[1]):
            out[a, c] += x * rows[0, c] + y * rows[1, c] + z * rows[2, c]


@compile_kernel
def add_cross_product(factor, lever, rows, out):
    """Add `factor` lever x rows, (3,) and (3, C), to `out` (3, C)."""
    for a in range(3):
        n, m = (a + 1) % 3, (a + 2) % 3
        y, z = factor * lever[n], factor * lever[m]
        for c in range(rows.shape[1]):
            out[a, c] += y * rows[m, c] - z * rows[n, c]


@compile_kernel
def add_rows(factor, rows, out):
    """Add `factor` times rows (3, C) to `out` (3, C)."""
    for a in range(3):
        for c in range(rows.shape[1]):
            out[a, c] += factor * rows[a, c]


@compile_inner_kernel
def solve_columns(tree, points, lever, lever_arm, factors, columns):
    """Write how the pose adapts to the gradients, as `sweep.solve_tree` does, and add this motion to the markers' shifts."""
    torque, force, turn, spin, velocity = columns[2:]
    gain, inverse = factors.gain.reshape(-1, 3, 3), factors.joint_inverse
    for i in range(len(tree.parents) - 1, 0, -1):
        p = tree.parents[i]
        add_rows(1.0, torque[i], turn[i])
        add_cross_product(-1.0, lever_arm[i], force[i], turn[i])
        add_rows(1.0, torque[i], torque[p])
        add_rows(1.0, force[i], force[p])
        if tree.free[i]:
            add_product(-1.0, load_matrix(gain, 2 * i), turn[i], torque[p])
            add_product(-1.0, load_matrix(gain, 2 * i + 1), turn[i], force[p])
    clear_array(spin[0])
    clear_array(velocity[0])
    for a in range(6):
        for b in range(6):
            h, rows = factors.h[0, a, b], torque[0] if b < 3 else force[0]
            out = spin[0] if a < 3 else velocity[0]
            for c in range(out.shape[1]):
                out[a % 3, c] -= h * rows[b % 3, c]
    for i in range(1, len(tree.parents)):
        p = tree.parents[i]
        clear_array(torque[i])
        if tree.free[i]:
            add_product(-1.0, load_matrix(inverse, i), turn[i], torque[i])
            add_product(-1.0, transpose_matrix(load_matrix(gain, 2 * i)), spin[p], torque[i])
            add_product(-1.0, transpose_matrix(load_matrix(gain, 2 * i + 1)), velocity[p], torque[i])
        copy_array(torque[i], turn[i])
        copy_array(spin[p], spin[i])
        copy_array(velocity[p], velocity[i])
        add_rows(1.0, turn[i], spin[i])
        add_cross_product(1.0, lever_arm[i], turn[i], velocity[i])
    for k in range(len(lever)):
        j = points.joints[k]
        add_rows(1.0, velocity[j], columns.marker_shift[k])
        add_cross_product(-1.0, lever[k], spin[j], columns.marker_shift[k])


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
def start_columns(begin, tree, points, pose, rotating, prior_information, jacobian, columns):
    """Write the shifts of markers and joints, and the gradients on joints' rotations, by the unknowns of the columns."""
    joint_shift, marker_shift, turn = columns.joint_shift, columns.marker_shift, columns.turn
    for array in (joint_shift, marker_shift, turn, columns.torque, columns.force):
        clear_array(array)
    joints, markers = len(joint_shift), len(marker_shift)
    for c in range(min(joint_shift.shape[2], 3 * (joints + markers + len(rotating)) - begin)):
        n, a = (begin + c) // 3, (begin + c) % 3
        f, k = n - joints - markers, n - joints
        for b in range(3):
            if f >= 0:
                for d in range(3):
                    turn[rotating[f], b, c] -= jacobian[f, d, b] * prior_information[rotating[f], a, d]
            elif k >= 0:
                marker_shift[k, b, c] = pose.rotation[points.joints[k], b, a]
            elif n > 0:
                joint_shift[n, b, c] = pose.rotation[tree.parents[n], b, a]
    for j in range(1, joints):
        add_rows(1.0, joint_shift[tree.parents[j]], joint_shift[j])
    for k in range(markers):
        add_rows(1.0, joint_shift[points.joints[k]], marker_shift[k])


@compile_inner_kernel
def add_products(points, parents, pose, rotating, jacobian, marker_weight, columns, products):
    """Add to `products` (U, C) those of the markers' weighted responses with the shifts of the body by the offsets of joints and
    markers, and the responses of the joints' deviations from the mean pose.
    """
    shift, force = columns.marker_shift, columns.force
    clear_array(force)
    first = 3 * len(force)
    for k in range(len(shift)):
        j, w, row = points.joints[k], marker_weight[k], first + 3 * k
        add_rows(w, shift[k], force[j])
        add_product(w, transpose_matrix(load_matrix(pose.rotation, j)), shift[k], products[row : row + 3])
    for j in range(len(force) - 1, 0, -1):
        add_rows(1.0, force[j], force[parents[j]])
        to_parent = transpose_matrix(load_matrix(pose.rotation, parents[j]))
        add_product(1.0, to_parent, force[j], products[3 * j : 3 * j + 3])
    first += 3 * len(shift)
    for f in range(len(rotating)):
        row = first + 3 * f
        add_product(1.0, load_matrix(jacobian, f), columns.turn[rotating[f]], products[row : row + 3])


@compile_kernel(nogil=True)
def sum_pose_responses(
    tree, terms, rotating, scale2, root, local, cost, marker_weight, products, marker_response, joint_response
):
    """Add to `products` (N, U, C) those of T frames at their poses, and write their `SharedResponses`.

    The first term must be the markers' PointTerm, the third the PosePriorTerm.

    Args:
        products: By block of columns; one block is the last, with the errors: most of the time is spent on the others.
        marker_response: (T, N, K, 3, C), or without columns: not written. The same holds for joint_response (T, N, J, 3, C).
    """
    points, pose_prior, joints, markers = terms[0], terms[2], local.shape[1], len(terms[0].joints)
    no_shared, (blocks, last, width) = np.zeros((len(root), 0)), products.shape
    work = allocate_workspace(joints, no_shared.shape[1], None)  # a literal 0 has another type and would be compiled again
    pose, equations, lever_arm = work.pose, work.equations, work.equations.lever_arm
    columns = ColumnWorkspace(
        np.empty((joints, 3, width)), np.empty((markers, 3, width)), np.empty((joints, 3, width)), np.empty((joints, 3, width)),
        np.empty((joints, 3, width)), np.empty((joints, 3, width)), np.empty((joints, 3, width)),
    )  # fmt: skip
    prior_error, jacobian = np.empty((len(rotating), 3)), np.empty((len(rotating), 3, 3))
    lever, error = np.empty((markers, 3)), np.empty((markers, 3))
    for t in range(len(root)):
        load_pose(root, local, no_shared, t, pose)
        compute_forward_kinematics(tree, pose)
        cost[t] = linearise_terms(tree, terms, t, scale2, pose, equations)
        compute_marker_errors(points, t, scale2, lever_arm, pose, lever, error, marker_weight[t])
        compute_prior_errors(pose_prior, rotating, tree, pose, prior_error, jacobian)
        sweep.factorise_tree(tree, equations, sweep.MIN_INFORMATION, work.factors)
        for n in range(blocks):
            begin = (last // width + 1 - blocks + n) * width
            start_columns(begin, tree, points, pose, rotating, pose_prior.information[0], jacobian, columns)
            for k in range(markers):
                w, shift = marker_weight[t, k], columns.marker_shift[k]
                add_rows(w, shift, columns.force[points.joints[k]])
                add_cross_product(w, lever[k], shift, columns.torque[points.joints[k]])
            for a in range(3 if n == blocks - 1 else 0):  # the errors, and with them the gradients of all terms
                for k in range(markers):
                    columns.marker_shift[k, a, last - begin] = error[k, a]
                for j in range(joints):
                    columns.torque[j, a, last - begin] = equations.g[j, a]
                    columns.force[j, a, last - begin] = equations.g[j, 3 + a]
                    columns.turn[j, a, last - begin] = equations.g_joint[j, a]
            solve_columns(tree, points, lever, lever_arm, work.factors, columns)
            for k in range(markers if marker_response.shape[4] else 0):
                to_joint = transpose_matrix(load_matrix(pose.rotation, points.joints[k]))
                add_product(1.0, to_joint, columns.marker_shift[k], marker_response[t, n, k])
            for j in range(joints if marker_response.shape[4] else 0):
                add_rows(1.0, columns.joint_shift[j], joint_response[t, n, j])
                add_rows(1.0, columns.velocity[j], joint_response[t, n, j])
                add_cross_product(-1.0, lever_arm[j], columns.spin[j], joint_response[t, n, j])
            add_products(points, tree.parents, pose, rotating, jacobian, marker_weight[t], columns, products[n])
            for f in range(len(rotating) if n == blocks - 1 else 0):
                for a in range(3):
                    products[n, 3 * (joints + markers + f) + a, last - begin] += prior_error[f, a]
