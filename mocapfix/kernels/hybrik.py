"""HybrIK's recursion down the tree, frame by frame: every joint's rotation in closed form from the points beyond it, compiled.

A joint rotates a set of points: its children, whose mean determines the swing, and all points off that axis, which determine the
twist: markers on the segment, and joints beyond a child that does not rotate. A point may be unknown.
"""

import math
from typing import NamedTuple

import numpy as np

from mocapfix.kernels.compilation_cache import compile_inner_kernel, compile_kernel
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

HYBRIK_NAIVE = 0  # HybrIK, Algorithm 1
HYBRIK_ADAPTIVE = 1  # HybrIK, Algorithm 2
HYBRIK_X = 2  # HybrIK-X, 3.2.3
MIN_LEVER_M = 0.01  # mean distance of a joint's points from it; below it they do not determine its direction


class HybrikSkeleton(NamedTuple):
    """A skeleton of J joints with the P points that each joint rotates, joint after joint; Q points may be measured."""

    parents: np.ndarray  # (J,)
    offsets: np.ndarray  # (J, 3) metres, in the parent's axes
    is_solved: np.ndarray  # (J,) bool: whether the joint's rotation is solved; else it stays as given
    first_point: np.ndarray  # (J + 1,) index of each joint's first point, and the end
    point_index: np.ndarray  # (P,) index among the Q measured points, of which the first J are the joints
    rest_position: np.ndarray  # (P, 3) metres, in the joint's axes
    is_child: np.ndarray  # (P,) bool: a child, which determines the swing
    constrains_twist: np.ndarray  # (P,) bool: off the bone's axis
    position_variance: np.ndarray  # (P,) m^2 per axis, of the point about its rest position
    conflict_joint: np.ndarray  # (J,) the joint two bones on which HybrIK-X reaches exactly; -1 for none


class HybrikObservations(NamedTuple):
    """Measured points; one row of `variance` or `twists` may serve all frames."""

    points: np.ndarray  # (T, Q, 3) metres, one number or more NaN where unknown
    variance: np.ndarray  # (T or 1, Q) m^2 per axis
    twists: np.ndarray  # (T or 1, J, 2) cosine and sine of each joint's twist, times its information (1/rad^2)


@compile_kernel(nogil=True)
def solve_hybrik_frames(skeleton, variant, observations, root, local, reach_error, first, stop):
    """Solve `local` (T, J, 3, 3), whose roots are given, in place, in the frames first..stop - 1.

    variant      HYBRIK_NAIVE, HYBRIK_ADAPTIVE or HYBRIK_X
    root         (T, 3) metres
    reach_error  (T,) metres, out: of the conflict joints the largest distance out of reach; negative: too near
    """
    joints = len(skeleton.parents)
    position, rotation = np.empty((joints, 3)), np.empty((joints, 3, 3))
    for t in range(first, stop):
        points, variance = observations.points[t], observations.variance[t % len(observations.variance)]
        twists = observations.twists[t % len(observations.twists)]
        reach_error[t] = 0.0
        for j in range(joints):
            _compute_world_pose(skeleton, j, root[t], local[t], position, rotation)
            if skeleton.is_solved[j]:
                error = _solve_joint(skeleton, variant, j, points, variance, twists, local[t], position, rotation)
                if abs(error) > abs(reach_error[t]):
                    reach_error[t] = error


@compile_inner_kernel
def _compute_world_pose(skeleton, j, root, local, position, rotation):
    """Write the world pose of one joint from its parent's."""
    p = skeleton.parents[j]
    if p < 0:
        position[j, 0], position[j, 1], position[j, 2] = root[0], root[1], root[2]
        store_matrix(load_matrix(local, j), rotation, j)
    else:
        offset = skeleton.offsets[j]
        rotated = multiply_vector(load_matrix(rotation, p), offset[0], offset[1], offset[2])
        position[j, 0], position[j, 1], position[j, 2] = add_scaled(_read_vector(position, p), 1.0, rotated)
        store_matrix(multiply_matrices(load_matrix(rotation, p), load_matrix(local, j)), rotation, j)


