"""Where a body's segments lie in one frame, in two passes over the tree (after belief propagation; Pearl 1988), compiled.

A segment's own markers are points. A neighbour tells of the joint that the two share, which is a point too, and of its own
axes, which the joint's habit ties to the segment's. From the leaves to the root each segment tells its parent what it knows;
then from the root to the leaves each tells its children, but to none what it has from it: so nothing is counted twice. What
is told is less than what is known: the joint as sure along every axis, and the axes as though they did not depend on it.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from mocapfix.kernels import registration_statistics, robust_registration
from mocapfix.kernels.small_matrices import load_matrix, multiply_matrices, transpose_matrix

STANDING_INFORMATION = 1e-3  # 1/rad^2: how surely a segment is turned as in the mean pose, where nothing else tells
MIN_ROTATION_INFORMATION = (
    1.0  # 1/rad^2: so well a turn is known of which nothing tells, for it cannot be wrong by more than half a turn
)


class SegmentTree(NamedTuple):
    """S segments, parents before children, the root first; the K markers in the order of their segments,
    as the frames must have them, too."""

    parent: np.ndarray  # (S,)
    joint_offset: np.ndarray  # (S, 3) metres: each one's joint in its parent's axes
    mean_rotation: np.ndarray  # (S, 3, 3) its axes in its parent's, in the mean pose
    rotation_information: np.ndarray  # (S, 3, 3) 1/rad^2, in its parent's axes: how surely they keep to that
    first_marker: np.ndarray  # (S + 1,) where the markers of each begin
    marker_offset: np.ndarray  # (K, 3) metres, in the segment's axes
    weight: np.ndarray  # (K,) 1/m^2
    standing_rotation: np.ndarray  # (S, 3, 3) the segments' axes in the mean pose, standing
    standing_position: np.ndarray  # (K, 3) metres: the markers there


class JointSegments(NamedTuple):
    """Which segments meet at each of J joints, so that they carry it."""

    first_segment: np.ndarray  # (J + 1,) where those of each begin
    segment: np.ndarray  # (N,)
    joint_offset: np.ndarray  # (N, 3) metres: the joint in that segment's axes


class PropagationWorkspace(NamedTuple):
    """Room for one frame, taken once for many. The last row of sums and poses is a segment without what a child told."""

    statistics: np.ndarray  # (S + 1, MOMENTS) what is known of each segment so far
    messages: np.ndarray  # (S, MOMENTS) what each told its parent
    poses: np.ndarray  # (S + 1, POSE)
    trust: np.ndarray  # (K,) the part of each marker's weight that counts; 0 where it is not seen


@njit(cache=True, nogil=True)
def propagate_segment_frames(segments, meetings, markers, position, variances, trust, first, stop):
    """Write where joints lie, position (T, J, 3), their variances per axis (T, J), and the part of each marker's weight that
    counted (T, K), in the frames first..stop - 1."""
    count, origin = len(segments.parent), np.zeros(3)
    room = registration_statistics.RegistrationWorkspace(
        np.empty((3, 3)), np.empty((3, 3)), np.empty((4, 4)), np.empty((4, 4)), np.empty((1, 3, 3))
    )
    work = PropagationWorkspace(
        np.empty((count + 1, registration_statistics.STATISTICS_SIZE)),
        np.empty((count, registration_statistics.STATISTICS_SIZE)),
        np.empty((count + 1, registration_statistics.SEGMENT_POSE_SIZE)),
        np.empty(len(segments.weight)),
    )
    for t in range(first, stop):
        _collect_marker_statistics(segments, markers[t], work, room)
        for n in range(1, 2 * count):  # from the leaves to the root, and back
            s = abs(count - n)
            if n > count:
                _send_to_child(segments, s, origin, work, room)
            _fit_segment(segments, s, markers[t], work, room)
            if n < count:
                _send_to_parent(segments, s, origin, work, room)
        registration_statistics.copy_row(work.trust, trust[t])
        for j in range(position.shape[1]):
            variances[t, j] = _combine_joint_estimates(meetings, j, work.poses, position[t, j], room)


@njit(cache=True)
def _collect_marker_statistics(segments, seen, work, room):
    """Begin with what each segment's own markers tell, and hardly more than nothing that the whole body tells of its turn."""
    count = len(segments.parent)
    registration_statistics.clear_row(work.statistics[count])
    for s in range(count):
        registration_statistics.clear_row(work.statistics[s])
        for i in range(segments.first[s], segments.first[s + 1]):
            x, w = seen[i], segments.weight[i]
            work.trust[i] = 0.0 if math.isnan(x[0]) else 1.0
            if work.trust[i] > 0:
                registration_statistics.add_point(work.statistics[s], w, x, segments.place[i])
                registration_statistics.add_point(work.statistics[count], w, x, segments.standing_position[i])
    registration_statistics.fit_segment_pose(work.statistics[count], work.poses[count], room)
    for s in range(count):
        turn = multiply_matrices(
            registration_statistics.read_matrix(work.poses[count], registration_statistics.ROTATION_INDEX),
            load_matrix(segments.standing_rotation, s),
        )
        registration_statistics.add_rotation_information(work.statistics[s], 0.5 * STANDING_INFORMATION, turn)


