"""A whole figure lost for a while: every segment's turn in the world, and the root's place, go on from both edges.

In the world, for there the parts of a body are steadier than in one another's axes: what the pelvis does the legs undo. Each
goes its smoothest way, by a Gaussian process in time alone (Matern-5/2) about an unknown middle; what that misses at other
times between like edges (see `between`) it is given.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.animation import carried
from mocapfix.kernels.process import matern
from mocapfix.solve import between
from mocapfix.solve.unshifted import continuous

SMOOTH, NOISE = 0.45, 1e-4  # seconds over which a course goes on as it does; variance of a sample, of the course's power
ANYWHERE = 100.0  # variance of a course's middle, likewise
BESIDE = 0.6  # seconds on either side that are learnt from


def beside(sound: np.ndarray, first: int, last: int, rate: float) -> np.ndarray:
    """-> the `sound` (T,) frames near first..last."""
    frames = round(BESIDE * rate)
    near = np.r_[max(0, first - frames) : first, last + 1 : min(len(sound), last + 1 + frames)]
    return near[sound[near]]


def weights(frames: np.ndarray, first: int, last: int, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """-> by how much each of N known frames counts (n, N) for a course over first..last, and what they leave open (n,), in units
    of the course's power."""
    gap = np.arange(first, last + 1)
    among = ANYWHERE + matern((frames[:, None] - frames) / rate, SMOOTH) + NOISE * np.eye(len(frames))
    between = ANYWHERE + matern((gap[:, None] - frames) / rate, SMOOTH)
    counts = np.linalg.solve(among, between.T).T
    return counts, np.maximum(ANYWHERE + 1 - (counts * between).sum(1), NOISE)


def course(known: np.ndarray, frames: np.ndarray, first: int, last: int, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """-> a course (n, C) over first..last, known (N, C) in some frames (N,), and its variance (n,) per number."""
    counts, left = weights(frames, first, last, rate)
    among = ANYWHERE + matern((frames[:, None] - frames) / rate, SMOOTH) + NOISE * np.eye(len(frames))
    power = float((known * np.linalg.solve(among, known)).sum() / known.size)
    return counts @ known, left * power


def turn(rotations: np.ndarray, frames: np.ndarray, first: int, last: int, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """-> rotations (n, 3, 3) over first..last of one that is known (N, 3, 3) in some frames, and the variance (n,), rad^2."""
    known = 2 * continuous(Rotation.from_matrix(rotations).as_quat())
    expected, variance = course(known, frames, first, last, rate)
    return Rotation.from_quat(expected).as_matrix(), variance * 4 / 3


def figure(
    parents: np.ndarray, root: np.ndarray, local: np.ndarray, sound: np.ndarray, first: int, last: int, rate: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """-> the root's places (n, 3) and the local rotations (n, J, 3, 3) over first..last, and the variances (n,), m^2, and (n, J),
    rad^2 per axis.

    root (T, 3) metres, local (T, J, 3, 3); sound (T,): frames in which the whole figure is known
    """
    near = beside(sound, first, last, rate)
    turned = carried(parents, np.zeros((*local.shape[:2], 3)), local)[1]
    place, of_place = course(root[near], near, first, last, rate)
    found, variance = np.empty((last - first + 1, *local.shape[1:])), np.empty((last - first + 1, local.shape[1]))
    for j in range(local.shape[1]):
        found[:, j], variance[:, j] = turn(turned[near, j], near, first, last, rate)
    counts = weights(near, first, last, rate)[0]
    if told := between.missed(root, local, turned, sound, counts, near, first, last, rate):
        turns, places, left = told
        found = found @ Rotation.from_rotvec(turns.reshape(-1, 3)).as_matrix().reshape(found.shape)
        place = place + places @ between.heading(turned[first - 1, 0]).T
        of_place, variance = of_place * left, variance * left
    inner = parents >= 0
    found[:, inner] = np.swapaxes(found[:, parents[inner]], -1, -2) @ found[:, inner]
    return place, found, of_place, variance
