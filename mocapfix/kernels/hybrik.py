"""HybrIK's recursion down the tree, frame by frame: every joint's turn in closed form from the places beyond it, compiled.

What a joint turns is a set of points: its children, whose mean gives the swing, and all that lies off that axis, which tells
the twist: markers that ride on it, and joints beyond a child that does not turn. A point may be unseen.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from mocapfix.kernels.small_matrices import load_matrix, multiply_matrices, multiply_vector, store_matrix, transpose_matrix
from mocapfix.kernels.swing_twist import (
    add_scaled,
    compute_dot,
    compute_square_root,
    compute_swing,
    compute_twist,
    compute_twist_evidence,
    solve_two_bone_joint,
)

HYBRIK_NAIVE, HYBRIK_ADAPTIVE, HYBRIK_X = 0, 1, 2  # HybrIK, Algorithms 1 and 2; HybrIK-X, 3.2.3
MIN_LEVER_M = 0.01  # metres: so near to a joint, markers that ride on it do not tell where it points


class HybrikSkeleton(NamedTuple):
    """A skeleton of J joints with the P points that each joint turns, joint after joint; Q points in all may be seen."""

    parents: np.ndarray  # (J,)
    offsets: np.ndarray  # (J, 3) metres
    is_solved: np.ndarray  # (J,) bool: whether the joint is turned; else it stays as it is given
    first_point: np.ndarray  # (J + 1,) where each joint's points begin, and the end
    point_index: np.ndarray  # (P,) which of the Q points seen it is; the first J are the joints
    rest_position: np.ndarray  # (P, 3) metres: where it rests in the joint's axes
    is_child: np.ndarray  # (P,) bool: a child, which gives the swing
    constrains_twist: np.ndarray  # (P,) bool: off the bone's axis, so that it tells the twist
    position_variance: np.ndarray  # (P,) m^2 per axis: how far it may be from its place anyway
    conflict_joint: np.ndarray  # (J,) the conflict joint two bones on, which HybrIK-X reaches exactly; -1 for none


class HybrikObservations(NamedTuple):
    """Where the points are; one row of `variance` or `twists` may serve all frames."""

    points: np.ndarray  # (T, Q, 3) metres, a number of it NaN where unknown
    variance: np.ndarray  # (T or 1, Q) m^2 per axis
    twists: np.ndarray  # (T or 1, J, 2) 1/rad^2: cosine and sine of each joint's twist, as long as they are sure


@njit(cache=True, nogil=True)
def solve_hybrik_frames(bones, way, seen, root, local, missed, first, stop):
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
            _compute_world_pose(bones, j, root[t], local[t], position, rotation)
            if bones.is_solved[j]:
                miss = _solve_joint(bones, way, j, points, variance, twists, local[t], position, rotation)
                if abs(miss) > abs(missed[t]):
                    missed[t] = miss


@njit(cache=True)
def _compute_world_pose(bones, j, root, local, position, rotation):
    """Write the world place of one joint from its parent's."""
    p = bones.parents[j]
    if p < 0:
        position[j, 0], position[j, 1], position[j, 2] = root[0], root[1], root[2]
        store_matrix(load_matrix(local, j), rotation, j)
    else:
        carried = multiply_vector(load_matrix(rotation, p), bones.offsets[j, 0], bones.offsets[j, 1], bones.offsets[j, 2])
        position[j, 0], position[j, 1], position[j, 2] = add_scaled(_read_vector(position, p), 1.0, carried)
        store_matrix(multiply_matrices(load_matrix(rotation, p), load_matrix(local, j)), rotation, j)


