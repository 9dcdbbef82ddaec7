"""What many frames say together of the unknowns they share, their poses eliminated (Schur complement by the sweep).

SCOPE's shape parameters (Eqs. 1 and 60-64), for markers: Q = P + 3 K + 3 F unknowns. The first P change joints' offsets and
markers' places along given deformations, linearly; then come the K markers' places themselves, in their joints' axes; the last
are the middle pose of the frames: by how much each of F joints is to be turned from its target, in its parent's axes.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from mocapfix.kernels import sweep
from mocapfix.kernels.forward_kinematics import compute_forward_kinematics, copy_array
from mocapfix.kernels.lie import compute_left_jacobian_inverse, compute_logarithm
from mocapfix.kernels.normal_equations import linearise_terms
from mocapfix.kernels.small_matrices import load_matrix, multiply_matrices, multiply_vector, store_matrix, transpose_matrix
from mocapfix.kernels.terms import TrackingTerm
from mocapfix.kernels.terms.contract import compute_robust_loss
from mocapfix.kernels.workspace import allocate_workspace, load_pose
from mocapfix.solve.parallel import run_over_frames
from mocapfix.solve.pose_problem import PoseProblem


class ShapeDeformations(NamedTuple):
    """What changes with P shared unknowns, in metres per unit."""

    joint_offsets: np.ndarray  # (P, J, 3) a joint in its parent's axes
    marker_offsets: np.ndarray  # (P, K, 3) a marker in its joint's axes


class SharedResponses(NamedTuple):
    """What the frames do when the shared unknowns change and each frame's pose gives way, in metres per unit.

    The last rows of `moved` and `bent` are what is left of the errors after the pose's own next step, in metres and radians.
    """

    cost: np.ndarray  # (T,) half the sum of squares, pulls included
    marker_weight: np.ndarray  # (T, K) 1/m^2, the markers' robust weights
    marker_shift: np.ndarray  # (T, P, K, 3) the markers, in their joints' axes, the pose held
    marker_response: np.ndarray  # (T, Q + 1, K, 3) the markers, in their joints' axes
    prior_response: np.ndarray  # (T, Q + 1, F, 3) radians, how far the joints are from the middle pose
    prior_information: np.ndarray  # (F, 3, 3) 1/rad^2, how strongly they are pulled there
    joint_response: np.ndarray  # (T, Q, J, 3) the joints, in world axes


def compute_shared_responses(
    problem: PoseProblem, deformations: ShapeDeformations, tracking: TrackingTerm, robust_scale_m: float, root, local
) -> SharedResponses:
    """-> how frames at their best poses, root (T, 3) and local (T, J, 3, 3), respond.

    target  the pull of each frame's pose, beside the problem's prior
    scale   metres, the robust scale
    """
    frames, joints = local.shape[:2]
    dense, markers = deformations.marker_offsets.shape[:2]
    turning = np.flatnonzero(problem.tree.free)[1:]
    unknowns = dense + 3 * markers + 3 * len(turning)
    found = SharedResponses(
        np.empty(frames),
        np.zeros((frames, markers)),
        np.empty((frames, dense, markers, 3)),
        np.empty((frames, unknowns + 1, markers, 3)),
        np.empty((frames, unknowns + 1, len(turning), 3)),
        problem.pose_prior.information[0, turning],
        np.empty((frames, unknowns, joints, 3)),
    )
    run_over_frames(
        eliminate_pose_frames, frames, problem.tree, problem.build_terms(tracking), deformations, turning,
        problem.normalise_robust_scales((robust_scale_m,))[0], root, local, *found,
    )  # fmt: skip
    return found


def reduce_shared_equations(responses: SharedResponses) -> tuple[np.ndarray, np.ndarray]:
    """-> curvature (Q, Q) and gradient (Q,) of the shared unknowns, all frames together."""
    dense, unknowns = responses.marker_shift.shape[1], responses.marker_response.shape[1] - 1
    own = dense + responses.marker_response[0, 0].size
    weighed = responses.marker_response * responses.marker_weight[:, None, :, None]
    whole = np.empty((unknowns + 1, unknowns))
    whole[:, dense:own] = weighed.sum(0).reshape(unknowns + 1, -1)
    whole[:, own:] = -np.einsum("qfa,fab->qfb", responses.prior_response.sum(0), responses.prior_information).reshape(
        unknowns + 1, -1
    )
    for rows in (slice(0, dense), slice(unknowns, None)):
        whole[rows, :dense] = np.tensordot(weighed[:, rows], responses.marker_shift, axes=([0, 2, 3], [0, 2, 3]))
    whole[dense:unknowns, :dense] = whole[:dense, dense:].T
    return whole[:unknowns], whole[unknowns]


@njit(cache=True)
def compute_shape_shift(deformations, p, points, parents, rotation, stretch, shift):
    """Write how joints (J, 3) and markers (K, 3) move, in world axes, with the p-th direction and no joint turning."""
    stretch[0] = 0.0
    for j in range(1, len(stretch)):
        r = rotation[parents[j]]
        x, y, z = deformations.offsets[p, j]
        for a in range(3):
            stretch[j, a] = stretch[parents[j], a] + r[a, 0] * x + r[a, 1] * y + r[a, 2] * z
    for k in range(len(shift)):
        j = points.joints[k]
        x, y, z = deformations.places[p, k]
        for a in range(3):
            shift[k, a] = stretch[j, a] + rotation[j, a, 0] * x + rotation[j, a, 1] * y + rotation[j, a, 2] * z


@njit(cache=True)
def compute_marker_gradient(points, lever, trusted, shift, g):
    """Write the gradient on the bodies' twists, g (J, 6), of markers shifted by `shift` (K, 3)."""
    g.fill(0)
    for k in range(len(shift)):
        w, on = trusted[k], g[points.joints[k]]
        x, y, z = lever[k]
        ex, ey, ez = shift[k]
        on[0] += w * (y * ez - z * ey)
        on[1] += w * (z * ex - x * ez)
        on[2] += w * (x * ey - y * ex)
        on[3] += w * ex
        on[4] += w * ey
        on[5] += w * ez


