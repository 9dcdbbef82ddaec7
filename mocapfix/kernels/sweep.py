"""The Gauss-Newton direction of a tree of joints in time linear in joints and measurements.

SCOPE's Algorithm 1 as an articulated-body sweep. A body's twist (w, v) is its turn and the velocity of the point of it
that lies at a common origin, both in world axes, so a child's twist is its parent's plus its own joint's turn and
what the P unknowns that all joints share (SCOPE's beta, or a prior's latent code) do to its offset:

    twist_i = twist_parent + S_i turn_i + [0; shift_i] shared,    S_i = [I; [d_i]x],    d_i = joint position - origin

and every measurement on body i is a quadratic in twist_i alone. Leaves to root each joint's turn is minimised out of its
body's quadratic, which leaves a quadratic of 6 + P in its parent's twist and the shared unknowns; root to leaves the turns
follow. `factor` does the first half once; `solve` uses it for one gradient, `uncertainty.covariance` for all bodies. (Blocks of
6 + P take half the time of 6 + P right-hand sides and a Schur complement at P = 10, a third at P = 32.)
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from mocapfix.kernels.forward_kinematics import copy_array
from mocapfix.kernels.small_matrices import factor_cholesky, invert_cholesky, invert_symmetric_3x3, multiply_rows, solve_cholesky

MIN_INFORMATION = 1e-3  # 1/m^2 or 1/rad^2: holds an unknown that nothing else does, so that its variance is large, not infinite


class PoseStep(NamedTuple):
    """A change of pose."""

    twist: np.ndarray  # (J, 6) every body's twist; the root's is its own step
    joint_turn: np.ndarray  # (J, 3) every joint's turn in world axes; zero for the root and joints that are not free
    shared: np.ndarray  # (P,)


class SweepFactors(NamedTuple):
    """What `factor` leaves."""

    h: np.ndarray  # (J, 6, 6) each body's curvature with its descendants'; the root's inverted
    h_twist_shared: np.ndarray  # (J, 6, P) likewise between its twist and the shared unknowns
    gain: np.ndarray  # (J, 6, 3) H S (S'HS + own)^-1
    joint_inverse: np.ndarray  # (J, 3, 3) (S'HS + own)^-1
    joint_gain_shared: np.ndarray  # (J, 3, P) how a joint's turn gives way to the shared unknowns; the root's whole twist: root
    root_gain_shared: np.ndarray  # (6, P)
    shared_cholesky: np.ndarray  # (P, P) the shared unknowns' curvature with all poses eliminated, its Cholesky factor


@njit(cache=True)
def allocate_step(joints, unknowns):
    """-> room for a step."""
    return PoseStep(np.zeros((joints, 6)), np.zeros((joints, 3)), np.zeros(unknowns))


@njit(cache=True)
def allocate_factors(joints, unknowns):
    """-> room for the factors of any frame's model."""
    return SweepFactors(
        np.empty((joints, 6, 6)), np.empty((joints, 6, unknowns)), np.zeros((joints, 6, 3)), np.zeros((joints, 3, 3)),
        np.zeros((joints, 3, unknowns)), np.empty((6, unknowns)), np.empty((unknowns, unknowns)),
    )  # fmt: skip


