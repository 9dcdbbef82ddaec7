"""Turning the joints down the tree, each to its own markers: a frame's first pose below its root, compiled."""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from mocapfix.kernels.rigid import crossed, means, nearest_rotation
from mocapfix.kernels.rotation import exponential, logarithm
from mocapfix.kernels.small import lone, matrix, product, put, times, transposed

MEAN_WEIGHT = 3e-3  # m^2: how much the mean pose's rotation counts beside markers (a marker counts its squared lever)


class Work(NamedTuple):
    """Room for one joint's registration, taken once for many frames."""

    cross: np.ndarray  # (3, 3)
    here: np.ndarray  # (3,)
    there: np.ndarray  # (3,)
    symmetric: np.ndarray  # (4, 4)
    vectors: np.ndarray  # (4, 4)
    target: np.ndarray  # (3, 3)


@njit(cache=True, nogil=True)
def turn_frames(parents, offsets, turning, joints, places, markers, root, local, first, stop):
    """Turn `local` (T, J, 3, 3) in place, in the frames first..stop - 1; turning (J, J): who shares whose turn."""
    count = len(parents)
    position, rotation, weight = np.empty((count, 3)), np.empty((count, 3, 3)), np.empty(len(joints))
    square, other, vector = np.empty((2, 3, 3)), np.empty((2, 4, 4)), np.zeros((2, 3))
    work = Work(square[0], vector[0], vector[1], other[0], other[1], square[1])
    for t in range(first, stop):
        for a in range(3):
            position[0, a] = root[t, a]
            for b in range(3):
                rotation[0, a, b] = local[t, 0, a, b]
        for j in range(1, count):
            _place(parents, offsets, j, local[t], position, rotation)
            if turning[j, j]:
                for k in range(len(joints)):
                    weight[k] = 1.0 if joints[k] == j and not math.isnan(markers[t, k, 0]) else 0.0
                _turned_to(markers[t], places, weight, position[j], rotation[j], work)
                _share(parents, offsets, turning[j], j, work, local[t], position, rotation)


@njit(cache=True)
def _place(parents, offsets, j, local, position, rotation):
    """Write the world place of one joint from its parent's."""
    p = parents[j]
    put(product(matrix(rotation, p), matrix(local, j)), rotation, j)
    x, y, z = times(matrix(rotation, p), offsets[j, 0], offsets[j, 1], offsets[j, 2])
    position[j, 0], position[j, 1], position[j, 2] = position[p, 0] + x, position[p, 1] + y, position[p, 2] + z


@njit(cache=True)
def _turned_to(seen, places, weight, centre, mean, work):
    """Write into work.target the world rotation of a joint at `centre`, near `mean` where its markers leave it open."""
    count = 0.0
    for k in range(len(weight)):
        count += weight[k]
    if count >= 3:  # markers enough to tell the turn without trusting the joint's place
        means(seen, places, weight, work.here, work.there)
    else:
        for a in range(3):
            work.here[a], work.there[a] = centre[a], 0.0
    crossed(seen, places, weight, work.here, work.there, work.cross)
    for a in range(3):
        for b in range(3):
            work.cross[a, b] += MEAN_WEIGHT * mean[a, b]
    nearest_rotation(work.cross, work.symmetric, work.vectors, work.target)


@njit(cache=True)
def _share(parents, offsets, chain, last, work, local, position, rotation):
    """Turn the joints of `chain` (J,) by equal parts so that the world rotation of the `last` becomes work.target."""
    first, count = last, 0
    for j in range(last, 0, -1):
        if chain[j]:
            first, count = j, count + 1
    target = lone(work.target)
    x, y, z, _ = logarithm(product(transposed(matrix(rotation, last)), target))
    part = exponential(x / count, y / count, z / count)
    for j in range(first, last + 1):
        if chain[j]:
            put(product(matrix(local, j), part), local, j)
        _place(parents, offsets, j, local, position, rotation)
    put(target, rotation, last)
    put(product(transposed(matrix(rotation, parents[last])), target), local, last)