@njit(cache=True)
def compute_point_shift(twist, lever, shift, out):
    """Write where a point of a body goes, `out` (3,): shifted by `shift` (3,) and taken along by the body's twist."""
    x, y, z = lever
    out[0] = shift[0] + twist[3] + twist[1] * z - twist[2] * y
    out[1] = shift[1] + twist[4] + twist[2] * x - twist[0] * z
    out[2] = shift[2] + twist[5] + twist[0] * y - twist[1] * x


@njit(cache=True)
def rotate_to_joint_axes(rotation, vector, out):
    """Write a vector (3,) in world axes as one in the axes of the joint turned by `rotation` (3, 3)."""
    x, y, z = vector
    for a in range(3):
        out[a] = rotation[0, a] * x + rotation[1, a] * y + rotation[2, a] * z


@njit(cache=True)
def compute_marker_errors(points, t, scale2, arm, pose, lever, error, trusted):
    """Write frame t's markers from the common origin, their errors (K, 3) and robust weights (K,)."""
    rotation = pose.rotation
    for k in range(len(lever)):
        j, square, weight = points.joints[k], 0.0, points.weight[t, k]
        for a in range(3):
            lever[k, a] = arm[j, a]
            for c in range(3):
                lever[k, a] += rotation[j, a, c] * points.places[k, c]
            error[k, a] = pose.position[0, a] + lever[k, a] - points.seen[t, k, a] if weight > 0 else 0.0
            square += error[k, a] ** 2
        trusted[k] = weight * compute_robust_loss(points.loss, weight * square, scale2)[1]


@njit(cache=True)
def compute_prior_errors(targets, turning, tree, pose, strain, through):
    """Write how far joints (F,) are from where they are pulled, (F, 3), and how that changes with their turns (F, 3, 3)."""
    for f in range(len(turning)):
        j = turning[f]
        x, y, z, c = compute_logarithm(
            multiply_matrices(load_matrix(pose.local, j), transpose_matrix(load_matrix(targets.rotations[0], j)))
        )
        store_matrix(
            multiply_matrices(
                compute_left_jacobian_inverse(x, y, z, c), transpose_matrix(load_matrix(pose.rotation, tree.parents[j]))
            ),
            through,
            f,
        )
        strain[f, 0], strain[f, 1], strain[f, 2] = x, y, z
        for a in range(3 if len(targets.vectors) else 0):
            strain[f, a] -= targets.vectors[j, a]


