"""The root of a pose, frame by frame: the rigid motion that lays what it carries on where that is seen, compiled."""

from typing import NamedTuple

import numpy as np
from numba import njit

from mocapfix.kernels.rigid import crossed, means, nearest_rotation
from mocapfix.kernels.small import lone, times


class Carried(NamedTuple):
    """R points that tell the root, of Q that may be seen."""

    source: np.ndarray  # (R,) which of the Q points it is
    place: np.ndarray  # (R, 3) metres: where it rests in the root's axes
    spread: np.ndarray  # (R,) m^2 per axis: how far it may be from its place anyway
    twin: np.ndarray  # (R,) the first point that rests at the same place, often itself


@njit(cache=True, nogil=True)
def register_frames(carried, points, variance, refine, place, turn, places, first, stop):
    """Write place, turn and the number of different known places of the frames first..stop - 1."""
    count = len(carried.source)
    seen, weight, counted = np.empty((count, 3)), np.empty(count), np.empty(count, np.int64)
    here, there, cross = np.empty(3), np.empty(3), np.empty((3, 3))
    symmetric, vectors = np.empty((4, 4)), np.empty((4, 4))
    for t in range(first, stop):
        var = variance[t % len(variance)]
        places[t], counted[:] = 0, 0
        for i in range(count):
            k = carried.source[i]
            known = not np.isnan(points[t, k, 0] + points[t, k, 1] + points[t, k, 2])
            weight[i] = 1.0 / (var[k] + carried.spread[i]) if known else 0.0
            for a in range(3):
                seen[i, a] = points[t, k, a]
            if known and counted[carried.twin[i]] == 0:
                counted[carried.twin[i]] = 1
                places[t] += 1
        means(seen, carried.place, weight, here, there)
        crossed(seen, carried.place, weight, here, there, cross)
        nearest_rotation(cross, symmetric, vectors, turn[t])
        x, y, z = times(lone(turn[t]), there[0], there[1], there[2])
        place[t, 0], place[t, 1], place[t, 2] = here[0] - x, here[1] - y, here[2] - z
        if not refine and weight[0] > 0.0:  # the root itself
            for a in range(3):
                place[t, a] = points[t, 0, a]
