"""Rigid registration of joints to measured points, frame by frame, compiled: the root, and the joints down the tree."""

import math
from typing import NamedTuple

import numpy as np

from mocapfix.kernels.compilation import compile_inner_kernel, compile_kernel
from mocapfix.kernels.lie import compute_exponential, compute_logarithm
from mocapfix.kernels.rigid_registration import accumulate_cross_covariance, compute_nearest_rotation, compute_weighted_means
from mocapfix.kernels.small_matrices import (
    load_matrix,
    load_single_matrix,
    multiply_matrices,
    multiply_vector,
    store_matrix,
    transpose_matrix,
)

MEAN_POSE_WEIGHT_M2 = 3e-3  # weight of the mean pose's rotation beside markers (a marker counts its squared lever)
MIN_MARKERS_FOR_ROTATION = 3  # a joint with fewer markers is rotated about its own position


class RootPoints(NamedTuple):
    """The R points that determine the root, of Q that may be measured."""

    point_index: np.ndarray  # (R,) index of each among the Q points
    rest_position: np.ndarray  # (R, 3) metres, in the root's axes
    position_variance: np.ndarray  # (R,) m^2 per axis, of the point about its rest position
    first_coincident: np.ndarray  # (R,) index of the first point with the same rest position, often itself


@compile_kernel(nogil=True)
def register_root_frames(root_points, points, variance, refine, position, rotation, place_counts, first, stop):
    """Write the root's position, rotation and the number of distinct known places, in the frames first..stop - 1.

    Args:
        points: (T, Q, 3) metres, NaN where unknown; the first is the root.
        variance: (T or 1, Q) m^2 per axis.
        refine: Whether the root's own position is fitted even where it is measured.
        position: (T, 3) metres, out.
        rotation: (T, 3, 3) out.
        place_counts: (T,) out.
    """
    count = len(root_points.point_index)
    measured, weight, is_counted = np.empty((count, 3)), np.empty(count), np.empty(count, np.int64)
    mean_points, mean_rest, cross = np.empty(3), np.empty(3), np.empty((3, 3))
    symmetric, vectors = np.empty((4, 4)), np.empty((4, 4))
    for t in range(first, stop):
        frame_variance = variance[t % len(variance)]
        place_counts[t] = 0
        for i in range(count):
            is_counted[i] = 0
        for i in range(count):
            k = root_points.point_index[i]
            known = not np.isnan(points[t, k, 0] + points[t, k, 1] + points[t, k, 2])
            weight[i] = 1.0 / (frame_variance[k] + root_points.position_variance[i]) if known else 0.0
            for a in range(3):
                measured[i, a] = points[t, k, a]
            if known and is_counted[root_points.first_coincident[i]] == 0:
                is_counted[root_points.first_coincident[i]] = 1
                place_counts[t] += 1
        compute_weighted_means(measured, root_points.rest_position, weight, mean_points, mean_rest)
        accumulate_cross_covariance(measured, root_points.rest_position, weight, mean_points, mean_rest, cross)
        compute_nearest_rotation(cross, symmetric, vectors, rotation[t])
        x, y, z = multiply_vector(load_single_matrix(rotation[t]), mean_rest[0], mean_rest[1], mean_rest[2])
        position[t, 0], position[t, 1], position[t, 2] = mean_points[0] - x, mean_points[1] - y, mean_points[2] - z
        if not refine and weight[0] > 0.0:  # the root itself is measured
            for a in range(3):
                position[t, a] = points[t, 0, a]


class LimbWorkspace(NamedTuple):
    """Arrays for one joint's registration, allocated once for many frames."""

    cross: np.ndarray  # (3, 3)
    mean_points: np.ndarray  # (3,)
    mean_model: np.ndarray  # (3,)
    symmetric: np.ndarray  # (4, 4)
    vectors: np.ndarray  # (4, 4)
    target: np.ndarray  # (3, 3) the joint's world rotation


