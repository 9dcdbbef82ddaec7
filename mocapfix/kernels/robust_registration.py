"""Robust registration of a segment to its markers, of which one may be an outlier, by sufficient statistics; compiled.

The statistics are a row of sixteen numbers: the sums, over the segment's known points, of the weight w (1/m^2), of w x (x the
point in the world), of w p (p its position in the segment's axes) and of w x p'. A rigid registration needs nothing else of the
points (Horn 1987, "Closed-form solution of absolute orientation using unit quaternions"). Information on the rotation from other
sources is a matrix Fisher density (Downs 1972), exp tr(F' R), and adds F to the last nine numbers. Rows of independent
information add up.

A pose is a row of twenty-five numbers: the rotation R, the centroids in the world and in the segment (x = world centroid +
R (p - segment centroid)), the weight and, in the segment's axes, the information (1/rad^2) on a further rotation about the world
centroid, relative to which position and rotation are independent.
"""

import math
from typing import NamedTuple

import numpy as np

from mocapfix.kernels.compilation_cache import compile_inner_kernel
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

STATISTICS_SIZE = 16  # numbers in a row of statistics
SEGMENT_POSE_SIZE = 25  # numbers in a pose
ROTATION_INDEX = 0  # first number of the rotation in a pose
WORLD_CENTROID_INDEX = 9
BODY_CENTROID_INDEX = 12
WEIGHT_INDEX = 15
INFORMATION_INDEX = 16
MIN_AXIS_INFORMATION_RATIO = 1e-9  # of an axis' information to the segment's sum, assumed for axes without any
MIN_AXIS_INFORMATION = 1e-12  # 1/rad^2, added to every axis' information before it is inverted


class RegistrationWorkspace(NamedTuple):
    """Arrays for one registration, allocated once for many frames."""

    cross: np.ndarray  # (3, 3)
    rotation: np.ndarray  # (3, 3)
    symmetric: np.ndarray  # (4, 4)
    vectors: np.ndarray  # (4, 4)
    inverse: np.ndarray  # (1, 3, 3)


@compile_inner_kernel
def read_matrix(row, n):
    """Return the 3 x 3 matrix that begins at number `n` of a row, as nine numbers."""
    return row[n], row[n + 1], row[n + 2], row[n + 3], row[n + 4], row[n + 5], row[n + 6], row[n + 7], row[n + 8]


@compile_inner_kernel
def clear_row(row):
    """Set a row to zero: no information."""
    for n in range(len(row)):
        row[n] = 0.0


@compile_inner_kernel
def copy_row(row, target):
    """Copy a row into `target`."""
    for n in range(len(row)):
        target[n] = row[n]


@compile_inner_kernel
def add_point(row, w, point, p):
    """Add a world point, three numbers, of weight w and position p (3,) in the segment's axes."""
    a, b, c = p[0], p[1], p[2]
    x, y, z = w * point[0], w * point[1], w * point[2]
    row[0] += w
    row[1] += x
    row[2] += y
    row[3] += z
    row[4] += w * a
    row[5] += w * b
    row[6] += w * c
    add_rotation_information(row, 1.0, (x * a, x * b, x * c, y * a, y * b, y * c, z * a, z * b, z * c))


@compile_inner_kernel
def add_rotation_information(row, factor, fisher):
    """Add `factor` times a matrix Fisher parameter, nine numbers."""
    for n in range(9):
        row[7 + n] += factor * fisher[n]


@compile_inner_kernel
def fit_segment_pose(row, pose, work):
    """Write the most likely pose. Without information it is the identity at the origin, with weight zero."""
    w, cross = row[0], work.cross
    scale = 1 / w if w > 0 else 0.0
    pose[WEIGHT_INDEX] = w
    for a in range(3):
        pose[WORLD_CENTROID_INDEX + a], pose[BODY_CENTROID_INDEX + a] = row[1 + a] * scale, row[4 + a] * scale
        for b in range(3):
            cross[a, b] = row[7 + 3 * a + b] - pose[WORLD_CENTROID_INDEX + a] * row[4 + b]
    is_solved, rotation = solve_wahba(load_single_matrix(cross))
    if not is_solved:
        compute_nearest_rotation(cross, work.symmetric, work.vectors, work.rotation)
        rotation = load_single_matrix(work.rotation)
    fit = multiply_matrices(transpose_matrix(rotation), load_single_matrix(cross))  # symmetric up to rounding
    trace = fit[0] + fit[4] + fit[8]
    xy, xz, yz = -0.5 * (fit[1] + fit[3]), -0.5 * (fit[2] + fit[6]), -0.5 * (fit[5] + fit[7])
    information = (trace - fit[0], xy, xz, xy, trace - fit[4], yz, xz, yz, trace - fit[8])
    for n in range(9):
        pose[ROTATION_INDEX + n], pose[INFORMATION_INDEX + n] = rotation[n], information[n]


@compile_inner_kernel
def transform_point(pose, p):
    """Return the world position of the point p (3,) of the segment."""
    b = BODY_CENTROID_INDEX
    x, y, z = multiply_vector(read_matrix(pose, ROTATION_INDEX), p[0] - pose[b], p[1] - pose[b + 1], p[2] - pose[b + 2])
    return pose[WORLD_CENTROID_INDEX] + x, pose[WORLD_CENTROID_INDEX + 1] + y, pose[WORLD_CENTROID_INDEX + 2] + z


