"""The Gauss-Newton direction with residuals that couple several bodies: a few rows on top of the sweep.

With the tree's curvature H and M rows U, the Sherman-Morrison-Woodbury formula (Hager 1989) solves (H + U'U) x = -f by one
sweep for f and one for each row: x = x0 + Y (I - U Y)^-1 U x0, where x0 = -H^-1 f and Y = -H^-1 U'. So the sweep stays
exact, and the cost is O(M J).
"""

from typing import NamedTuple

import numpy as np

from mocapfix.kernels import sweep
from mocapfix.kernels.compilation import compile_inner_kernel
from mocapfix.kernels.small_matrices import clear_array, copy_array, factor_cholesky, solve_cholesky


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
    """Write the response to each row, after `sweep.factorise_tree`; spare_g (J, 6) is overwritten."""
    rows = len(equations.row_residual)
    for m in range(rows):
        step = sweep.PoseStep(responses.twist[m], responses.joint_turn[m], responses.shared[m])
        clear_array(step.shared)
        copy_array(equations.row_twist[m], spare_g)
        sweep.solve_tree(tree, equations, factors, spare_g, equations.row_joint[m], step)
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
