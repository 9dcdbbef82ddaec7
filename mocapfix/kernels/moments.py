"""What is known of one segment's pose as numbers that add up, and the pose that follows from them, compiled.

A row of sixteen numbers: the sums, over the points known of a segment, of the weight w (1/m^2), of w x (the point in the
world), of w p (its place in the segment's axes) and of w x p'. That is all that a rigid registration asks of points (Horn
1987, "Closed-form solution of absolute orientation using unit quaternions"). What is known of the turn apart from points is
a matrix Fisher density (Downs 1972), exp tr(F' turn), and adds F to the last nine. Rows of independent knowledge add.

A pose is a row of twenty-five: the turn, `here` and `there` (x = here + turn (p - there)), the weight and, in the segment's
axes, the information (1/rad^2) about a further turn round `here`, by which place and turn are independent.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from mocapfix.kernels.attitude import attitude
from mocapfix.kernels.rigid import nearest_rotation
from mocapfix.kernels.small import inverse_3, lone, matrix, product, put, times, transposed

MOMENTS, POSE = 16, 25  # numbers in a row
TURN, HERE, THERE, WEIGHT, INFORMATION = 0, 9, 12, 15, 16  # where they begin in a pose
OPEN = 1e-9  # the part of a segment's information that axes have of which nothing tells


class Room(NamedTuple):
    """Room for one registration, taken once for many frames."""

    cross: np.ndarray  # (3, 3)
    turn: np.ndarray  # (3, 3)
    symmetric: np.ndarray  # (4, 4)
    vectors: np.ndarray  # (4, 4)
    small: np.ndarray  # (1, 3, 3)


@njit(cache=True)
def nine(row, n):
    """-> the 3 x 3 matrix that begins at number `n` of a row."""
    return row[n], row[n + 1], row[n + 2], row[n + 3], row[n + 4], row[n + 5], row[n + 6], row[n + 7], row[n + 8]


@njit(cache=True)
def clear(row):
    """Write that nothing is known."""
    for n in range(len(row)):
        row[n] = 0.0


@njit(cache=True)
def copy(row, into):
    """Write one row over another."""
    for n in range(len(row)):
        into[n] = row[n]


@njit(cache=True)
def add_point(row, w, at, p):
    """Add what a point, three numbers, at the place `p` (3,) tells."""
    a, b, c = p[0], p[1], p[2]
    x, y, z = w * at[0], w * at[1], w * at[2]
    row[0] += w
    row[1] += x
    row[2] += y
    row[3] += z
    row[4] += w * a
    row[5] += w * b
    row[6] += w * c
    add_turn(row, 1.0, (x * a, x * b, x * c, y * a, y * b, y * c, z * a, z * b, z * c))


@njit(cache=True)
def add_turn(row, factor, fisher):
    """Add so many times what is known of the turn, nine numbers."""
    for n in range(9):
        row[7 + n] += factor * fisher[n]


@njit(cache=True)
def lay(row, pose, room):
    """Write the likeliest pose. Where nothing is known, that is no turn, at the origin, of no weight."""
    w, cross = row[0], room.cross
    scale = 1 / w if w > 0 else 0.0
    pose[WEIGHT] = w
    for a in range(3):
        pose[HERE + a], pose[THERE + a] = row[1 + a] * scale, row[4 + a] * scale
        for b in range(3):
            cross[a, b] = row[7 + 3 * a + b] - pose[HERE + a] * row[4 + b]
    told, turn = attitude(lone(cross))
    if not told:
        nearest_rotation(cross, room.symmetric, room.vectors, room.turn)
        turn = lone(room.turn)
    fit = product(transposed(turn), lone(cross))  # symmetric but for rounding
    trace = fit[0] + fit[4] + fit[8]
    xy, xz, yz = -0.5 * (fit[1] + fit[3]), -0.5 * (fit[2] + fit[6]), -0.5 * (fit[5] + fit[7])
    known = (trace - fit[0], xy, xz, xy, trace - fit[4], yz, xz, yz, trace - fit[8])
    for n in range(9):
        pose[TURN + n], pose[INFORMATION + n] = turn[n], known[n]


@njit(cache=True)
def carried(pose, p):
    """-> the point in the world at the place `p` (3,)."""
    x, y, z = times(nine(pose, TURN), p[0] - pose[THERE], p[1] - pose[THERE + 1], p[2] - pose[THERE + 2])
    return pose[HERE] + x, pose[HERE + 1] + y, pose[HERE + 2] + z


@njit(cache=True)
def variance(pose, p, least, room):
    """-> m^2: the mean variance per axis of the point at place `p`, the turn being known at least so well (1/rad^2)."""
    if pose[WEIGHT] <= 0:
        return math.inf
    k = nine(pose, INFORMATION)
    least += OPEN * (k[0] + k[4] + k[8]) + 1e-12
    put((k[0] + least, k[1], k[2], k[3], k[4] + least, k[5], k[6], k[7], k[8] + least), room.small, 0)
    inverse_3(room.small, 0)
    k = matrix(room.small, 0)
    x, y, z = p[0] - pose[THERE], p[1] - pose[THERE + 1], p[2] - pose[THERE + 2]
    a, b, c = times(k, x, y, z)
    return 1 / pose[WEIGHT] + max(0.0, (k[0] + k[4] + k[8]) * (x * x + y * y + z * z) - (a * x + b * y + c * z)) / 3


@njit(cache=True)
def through(known, habit, room):
    """-> F of what a neighbour's turn, `known` so surely (1/rad^2, nine numbers), says through a joint of a `habit` so sure.

    Covariances add; F is half the trace of the information less the information. All in the same axes, of the parent.
    """
    put((
        known[0] + habit[0], known[1] + habit[1], known[2] + habit[2],
        known[3] + habit[3], known[4] + habit[4], known[5] + habit[5],
        known[6] + habit[6], known[7] + habit[7], known[8] + habit[8],
    ), room.small, 0)  # fmt: skip
    inverse_3(room.small, 0)
    lost = product(habit, product(matrix(room.small, 0), habit))
    half = 0.5 * (habit[0] - lost[0] + habit[4] - lost[4] + habit[8] - lost[8])
    return (
        half - habit[0] + lost[0], lost[1] - habit[1], lost[2] - habit[2],
        lost[3] - habit[3], half - habit[4] + lost[4], lost[5] - habit[5],
        lost[6] - habit[6], lost[7] - habit[7], half - habit[8] + lost[8],
    )  # fmt: skip