@compile_inner_kernel
def _solve_joint(skeleton, variant, j, points, variance, twists, local, position, rotation):
    """Rotate one joint towards its points. Returns the reach error of its conflict joint, metres."""
    parent_rotation = load_matrix(rotation, skeleton.parents[j])
    to_parent = transpose_matrix(parent_rotation)
    here = _read_vector(position, j)
    origin = _read_vector(points, j) if variant == HYBRIK_NAIVE and _is_known(points, j) else here
    rest, measured, weight, reach_error = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0, 0.0
    for i in range(skeleton.first_point[j], skeleton.first_point[j + 1]):
        if skeleton.is_child[i]:
            k = skeleton.point_index[i]
            known, target, error = _compute_child_target(skeleton, variant, j, k, points, variance, here, rotation)
            if known:
                w = 1.0 / (variance[k] + skeleton.position_variance[i])
                rest = add_scaled(rest, w, _read_vector(skeleton.rest_position, i))
                measured = add_scaled(measured, w, add_scaled(target, -1.0, origin))
                weight, reach_error = weight + w, error if abs(error) > abs(reach_error) else reach_error
    if compute_dot(rest, rest) <= (MIN_LEVER_M * weight) ** 2:  # nothing is known, or the points' mean is the joint itself
        return 0.0
    swing = compute_swing(rest, multiply_vector(to_parent, measured[0], measured[1], measured[2]))
    to_swung = multiply_matrices(transpose_matrix(swing), to_parent)
    cosine, sine = twists[j, 0], twists[j, 1]
    for i in range(skeleton.first_point[j], skeleton.first_point[j + 1]):
        k = skeleton.point_index[i]
        if skeleton.constrains_twist[i] and _is_known(points, k):
            d = add_scaled(_read_vector(points, k), -1.0, origin if skeleton.is_child[i] else here)
            d = multiply_vector(to_swung, d[0], d[1], d[2])
            c, s = compute_twist_evidence(rest, _read_vector(skeleton.rest_position, i), d)
            w = 1.0 / (variance[k] + skeleton.position_variance[i])
            cosine, sine = cosine + w * c, sine + w * s
    if cosine == 0.0 and sine == 0.0:  # no evidence, or equal evidence for opposite angles
        cosine = 1.0
    store_matrix(multiply_matrices(swing, compute_twist(rest, cosine, sine)), local, j)
    store_matrix(multiply_matrices(parent_rotation, load_matrix(local, j)), rotation, j)
    return reach_error


@compile_inner_kernel
def _compute_child_target(skeleton, variant, j, child, points, variance, here, rotation):
    """Return whether a child's target is known, the target, and the reach error of the conflict joint beyond it."""
    end, target = skeleton.conflict_joint[j], _read_vector(points, child)
    if variant != HYBRIK_X or end < 0 or skeleton.parents[end] != child or not _is_known(points, end):
        return _is_known(points, child), target, 0.0
    if not _is_known(points, child):  # its position with the joint's given rotation
        offset = skeleton.offsets[child]
        target = add_scaled(here, 1.0, multiply_vector(load_matrix(rotation, j), offset[0], offset[1], offset[2]))
    upper, lower = _compute_length(skeleton.offsets, child), _compute_length(skeleton.offsets, end)
    end_target = _compute_subtree_root(skeleton, end, points, variance)
    middle, error = solve_two_bone_joint(here, target, end_target, upper, lower)
    return True, middle, error


@compile_inner_kernel
def _compute_subtree_root(skeleton, j, points, variance):
    """Return the position of a conflict joint according to the sub-tree that hangs on it.

    The joint and its children form one rigid rod; the error of its length is distributed over both ends by their weights.
    """
    rest, measured, weight = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0
    for i in range(skeleton.first_point[j], skeleton.first_point[j + 1]):
        k = skeleton.point_index[i]
        if skeleton.is_child[i] and _is_known(points, k):
            w = 1.0 / (variance[k] + skeleton.position_variance[i])
            rest = add_scaled(rest, w, _read_vector(skeleton.rest_position, i))
            measured = add_scaled(measured, w, add_scaled(_read_vector(points, k), -1.0, _read_vector(points, j)))
            weight += w
    length = compute_square_root(compute_dot(measured, measured))
    if length == 0.0:
        return _read_vector(points, j)
    share = 1.0 / (weight + 1.0 / variance[j])  # times `weight`, by which `measured` has yet to be divided
    return add_scaled(_read_vector(points, j), share * (1.0 - compute_square_root(compute_dot(rest, rest)) / length), measured)


@compile_inner_kernel
def _is_known(points, k):
    return not math.isnan(points[k, 0] + points[k, 1] + points[k, 2])


@compile_inner_kernel
def _read_vector(m, j):
    return m[j, 0], m[j, 1], m[j, 2]


@compile_inner_kernel
def _compute_length(m, j):
    return compute_square_root(compute_dot(_read_vector(m, j), _read_vector(m, j)))
