"""Poses of a body's segments in one frame by two passes over the tree (belief propagation; Pearl 1988), compiled.

A segment's own markers are points. A neighbour gives information on the joint that the two share, which is a point too, and on
the segment's axes, which the joint's mean rotation ties to the neighbour's. From the leaves to the root each segment sends its
information to its parent; then from the root to the leaves each sends its information to its children, without what it received
from them, so that nothing is counted twice. The messages are approximate, and conservative: the joint is equally uncertain along
every axis, and independent of the rotation.

A segment is registered robustly to its markers, of which one may be an outlier, by sufficient statistics.

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

from mocapfix.kernels.compilation import compile_inner_kernel, compile_kernel
from mocapfix.kernels.rigid_registration import fit_rotation
from mocapfix.kernels.small_matrices import (
    clear_array,
    copy_array,
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
    rotation = fit_rotation(cross, work.symmetric, work.vectors, work.rotation)
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

    Args:
        min_information: 1/rad^2, added to the information on the rotation about every axis.
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

    Covariances add; the Fisher parameter is half the trace of the information minus the information. All in the parent's axes.

    Args:
        known: Information (1/rad^2, nine numbers) on the neighbour's rotation.
        joint: Information on the joint's rotation about its mean.
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

    Args:
        measured, offsets, weight: (N, 3), (N, 3), (N,) the segment's markers, which its `row` of statistics already includes.
        inlier_weight: (N,) the fraction of each one's weight in the row, 0 where missing; updated, as is the row.
        spare: A row of statistics and a pose, overwritten.
    """
    fit_segment_pose(row, pose, work)
    best, worst_square = _compute_disagreement(measured, offsets, inlier_weight, pose)
    if worst_square < OUTLIER_SCALE_M**2:
        return
    others, candidate = spare
    for i in range(len(inlier_weight)):
        if inlier_weight[i] > 0:
            copy_array(row, others)
            add_point(others, -inlier_weight[i] * weight[i], measured[i], offsets[i])
            fit_segment_pose(others, candidate, work)
            disagreement, _ = _compute_disagreement(measured, offsets, inlier_weight, candidate)
            if disagreement < best:
                best = disagreement
                copy_array(candidate, pose)
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


STANDING_INFORMATION = 1e-3  # 1/rad^2: on a segment's rotation in the mean pose, for segments without other information
MIN_ROTATION_INFORMATION = 1.0  # 1/rad^2: of a segment without any, as a rotation is never wrong by more than half a turn


class SegmentTree(NamedTuple):
    """S segments, parents before children, the root first; the K markers ordered by segment, in the frames too."""

    parent: np.ndarray  # (S,)
    joint_offset: np.ndarray  # (S, 3) metres: each segment's joint in its parent's axes
    mean_rotation: np.ndarray  # (S, 3, 3) its axes in its parent's, in the mean pose
    rotation_information: np.ndarray  # (S, 3, 3) 1/rad^2, in its parent's axes: about the mean rotation
    first_marker: np.ndarray  # (S + 1,) index of each segment's first marker, and the end
    marker_offset: np.ndarray  # (K, 3) metres, in the segment's axes
    weight: np.ndarray  # (K,) 1/m^2
    standing_rotation: np.ndarray  # (S, 3, 3) the segments' axes in the mean pose, standing
    standing_position: np.ndarray  # (K, 3) metres: the markers in that pose


class JointSegments(NamedTuple):
    """The segments that meet at each of J joints."""

    first_segment: np.ndarray  # (J + 1,) index of each joint's first entry, and the end
    segment: np.ndarray  # (N,)
    joint_offset: np.ndarray  # (N, 3) metres: the joint in that segment's axes


class PropagationWorkspace(NamedTuple):
    """Arrays for one frame, allocated once for many. The last row of statistics and poses is a spare."""

    statistics: np.ndarray  # (S + 1, STATISTICS_SIZE) each segment's information so far
    messages: np.ndarray  # (S, STATISTICS_SIZE) from each segment to its parent
    poses: np.ndarray  # (S + 1, SEGMENT_POSE_SIZE)
    inlier_weight: np.ndarray  # (K,) the fraction of each marker's weight that counts; 0 where missing


@compile_kernel(nogil=True)
def propagate_segment_frames(segments, joint_segments, markers, position, variances, inlier_weight, first, stop):
    """Write the joints' positions (T, J, 3), their variances per axis (T, J), and the fraction of each marker's weight that
    counted (T, K), in the frames first..stop - 1.
    """
    count, origin = len(segments.parent), np.zeros(3)
    registration = RegistrationWorkspace(
        np.empty((3, 3)), np.empty((3, 3)), np.empty((4, 4)), np.empty((4, 4)), np.empty((1, 3, 3))
    )
    work = PropagationWorkspace(
        np.empty((count + 1, STATISTICS_SIZE)),
        np.empty((count, STATISTICS_SIZE)),
        np.empty((count + 1, SEGMENT_POSE_SIZE)),
        np.empty(len(segments.weight)),
    )
    for t in range(first, stop):
        _collect_marker_statistics(segments, markers[t], work, registration)
        for n in range(1, 2 * count):  # from the leaves to the root, and back
            s = abs(count - n)
            if n > count:
                _send_to_child(segments, s, origin, work, registration)
            _fit_segment(segments, s, markers[t], work, registration)
            if n < count:
                _send_to_parent(segments, s, origin, work, registration)
        copy_array(work.inlier_weight, inlier_weight[t])
        for j in range(position.shape[1]):
            variances[t, j] = _combine_joint_estimates(joint_segments, j, work.poses, position[t, j], registration)