@njit(cache=True)
def _solve_joint(bones, way, j, points, variance, twists, local, position, rotation):
    """Turn one joint towards its points. -> by how much a conflict joint is missed, metres"""
    parent = transpose_matrix(load_matrix(rotation, bones.parents[j]))
    here = _read_vector(position, j)
    origin = _read_vector(points, j) if way == HYBRIK_NAIVE and _is_known(points, j) else here
    place, there, weight, missed = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0, 0.0
    for i in range(bones.first[j], bones.first[j + 1]):
        if bones.child[i]:
            known, target, miss = _compute_child_target(bones, way, j, bones.point_index[i], points, variance, here, rotation)
            if known:
                w = 1.0 / (variance[bones.point_index[i]] + bones.spread[i])
                place, there = (
                    add_scaled(place, w, _read_vector(bones.rest_position, i)),
                    add_scaled(there, w, add_scaled(target, -1.0, origin)),
                )
                weight, missed = weight + w, miss if abs(miss) > abs(missed) else missed
    if compute_dot(place, place) <= (MIN_LEVER_M * weight) ** 2:  # nothing is known, or its middle is the joint itself
        return 0.0
    swung = compute_swing(place, multiply_vector(parent, there[0], there[1], there[2]))
    back = multiply_matrices(transpose_matrix(swung), parent)
    cosine, sine = twists[j, 0], twists[j, 1]
    for i in range(bones.first[j], bones.first[j + 1]):
        k = bones.point_index[i]
        if bones.constrains_twist[i] and _is_known(points, k):
            off = add_scaled(_read_vector(points, k), -1.0, origin if bones.child[i] else here)
            c, s = compute_twist_evidence(
                place, _read_vector(bones.rest_position, i), multiply_vector(back, off[0], off[1], off[2])
            )
            w = 1.0 / (variance[k] + bones.spread[i])
            cosine, sine = cosine + w * c, sine + w * s
    if cosine == 0.0 and sine == 0.0:  # as much says one turn as the opposite
        cosine = 1.0
    store_matrix(multiply_matrices(swung, compute_twist(place, cosine, sine)), local, j)
    store_matrix(multiply_matrices(load_matrix(rotation, bones.parents[j]), load_matrix(local, j)), rotation, j)
    return missed


@njit(cache=True)
def _compute_child_target(bones, way, j, child, points, variance, here, rotation):
    """-> whether it is known where a child should be; that; and by how much the conflict joint beyond it is missed."""
    end, target = bones.conflict_joint[j], _read_vector(points, child)
    if way != HYBRIK_X or end < 0 or bones.parents[end] != child or not _is_known(points, end):
        return _is_known(points, child), target, 0.0
    if not _is_known(points, child):  # where the joint as it is given would put it
        rest = multiply_vector(
            load_matrix(rotation, j), bones.offsets[child, 0], bones.offsets[child, 1], bones.offsets[child, 2]
        )
        target = add_scaled(here, 1.0, rest)
    upper, lower = _compute_length(bones.offsets, child), _compute_length(bones.offsets, end)
    met, missed = solve_two_bone_joint(here, target, _compute_subtree_root(bones, end, points, variance), upper, lower)
    return True, met, missed


@njit(cache=True)
def _compute_subtree_root(bones, j, points, variance):
    """-> where the sub-tree that hangs on a conflict joint puts it.

    The joint and its children are one rigid rod: what they are too far or too near to one another, each takes its share of.
    """
    place, there, weight = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0
    for i in range(bones.first[j], bones.first[j + 1]):
        k = bones.point_index[i]
        if bones.child[i] and _is_known(points, k):
            w = 1.0 / (variance[k] + bones.spread[i])
            place, there = (
                add_scaled(place, w, _read_vector(bones.rest_position, i)),
                add_scaled(there, w, add_scaled(_read_vector(points, k), -1.0, _read_vector(points, j))),
            )
            weight += w
    apart = compute_square_root(compute_dot(there, there))
    if apart == 0.0:
        return _read_vector(points, j)
    share = 1.0 / (weight + 1.0 / variance[j])  # times `weight`, by which `there` still is to be divided
    return add_scaled(_read_vector(points, j), share * (1.0 - compute_square_root(compute_dot(place, place)) / apart), there)


@njit(cache=True)
def _is_known(points, k):
    return not math.isnan(points[k, 0] + points[k, 1] + points[k, 2])


@njit(cache=True)
def _read_vector(m, j):
    return m[j, 0], m[j, 1], m[j, 2]


@njit(cache=True)
def _compute_length(m, j):
    return compute_square_root(compute_dot(_read_vector(m, j), _read_vector(m, j)))
