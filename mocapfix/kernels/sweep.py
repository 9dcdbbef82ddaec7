"""The Gauss-Newton direction of a tree of joints in time linear in joints and measurements.

SCOPE's Algorithm 1 as an articulated-body sweep. A body's twist (w, v) is its rotation and the velocity of its point at a
common origin, both in world axes. So a child's twist is its parent's plus its own joint's rotation:

    twist_i = twist_parent + S_i turn_i,    S_i = [I; [d_i]x],    d_i = joint position - origin

and every measurement on body i is a quadratic in twist_i alone. From the leaves to the root each joint's rotation is eliminated
from its body's quadratic, which leaves a quadratic of 6 + P in its parent's twist and the P unknowns that all joints share (a
prior's latent code); from the root to the leaves the rotations follow by substitution. `factorise_tree` does the first half once;
`solve_tree` uses it for one gradient, `covariance.propagate_covariance` for all bodies. (Blocks of 6 + P take half the time of
6 + P right-hand sides and a Schur complement at P = 10, a third at P = 32.)

Residuals that couple several bodies are a few rows on top of the sweep. With the tree's curvature H and M rows U, the
Sherman-Morrison-Woodbury formula (Hager 1989) solves (H + U'U) x = -f by one sweep for f and one for each row:
x = x0 + Y (I - U Y)^-1 U x0, where x0 = -H^-1 f and Y = -H^-1 U'. So the sweep stays exact, and the cost is O(M J).
"""

from typing import NamedTuple

import numpy as np

from mocapfix.kernels.compilation import compile_inner_kernel
from mocapfix.kernels.small_matrices import (
    clear_array,
    copy_array,
    factor_cholesky,
    invert_cholesky,
    invert_symmetric_3x3,
    multiply_rows,
    solve_cholesky,
)

MIN_INFORMATION = 1e-3  # 1/m^2 or 1/rad^2, added to every unknown: keeps the variance of an unconstrained one finite


class PoseStep(NamedTuple):
    """A change of pose."""

    twist: np.ndarray  # (J, 6) every body's twist; the root's is its own step
    joint_turn: np.ndarray  # (J, 3) every joint's rotation vector in world axes; zero for the root and joints that are not free
    shared: np.ndarray  # (P,)


class SweepFactors(NamedTuple):
    """The result of `factorise_tree`."""

    h: np.ndarray  # (J, 6, 6) each body's curvature with its descendants'; the root's inverted
    h_twist_shared: np.ndarray  # (J, 6, P) likewise between its twist and the shared unknowns
    gain: np.ndarray  # (J, 6, 3) H S (S'HS + h_joint)^-1
    joint_inverse: np.ndarray  # (J, 3, 3) (S'HS + h_joint)^-1
    joint_gain_shared: np.ndarray  # (J, 3, P) response of a joint's rotation to the shared unknowns
    root_gain_shared: np.ndarray  # (6, P) response of the root's twist to the shared unknowns
    shared_cholesky: np.ndarray  # (P, P) Cholesky factor of the shared unknowns' curvature with all poses eliminated


@compile_inner_kernel
def allocate_step(joints, unknowns):
    """Return arrays for a step."""
    return PoseStep(np.zeros((joints, 6)), np.zeros((joints, 3)), np.zeros(unknowns))


@compile_inner_kernel
def allocate_factors(joints, unknowns):
    """Return arrays for the factors of any frame's model."""
    return SweepFactors(
        np.empty((joints, 6, 6)), np.empty((joints, 6, unknowns)), np.zeros((joints, 6, 3)), np.zeros((joints, 3, 3)),
        np.zeros((joints, 3, unknowns)), np.empty((6, unknowns)), np.empty((unknowns, unknowns)),
    )  # fmt: skip