@njit(cache=True)
def factorise_tree(tree, system, mu, f):
    """Eliminate every joint's turn, the root's twist and the shared unknowns, in this order, into `f`.

    mu  Marquardt damping, added to the diagonal of every unknown
    """
    parents, free, arm, own = tree.parents, tree.free, system.arm, system.own
    h, gain, inverse, unknowns = f.h, f.gain, f.joint_inverse, len(system.shared)
    copy_array(system.h, h)
    if unknowns:
        f.cross.fill(0)
        copy_array(system.own_cross[0], f.cross[0, :3])  # the root's own turn is part of its twist
        copy_array(system.shared, f.shared)
    for i in range(len(parents) - 1, 0, -1):
        p = parents[i]
        if len(tree.shape):
            transfer_shared_shift(i, system.shift, h, f.cross, f.shared)
        if not free[i]:
            for a in range(6):
                for b in range(6):
                    h[p, a, b] += h[i, a, b]
                for c in range(unknowns):
                    f.cross[p, a, c] += f.cross[i, a, c]
            continue
        x, y, z = arm[i, 0], arm[i, 1], arm[i, 2]
        for a in range(6):  # gain is H S at first; the columns of [d]x are (0, z, -y), (-z, 0, x), (y, -x, 0)
            gain[i, a, 0] = h[i, a, 0] + z * h[i, a, 4] - y * h[i, a, 5]
            gain[i, a, 1] = h[i, a, 1] - z * h[i, a, 3] + x * h[i, a, 5]
            gain[i, a, 2] = h[i, a, 2] + y * h[i, a, 3] - x * h[i, a, 4]
        for b in range(3):
            inverse[i, 0, b] = gain[i, 0, b] + z * gain[i, 4, b] - y * gain[i, 5, b] + own[i, 0, b]
            inverse[i, 1, b] = gain[i, 1, b] - z * gain[i, 3, b] + x * gain[i, 5, b] + own[i, 1, b]
            inverse[i, 2, b] = gain[i, 2, b] + y * gain[i, 3, b] - x * gain[i, 4, b] + own[i, 2, b]
            inverse[i, b, b] += mu
        l10, l20, l21, d0, d1, d2 = ldl = invert_symmetric_3x3(inverse, i)
        for a in range(6):  # H S L^-T: with it the differences keep the digits that they would lose with an explicit inverse
            gain[i, a, 1] -= l10 * gain[i, a, 0]
            gain[i, a, 2] -= l20 * gain[i, a, 0] + l21 * gain[i, a, 1]
        if unknowns:
            eliminate_joint_shared(i, p, arm, system.own_cross, gain, ldl, f.cross, f.yielding, f.shared)
        for a in range(5, -1, -1):
            g0, g1, g2 = gain[i, a, 0] * d0, gain[i, a, 1] * d1, gain[i, a, 2] * d2
            for b in range(a + 1):  # rows below are gains by now, those up to a not yet
                left = h[i, a, b] - g0 * gain[i, b, 0] - g1 * gain[i, b, 1] - g2 * gain[i, b, 2]
                h[p, a, b] += left
                if a != b:
                    h[p, b, a] += left
            g1 -= l21 * g2
            gain[i, a, 0], gain[i, a, 1], gain[i, a, 2] = g0 - l10 * g1 - l20 * g2, g1, g2
    for a in range(6):
        h[0, a, a] += mu
    factor_cholesky(h[0])
    if unknowns:
        eliminate_root(mu, h[0], f.cross[0], f.root, f.shared)
    invert_cholesky(h[0])


