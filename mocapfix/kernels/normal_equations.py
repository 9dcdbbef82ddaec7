"""A frame's quadratic model: what its terms say near one pose."""

from typing import NamedTuple

import numpy as np
from numba import literal_unroll, njit

from mocapfix.kernels.small_matrices import load_matrix, multiply_vector
from mocapfix.kernels.terms.contract import add_term


class NormalEquations(NamedTuple):
    """1/2 x'Hx + gradient'x over the bodies' twists, the joints' own turns and P unknowns shared by all joints.

    A body's twist is (turn, velocity of its point at the origin, which is the root's place), in world axes. M rows touch
    several bodies at once: each adds half the square of (away + rows . twists + ...), in standard deviations.
    """

    h: np.ndarray  # (J, 6, 6) curvature of each body's twist
    g: np.ndarray  # (J, 6) its gradient
    h_joint: np.ndarray  # (J, 3, 3) curvature of each joint's own turn
    g_joint: np.ndarray  # (J, 3)
    lever_arm: np.ndarray  # (J, 3) metres: joints from the origin
    shared_shift: np.ndarray  # (J, 3, P) how a joint moves, beyond its parent, with each shared unknown
    h_joint_shared: np.ndarray  # (J, 3, P) curvature between own turns, the root's too, and shared unknowns
    h_shared: np.ndarray  # (P, P) lower triangle
    g_shared: np.ndarray  # (P,)
    row_twist: np.ndarray  # (M, J, 6)
    row_joint: np.ndarray  # (M, J, 3)
    row_residual: np.ndarray  # (M,)
    row_count: np.ndarray  # (1,) how many rows are


@njit(cache=True)
def allocate_equations(joints, unknowns, rows):
    """-> room for the model of any frame with so many joints, shared unknowns and rows (None for none)."""
    rows = 0 if rows is None else rows
    return NormalEquations(
        np.empty((joints, 6, 6)), np.empty((joints, 6)), np.empty((joints, 3, 3)), np.empty((joints, 3)), np.empty((joints, 3)),
        np.zeros((joints, 3, unknowns)), np.empty((joints, 3, unknowns)), np.empty((unknowns, unknowns)),
        np.empty(unknowns), np.empty((rows, joints, 6)), np.empty((rows, joints, 3)),
        np.empty(rows), np.zeros(1, np.int64),
    )  # fmt: skip


@njit(cache=True)
def clear_equations(system):
    """Make the model say nothing."""
    system.h.fill(0)
    system.g.fill(0)
    system.h_joint.fill(0)
    system.b.fill(0)
    system.h_joint_shared.fill(0)
    system.h_shared.fill(0)
    system.g_shared.fill(0)
    system.rows.fill(0)
    system.row_joint.fill(0)
    system.row_residual.fill(0)
    system.row_count[0] = 0


@njit(cache=True)
def linearise_terms(tree, terms, t, scale2, pose, system):
    """Write the model of frame t's terms at a pose whose world joints are known. -> cost"""
    clear_equations(system)
    cost = 0.0
    for term in literal_unroll(terms):
        cost += add_term(term, t, scale2, tree, pose, system)
    h, arm, position = system.h, system.lever_arm, pose.position
    for j in range(len(h)):
        for a in range(3):
            arm[j, a] = position[j, a] - position[0, a]
        for a in range(1, 6):  # the upper triangles
            for b in range(a):
                h[j, b, a] = h[j, a, b]
    for a in range(3):  # the root's own turn is part of its twist
        system.g[0, a] += system.b[0, a]
        system.b[0, a] = 0.0
        for c in range(3):
            h[0, a, c] += system.h_joint[0, a, c]
        for m in range(len(system.row_residual)):
            system.rows[m, 0, a] += system.row_joint[m, 0, a]
            system.row_joint[m, 0, a] = 0.0
    for q in range(len(tree.shape)):
        for j in range(1, len(h)):
            s = tree.shape[q, j]
            x, y, z = multiply_vector(load_matrix(pose.rotation, tree.parents[j]), s[0], s[1], s[2])
            system.shared_shift[j, 0, q], system.shared_shift[j, 1, q], system.shared_shift[j, 2, q] = x, y, z
    return cost
