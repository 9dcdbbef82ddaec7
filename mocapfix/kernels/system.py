"""A frame's quadratic model: what its terms say near one pose."""

from typing import NamedTuple

import numpy as np
from numba import literal_unroll, njit

from mocapfix.kernels.small import matrix, times
from mocapfix.kernels.terms.contract import add


class System(NamedTuple):
    """1/2 x'Hx + gradient'x over the bodies' twists, the joints' own turns and P unknowns shared by all joints.

    A body's twist is (turn, velocity of its point at the origin, which is the root's place), in world axes. M rows touch
    several bodies at once: each adds half the square of (away + rows . twists + ...), in standard deviations.
    """

    h: np.ndarray  # (J, 6, 6) curvature of each body's twist
    g: np.ndarray  # (J, 6) its gradient
    own: np.ndarray  # (J, 3, 3) curvature of each joint's own turn
    b: np.ndarray  # (J, 3)
    arm: np.ndarray  # (J, 3) metres: joints from the origin
    shift: np.ndarray  # (J, 3, P) how a joint moves, beyond its parent, with each shared unknown
    own_cross: np.ndarray  # (J, 3, P) curvature between own turns, the root's too, and shared unknowns
    shared: np.ndarray  # (P, P) lower triangle
    shared_g: np.ndarray  # (P,)
    rows: np.ndarray  # (M, J, 6)
    rows_own: np.ndarray  # (M, J, 3)
    away: np.ndarray  # (M,)
    written: np.ndarray  # (1,) how many rows are


@njit(cache=True)
def empty_system(joints, unknowns, rows):
    """-> room for the model of any frame with so many joints, shared unknowns and rows (None for none)."""
    rows = 0 if rows is None else rows
    return System(
        np.empty((joints, 6, 6)), np.empty((joints, 6)), np.empty((joints, 3, 3)), np.empty((joints, 3)), np.empty((joints, 3)),
        np.zeros((joints, 3, unknowns)), np.empty((joints, 3, unknowns)), np.empty((unknowns, unknowns)),
        np.empty(unknowns), np.empty((rows, joints, 6)), np.empty((rows, joints, 3)),
        np.empty(rows), np.zeros(1, np.int64),
    )  # fmt: skip


@njit(cache=True)
def clear(system):
    """Make the model say nothing."""
    system.h.fill(0)
    system.g.fill(0)
    system.own.fill(0)
    system.b.fill(0)
    system.own_cross.fill(0)
    system.shared.fill(0)
    system.shared_g.fill(0)
    system.rows.fill(0)
    system.rows_own.fill(0)
    system.away.fill(0)
    system.written[0] = 0


@njit(cache=True)
def linearise(tree, terms, t, scale2, pose, system):
    """Write the model of frame t's terms at a pose whose world joints are known. -> cost"""
    clear(system)
    cost = 0.0
    for term in literal_unroll(terms):
        cost += add(term, t, scale2, tree, pose, system)
    h, arm, position = system.h, system.arm, pose.position
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
            h[0, a, c] += system.own[0, a, c]
        for m in range(len(system.away)):
            system.rows[m, 0, a] += system.rows_own[m, 0, a]
            system.rows_own[m, 0, a] = 0.0
    for q in range(len(tree.shape)):
        for j in range(1, len(h)):
            s = tree.shape[q, j]
            x, y, z = times(matrix(pose.rotation, tree.parents[j]), s[0], s[1], s[2])
            system.shift[j, 0, q], system.shift[j, 1, q], system.shift[j, 2, q] = x, y, z
    return cost
