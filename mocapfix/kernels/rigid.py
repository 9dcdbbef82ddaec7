"""The rigid motion that lays one cloud of points on another, frame by frame: weighted sums and the rotation they ask for."""

import math

import numpy as np
from numba import njit

from mocapfix.kernels.rotation import of_quaternion
from mocapfix.kernels.small import put

SWEEPS = 10  # of Jacobi's method at most: it converges quadratically, in four or five
NOTHING = 1e-32  # squared share of an off-diagonal entry that is rounding


def centred(seen: np.ndarray, places: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """-> cross (T, 3, 3) of points (T, K, 3) against places (K, 3) about their weighted means (T, 3), and these means.

    weight  (T, K); a point of weight 0 may be NaN
    """
    frames = len(seen)
    cross, here, there = np.empty((frames, 3, 3)), np.empty((frames, 3)), np.empty((frames, 3))
    _centred(_plain(seen), _plain(places), _plain(weight), cross, here, there)
    return cross, here, there


def fitted(cross: np.ndarray) -> np.ndarray:
    """-> the rotations (T, 3, 3) that maximise trace(R' cross), never a reflection.

    cross  (T, 3, 3) sums of outer products, measured by model
    """
    turn = np.empty(cross.shape)
    _fitted(_plain(cross), turn)
    return turn


def inside(points: np.ndarray, centre: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """-> points (T, K, 3) in the axes (T, 3, 3) that have their origin at `centre` (T, 3); NaN stays NaN."""
    placed = np.empty(points.shape)
    _inside(_plain(points), _plain(centre), _plain(turn), placed)
    return placed


def _plain(array: np.ndarray) -> np.ndarray:
    """-> the array as the kernels want it, so that each is compiled once."""
    return np.ascontiguousarray(array, float)


@njit(cache=True)
def means(seen, places, weight, here, there):
    """One frame: write the weighted means (3,) of points `seen` (K, 3) and of their `places` (K, 3)."""
    total = 1e-12
    for a in range(3):
        here[a], there[a] = 0.0, 0.0
    for k in range(len(weight)):
        if weight[k] > 0:
            total += weight[k]
            for a in range(3):
                here[a] += weight[k] * seen[k, a]
                there[a] += weight[k] * places[k, a]
    for a in range(3):
        here[a] /= total
        there[a] /= total


@njit(cache=True)
def crossed(seen, places, weight, here, there, cross):
    """One frame: write the weighted sum (3, 3) of the outer products of seen - here by places - there."""
    for a in range(3):
        for b in range(3):
            cross[a, b] = 0.0
    for k in range(len(weight)):
        if weight[k] > 0:
            for a in range(3):
                lever = weight[k] * (seen[k, a] - here[a])
                for b in range(3):
                    cross[a, b] += lever * (places[k, b] - there[b])


@njit(cache=True)
def nearest_rotation(cross, m, vectors, out):
    """Write into `out` (3, 3) the rotation that maximises trace(out' cross).

    It is the one whose quaternion is the eigenvector of a symmetric 4 x 4 matrix with the largest eigenvalue (Horn 1987,
    "Closed-form solution of absolute orientation using unit quaternions"), so that it is a rotation whatever the cloud.
    `m` and `vectors` (4, 4) are written over.
    """
    xx, yy, zz = cross[0, 0], cross[1, 1], cross[2, 2]
    m[0, 0], m[1, 1], m[2, 2], m[3, 3] = xx + yy + zz, xx - yy - zz, yy - xx - zz, zz - xx - yy
    m[0, 1], m[0, 2], m[0, 3] = cross[2, 1] - cross[1, 2], cross[0, 2] - cross[2, 0], cross[1, 0] - cross[0, 1]
    m[1, 2], m[1, 3], m[2, 3] = cross[0, 1] + cross[1, 0], cross[2, 0] + cross[0, 2], cross[1, 2] + cross[2, 1]
    for i in range(4):
        for j in range(4):
            vectors[i, j] = 1.0 if i == j else 0.0
    for _ in range(SWEEPS):
        done = True
        for i in range(3):
            for j in range(i + 1, 4):
                if m[i, j] ** 2 > NOTHING * (m[i, i] ** 2 + m[j, j] ** 2):
                    _annihilate(m, vectors, i, j)
                    done = False
        if done:
            break
    best = 0
    for i in range(1, 4):
        if m[i, i] > m[best, best]:
            best = i
    q = vectors[best]  # w first
    put(of_quaternion(q[1], q[2], q[3], q[0]), out.reshape((1, 3, 3)), 0)


@njit(cache=True)
def _annihilate(m, vectors, i, j):
    """Turn the axes i < j so that m[i, j] becomes 0; only the upper triangle of `m` is kept, eigenvectors are rows."""
    half = (m[j, j] - m[i, i]) / (2 * m[i, j])
    tangent = math.copysign(1.0, half) / (abs(half) + math.sqrt(half * half + 1))
    c = 1 / math.sqrt(tangent * tangent + 1)
    s = tangent * c
    m[i, i] -= tangent * m[i, j]
    m[j, j] += tangent * m[i, j]
    m[i, j] = 0.0
    for k in range(4):
        if k != i and k != j:
            a, b = (min(i, k), max(i, k)), (min(j, k), max(j, k))
            m[a], m[b] = c * m[a] - s * m[b], s * m[a] + c * m[b]
        vectors[i, k], vectors[j, k] = c * vectors[i, k] - s * vectors[j, k], s * vectors[i, k] + c * vectors[j, k]


@njit(cache=True)
def _centred(seen, places, weight, cross, here, there):
    for t in range(len(seen)):
        means(seen[t], places, weight[t], here[t], there[t])
        crossed(seen[t], places, weight[t], here[t], there[t], cross[t])


@njit(cache=True)
def _fitted(cross, turn):
    m, vectors = np.empty((4, 4)), np.empty((4, 4))
    for t in range(len(cross)):
        nearest_rotation(cross[t], m, vectors, turn[t])


@njit(cache=True)
def _inside(points, centre, turn, placed):
    for t in range(len(points)):
        for k in range(points.shape[1]):
            for a in range(3):
                total = 0.0
                for b in range(3):
                    total += (points[t, k, b] - centre[t, b]) * turn[t, b, a]
                placed[t, k, a] = total