@compile_inner_kernel
def factorise_tree(tree, equations, damping, factors):
    """Eliminate all joints' rotations, the root's twist and the shared unknowns into `factors`, with Marquardt damping."""
    parents, free, lever_arm, h_joint = tree.parents, tree.free, equations.lever_arm, equations.h_joint
    h, gain, inverse, cross = factors.h, factors.gain, factors.joint_inverse, factors.h_twist_shared
    unknowns = len(equations.h_shared)
    copy_array(equations.h, h)
    if unknowns:
        clear_array(cross)
        copy_array(equations.h_joint_shared[0], cross[0, :3])  # the root's own rotation is part of its twist
        copy_array(equations.h_shared, factors.shared_cholesky)
    for i in range(len(parents) - 1, 0, -1):
        p = parents[i]
        if not free[i]:
            for a in range(6):
                for b in range(6):
                    h[p, a, b] += h[i, a, b]
                for c in range(unknowns):
                    cross[p, a, c] += cross[i, a, c]
            continue
        x, y, z = lever_arm[i, 0], lever_arm[i, 1], lever_arm[i, 2]
        for a in range(6):  # gain is H S at first; the columns of [d]x are (0, z, -y), (-z, 0, x), (y, -x, 0)
            gain[i, a, 0] = h[i, a, 0] + z * h[i, a, 4] - y * h[i, a, 5]
            gain[i, a, 1] = h[i, a, 1] - z * h[i, a, 3] + x * h[i, a, 5]
            gain[i, a, 2] = h[i, a, 2] + y * h[i, a, 3] - x * h[i, a, 4]
        for b in range(3):
            inverse[i, 0, b] = gain[i, 0, b] + z * gain[i, 4, b] - y * gain[i, 5, b] + h_joint[i, 0, b]
            inverse[i, 1, b] = gain[i, 1, b] - z * gain[i, 3, b] + x * gain[i, 5, b] + h_joint[i, 1, b]
            inverse[i, 2, b] = gain[i, 2, b] + y * gain[i, 3, b] - x * gain[i, 4, b] + h_joint[i, 2, b]
            inverse[i, b, b] += damping
        l10, l20, l21, d0, d1, d2 = ldl = invert_symmetric_3x3(inverse, i)
        for a in range(6):  # H S L^-T: differences of these keep the digits that an explicit inverse would lose
            gain[i, a, 1] -= l10 * gain[i, a, 0]
            gain[i, a, 2] -= l20 * gain[i, a, 0] + l21 * gain[i, a, 1]
        if unknowns:
            eliminate_joint_shared(
                i, p, lever_arm, equations.h_joint_shared, gain, ldl, cross, factors.joint_gain_shared, factors.shared_cholesky
            )
        for a in range(5, -1, -1):
            g0, g1, g2 = gain[i, a, 0] * d0, gain[i, a, 1] * d1, gain[i, a, 2] * d2
            for b in range(a + 1):  # rows after `a` already hold gains, rows up to `a` still H S L^-T
                remaining = h[i, a, b] - g0 * gain[i, b, 0] - g1 * gain[i, b, 1] - g2 * gain[i, b, 2]
                h[p, a, b] += remaining
                if a != b:
                    h[p, b, a] += remaining
            g1 -= l21 * g2
            gain[i, a, 0], gain[i, a, 1], gain[i, a, 2] = g0 - l10 * g1 - l20 * g2, g1, g2
    for a in range(6):
        h[0, a, a] += damping
    factor_cholesky(h[0])
    if unknowns:
        eliminate_root(damping, h[0], cross[0], factors.root_gain_shared, factors.shared_cholesky)
    invert_cholesky(h[0])


@compile_inner_kernel
def eliminate_joint_shared(i, p, lever_arm, h_joint_shared, u, ldl, cross, joint_gain, h_shared):
    """Eliminate joint i's rotation from the curvature between its body and the P shared unknowns.

    u (J, 6, 3) holds H S L^-T; cross (J, 6, P), joint_gain (J, 3, P) and h_shared (P, P) are updated.
    """
    x, y, z = lever_arm[i, 0], lever_arm[i, 1], lever_arm[i, 2]
    l10, l20, l21, d0, d1, d2 = ldl
    unknowns = len(h_shared)
    for c in range(unknowns):  # one row at a time, here and below, so that the compiler vectorises
        joint_gain[i, 0, c] = cross[i, 0, c] + z * cross[i, 4, c] - y * cross[i, 5, c] + h_joint_shared[i, 0, c]
    for c in range(unknowns):
        w1 = cross[i, 1, c] - z * cross[i, 3, c] + x * cross[i, 5, c] + h_joint_shared[i, 1, c]
        joint_gain[i, 1, c] = w1 - l10 * joint_gain[i, 0, c]
    for c in range(unknowns):
        w2 = cross[i, 2, c] + y * cross[i, 3, c] - x * cross[i, 4, c] + h_joint_shared[i, 2, c]
        joint_gain[i, 2, c] = w2 - l20 * joint_gain[i, 0, c] - l21 * joint_gain[i, 1, c]
    for c in range(unknowns):
        w0, w1, w2 = d0 * joint_gain[i, 0, c], d1 * joint_gain[i, 1, c], d2 * joint_gain[i, 2, c]
        for d in range(c + 1):
            h_shared[c, d] -= w0 * joint_gain[i, 0, d] + w1 * joint_gain[i, 1, d] + w2 * joint_gain[i, 2, d]
    for a in range(6):
        u0, u1, u2 = d0 * u[i, a, 0], d1 * u[i, a, 1], d2 * u[i, a, 2]
        for c in range(unknowns):
            cross[p, a, c] += (
                cross[i, a, c] - u0 * joint_gain[i, 0, c] - u1 * joint_gain[i, 1, c] - u2 * joint_gain[i, 2, c]
            )  # fmt: skip
    for c in range(unknowns):
        y2 = d2 * joint_gain[i, 2, c]
        y1 = d1 * joint_gain[i, 1, c] - l21 * y2
        joint_gain[i, 0, c], joint_gain[i, 1, c], joint_gain[i, 2, c] = d0 * joint_gain[i, 0, c] - l10 * y1 - l20 * y2, y1, y2