@compile_inner_kernel
def _collect_marker_statistics(segments, measured, work, registration):
    """Initialise the statistics with each segment's own markers, and a weak prior on its rotation from the whole body's."""
    count = len(segments.parent)
    clear_array(work.statistics[count])
    for s in range(count):
        clear_array(work.statistics[s])
        for i in range(segments.first_marker[s], segments.first_marker[s + 1]):
            x, w = measured[i], segments.weight[i]
            work.inlier_weight[i] = 0.0 if math.isnan(x[0]) else 1.0
            if work.inlier_weight[i] > 0:
                add_point(work.statistics[s], w, x, segments.marker_offset[i])
                add_point(work.statistics[count], w, x, segments.standing_position[i])
    fit_segment_pose(work.statistics[count], work.poses[count], registration)
    body_rotation = read_matrix(work.poses[count], ROTATION_INDEX)
    for s in range(count):
        rotation = multiply_matrices(body_rotation, load_matrix(segments.standing_rotation, s))
        add_rotation_information(work.statistics[s], 0.5 * STANDING_INFORMATION, rotation)


@compile_inner_kernel
def _fit_segment(segments, s, measured, work, registration):
    """Fit a segment's pose to its information so far."""
    a, b, spare = segments.first_marker[s], segments.first_marker[s + 1], len(segments.parent)
    fit_segment_pose_robustly(
        measured[a:b], segments.marker_offset[a:b], segments.weight[a:b], work.inlier_weight[a:b], work.statistics[s],
        work.poses[s], registration, (work.statistics[spare], work.poses[spare]),
    )  # fmt: skip


@compile_inner_kernel
def _send_to_parent(segments, s, origin, work, registration):
    """Add this segment's information to its parent's."""
    pose, message, mean = work.poses[s], work.messages[s], load_matrix(segments.mean_rotation, s)
    clear_array(message)
    weight = 1 / compute_point_variance(pose, origin, 0.0, registration)
    add_point(message, weight, transform_point(pose, origin), segments.joint_offset[s])
    information = read_matrix(pose, INFORMATION_INDEX)
    known = multiply_matrices(mean, multiply_matrices(information, transpose_matrix(mean)))
    joint = load_matrix(segments.rotation_information, s)
    fisher = propagate_rotation_information(known, joint, registration)
    rotation = read_matrix(pose, ROTATION_INDEX)
    fisher = multiply_matrices(rotation, multiply_matrices(transpose_matrix(mean), fisher))
    add_rotation_information(message, 1.0, fisher)
    for n in range(STATISTICS_SIZE):
        work.statistics[segments.parent[s], n] += message[n]


@compile_inner_kernel
def _send_to_child(segments, s, origin, work, registration):
    """Add to this segment's information its parent's, without what the parent received from it."""
    parent, spare = segments.parent[s], len(segments.parent)
    for n in range(STATISTICS_SIZE):
        work.statistics[spare, n] = work.statistics[parent, n] - work.messages[s, n]
    pose, row = work.poses[spare], work.statistics[s]
    fit_segment_pose(work.statistics[spare], pose, registration)
    information = read_matrix(pose, INFORMATION_INDEX)
    joint = load_matrix(segments.rotation_information, s)
    fisher = propagate_rotation_information(information, joint, registration)
    rotation = read_matrix(pose, ROTATION_INDEX)
    fisher = multiply_matrices(rotation, multiply_matrices(fisher, load_matrix(segments.mean_rotation, s)))
    add_rotation_information(row, 1.0, fisher)
    weight = 1 / compute_point_variance(pose, segments.joint_offset[s], 0.0, registration)
    add_point(row, weight, transform_point(pose, segments.joint_offset[s]), origin)


@compile_inner_kernel
def _combine_joint_estimates(joint_segments, j, poses, position, registration):
    """Write the weighted mean of a joint's positions according to the segments that meet there. Returns its variance.

    After the messages the segments' estimates are hardly independent, so the variance is their mean variance, not that of a mean.
    """
    total = 0.0
    position[0], position[1], position[2] = 0.0, 0.0, 0.0
    for n in range(joint_segments.first_segment[j], joint_segments.first_segment[j + 1]):
        pose, p = poses[joint_segments.segment[n]], joint_segments.joint_offset[n]
        x, y, z = transform_point(pose, p)
        weight = 1 / compute_point_variance(pose, p, MIN_ROTATION_INFORMATION, registration)
        total += weight
        position[0] += weight * x
        position[1] += weight * y
        position[2] += weight * z
    if total <= 0:
        return math.inf
    for a in range(3):
        position[a] /= total
    return (joint_segments.first_segment[j + 1] - joint_segments.first_segment[j]) / total
