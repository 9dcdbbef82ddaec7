"""Poses of a body's segments in one frame by two passes over the tree (belief propagation; Pearl 1988), compiled.

A segment's own markers are points. A neighbour gives information on the joint that the two share, which is a point too, and on
the segment's axes, which the joint's mean rotation ties to the neighbour's. From the leaves to the root each segment sends its
information to its parent; then from the root to the leaves each sends its information to its children, without what it received
from them, so that nothing is counted twice. The messages are approximate, and conservative: the joint is equally uncertain along
every axis, and independent of the rotation.
"""

import math
from typing import NamedTuple

import numpy as np

from mocapfix.kernels import robust_registration as statistics
from mocapfix.kernels.compilation_cache import compile_inner_kernel, compile_kernel
from mocapfix.kernels.robust_registration import fit_segment_pose_robustly
from mocapfix.kernels.small_matrices import load_matrix, multiply_matrices, transpose_matrix

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
    counted (T, K), in the frames first..stop - 1."""
    count, origin = len(segments.parent), np.zeros(3)
    registration = statistics.RegistrationWorkspace(
        np.empty((3, 3)), np.empty((3, 3)), np.empty((4, 4)), np.empty((4, 4)), np.empty((1, 3, 3))
    )
    work = PropagationWorkspace(
        np.empty((count + 1, statistics.STATISTICS_SIZE)),
        np.empty((count, statistics.STATISTICS_SIZE)),
        np.empty((count + 1, statistics.SEGMENT_POSE_SIZE)),
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
        statistics.copy_row(work.inlier_weight, inlier_weight[t])
        for j in range(position.shape[1]):
            variances[t, j] = _combine_joint_estimates(joint_segments, j, work.poses, position[t, j], registration)


@compile_inner_kernel
def _collect_marker_statistics(segments, measured, work, registration):
    """Initialise the statistics with each segment's own markers, and a weak prior on its rotation from the whole body's."""
    count = len(segments.parent)
    statistics.clear_row(work.statistics[count])
    for s in range(count):
        statistics.clear_row(work.statistics[s])
        for i in range(segments.first_marker[s], segments.first_marker[s + 1]):
            x, w = measured[i], segments.weight[i]
            work.inlier_weight[i] = 0.0 if math.isnan(x[0]) else 1.0
            if work.inlier_weight[i] > 0:
                statistics.add_point(work.statistics[s], w, x, segments.marker_offset[i])
                statistics.add_point(work.statistics[count], w, x, segments.standing_position[i])
    statistics.fit_segment_pose(work.statistics[count], work.poses[count], registration)
    body_rotation = statistics.read_matrix(work.poses[count], statistics.ROTATION_INDEX)
    for s in range(count):
        rotation = multiply_matrices(body_rotation, load_matrix(segments.standing_rotation, s))
        statistics.add_rotation_information(work.statistics[s], 0.5 * STANDING_INFORMATION, rotation)


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
    statistics.clear_row(message)
    weight = 1 / statistics.compute_point_variance(pose, origin, 0.0, registration)
    statistics.add_point(message, weight, statistics.transform_point(pose, origin), segments.joint_offset[s])
    information = statistics.read_matrix(pose, statistics.INFORMATION_INDEX)
    known = multiply_matrices(mean, multiply_matrices(information, transpose_matrix(mean)))
    joint = load_matrix(segments.rotation_information, s)
    fisher = statistics.propagate_rotation_information(known, joint, registration)
    rotation = statistics.read_matrix(pose, statistics.ROTATION_INDEX)
    fisher = multiply_matrices(rotation, multiply_matrices(transpose_matrix(mean), fisher))
    statistics.add_rotation_information(message, 1.0, fisher)
    for n in range(statistics.STATISTICS_SIZE):
        work.statistics[segments.parent[s], n] += message[n]


@compile_inner_kernel
def _send_to_child(segments, s, origin, work, registration):
    """Add to this segment's information its parent's, without what the parent received from it."""
    parent, spare = segments.parent[s], len(segments.parent)
    for n in range(statistics.STATISTICS_SIZE):
        work.statistics[spare, n] = work.statistics[parent, n] - work.messages[s, n]
    pose, row = work.poses[spare], work.statistics[s]
    statistics.fit_segment_pose(work.statistics[spare], pose, registration)
    information = statistics.read_matrix(pose, statistics.INFORMATION_INDEX)
    joint = load_matrix(segments.rotation_information, s)
    fisher = statistics.propagate_rotation_information(information, joint, registration)
    rotation = statistics.read_matrix(pose, statistics.ROTATION_INDEX)
    fisher = multiply_matrices(rotation, multiply_matrices(fisher, load_matrix(segments.mean_rotation, s)))
    statistics.add_rotation_information(row, 1.0, fisher)
    weight = 1 / statistics.compute_point_variance(pose, segments.joint_offset[s], 0.0, registration)
    statistics.add_point(row, weight, statistics.transform_point(pose, segments.joint_offset[s]), origin)


@compile_inner_kernel
def _combine_joint_estimates(joint_segments, j, poses, position, registration):
    """Write the weighted mean of a joint's positions according to the segments that meet there. Returns its variance.

    After the messages the segments' estimates are hardly independent, so the variance is their mean variance, not that of a mean.
    """
    total = 0.0
    position[0], position[1], position[2] = 0.0, 0.0, 0.0
    for n in range(joint_segments.first_segment[j], joint_segments.first_segment[j + 1]):
        pose, p = poses[joint_segments.segment[n]], joint_segments.joint_offset[n]
        x, y, z = statistics.transform_point(pose, p)
        weight = 1 / statistics.compute_point_variance(pose, p, MIN_ROTATION_INFORMATION, registration)
        total += weight
        position[0] += weight * x
        position[1] += weight * y
        position[2] += weight * z
    if total <= 0:
        return math.inf
    for a in range(3):
        position[a] /= total
    return (joint_segments.first_segment[j + 1] - joint_segments.first_segment[j]) / total