@compile_inner_kernel
def compute_point_variance(pose, p, min_information, work):
    """Return the mean variance per axis (m^2) of the point p (3,); infinite for a pose without weight.

    min_information  1/rad^2, added to the information on the rotation about every axis
    """
    if pose[WEIGHT_INDEX] <= 0:
        return math.inf
    k = read_matrix(pose, INFORMATION_INDEX)
    min_information += MIN_AXIS_INFORMATION_RATIO * (k[0] + k[4] + k[8]) + MIN_AXIS_INFORMATION
    store_matrix(
        (k[0] + min_information, k[1], k[2], k[3], k[4] + min_information, k[5], k[6], k[7], k[8] + min_information),
        work.inverse,
        0,
    )
    invert_symmetric_3x3(work.inverse, 0)
    k = load_matrix(work.inverse, 0)
    b = BODY_CENTROID_INDEX
    x, y, z = p[0] - pose[b], p[1] - pose[b + 1], p[2] - pose[b + 2]
    u, v, w = multiply_vector(k, x, y, z)
    lever = (k[0] + k[4] + k[8]) * (x * x + y * y + z * z) - (u * x + v * y + w * z)
    return 1 / pose[WEIGHT_INDEX] + max(0.0, lever) / 3


@compile_inner_kernel
def propagate_rotation_information(known, joint, work):
    """Return the Fisher parameter that a neighbour's rotation gives through a joint.

    known  information (1/rad^2, nine numbers) on the neighbour's rotation
    joint  information on the joint's rotation about its mean

    Covariances add; the Fisher parameter is half the trace of the information minus the information. All in the parent's axes.
    """
    store_matrix((
        known[0] + joint[0], known[1] + joint[1], known[2] + joint[2],
        known[3] + joint[3], known[4] + joint[4], known[5] + joint[5],
        known[6] + joint[6], known[7] + joint[7], known[8] + joint[8],
    ), work.inverse, 0)  # fmt: skip
    invert_symmetric_3x3(work.inverse, 0)
    loss = multiply_matrices(joint, multiply_matrices(load_matrix(work.inverse, 0), joint))
    half = 0.5 * (joint[0] - loss[0] + joint[4] - loss[4] + joint[8] - loss[8])
    return (
        half - joint[0] + loss[0], loss[1] - joint[1], loss[2] - joint[2],
        loss[3] - joint[3], half - joint[4] + loss[4], loss[5] - joint[5],
        loss[6] - joint[6], loss[7] - joint[7], half - joint[8] + loss[8],
    )  # fmt: skip


OUTLIER_SCALE_M = 0.05  # Geman-McClure scale: a marker's weight falls with its distance from the segment, over this


@compile_inner_kernel
def fit_segment_pose_robustly(measured, offsets, weight, inlier_weight, row, pose, work, spare):
    """Write the most likely pose; if a marker lies far from it, fit again with weights that fall with the distance.

    The distance is that from the pose on which the markers agree best, among the fit to all markers and the fits to all but
    one.

    measured, offsets, weight  (N, 3), (N, 3), (N,) the segment's markers, which its `row` of statistics already includes
    inlier_weight              (N,) the fraction of each one's weight in the row, 0 where missing; updated, as is the row
    spare                      a row of statistics and a pose, overwritten
    """
    fit_segment_pose(row, pose, work)
    best, worst_square = _compute_disagreement(measured, offsets, inlier_weight, pose)
    if worst_square < OUTLIER_SCALE_M**2:
        return
    others, candidate = spare
    for i in range(len(inlier_weight)):
        if inlier_weight[i] > 0:
            copy_row(row, others)
            add_point(others, -inlier_weight[i] * weight[i], measured[i], offsets[i])
            fit_segment_pose(others, candidate, work)
            disagreement, _ = _compute_disagreement(measured, offsets, inlier_weight, candidate)
            if disagreement < best:
                best = disagreement
                copy_row(candidate, pose)
    for i in range(len(inlier_weight)):
        if inlier_weight[i] > 0:
            inlier = 1 / (1 + _compute_squared_distance(pose, offsets[i], measured[i]) / OUTLIER_SCALE_M**2) ** 2
            add_point(row, (inlier - inlier_weight[i]) * weight[i], measured[i], offsets[i])
            inlier_weight[i] = inlier
    fit_segment_pose(row, pose, work)


@compile_inner_kernel
def _compute_disagreement(measured, offsets, inlier_weight, pose):
    """Return the markers' robust disagreement with a pose (from 0 to their count) and the largest squared distance."""
    total, worst_square = 0.0, 0.0
    for i in range(len(inlier_weight)):
        if inlier_weight[i] > 0:
            square = _compute_squared_distance(pose, offsets[i], measured[i])
            total += square / (square + OUTLIER_SCALE_M**2)
            worst_square = max(worst_square, square)
    return total, worst_square


@compile_inner_kernel
def _compute_squared_distance(pose, p, point):
    """Return the squared distance of a measured point from its position according to the pose."""
    x, y, z = transform_point(pose, p)
    return (point[0] - x) ** 2 + (point[1] - y) ** 2 + (point[2] - z) ** 2
