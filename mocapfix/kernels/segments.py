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

from mocapfix.kernels import moments, outvoted
from mocapfix.kernels.small import matrix, product, transposed

HINT = 1e-3  # 1/rad^2: how surely a segment is turned as in the mean pose, where nothing else tells
ANYHOW = 1.0  # 1/rad^2: so well a turn is known of which nothing tells, for it cannot be wrong by more than half a turn


class Segments(NamedTuple):
    """S segments, parents before children, the root first; the K markers in the order of their segments,
    as the frames must have them, too."""

    parent: np.ndarray  # (S,)
    origin: np.ndarray  # (S, 3) metres: each one's joint in its parent's axes
    mean: np.ndarray  # (S, 3, 3) its axes in its parent's, in the mean pose
    habit: np.ndarray  # (S, 3, 3) 1/rad^2, in its parent's axes: how surely they keep to that
    first: np.ndarray  # (S + 1,) where the markers of each begin
    place: np.ndarray  # (K, 3) metres, in the segment's axes
    weight: np.ndarray  # (K,) 1/m^2
    stance: np.ndarray  # (S, 3, 3) the segments' axes in the mean pose, standing
    standing: np.ndarray  # (K, 3) metres: the markers there


class Meetings(NamedTuple):
    """Which segments meet at each of J joints, so that they carry it."""

    first: np.ndarray  # (J + 1,) where those of each begin
    segment: np.ndarray  # (N,)
    place: np.ndarray  # (N, 3) metres: the joint in that segment's axes


class Work(NamedTuple):
    """Room for one frame, taken once for many. The last row of sums and poses is a segment without what a child told."""

    sums: np.ndarray  # (S + 1, MOMENTS) what is known of each segment so far
    told: np.ndarray  # (S, MOMENTS) what each told its parent
    poses: np.ndarray  # (S + 1, POSE)
    trust: np.ndarray  # (K,) the part of each marker's weight that counts; 0 where it is not seen


@njit(cache=True, nogil=True)
def lay_frames(segments, meetings, markers, position, variances, trust, first, stop):
    """Write where joints lie, position (T, J, 3), their variances per axis (T, J), and the part of each marker's weight that
    counted (T, K), in the frames first..stop - 1."""
    count, origin = len(segments.parent), np.zeros(3)
    room = moments.Room(np.empty((3, 3)), np.empty((3, 3)), np.empty((4, 4)), np.empty((4, 4)), np.empty((1, 3, 3)))
    work = Work(
        np.empty((count + 1, moments.MOMENTS)),
        np.empty((count, moments.MOMENTS)),
        np.empty((count + 1, moments.POSE)),
        np.empty(len(segments.weight)),
    )
    for t in range(first, stop):
        _gather(segments, markers[t], work, room)
        for n in range(1, 2 * count):  # from the leaves to the root, and back
            s = abs(count - n)
            if n > count:
                _tell_child(segments, s, origin, work, room)
            _lay(segments, s, markers[t], work, room)
            if n < count:
                _tell_parent(segments, s, origin, work, room)
        moments.copy(work.trust, trust[t])
        for j in range(position.shape[1]):
            variances[t, j] = _met(meetings, j, work.poses, position[t, j], room)


@njit(cache=True)
def _gather(segments, seen, work, room):
    """Begin with what each segment's own markers tell, and hardly more than nothing that the whole body tells of its turn."""
    count = len(segments.parent)
    moments.clear(work.sums[count])
    for s in range(count):
        moments.clear(work.sums[s])
        for i in range(segments.first[s], segments.first[s + 1]):
            x, w = seen[i], segments.weight[i]
            work.trust[i] = 0.0 if math.isnan(x[0]) else 1.0
            if work.trust[i] > 0:
                moments.add_point(work.sums[s], w, x, segments.place[i])
                moments.add_point(work.sums[count], w, x, segments.standing[i])
    moments.lay(work.sums[count], work.poses[count], room)
    for s in range(count):
        turn = product(moments.nine(work.poses[count], moments.TURN), matrix(segments.stance, s))
        moments.add_turn(work.sums[s], 0.5 * HINT, turn)


@njit(cache=True)
def _lay(segments, s, seen, work, room):
    """Lay a segment by what is known of it so far."""
    a, b, spare = segments.first[s], segments.first[s + 1], len(segments.parent)
    outvoted.lay(
        seen[a:b], segments.place[a:b], segments.weight[a:b], work.trust[a:b], work.sums[s], work.poses[s], room,
        (work.sums[spare], work.poses[spare]),
    )  # fmt: skip


@njit(cache=True)
def _tell_parent(segments, s, origin, work, room):
    """Add to what is known of the parent what this segment knows without it."""
    pose, told, mean = work.poses[s], work.told[s], matrix(segments.mean, s)
    moments.clear(told)
    moments.add_point(told, 1 / moments.variance(pose, origin, 0.0, room), moments.carried(pose, origin), segments.origin[s])
    known = product(mean, product(moments.nine(pose, moments.INFORMATION), transposed(mean)))
    fisher = moments.through(known, matrix(segments.habit, s), room)
    moments.add_turn(told, 1.0, product(moments.nine(pose, moments.TURN), product(transposed(mean), fisher)))
    for n in range(moments.MOMENTS):
        work.sums[segments.parent[s], n] += told[n]


@njit(cache=True)
def _tell_child(segments, s, origin, work, room):
    """Add to what is known of this segment what its parent knows without it."""
    parent, rest = segments.parent[s], len(segments.parent)
    for n in range(moments.MOMENTS):
        work.sums[rest, n] = work.sums[parent, n] - work.told[s, n]
    pose, sums = work.poses[rest], work.sums[s]
    moments.lay(work.sums[rest], pose, room)
    fisher = moments.through(moments.nine(pose, moments.INFORMATION), matrix(segments.habit, s), room)
    moments.add_turn(sums, 1.0, product(moments.nine(pose, moments.TURN), product(fisher, matrix(segments.mean, s))))
    moments.add_point(
        sums, 1 / moments.variance(pose, segments.origin[s], 0.0, room), moments.carried(pose, segments.origin[s]), origin
    )


@njit(cache=True)
def _met(meetings, j, poses, position, room):
    """Write the mean of where the segments that meet at a joint carry it, as each is sure. -> its variance

    They have told each other what they know, so that together they know hardly more than each.
    """
    total = 0.0
    position[0], position[1], position[2] = 0.0, 0.0, 0.0
    for n in range(meetings.first[j], meetings.first[j + 1]):
        pose, p = poses[meetings.segment[n]], meetings.place[n]
        x, y, z = moments.carried(pose, p)
        sure = 1 / moments.variance(pose, p, ANYHOW, room)
        total += sure
        position[0] += sure * x
        position[1] += sure * y
        position[2] += sure * z
    if total <= 0:
        return math.inf
    for a in range(3):
        position[a] /= total
    return (meetings.first[j + 1] - meetings.first[j]) / total
