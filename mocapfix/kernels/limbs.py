"""Turning the joints down the tree, each to its own markers: a frame's first pose below its root, compiled."""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from mocapfix.kernels.rigid import crossed, means, nearest_rotation
from mocapfix.kernels.rotation import exponential, logarithm, multiply

MEAN_WEIGHT = 3e-3  # m^2: how much the mean pose's rotation counts beside markers (a marker counts its squared lever)


class Work(NamedTuple):
    """Room for one joint's registration, taken once for many frames."""

    cross: np.ndarray  # (3, 3)
    here: np.ndarray  # (3,)
    there: np.ndarray  # (3,)
    symmetric: np.ndarray  # (4, 4)
    vectors: np.ndarray  # (4, 4)
    target: np.ndarray  # (3, 3)
    step: np.ndarray  # (3, 3)
    part: np.ndarray  # (3, 3)


@njit(cache=True, nogil=True)
def turn_frames(parents, offsets, turning, joints, places, markers, root, local, first, stop):
    """Turn `local` (T, J, 3, 3) in place, in the frames first..stop - 1; turning (J, J): who shares whose turn."""
    count = len(parents)
    position, rotation, weight = np.empty((count, 3)), np.empty((count, 3, 3)), np.empty(len(joints))
    square, other, vector = np.empty((4, 3, 3)), np.empty((2, 4, 4)), np.zeros((2, 3))
    work = Work(square[0], vector[0], vector[1], other[0], other[1], square[1], square[2], square[3])
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
    multiply(rotation[p], local[j], rotation[j])
    for a in range(3):
        position[j, a] = position[p, a]
        for b in range(3):
            position[j, a] += rotation[p, a, b] * offsets[j, b]


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
    _unturned(rotation[last], work.target, work.step)
    logarithm(work.step, work.here)
    exponential(work.here[0] / count, work.here[1] / count, work.here[2] / count, work.part)
    for j in range(first, last + 1):
        if chain[j]:
            multiply(local[j], work.part, work.step)
            _copy(work.step, local[j])
        _place(parents, offsets, j, local, position, rotation)
    _copy(work.target, rotation[last])
    _unturned(rotation[parents[last]], work.target, local[last])


@njit(cache=True)
def _unturned(a, b, out):
    """Write a' @ b (3, 3) into `out`, which is neither of them."""
    for i in range(3):
        for j in range(3):
            out[i, j] = a[0, i] * b[0, j] + a[1, i] * b[1, j] + a[2, i] * b[2, j]


@njit(cache=True)
def _copy(a, out):
    for i in range(3):
        for j in range(3):
            out[i, j] = a[i, j]
