"""The direction where some residuals touch several bodies at once: a few rows on top of the sweep.

With the tree's curvature H and M rows U, the Sherman-Morrison-Woodbury formula (Hager 1989) solves (H + U'U) x = -f by one
sweep for f and one for each row: x = x0 + Y (I - U Y)^-1 U x0, where x0 = -H^-1 f and Y = -H^-1 U'. So the sweep stays
exact, and the cost O(M K).
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from mocapfix.kernels import sweep
from mocapfix.kernels.forward_kinematics import copy_array
from mocapfix.kernels.small_matrices import factor_cholesky, solve_cholesky


class RowResponses(NamedTuple):
    """How the body gives way to each of M rows: one step each, and the rows' curvature among themselves."""

    twist: np.ndarray  # (M, J, 6)
    joint_turn: np.ndarray  # (M, J, 3)
    shared: np.ndarray  # (M, P)
    capacitance: np.ndarray  # (M, M)
    row_product: np.ndarray  # (M,)


@njit(cache=True)
def allocate_row_responses(joints, unknowns, rows):
    """-> room for the answers to so many rows; None where there are none."""
    if rows is None:
        return None
    return RowResponses(
        np.empty((rows, joints, 6)), np.empty((rows, joints, 3)), np.empty((rows, unknowns)), np.empty((rows, rows)),
        np.empty(rows),
    )  # fmt: skip


@njit(cache=True)
def multiply_row(system, m, twist, turn):
    """-> how far a step goes along row m."""
    total = 0.0
    for j in range(len(turn)):
        for a in range(6):
            total += system.rows[m, j, a] * twist[j, a]
        for a in range(3):
            total += system.row_joint[m, j, a] * turn[j, a]
    return total


@njit(cache=True)
def add_row_gradient(system, answers, g, b):
    """Add the rows' own gradient to g (J, 6) and b (J, 3)."""
    if answers is None:
        return
    for m in range(len(system.away)):
        for j in range(len(g)):
            for a in range(6):
                g[j, a] += system.away[m] * system.rows[m, j, a]
            for a in range(3):
                b[j, a] += system.away[m] * system.row_joint[m, j, a]


@njit(cache=True)
def compute_row_responses(tree, system, factors, spare_g, answers):
    """Write how the body gives way to each row, after `factor`; spare_g (J, 6) is spoilt."""
    rows = len(system.away)
    for m in range(rows):
        step = sweep.PoseStep(answers.twist[m], answers.turn[m], answers.shared[m])
        step.shared.fill(0)
        copy_array(system.rows[m], spare_g)
        sweep.solve_tree(tree, system, factors, spare_g, system.row_joint[m], step)
    for m in range(rows):
        for n in range(rows):
            answers.capacitance[m, n] = (1.0 if m == n else 0.0) - multiply_row(system, m, answers.twist[n], answers.turn[n])
    factor_cholesky(answers.capacitance)


@njit(cache=True)
def correct_step(system, answers, step):
    """Turn a step that heeds the rows' gradient, but not their curvature, into one that heeds both."""
    along = answers.row_product
    for m in range(len(along)):
        along[m] = multiply_row(system, m, step.twist, step.turn)
    solve_cholesky(answers.capacitance, along)
    for m in range(len(along)):
        for j in range(len(step.turn)):
            for a in range(6):
                step.twist[j, a] += along[m] * answers.twist[m, j, a]
            for a in range(3):
                step.turn[j, a] += along[m] * answers.turn[m, j, a]
        for c in range(len(step.shared)):
            step.shared[c] += along[m] * answers.shared[m, c]


@njit(cache=True)
def apply_rows(tree, system, factors, answers, spare_g, step):
    """Make the sweep's step one that heeds the rows' curvature, too; spare_g (J, 6) is spoilt."""
    if answers is None:
        return
    compute_row_responses(tree, system, factors, spare_g, answers)
    correct_step(system, answers, step)


@njit(cache=True)
def compute_row_decrease(system, answers, step):
    """-> what the rows' gradient takes from the cost along a step."""
    total = 0.0
    if answers is not None:
        for m in range(len(system.away)):
            total -= system.away[m] * multiply_row(system, m, step.twist, step.turn)
    return total