@njit(cache=True)
def _fit_segment(segments, s, seen, work, room):
    """Lay a segment by what is known of it so far."""
    a, b, spare = segments.first[s], segments.first[s + 1], len(segments.parent)
    robust_registration.fit_segment_pose_robustly(
        seen[a:b], segments.place[a:b], segments.weight[a:b], work.trust[a:b], work.statistics[s], work.poses[s], room,
        (work.statistics[spare], work.poses[spare]),
    )  # fmt: skip


@njit(cache=True)
def _send_to_parent(segments, s, origin, work, room):
    """Add to what is known of the parent what this segment knows without it."""
    pose, told, mean = work.poses[s], work.told[s], load_matrix(segments.mean, s)
    registration_statistics.clear_row(told)
    registration_statistics.add_point(
        told,
        1 / registration_statistics.compute_point_variance(pose, origin, 0.0, room),
        registration_statistics.transform_point(pose, origin),
        segments.origin[s],
    )
    known = multiply_matrices(
        mean,
        multiply_matrices(
            registration_statistics.read_matrix(pose, registration_statistics.INFORMATION_INDEX), transpose_matrix(mean)
        ),
    )
    fisher = registration_statistics.propagate_rotation_information(known, load_matrix(segments.habit, s), room)
    registration_statistics.add_rotation_information(
        told,
        1.0,
        multiply_matrices(
            registration_statistics.read_matrix(pose, registration_statistics.ROTATION_INDEX),
            multiply_matrices(transpose_matrix(mean), fisher),
        ),
    )
    for n in range(registration_statistics.STATISTICS_SIZE):
        work.statistics[segments.parent[s], n] += told[n]


@njit(cache=True)
def _send_to_child(segments, s, origin, work, room):
    """Add to what is known of this segment what its parent knows without it."""
    parent, rest = segments.parent[s], len(segments.parent)
    for n in range(registration_statistics.STATISTICS_SIZE):
        work.statistics[rest, n] = work.statistics[parent, n] - work.told[s, n]
    pose, sums = work.poses[rest], work.statistics[s]
    registration_statistics.fit_segment_pose(work.statistics[rest], pose, room)
    fisher = registration_statistics.propagate_rotation_information(
        registration_statistics.read_matrix(pose, registration_statistics.INFORMATION_INDEX), load_matrix(segments.habit, s), room
    )
    registration_statistics.add_rotation_information(
        sums,
        1.0,
        multiply_matrices(
            registration_statistics.read_matrix(pose, registration_statistics.ROTATION_INDEX),
            multiply_matrices(fisher, load_matrix(segments.mean, s)),
        ),
    )
    registration_statistics.add_point(
        sums,
        1 / registration_statistics.compute_point_variance(pose, segments.origin[s], 0.0, room),
        registration_statistics.transform_point(pose, segments.origin[s]),
        origin,
    )


@njit(cache=True)
def _combine_joint_estimates(meetings, j, poses, position, room):
    """Write the mean of where the segments that meet at a joint carry it, as each is sure. -> its variance

    They have told each other what they know, so that together they know hardly more than each.
    """
    total = 0.0
    position[0], position[1], position[2] = 0.0, 0.0, 0.0
    for n in range(meetings.first[j], meetings.first[j + 1]):
        pose, p = poses[meetings.segment[n]], meetings.place[n]
        x, y, z = registration_statistics.transform_point(pose, p)
        sure = 1 / registration_statistics.compute_point_variance(pose, p, MIN_ROTATION_INFORMATION, room)
        total += sure
        position[0] += sure * x
        position[1] += sure * y
        position[2] += sure * z
    if total <= 0:
        return math.inf
    for a in range(3):
        position[a] /= total
    return (meetings.first[j + 1] - meetings.first[j]) / total