@compile_inner_kernel
def subtract_row(factor, row, out):
    """Subtract `factor` times a row (P,) from `out` (P,)."""
    for c in range(len(row)):
        out[c] -= factor * row[c]


@compile_inner_kernel
def divide_row(row, divisor):
    """Divide a row (P,) in place."""
    for c in range(len(row)):
        row[c] /= divisor


@compile_inner_kernel
def eliminate_root(damping, lower, cross, root_gain, h_shared):
    """Eliminate the root's twist, whose curvature is L L', from the shared unknowns' curvature and factor the remainder."""
    copy_array(cross, root_gain)
    for a in range(6):  # L^-1 cross
        for b in range(a):
            subtract_row(lower[a, b], root_gain[b], root_gain[a])
        divide_row(root_gain[a], lower[a, a])
    for c in range(len(h_shared)):
        r0, r1, r2 = root_gain[0, c], root_gain[1, c], root_gain[2, c]
        r3, r4, r5 = root_gain[3, c], root_gain[4, c], root_gain[5, c]
        for d in range(c + 1):
            product = r0 * root_gain[0, d] + r1 * root_gain[1, d] + r2 * root_gain[2, d]
            h_shared[c, d] -= product + r3 * root_gain[3, d] + r4 * root_gain[4, d] + r5 * root_gain[5, d]
        h_shared[c, c] += damping
    for a in range(5, -1, -1):  # L^-T of it
        for b in range(a + 1, 6):
            subtract_row(lower[b, a], root_gain[b], root_gain[a])
        divide_row(root_gain[a], lower[a, a])
    factor_cholesky(h_shared)


@compile_inner_kernel
def solve_tree(tree, equations, factors, g, g_joint, step):
    """Minimise 1/2 x'Hx + gradient'x with the factors from `factorise_tree`, into `step`.

    Args:
        g: (J, 6) gradient on each body's twist; overwritten.
        g_joint: (J, 3) gradient on each joint's own rotation.
        step.shared: (P,) in: gradient on the shared unknowns; out: their step.
    """
    lever_arm, gain, inverse = equations.lever_arm, factors.gain, factors.joint_inverse
    twist, turn, shared, joint_gain = step.twist, step.joint_turn, step.shared, factors.joint_gain_shared
    for i in range(len(tree.parents) - 1, 0, -1):
        p = tree.parents[i]
        if not tree.free[i]:
            for a in range(6):
                g[p, a] += g[i, a]
            continue
        x, y, z = lever_arm[i, 0], lever_arm[i, 1], lever_arm[i, 2]
        u0 = g[i, 0] + z * g[i, 4] - y * g[i, 5] + g_joint[i, 0]
        u1 = g[i, 1] - z * g[i, 3] + x * g[i, 5] + g_joint[i, 1]
        u2 = g[i, 2] + y * g[i, 3] - x * g[i, 4] + g_joint[i, 2]
        turn[i, 0], turn[i, 1], turn[i, 2] = u0, u1, u2
        for c in range(len(shared)):
            shared[c] -= joint_gain[i, 0, c] * u0 + joint_gain[i, 1, c] * u1 + joint_gain[i, 2, c] * u2
        for a in range(6):
            g[p, a] += g[i, a] - gain[i, a, 0] * u0 - gain[i, a, 1] * u1 - gain[i, a, 2] * u2
    solve_root(factors, g, step)
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
            y0, y1, y2 = multiply_rows(joint_gain[i], shared)
            w0, w1, w2 = w0 - y0, w1 - y1, w2 - y2
        turn[i, 0], turn[i, 1], turn[i, 2] = w0, w1, w2
        x, y, z = lever_arm[i, 0], lever_arm[i, 1], lever_arm[i, 2]
        twist[i, 0], twist[i, 1], twist[i, 2] = twist[p, 0] + w0, twist[p, 1] + w1, twist[p, 2] + w2
        twist[i, 3] = twist[p, 3] + y * w2 - z * w1
        twist[i, 4] = twist[p, 4] + z * w0 - x * w2
        twist[i, 5] = twist[p, 5] + x * w1 - y * w0