@compile_kernel(nogil=True)
def register_limb_frames(parents, offsets, shared_rotations, joints, marker_offsets, markers, root, local, first, stop):
    """Fit the joints to their markers down the tree, in the frames first..stop - 1; `local` (T, J, 3, 3) is changed in place.

    Args:
        shared_rotations: (J, J) bool: row j marks the joints that share the rotation of joint j.
        joints: (K,) each marker's joint.
        marker_offsets: (K, 3) metres, in the joints' axes.
        markers: (T, K, 3) metres, NaN where missing.
    """
    count = len(parents)
    position, rotation, weight = np.empty((count, 3)), np.empty((count, 3, 3)), np.empty(len(joints))
    square, other, vector = np.empty((2, 3, 3)), np.empty((2, 4, 4)), np.zeros((2, 3))
    work = LimbWorkspace(square[0], vector[0], vector[1], other[0], other[1], square[1])
    for t in range(first, stop):
        for a in range(3):
            position[0, a] = root[t, a]
            for b in range(3):
                rotation[0, a, b] = local[t, 0, a, b]
        for j in range(1, count):
            _compute_joint_pose(parents, offsets, j, local[t], position, rotation)
            if shared_rotations[j, j]:
                for k in range(len(joints)):
                    weight[k] = 1.0 if joints[k] == j and not math.isnan(markers[t, k, 0]) else 0.0
                _fit_joint_rotation(markers[t], marker_offsets, weight, position[j], rotation[j], work)
                _distribute_rotation(parents, offsets, shared_rotations[j], j, work, local[t], position, rotation)


@compile_inner_kernel
def _compute_joint_pose(parents, offsets, j, local, position, rotation):
    """Write the world pose of one joint from its parent's."""
    p = parents[j]
    store_matrix(multiply_matrices(load_matrix(rotation, p), load_matrix(local, j)), rotation, j)
    x, y, z = multiply_vector(load_matrix(rotation, p), offsets[j, 0], offsets[j, 1], offsets[j, 2])
    position[j, 0], position[j, 1], position[j, 2] = position[p, 0] + x, position[p, 1] + y, position[p, 2] + z


@compile_inner_kernel
def _fit_joint_rotation(markers, marker_offsets, weight, centre, mean_rotation, work):
    """Write into work.target the world rotation of a joint at `centre`; `mean_rotation` regularises it."""
    count = 0.0
    for k in range(len(weight)):
        count += weight[k]
    if count >= MIN_MARKERS_FOR_ROTATION:  # enough markers to fit the rotation without the joint's position
        compute_weighted_means(markers, marker_offsets, weight, work.mean_points, work.mean_model)
    else:
        for a in range(3):
            work.mean_points[a], work.mean_model[a] = centre[a], 0.0
    accumulate_cross_covariance(markers, marker_offsets, weight, work.mean_points, work.mean_model, work.cross)
    for a in range(3):
        for b in range(3):
            work.cross[a, b] += MEAN_POSE_WEIGHT_M2 * mean_rotation[a, b]
    compute_nearest_rotation(work.cross, work.symmetric, work.vectors, work.target)


@compile_inner_kernel
def _distribute_rotation(parents, offsets, chain, last, work, local, position, rotation):
    """Rotate the joints of `chain` (J,) by equal parts, so that the world rotation of joint `last` becomes work.target."""
    first, count = last, 0
    for j in range(last, 0, -1):
        if chain[j]:
            first, count = j, count + 1
    target = load_single_matrix(work.target)
    x, y, z, _ = compute_logarithm(multiply_matrices(transpose_matrix(load_matrix(rotation, last)), target))
    part = compute_exponential(x / count, y / count, z / count)
    for j in range(first, last + 1):
        if chain[j]:
            store_matrix(multiply_matrices(load_matrix(local, j), part), local, j)
        _compute_joint_pose(parents, offsets, j, local, position, rotation)
    store_matrix(target, rotation, last)
    store_matrix(multiply_matrices(transpose_matrix(load_matrix(rotation, parents[last])), target), local, last)
