"""One frame's normal equations, the quadratic model of all terms near a pose; and the working memory of its solve."""

from typing import NamedTuple

import numpy as np
from numba import literal_unroll

from mocapfix.kernels.compilation import compile_inner_kernel
from mocapfix.kernels.forward_kinematics import FramePose, allocate_pose
from mocapfix.kernels.small_matrices import clear_array, copy_array
from mocapfix.kernels.sweep import PoseStep, RowResponses, SweepFactors, allocate_factors, allocate_row_responses, allocate_step
from mocapfix.kernels.terms.contract import add_term


class NormalEquations(NamedTuple):
    """1/2 x'Hx + gradient'x over the bodies' twists, the joints' own rotations and P unknowns shared by all joints.

    A body's twist is (rotation, velocity of its point at the origin, which is the root's position), in world axes. M rows
    couple several bodies: each adds half the square of (row_residual + row_twist . twists + row_joint . rotations), in
    standard deviations.
    """

    h: np.ndarray  # (J, 6, 6) curvature of each body's twist
    g: np.ndarray  # (J, 6) gradient of each body's twist
    h_joint: np.ndarray  # (J, 3, 3) curvature of each joint's own rotation
    g_joint: np.ndarray  # (J, 3) its gradient
    lever_arm: np.ndarray  # (J, 3) metres: joints from the origin, in world axes
    h_joint_shared: np.ndarray  # (J, 3, P) curvature between joints' rotations (the root's too) and shared unknowns
    h_shared: np.ndarray  # (P, P) lower triangle
    g_shared: np.ndarray  # (P,)
    row_twist: np.ndarray  # (M, J, 6)
    row_joint: np.ndarray  # (M, J, 3)
    row_residual: np.ndarray  # (M,)
    row_count: np.ndarray  # (1,) number of rows written so far


@compile_inner_kernel
def allocate_equations(joints, unknowns, rows):
    """Return arrays for the model of any frame with so many joints, shared unknowns and rows (None for no rows)."""
    rows = 0 if rows is None else rows
    return NormalEquations(
        np.empty((joints, 6, 6)), np.empty((joints, 6)), np.empty((joints, 3, 3)), np.empty((joints, 3)), np.empty((joints, 3)),
        np.empty((joints, 3, unknowns)), np.empty((unknowns, unknowns)),
        np.empty(unknowns), np.empty((rows, joints, 6)), np.empty((rows, joints, 3)),
        np.empty(rows), np.zeros(1, np.int64),
    )  # fmt: skip


@compile_inner_kernel
def clear_equations(equations):
    """Set the model to zero."""
    clear_array(equations.h)
    clear_array(equations.g)
    clear_array(equations.h_joint)
    clear_array(equations.g_joint)
    clear_array(equations.h_joint_shared)
    clear_array(equations.h_shared)
    clear_array(equations.g_shared)
    clear_array(equations.row_twist)
    clear_array(equations.row_joint)
    clear_array(equations.row_residual)
    equations.row_count[0] = 0


@compile_inner_kernel
def linearise_terms(tree, terms, t, scale2, pose, equations):
    """Write the model of frame t's terms at a pose whose forward kinematics is computed. Returns the cost."""
    clear_equations(equations)
    cost = 0.0
    for term in literal_unroll(terms):
        cost += add_term(term, t, scale2, tree, pose, equations)
    h, lever_arm, position = equations.h, equations.lever_arm, pose.position
    for j in range(len(h)):
        for a in range(3):
            lever_arm[j, a] = position[j, a] - position[0, a]
        for a in range(1, 6):  # the upper triangles
            for b in range(a):
                h[j, b, a] = h[j, a, b]
    for a in range(3):  # the root's own rotation is part of its twist
        equations.g[0, a] += equations.g_joint[0, a]
        equations.g_joint[0, a] = 0.0
        for c in range(3):
            h[0, a, c] += equations.h_joint[0, a, c]
        for m in range(len(equations.row_residual)):
            equations.row_twist[m, 0, a] += equations.row_joint[m, 0, a]
            equations.row_joint[m, 0, a] = 0.0
    return cost


class SolveWorkspace(NamedTuple):
    """All arrays that the solve of a frame writes; allocated once for many frames."""

    pose: FramePose
    trial_pose: FramePose
    equations: NormalEquations
    factors: SweepFactors
    step: PoseStep
    row_responses: RowResponses | None  # None if no term writes rows
    g: np.ndarray  # (J, 6) gradient, overwritten by the sweep
    g_joint: np.ndarray  # (J, 3)


@compile_inner_kernel
def allocate_workspace(joints, unknowns, rows):
    """Return the workspace for so many joints, shared unknowns and rows; without rows (None) no code for them is compiled."""
    return SolveWorkspace(
        allocate_pose(joints, unknowns), allocate_pose(joints, unknowns), allocate_equations(joints, unknowns, rows),
        allocate_factors(joints, unknowns), allocate_step(joints, unknowns), allocate_row_responses(joints, unknowns, rows),
        np.empty((joints, 6)), np.empty((joints, 3)),
    )  # fmt: skip


@compile_inner_kernel
def copy_pose(source, target):
    """Copy a pose."""
    copy_array(source.root, target.root)
    copy_array(source.local, target.local)
    copy_array(source.shared, target.shared)
    copy_array(source.position, target.position)
    copy_array(source.rotation, target.rotation)


@compile_inner_kernel
def load_pose(root, local, shared, t, pose):
    """Copy frame t of poses root (T, 3), local (T, J, 3, 3), shared (T, P) into `pose`."""
    copy_array(root[t], pose.root)
    copy_array(local[t], pose.local)
    copy_array(shared[t], pose.shared)


@compile_inner_kernel
def store_pose(pose, root, local, shared, t):
    """Copy `pose` into frame t of poses root (T, 3), local (T, J, 3, 3), shared (T, P)."""
    copy_array(pose.root, root[t])
    copy_array(pose.local, local[t])
    copy_array(pose.shared, shared[t])
