"""One frame with everything SCOPE measures on a body: 3-D keypoints, 2-D keypoints, part orientations, and shape parameters.

SCOPE (section 3.3, Eqs. 1-7): keypoint n is carried by a joint at places_n + sum_p beta_p growth_pn, in the joint's axes, and
a joint lies in its parent's axes at offsets_j + sum_p beta_p growth_pj. Here beta = 0, about which all is linearised.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from mocapfix.kernels.kinematics import forward
from mocapfix.kernels.levenberg import Pull, Tree

POINT, PROJECTION, ORIENTATION = 0, 1, 2
ROWS = (3, 2, 3)  # numbers that each measures


class Measured(NamedTuple):
    """The measurements of one kind."""

    joints: np.ndarray  # (N,) that carry them
    places: np.ndarray  # (N, 3) metres, in the joint's axes
    growth: np.ndarray  # (P, N, 3) metres for a unit of each shape parameter
    targets: np.ndarray  # (N, 3): a place in metres; x/z, y/z and 0 before the camera; a unit vector
    weight: np.ndarray  # (N,) 1/m^2 or 1: the inverse variance


class Scene(NamedTuple):
    """A body in a pose and what is measured of it."""

    tree: Tree
    growth: np.ndarray  # (P, J, 3) metres: how the offsets change with the shape parameters
    points: Measured
    projections: Measured
    orientations: Measured
    eye: np.ndarray  # (3,) metres: the camera; it looks along the world's +z, its focal length being 1
    pull: Pull  # of one frame
    local: np.ndarray  # (J, 3, 3)
    position: np.ndarray  # (J, 3) metres, in the world
    rotation: np.ndarray  # (J, 3, 3) in the world


def posed(tree: Tree, growth, points, projections, orientations, eye, pull: Pull, root, local) -> Scene:
    """-> the scene, the body's joints where the pose root (3,), local (J, 3, 3) puts them."""
    position, rotation = np.empty((len(local), 3)), np.empty(local.shape)
    forward(tree.parents, tree.offsets, root, local, position, rotation)
    return Scene(tree, growth, points, projections, orientations, eye, pull, local, position, rotation)


@njit(cache=True)
def stretched(scene, stretch):
    """Write how every joint moves in the world (P, J, 3) with each shape parameter."""
    for p in range(len(stretch)):
        for a in range(3):
            stretch[p, 0, a] = 0.0
        for j in range(1, len(scene.local)):
            up, by = scene.tree.parents[j], scene.growth[p, j]
            r = scene.rotation[up]
            for a in range(3):
                stretch[p, j, a] = stretch[p, up, a] + r[a, 0] * by[0] + r[a, 1] * by[1] + r[a, 2] * by[2]


@njit(cache=True)
def rows(scene, kind, measured, n, stretch, by_place, by_twist, by_shape, residual):
    """Linearise one measurement, everything over its standard deviation. -> how many rows it has

    by_place  (3, 3) workspace: the derivative to where the keypoint (for an orientation: its unit vector) is
    by_twist  (3, 6) out: to its body's turn and shift, about the root's place
    by_shape  (3, P) out
    residual  (3,) out
    """
    j, place, target, w = measured.joints[n], measured.places[n], measured.targets[n], np.sqrt(measured.weight[n])
    r, origin = scene.rotation[j], scene.position[0]
    x = r[0, 0] * place[0] + r[0, 1] * place[1] + r[0, 2] * place[2]
    y = r[1, 0] * place[0] + r[1, 1] * place[1] + r[1, 2] * place[2]
    z = r[2, 0] * place[0] + r[2, 1] * place[1] + r[2, 2] * place[2]
    by_place.fill(0)
    count, shifts = 3, 1.0
    if kind == ORIENTATION:
        length, shifts = np.sqrt(x * x + y * y + z * z), 0.0
        x, y, z = x / length, y / length, z / length
        residual[0], residual[1], residual[2] = w * (x - target[0]), w * (y - target[1]), w * (z - target[2])
        by_place[0, 0], by_place[1, 1], by_place[2, 2] = w, w, w
    else:
        x, y, z = x + scene.position[j, 0], y + scene.position[j, 1], z + scene.position[j, 2]
        if kind == POINT:
            residual[0], residual[1], residual[2] = w * (x - target[0]), w * (y - target[1]), w * (z - target[2])
            by_place[0, 0], by_place[1, 1], by_place[2, 2] = w, w, w
        else:
            count = 2
            u, v, depth = x - scene.eye[0], y - scene.eye[1], z - scene.eye[2]
            residual[0], residual[1] = w * (u / depth - target[0]), w * (v / depth - target[1])
            by_place[0, 0], by_place[0, 2] = w / depth, -w * u / depth**2
            by_place[1, 1], by_place[1, 2] = w / depth, -w * v / depth**2
        x, y, z = x - origin[0], y - origin[1], z - origin[2]
    for a in range(count):
        dx, dy, dz = by_place[a]
        by_twist[a, 0], by_twist[a, 1], by_twist[a, 2] = y * dz - z * dy, z * dx - x * dz, x * dy - y * dx
        by_twist[a, 3], by_twist[a, 4], by_twist[a, 5] = shifts * dx, shifts * dy, shifts * dz
    for p in range(len(stretch)):
        grown = measured.growth[p, n]
        gx = r[0, 0] * grown[0] + r[0, 1] * grown[1] + r[0, 2] * grown[2]
        gy = r[1, 0] * grown[0] + r[1, 1] * grown[1] + r[1, 2] * grown[2]
        gz = r[2, 0] * grown[0] + r[2, 1] * grown[1] + r[2, 2] * grown[2]
        if kind == ORIENTATION:  # what lengthens the part does not turn it
            along = x * gx + y * gy + z * gz
            gx, gy, gz = (gx - along * x) / length, (gy - along * y) / length, (gz - along * z) / length
        else:
            gx, gy, gz = gx + stretch[p, j, 0], gy + stretch[p, j, 1], gz + stretch[p, j, 2]
        for a in range(count):
            by_shape[a, p] = by_place[a, 0] * gx + by_place[a, 1] * gy + by_place[a, 2] * gz
    return count
