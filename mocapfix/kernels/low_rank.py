"""The direction where some residuals touch several bodies at once: a few rows on top of the sweep.

With the tree's curvature H and M rows U, the Sherman-Morrison-Woodbury formula (Hager 1989) solves (H + U'U) x = -f by one
sweep for f and one for each row: x = x0 + Y (I - U Y)^-1 U x0, where x0 = -H^-1 f and Y = -H^-1 U'. So the sweep stays
exact, and the cost O(M K).
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from mocapfix.kernels import sweep
from mocapfix.kernels.pose import copy
from mocapfix.kernels.small import cholesky, cholesky_solve


class Answers(NamedTuple):
    """How the body gives way to each of M rows: one step each, and the rows' curvature among themselves."""

    twist: np.ndarray  # (M, J, 6)
    turn: np.ndarray  # (M, J, 3)
    shared: np.ndarray  # (M, P)
    among: np.ndarray  # (M, M)
    along: np.ndarray  # (M,)


@njit(cache=True)
def empty_answers(joints, unknowns, rows):
    """-> room for the answers to so many rows; None where there are none."""
    if rows is None:
        return None
    return Answers(
        np.empty((rows, joints, 6)), np.empty((rows, joints, 3)), np.empty((rows, unknowns)), np.empty((rows, rows)),
        np.empty(rows),
    )  # fmt: skip


@njit(cache=True)
def along_row(system, m, twist, turn):
    """-> how far a step goes along row m."""
    total = 0.0
    for j in range(len(turn)):
        for a in range(6):
            total += system.rows[m, j, a] * twist[j, a]
        for a in range(3):
            total += system.rows_own[m, j, a] * turn[j, a]
    return total


@njit(cache=True)
def add_gradient(system, answers, g, b):
    """Add the rows' own gradient to g (J, 6) and b (J, 3)."""
    if answers is None:
        return
    for m in range(len(system.away)):
        for j in range(len(g)):
            for a in range(6):
                g[j, a] += system.away[m] * system.rows[m, j, a]
            for a in range(3):
                b[j, a] += system.away[m] * system.rows_own[m, j, a]


@njit(cache=True)
def answer(tree, system, factors, spare_g, answers):
    """Write how the body gives way to each row, after `factor`; spare_g (J, 6) is spoilt."""
    rows = len(system.away)
    for m in range(rows):
        step = sweep.Step(answers.twist[m], answers.turn[m], answers.shared[m])
        step.shared.fill(0)
        copy(system.rows[m], spare_g)
        sweep.solve(tree, system, factors, spare_g, system.rows_own[m], step)
    for m in range(rows):
        for n in range(rows):
            answers.among[m, n] = (1.0 if m == n else 0.0) - along_row(system, m, answers.twist[n], answers.turn[n])
    cholesky(answers.among)


@njit(cache=True)
def corrected(system, answers, step):
    """Turn a step that heeds the rows' gradient, but not their curvature, into one that heeds both."""
    along = answers.along
    for m in range(len(along)):
        along[m] = along_row(system, m, step.twist, step.turn)
    cholesky_solve(answers.among, along)
    for m in range(len(along)):
        for j in range(len(step.turn)):
            for a in range(6):
                step.twist[j, a] += along[m] * answers.twist[m, j, a]
            for a in range(3):
                step.turn[j, a] += along[m] * answers.turn[m, j, a]
        for c in range(len(step.shared)):
            step.shared[c] += along[m] * answers.shared[m, c]


@njit(cache=True)
def heed_rows(tree, system, factors, answers, spare_g, step):
    """Make the sweep's step one that heeds the rows' curvature, too; spare_g (J, 6) is spoilt."""
    if answers is None:
        return
    answer(tree, system, factors, spare_g, answers)
    corrected(system, answers, step)


@njit(cache=True)
def fall(system, answers, step):
    """-> what the rows' gradient takes from the cost along a step."""
    total = 0.0
    if answers is not None:
        for m in range(len(system.away)):
            total -= system.away[m] * along_row(system, m, step.twist, step.turn)
    return total