@njit(cache=True)
def eliminate_joint_shared(i, p, arm, own_cross, u, ldl, cross, yielding, shared):
    """Eliminate joint i's turn from what its body shares with the P unknowns; u (J, 6, 3) holds H S L^-T."""
    x, y, z = arm[i, 0], arm[i, 1], arm[i, 2]
    l10, l20, l21, d0, d1, d2 = ldl
    unknowns = len(shared)
    for c in range(unknowns):  # one row at a time, here as elsewhere: the compiler then takes several numbers at once
        yielding[i, 0, c] = cross[i, 0, c] + z * cross[i, 4, c] - y * cross[i, 5, c] + own_cross[i, 0, c]
    for c in range(unknowns):
        w1 = cross[i, 1, c] - z * cross[i, 3, c] + x * cross[i, 5, c] + own_cross[i, 1, c]
        yielding[i, 1, c] = w1 - l10 * yielding[i, 0, c]
    for c in range(unknowns):
        w2 = cross[i, 2, c] + y * cross[i, 3, c] - x * cross[i, 4, c] + own_cross[i, 2, c]
        yielding[i, 2, c] = w2 - l20 * yielding[i, 0, c] - l21 * yielding[i, 1, c]
    for c in range(unknowns):
        w0, w1, w2 = d0 * yielding[i, 0, c], d1 * yielding[i, 1, c], d2 * yielding[i, 2, c]
        for d in range(c + 1):
            shared[c, d] -= w0 * yielding[i, 0, d] + w1 * yielding[i, 1, d] + w2 * yielding[i, 2, d]
    for a in range(6):
        u0, u1, u2 = d0 * u[i, a, 0], d1 * u[i, a, 1], d2 * u[i, a, 2]
        for c in range(unknowns):
            cross[p, a, c] += cross[i, a, c] - u0 * yielding[i, 0, c] - u1 * yielding[i, 1, c] - u2 * yielding[i, 2, c]
    for c in range(unknowns):
        y2 = d2 * yielding[i, 2, c]
        y1 = d1 * yielding[i, 1, c] - l21 * y2
        yielding[i, 0, c], yielding[i, 1, c], yielding[i, 2, c] = d0 * yielding[i, 0, c] - l10 * y1 - l20 * y2, y1, y2


@njit(cache=True)
def transfer_shared_shift(i, shift, h, cross, shared):
    """Write body i's quadratic as one of its twist before the shared unknowns move its joint."""
    for c in range(len(shared)):
        sx, sy, sz = shift[i, 0, c], shift[i, 1, c], shift[i, 2, c]
        for d in range(c):  # cross[.., d] already has its own shift in it, cross[.., c] not yet
            shared[c, d] += sx * cross[i, 3, d] + sy * cross[i, 4, d] + sz * cross[i, 5, d]
            shared[c, d] += cross[i, 3, c] * shift[i, 0, d] + cross[i, 4, c] * shift[i, 1, d] + cross[i, 5, c] * shift[i, 2, d]
        shared[c, c] += 2 * (sx * cross[i, 3, c] + sy * cross[i, 4, c] + sz * cross[i, 5, c])
        for a in range(6):
            moved = h[i, a, 3] * sx + h[i, a, 4] * sy + h[i, a, 5] * sz
            cross[i, a, c] += moved
            if a > 2:
                shared[c, c] += shift[i, a - 3, c] * moved


@njit(cache=True)
def subtract_row(times, row, out):
    """Take so many times a row (P,) from another, `out`."""
    for c in range(len(row)):
        out[c] -= times * row[c]


@njit(cache=True)
def divide_row(row, by):
    """Divide a row (P,) in place."""
    for c in range(len(row)):
        row[c] /= by


@njit(cache=True)
def eliminate_root(mu, lower, cross, root, shared):
    """Eliminate the root's twist, whose curvature is L L', from the shared unknowns' and factor what is left."""
    copy_array(cross, root)
    for a in range(6):  # L^-1 cross
        for b in range(a):
            subtract_row(lower[a, b], root[b], root[a])
        divide_row(root[a], lower[a, a])
    for c in range(len(shared)):
        r0, r1, r2, r3, r4, r5 = root[0, c], root[1, c], root[2, c], root[3, c], root[4, c], root[5, c]
        for d in range(c + 1):
            left = r0 * root[0, d] + r1 * root[1, d] + r2 * root[2, d]
            shared[c, d] -= left + r3 * root[3, d] + r4 * root[4, d] + r5 * root[5, d]
        shared[c, c] += mu
    for a in range(5, -1, -1):  # L^-T of it
        for b in range(a + 1, 6):
            subtract_row(lower[b, a], root[b], root[a])
        divide_row(root[a], lower[a, a])
    factor_cholesky(shared)