@njit(cache=True)
def compute_prior_gradient(information, through, a, out):
    """Write the gradient on a joint's turn, `out` (3,), of a unit along axis `a` of the vector that it is pulled to."""
    x, y, z = multiply_vector(transpose_matrix(through), information[0, a], information[1, a], information[2, a])
    out[0], out[1], out[2] = -x, -y, -z


@njit(inline="always")
def eliminate_pose(tree, terms, t, deformations, turning, scale2, work, trusted, away, moved, bent, pull, carried):
    """Write one frame's `Responses` at the work's pose, markers being the first term and targets the third. -> its cost"""
    points, system, step, rotation, arm = terms[0], work.system, work.step, work.pose.rotation, work.system.arm
    joints, markers, dense, last = len(arm), len(trusted), len(away), len(carried)
    strain, through = np.empty((len(turning), 3)), np.empty((len(turning), 3, 3))
    lever, error, at = np.empty((markers, 3)), np.empty((markers, 3)), np.empty(3)
    stretch, shift = np.zeros((joints, 3)), np.zeros((markers, 3))
    compute_forward_kinematics(tree, work.pose)
    cost = linearise_terms(tree, terms, t, scale2, work.pose, system)
    compute_marker_errors(points, t, scale2, arm, work.pose, lever, error, trusted)
    compute_prior_errors(terms[2], turning, tree, work.pose, strain, through)
    sweep.factorise_tree(tree, system, sweep.MIN_INFORMATION, work.factors)
    for q in range(len(moved)):
        k, f = (q - dense) // 3, (q - dense) // 3 - markers
        stretch.fill(0)
        shift.fill(0)
        if q < dense:
            compute_shape_shift(deformations, q, points, tree.parents, rotation, stretch, shift)
            for m in range(markers):
                rotate_to_joint_axes(rotation[points.joints[m]], shift[m], away[q, m])
        for a in range(3 if q >= dense and k < markers else 0):
            shift[k, a] = rotation[points.joints[k], a, (q - dense) % 3]
        if q < last:
            compute_marker_gradient(points, lever, trusted, shift, work.g)
            work.b.fill(0)
            if f >= 0:
                compute_prior_gradient(pull[f], load_matrix(through, f), (q - dense) % 3, work.b[turning[f]])
        else:  # the errors themselves, and with them what the pulls say to the pose
            copy_array(error, shift)
            copy_array(system.g, work.g)
            copy_array(system.b, work.b)
        sweep.solve_tree(tree, system, work.factors, work.g, work.b, step)
        for j in range(joints if q < last else 0):
            compute_point_shift(step.twist[j], arm[j], stretch[j], carried[q, j])
        for m in range(markers):
            j = points.joints[m]
            compute_point_shift(step.twist[j], lever[m], shift[m], at)
            rotate_to_joint_axes(rotation[j], at, moved[q, m])
        for i in range(len(turning)):
            turn = step.joint_turn[turning[i]]
            x, y, z = multiply_vector(load_matrix(through, i), turn[0], turn[1], turn[2])
            bent[q, i, 0], bent[q, i, 1], bent[q, i, 2] = x, y, z
            for a in range(3 if q == last else 0):
                bent[q, i, a] += strain[i, a]
        if f >= 0 and q < last:
            bent[q, f, (q - dense) % 3] -= 1.0
    return cost


@njit(cache=True, nogil=True)
def eliminate_pose_frames(
    tree, terms, deformations, turning, scale2, root, local, cost, trusted, away, moved, bent, pull, carried, first, stop
):
    """`respond` on first..stop, each into its own row."""
    none = np.zeros((len(root), 0))
    work = allocate_workspace(local.shape[1], none.shape[1], None)  # a plain 0 would be a type of its own, compiled anew
    for t in range(first, stop):
        load_pose(root, local, none, t, work.pose)
        cost[t] = eliminate_pose(
            tree, terms, t, deformations, turning, scale2, work, trusted[t], away[t], moved[t], bent[t], pull, carried[t]
        )
