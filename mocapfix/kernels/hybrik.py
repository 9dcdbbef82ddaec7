"""HybrIK's recursion down the tree, frame by frame: every joint's turn in closed form from the places beyond it, compiled.

What a joint turns is a set of points: its children, whose mean gives the swing, and all that lies off that axis, which tells
the twist: markers that ride on it, and joints beyond a child that does not turn. A point may be unseen.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from mocapfix.kernels.small import matrix, product, put, times, transposed
from mocapfix.kernels.twist_swing import between, dot, plus, square_root, swing, told, twist

NAIVE, ADAPTIVE, X = 0, 1, 2  # HybrIK, Algorithms 1 and 2; HybrIK-X, 3.2.3
SHORT = 0.01  # metres: so near to a joint, markers that ride on it do not tell where it points


class Bones(NamedTuple):
    """A skeleton of J joints with the P points that each joint turns, joint after joint; Q points in all may be seen."""

    parents: np.ndarray  # (J,)
    offsets: np.ndarray  # (J, 3) metres
    turns: np.ndarray  # (J,) bool: whether the joint is turned; else it stays as it is given
    first: np.ndarray  # (J + 1,) where each joint's points begin, and the end
    source: np.ndarray  # (P,) which of the Q points seen it is; the first J are the joints
    place: np.ndarray  # (P, 3) metres: where it rests in the joint's axes
    child: np.ndarray  # (P,) bool: a child, which gives the swing
    tells: np.ndarray  # (P,) bool: off the bone's axis, so that it tells the twist
    spread: np.ndarray  # (P,) m^2 per axis: how far it may be from its place anyway
    ahead: np.ndarray  # (J,) the conflict joint two bones on, which HybrIK-X reaches exactly; -1 for none


class Seen(NamedTuple):
    """Where the points are; one row of `variance` or `twists` may serve all frames."""

    points: np.ndarray  # (T, Q, 3) metres, a number of it NaN where unknown
    variance: np.ndarray  # (T or 1, Q) m^2 per axis
    twists: np.ndarray  # (T or 1, J, 2) 1/rad^2: cosine and sine of each joint's twist, as long as they are sure


@njit(cache=True, nogil=True)
def recur_frames(bones, way, seen, root, local, missed, first, stop):
    """Turn `local` (T, J, 3, 3), whose roots are right, in place, in the frames first..stop - 1.

    missed (T,): by how many metres the worst end that HybrIK-X should reach is out of reach; less than 0: too near
    """
    joints = len(bones.parents)
    position, rotation = np.empty((joints, 3)), np.empty((joints, 3, 3))
    for t in range(first, stop):
        points, variance = seen.points[t], seen.variance[t % len(seen.variance)]
        twists = seen.twists[t % len(seen.twists)]
        missed[t] = 0.0
        for j in range(joints):
            _place(bones, j, root[t], local[t], position, rotation)
            if bones.turns[j]:
                miss = _turn(bones, way, j, points, variance, twists, local[t], position, rotation)
                if abs(miss) > abs(missed[t]):
                    missed[t] = miss


@njit(cache=True)
def _place(bones, j, root, local, position, rotation):
    """Write the world place of one joint from its parent's."""
    p = bones.parents[j]
    if p < 0:
        position[j, 0], position[j, 1], position[j, 2] = root[0], root[1], root[2]
        put(matrix(local, j), rotation, j)
    else:
        carried = times(matrix(rotation, p), bones.offsets[j, 0], bones.offsets[j, 1], bones.offsets[j, 2])
        position[j, 0], position[j, 1], position[j, 2] = plus(_row(position, p), 1.0, carried)
        put(product(matrix(rotation, p), matrix(local, j)), rotation, j)


@njit(cache=True)
def _turn(bones, way, j, points, variance, twists, local, position, rotation):
    """Turn one joint towards its points. -> by how much a conflict joint is missed, metres"""
    parent = transposed(matrix(rotation, bones.parents[j]))
    here = _row(position, j)
    origin = _row(points, j) if way == NAIVE and _known(points, j) else here
    place, there, weight, missed = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0, 0.0
    for i in range(bones.first[j], bones.first[j + 1]):
        if bones.child[i]:
            known, target, miss = _target(bones, way, j, bones.source[i], points, variance, here, rotation)
            if known:
                w = 1.0 / (variance[bones.source[i]] + bones.spread[i])
                place, there = plus(place, w, _row(bones.place, i)), plus(there, w, plus(target, -1.0, origin))
                weight, missed = weight + w, miss if abs(miss) > abs(missed) else missed
    if dot(place, place) <= (SHORT * weight) ** 2:  # nothing is known, or its middle is the joint itself
        return 0.0
    swung = swing(place, times(parent, there[0], there[1], there[2]))
    back = product(transposed(swung), parent)
    cosine, sine = twists[j, 0], twists[j, 1]
    for i in range(bones.first[j], bones.first[j + 1]):
        k = bones.source[i]
        if bones.tells[i] and _known(points, k):
            off = plus(_row(points, k), -1.0, origin if bones.child[i] else here)
            c, s = told(place, _row(bones.place, i), times(back, off[0], off[1], off[2]))
            w = 1.0 / (variance[k] + bones.spread[i])
            cosine, sine = cosine + w * c, sine + w * s
    if cosine == 0.0 and sine == 0.0:  # as much says one turn as the opposite
        cosine = 1.0
    put(product(swung, twist(place, cosine, sine)), local, j)
    put(product(matrix(rotation, bones.parents[j]), matrix(local, j)), rotation, j)
    return missed


@njit(cache=True)
def _target(bones, way, j, child, points, variance, here, rotation):
    """-> whether it is known where a child should be; that; and by how much the conflict joint beyond it is missed."""
    end, target = bones.ahead[j], _row(points, child)
    if way != X or end < 0 or bones.parents[end] != child or not _known(points, end):
        return _known(points, child), target, 0.0
    if not _known(points, child):  # where the joint as it is given would put it
        rest = times(matrix(rotation, j), bones.offsets[child, 0], bones.offsets[child, 1], bones.offsets[child, 2])
        target = plus(here, 1.0, rest)
    upper, lower = _length(bones.offsets, child), _length(bones.offsets, end)
    met, missed = between(here, target, _subtree_root(bones, end, points, variance), upper, lower)
    return True, met, missed


@njit(cache=True)
def _subtree_root(bones, j, points, variance):
    """-> where the sub-tree that hangs on a conflict joint puts it.

    The joint and its children are one rigid rod: what they are too far or too near to one another, each takes its share of.
    """
    place, there, weight = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0
    for i in range(bones.first[j], bones.first[j + 1]):
        k = bones.source[i]
        if bones.child[i] and _known(points, k):
            w = 1.0 / (variance[k] + bones.spread[i])
            place, there = plus(place, w, _row(bones.place, i)), plus(there, w, plus(_row(points, k), -1.0, _row(points, j)))
            weight += w
    apart = square_root(dot(there, there))
    if apart == 0.0:
        return _row(points, j)
    share = 1.0 / (weight + 1.0 / variance[j])  # times `weight`, by which `there` still is to be divided
    return plus(_row(points, j), share * (1.0 - square_root(dot(place, place)) / apart), there)


@njit(cache=True)
def _known(points, k):
    return not math.isnan(points[k, 0] + points[k, 1] + points[k, 2])


@njit(cache=True)
def _row(m, j):
    return m[j, 0], m[j, 1], m[j, 2]


@njit(cache=True)
def _length(m, j):
    return square_root(dot(_row(m, j), _row(m, j)))