@njit(cache=True)
def solve_tree(tree, system, f, g, b, step):
    """Minimise 1/2 x'Hx + gradient'x with what `factor` left. -> nothing; writes the step.

    g            (J, 6) gradient on each body's twist; spoilt
    b            (J, 3) gradient on each joint's own turn
    step.shared  (P,) in: gradient on the shared unknowns
    """
    arm, gain, inverse, shift = system.arm, f.gain, f.joint_inverse, system.shift
    twist, turn, shared, shapes = step.twist, step.joint_turn, step.shared, len(tree.shape)
    for i in range(len(tree.parents) - 1, 0, -1):
        p = tree.parents[i]
        for c in range(shapes):
            shared[c] += shift[i, 0, c] * g[i, 3] + shift[i, 1, c] * g[i, 4] + shift[i, 2, c] * g[i, 5]
        if not tree.free[i]:
            for a in range(6):
                g[p, a] += g[i, a]
            continue
        x, y, z = arm[i, 0], arm[i, 1], arm[i, 2]
        u0 = g[i, 0] + z * g[i, 4] - y * g[i, 5] + b[i, 0]
        u1 = g[i, 1] - z * g[i, 3] + x * g[i, 5] + b[i, 1]
        u2 = g[i, 2] + y * g[i, 3] - x * g[i, 4] + b[i, 2]
        turn[i, 0], turn[i, 1], turn[i, 2] = u0, u1, u2
        for c in range(len(shared)):
            shared[c] -= f.yielding[i, 0, c] * u0 + f.yielding[i, 1, c] * u1 + f.yielding[i, 2, c] * u2
        for a in range(6):
            g[p, a] += g[i, a] - gain[i, a, 0] * u0 - gain[i, a, 1] * u1 - gain[i, a, 2] * u2
    solve_root(f, g, step)
    for i in range(1, len(tree.parents)):
        p = tree.parents[i]
        w0, w1, w2 = 0.0, 0.0, 0.0
        if tree.free[i]:
            u0, u1, u2 = turn[i, 0], turn[i, 1], turn[i, 2]
            w0 = -(inverse[i, 0, 0] * u0 + inverse[i, 0, 1] * u1 + inverse[i, 0, 2] * u2)
            w1 = -(inverse[i, 1, 0] * u0 + inverse[i, 1, 1] * u1 + inverse[i, 1, 2] * u2)
            w2 = -(inverse[i, 2, 0] * u0 + inverse[i, 2, 1] * u1 + inverse[i, 2, 2] * u2)
            for a in range(6):
                w0 -= gain[i, a, 0] * twist[p, a]
                w1 -= gain[i, a, 1] * twist[p, a]
                w2 -= gain[i, a, 2] * twist[p, a]
            y0, y1, y2 = multiply_rows(f.yielding[i], shared)
            w0, w1, w2 = w0 - y0, w1 - y1, w2 - y2
        turn[i, 0], turn[i, 1], turn[i, 2] = w0, w1, w2
        x, y, z = arm[i, 0], arm[i, 1], arm[i, 2]
        twist[i, 0], twist[i, 1], twist[i, 2] = twist[p, 0] + w0, twist[p, 1] + w1, twist[p, 2] + w2
        twist[i, 3] = twist[p, 3] + y * w2 - z * w1
        twist[i, 4] = twist[p, 4] + z * w0 - x * w2
        twist[i, 5] = twist[p, 5] + x * w1 - y * w0
        for c in range(shapes):
            for a in range(3):
                twist[i, 3 + a] += shift[i, a, c] * shared[c]


@njit(cache=True)
def solve_root(f, g, step):
    """Write the shared unknowns' step and the root's."""
    twist, shared = step.twist, step.shared
    for a in range(6):
        twist[0, a] = 0.0
        for c in range(6):
            twist[0, a] -= f.h[0, a, c] * g[0, c]
    for c in range(len(shared)):
        for a in range(6):
            shared[c] -= f.root[a, c] * g[0, a]
        shared[c] = -shared[c]
    solve_cholesky(f.shared, shared)
    for a in range(6):
        for c in range(len(shared)):
            twist[0, a] -= f.root[a, c] * shared[c]
    for a in range(3):
        step.joint_turn[0, a] = 0.0
