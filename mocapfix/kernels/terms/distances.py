"""Distances between two points of the body, on one segment or on two: hands that hold a stick, a marker pair's spacing."""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from mocapfix.kernels.small import matrix, times
from mocapfix.kernels.terms.contract import adds, of_frame

TOUCHING = 1e-9  # metres: nearer points have no direction from one to the other


class Distances(NamedTuple):
    """Residual: (distance between the points - length) / standard deviation; each a row on top of the sweep."""

    joints: np.ndarray  # (D, 2) whose bodies carry the points
    places: np.ndarray  # (D, 2, 3) metres, in the joints' axes
    length: np.ndarray  # (1 or T, D) metres
    weight: np.ndarray  # (1 or T, D) 1 / m^2; 0 for none


@njit(cache=True)
def carried(term, k, e, pose):
    """-> where end e of distance k lies from the origin, the root's place."""
    j, place, position = term.joints[k, e], term.places[k, e], pose.position
    x, y, z = times(matrix(pose.rotation, j), place[0], place[1], place[2])
    return x + position[j, 0] - position[0, 0], y + position[j, 1] - position[0, 1], z + position[j, 2] - position[0, 2]


@adds(Distances)
def add(term, t, scale2, tree, pose, system):
    """Write one row for each distance. -> cost"""
    length, weight, cost = of_frame(term.length, t), of_frame(term.weight, t), 0.0
    for k in range(len(term.joints)):
        m = system.written[0]
        system.written[0] += 1
        if weight[k] == 0.0:
            continue
        ends = (carried(term, k, 0, pose), carried(term, k, 1, pose))
        ux, uy, uz = ends[1][0] - ends[0][0], ends[1][1] - ends[0][1], ends[1][2] - ends[0][2]
        distance = math.sqrt(ux * ux + uy * uy + uz * uz)
        root = math.sqrt(weight[k])
        system.away[m] = root * (distance - length[k])
        cost += 0.5 * system.away[m] ** 2
        scale = root / max(distance, TOUCHING)
        for e in range(2):
            ux, uy, uz = -ux, -uy, -uz  # the first end pulls back, the second ahead
            row, j = system.rows[m], term.joints[k, e]
            x, y, z = ends[e]
            row[j, 0] += scale * (y * uz - z * uy)
            row[j, 1] += scale * (z * ux - x * uz)
            row[j, 2] += scale * (x * uy - y * ux)
            row[j, 3] += scale * ux
            row[j, 4] += scale * uy
            row[j, 5] += scale * uz
    return cost