@compile_inner_kernel
def solve_root(factors, g, step):
    """Write the steps of the shared unknowns and of the root."""
    twist, shared, root_gain = step.twist, step.shared, factors.root_gain_shared
    for a in range(6):
        twist[0, a] = 0.0
        for c in range(6):
            twist[0, a] -= factors.h[0, a, c] * g[0, c]
    for c in range(len(shared)):
        for a in range(6):
            shared[c] -= root_gain[a, c] * g[0, a]
        shared[c] = -shared[c]
    solve_cholesky(factors.shared_cholesky, shared)
    for a in range(6):
        for c in range(len(shared)):
            twist[0, a] -= root_gain[a, c] * shared[c]
    for a in range(3):
        step.joint_turn[0, a] = 0.0


class RowResponses(NamedTuple):
    """The body's response to each of M rows, Y = -H^-1 U', and the capacitance matrix I - U Y."""

    twist: np.ndarray  # (M, J, 6)
    joint_turn: np.ndarray  # (M, J, 3)
    shared: np.ndarray  # (M, P)
    capacitance: np.ndarray  # (M, M), its Cholesky factor
    row_product: np.ndarray  # (M,) working memory: the rows times a step


@compile_inner_kernel
def allocate_row_responses(joints, unknowns, rows):
    """Return arrays for the responses to so many rows; None for no rows."""
    if rows is None:
        return None
    return RowResponses(
        np.empty((rows, joints, 6)), np.empty((rows, joints, 3)), np.empty((rows, unknowns)), np.empty((rows, rows)),
        np.empty(rows),
    )  # fmt: skip


@compile_inner_kernel
def multiply_row(equations, m, twist, joint_turn):
    """Return the product of row m and a step."""
    total = 0.0
    for j in range(len(joint_turn)):
        for a in range(6):
            total += equations.row_twist[m, j, a] * twist[j, a]
        for a in range(3):
            total += equations.row_joint[m, j, a] * joint_turn[j, a]
    return total


@compile_inner_kernel
def add_row_gradient(equations, responses, g, g_joint):
    """Add the rows' gradient to g (J, 6) and g_joint (J, 3)."""
    if responses is None:
        return
    for m in range(len(equations.row_residual)):
        for j in range(len(g)):
            for a in range(6):
                g[j, a] += equations.row_residual[m] * equations.row_twist[m, j, a]
            for a in range(3):
                g_joint[j, a] += equations.row_residual[m] * equations.row_joint[m, j, a]


@compile_inner_kernel
def compute_row_responses(tree, equations, factors, spare_g, responses):
    """Write the response to each row, after `factorise_tree`; spare_g (J, 6) is overwritten."""
    rows = len(equations.row_residual)
    for m in range(rows):
        step = PoseStep(responses.twist[m], responses.joint_turn[m], responses.shared[m])
        clear_array(step.shared)
        copy_array(equations.row_twist[m], spare_g)
        solve_tree(tree, equations, factors, spare_g, equations.row_joint[m], step)
    for m in range(rows):
        for n in range(rows):
            product = multiply_row(equations, m, responses.twist[n], responses.joint_turn[n])
            responses.capacitance[m, n] = (1.0 if m == n else 0.0) - product
    factor_cholesky(responses.capacitance)


@compile_inner_kernel
def correct_step(equations, responses, step):
    """Correct a step that includes the rows' gradient but not their curvature, so that it includes both."""
    product = responses.row_product
    for m in range(len(product)):
        product[m] = multiply_row(equations, m, step.twist, step.joint_turn)
    solve_cholesky(responses.capacitance, product)
    for m in range(len(product)):
        for j in range(len(step.joint_turn)):
            for a in range(6):
                step.twist[j, a] += product[m] * responses.twist[m, j, a]
            for a in range(3):
                step.joint_turn[j, a] += product[m] * responses.joint_turn[m, j, a]
        for c in range(len(step.shared)):
            step.shared[c] += product[m] * responses.shared[m, c]


@compile_inner_kernel
def apply_rows(tree, equations, factors, responses, spare_g, step):
    """Include the rows' curvature in the sweep's step; spare_g (J, 6) is overwritten."""
    if responses is None:
        return
    compute_row_responses(tree, equations, factors, spare_g, responses)
    correct_step(equations, responses, step)


@compile_inner_kernel
def compute_row_decrease(equations, responses, step):
    """Return the decrease of the cost along a step that the rows' gradient predicts."""
    total = 0.0
    if responses is not None:
        for m in range(len(equations.row_residual)):
            total -= equations.row_residual[m] * multiply_row(equations, m, step.twist, step.joint_turn)
    return total
