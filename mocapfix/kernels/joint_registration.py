"""Turning the joints down the tree, each to its own markers: a frame's first pose below its root, compiled."""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

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

# MERGED: mocapfix.kernels.limbs
MEAN_POSE_WEIGHT_M2 = 3e-3  # m^2: how much the mean pose's rotation counts beside markers (a marker counts its squared lever)


class LimbWorkspace(NamedTuple):
    """Room for one joint's registration, taken once for many frames."""

    cross: np.ndarray  # (3, 3)
    here: np.ndarray  # (3,)
    there: np.ndarray  # (3,)
    symmetric: np.ndarray  # (4, 4)
    vectors: np.ndarray  # (4, 4)
    target: np.ndarray  # (3, 3)


@njit(cache=True, nogil=True)
def register_limb_frames(parents, offsets, turning, joints, places, markers, root, local, first, stop):
    """Turn `local` (T, J, 3, 3) in place, in the frames first..stop - 1; turning (J, J): who shares whose turn."""
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
            if turning[j, j]:
                for k in range(len(joints)):
                    weight[k] = 1.0 if joints[k] == j and not math.isnan(markers[t, k, 0]) else 0.0
                _fit_joint_rotation(markers[t], places, weight, position[j], rotation[j], work)
                _distribute_rotation(parents, offsets, turning[j], j, work, local[t], position, rotation)


@njit(cache=True)
def _compute_joint_pose(parents, offsets, j, local, position, rotation):
    """Write the world place of one joint from its parent's."""
    p = parents[j]
    store_matrix(multiply_matrices(load_matrix(rotation, p), load_matrix(local, j)), rotation, j)
    x, y, z = multiply_vector(load_matrix(rotation, p), offsets[j, 0], offsets[j, 1], offsets[j, 2])
    position[j, 0], position[j, 1], position[j, 2] = position[p, 0] + x, position[p, 1] + y, position[p, 2] + z


@njit(cache=True)
def _fit_joint_rotation(seen, places, weight, centre, mean, work):
    """Write into work.target the world rotation of a joint at `centre`, near `mean` where its markers leave it open."""
    count = 0.0
    for k in range(len(weight)):
        count += weight[k]
    if count >= 3:  # markers enough to tell the turn without trusting the joint's place
        compute_weighted_means(seen, places, weight, work.here, work.there)
    else:
        for a in range(3):
            work.here[a], work.there[a] = centre[a], 0.0
    accumulate_cross_covariance(seen, places, weight, work.here, work.there, work.cross)
    for a in range(3):
        for b in range(3):
            work.cross[a, b] += MEAN_POSE_WEIGHT_M2 * mean[a, b]
    compute_nearest_rotation(work.cross, work.symmetric, work.vectors, work.target)


@njit(cache=True)
def _distribute_rotation(parents, offsets, chain, last, work, local, position, rotation):
    """Turn the joints of `chain` (J,) by equal parts so that the world rotation of the `last` becomes work.target."""
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


# MERGED: mocapfix.kernels.root
# The root of a pose, frame by frame: the rigid motion that lays what it carries on where that is seen, compiled.
class RootPoints(NamedTuple):
    """R points that tell the root, of Q that may be seen."""

    point_index: np.ndarray  # (R,) which of the Q points it is
    rest_position: np.ndarray  # (R, 3) metres: where it rests in the root's axes
    position_variance: np.ndarray  # (R,) m^2 per axis: how far it may be from its place anyway
    first_coincident: np.ndarray  # (R,) the first point that rests at the same place, often itself


@njit(cache=True, nogil=True)
def register_root_frames(carried, points, variance, refine, place, turn, places, first, stop):
    """Write place, turn and the number of different known places of the frames first..stop - 1."""
    count = len(carried.point_index)
    seen, weight, counted = np.empty((count, 3)), np.empty(count), np.empty(count, np.int64)
    here, there, cross = np.empty(3), np.empty(3), np.empty((3, 3))
    symmetric, vectors = np.empty((4, 4)), np.empty((4, 4))
    for t in range(first, stop):
        var = variance[t % len(variance)]
        places[t], counted[:] = 0, 0
        for i in range(count):
            k = carried.point_index[i]
            known = not np.isnan(points[t, k, 0] + points[t, k, 1] + points[t, k, 2])
            weight[i] = 1.0 / (var[k] + carried.spread[i]) if known else 0.0
            for a in range(3):
                seen[i, a] = points[t, k, a]
            if known and counted[carried.first_coincident[i]] == 0:
                counted[carried.first_coincident[i]] = 1
                places[t] += 1
        compute_weighted_means(seen, carried.place, weight, here, there)
        accumulate_cross_covariance(seen, carried.place, weight, here, there, cross)
        compute_nearest_rotation(cross, symmetric, vectors, turn[t])
        x, y, z = multiply_vector(load_single_matrix(turn[t]), there[0], there[1], there[2])
        place[t, 0], place[t, 1], place[t, 2] = here[0] - x, here[1] - y, here[2] - z
        if not refine and weight[0] > 0.0:  # the root itself
            for a in range(3):
                place[t, a] = points[t, 0, a]
