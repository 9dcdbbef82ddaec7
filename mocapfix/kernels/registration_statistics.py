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

from mocapfix.kernels.rigid_registration import compute_nearest_rotation, solve_wahba
from mocapfix.kernels.small_matrices import (
    invert_symmetric_3x3,
    load_matrix,
    load_single_matrix,
    multiply_matrices,
    multiply_vector,
    store_matrix,
    transpose_matrix,
)

STATISTICS_SIZE, SEGMENT_POSE_SIZE = 16, 25  # numbers in a row
ROTATION_INDEX, WORLD_CENTROID_INDEX, BODY_CENTROID_INDEX, WEIGHT_INDEX, INFORMATION_INDEX = (
    0,
    9,
    12,
    15,
    16,
)  # where they begin in a pose
MIN_AXIS_INFORMATION_RATIO = 1e-9  # the part of a segment's information that axes have of which nothing tells


class RegistrationWorkspace(NamedTuple):
    """Room for one registration, taken once for many frames."""

    cross: np.ndarray  # (3, 3)
    turn: np.ndarray  # (3, 3)
    symmetric: np.ndarray  # (4, 4)
    vectors: np.ndarray  # (4, 4)
    small: np.ndarray  # (1, 3, 3)


@njit(cache=True)
def read_matrix(row, n):
    """-> the 3 x 3 matrix that begins at number `n` of a row."""
    return row[n], row[n + 1], row[n + 2], row[n + 3], row[n + 4], row[n + 5], row[n + 6], row[n + 7], row[n + 8]


@njit(cache=True)
def clear_row(row):
    """Write that nothing is known."""
    for n in range(len(row)):
        row[n] = 0.0


@njit(cache=True)
def copy_row(row, into):
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
    add_rotation_information(row, 1.0, (x * a, x * b, x * c, y * a, y * b, y * c, z * a, z * b, z * c))


@njit(cache=True)
def add_rotation_information(row, factor, fisher):
    """Add so many times what is known of the turn, nine numbers."""
    for n in range(9):
        row[7 + n] += factor * fisher[n]


@njit(cache=True)
def fit_segment_pose(row, pose, room):
    """Write the likeliest pose. Where nothing is known, that is no turn, at the origin, of no weight."""
    w, cross = row[0], room.cross
    scale = 1 / w if w > 0 else 0.0
    pose[WEIGHT_INDEX] = w
    for a in range(3):
        pose[WORLD_CENTROID_INDEX + a], pose[BODY_CENTROID_INDEX + a] = row[1 + a] * scale, row[4 + a] * scale
        for b in range(3):
            cross[a, b] = row[7 + 3 * a + b] - pose[WORLD_CENTROID_INDEX + a] * row[4 + b]
    told, turn = solve_wahba(load_single_matrix(cross))
    if not told:
        compute_nearest_rotation(cross, room.symmetric, room.vectors, room.turn)
        turn = load_single_matrix(room.turn)
    fit = multiply_matrices(transpose_matrix(turn), load_single_matrix(cross))  # symmetric but for rounding
    trace = fit[0] + fit[4] + fit[8]
    xy, xz, yz = -0.5 * (fit[1] + fit[3]), -0.5 * (fit[2] + fit[6]), -0.5 * (fit[5] + fit[7])
    known = (trace - fit[0], xy, xz, xy, trace - fit[4], yz, xz, yz, trace - fit[8])
    for n in range(9):
        pose[ROTATION_INDEX + n], pose[INFORMATION_INDEX + n] = turn[n], known[n]


@njit(cache=True)
def transform_point(pose, p):
    """-> the point in the world at the place `p` (3,)."""
    x, y, z = multiply_vector(
        read_matrix(pose, ROTATION_INDEX),
        p[0] - pose[BODY_CENTROID_INDEX],
        p[1] - pose[BODY_CENTROID_INDEX + 1],
        p[2] - pose[BODY_CENTROID_INDEX + 2],
    )
    return pose[WORLD_CENTROID_INDEX] + x, pose[WORLD_CENTROID_INDEX + 1] + y, pose[WORLD_CENTROID_INDEX + 2] + z


@njit(cache=True)
def compute_point_variance(pose, p, least, room):
    """-> m^2: the mean variance per axis of the point at place `p`, the turn being known at least so well (1/rad^2)."""
    if pose[WEIGHT_INDEX] <= 0:
        return math.inf
    k = read_matrix(pose, INFORMATION_INDEX)
    least += MIN_AXIS_INFORMATION_RATIO * (k[0] + k[4] + k[8]) + 1e-12
    store_matrix((k[0] + least, k[1], k[2], k[3], k[4] + least, k[5], k[6], k[7], k[8] + least), room.small, 0)
    invert_symmetric_3x3(room.small, 0)
    k = load_matrix(room.small, 0)
    x, y, z = p[0] - pose[BODY_CENTROID_INDEX], p[1] - pose[BODY_CENTROID_INDEX + 1], p[2] - pose[BODY_CENTROID_INDEX + 2]
    a, b, c = multiply_vector(k, x, y, z)
    return 1 / pose[WEIGHT_INDEX] + max(0.0, (k[0] + k[4] + k[8]) * (x * x + y * y + z * z) - (a * x + b * y + c * z)) / 3


@njit(cache=True)
def propagate_rotation_information(known, habit, room):
    """-> F of what a neighbour's turn, `known` so surely (1/rad^2, nine numbers), says through a joint of a `habit` so sure.

    Covariances add; F is half the trace of the information less the information. All in the same axes, of the parent.
    """
    store_matrix((
        known[0] + habit[0], known[1] + habit[1], known[2] + habit[2],
        known[3] + habit[3], known[4] + habit[4], known[5] + habit[5],
        known[6] + habit[6], known[7] + habit[7], known[8] + habit[8],
    ), room.small, 0)  # fmt: skip
    invert_symmetric_3x3(room.small, 0)
    lost = multiply_matrices(habit, multiply_matrices(load_matrix(room.small, 0), habit))
    half = 0.5 * (habit[0] - lost[0] + habit[4] - lost[4] + habit[8] - lost[8])
    return (
        half - habit[0] + lost[0], lost[1] - habit[1], lost[2] - habit[2],
        lost[3] - habit[3], half - habit[4] + lost[4], lost[5] - habit[5],
        lost[6] - habit[6], lost[7] - habit[7], half - habit[8] + lost[8],
    )  # fmt: skip
