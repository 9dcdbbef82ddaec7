"""Measured points of the body: in space (markers on a joint's segment, or joints themselves, offset zero), or in camera images.

Images are SCOPE's first loss (Eq. 5), and MNN-IK's 2-D application (Eq. 5.2).

Measured directions of bones, and measured orientations of bodies.
"""

from typing import NamedTuple

import numpy as np

from mocapfix.kernels.lie import compute_left_jacobian_inverse, compute_logarithm
from mocapfix.kernels.small_matrices import load_matrix, multiply_matrices, multiply_vector, transpose_matrix
from mocapfix.kernels.terms.contract import GEMAN_MCCLURE, compute_robust_loss, register_term

MAX_POINT_DISTANCE_M = 1e6  # from the body; samples farther away, infinite or NaN are ignored


class PointTerm(NamedTuple):
    """Residual: (position of the point - measured) / standard deviation, three numbers, robust together."""

    joints: np.ndarray  # (K,)
    offsets: np.ndarray  # (K, 3) metres, in the joint's axes
    measured: np.ndarray  # (T, K, 3) metres, in the world; anything where the weight is 0
    weight: np.ndarray  # (T, K) 1 / m^2; 0 for a missing sample
    loss: int = GEMAN_MCCLURE


@register_term(PointTerm)
def add_point_term(term, t, scale2, tree, pose, equations):
    """Add the points to the curvature and gradient of their bodies' twists. Returns the cost."""
    h, g, position, rotation, measured = equations.h, equations.g, pose.position, pose.rotation, term.measured
    ox, oy, oz = position[0, 0], position[0, 1], position[0, 2]
    cost = 0.0
    for k in range(len(term.joints)):
        precision = term.weight[t, k]
        if precision == 0.0:
            continue
        j = term.joints[k]
        a, b, c = term.offsets[k, 0], term.offsets[k, 1], term.offsets[k, 2]
        x = position[j, 0] + rotation[j, 0, 0] * a + rotation[j, 0, 1] * b + rotation[j, 0, 2] * c
        y = position[j, 1] + rotation[j, 1, 0] * a + rotation[j, 1, 1] * b + rotation[j, 1, 2] * c
        z = position[j, 2] + rotation[j, 2, 0] * a + rotation[j, 2, 1] * b + rotation[j, 2, 2] * c
        ex, ey, ez = x - measured[t, k, 0], y - measured[t, k, 1], z - measured[t, k, 2]
        square = ex * ex + ey * ey + ez * ez
        if not square < MAX_POINT_DISTANCE_M * MAX_POINT_DISTANCE_M:
            continue
        loss, weight = compute_robust_loss(term.loss, precision * square, scale2)
        cost += loss
        w = precision * weight
        x, y, z = x - ox, y - oy, z - oz
        wx, wy, wz = w * x, w * y, w * z
        h[j, 0, 0] += wy * y + wz * z
        h[j, 1, 0] -= wx * y
        h[j, 1, 1] += wx * x + wz * z
        h[j, 2, 0] -= wx * z
        h[j, 2, 1] -= wy * z
        h[j, 2, 2] += wx * x + wy * y
        h[j, 3, 1] += wz
        h[j, 3, 2] -= wy
        h[j, 4, 0] -= wz
        h[j, 4, 2] += wx
        h[j, 5, 0] += wy
        h[j, 5, 1] -= wx
        h[j, 3, 3] += w
        h[j, 4, 4] += w
        h[j, 5, 5] += w
        g[j, 0] += wy * ez - wz * ey
        g[j, 1] += wz * ex - wx * ez
        g[j, 2] += wx * ey - wy * ex
        g[j, 3] += w * ex
        g[j, 4] += w * ey
        g[j, 5] += w * ez
    return cost


MIN_CAMERA_DEPTH_M = 0.01  # in front of a perspective camera; points nearer than this, or behind it, are ignored


class ReprojectionTerm(NamedTuple):
    """Residual: (image of the point - measured) / standard deviation, two numbers, robust together.

    A camera's axes are x to the right, y down, z ahead. A perspective camera measures (x, y) / z: the tangents of the angles, so
    radians near the axis. A scaled orthographic camera measures (x, y), in metres. `normalise_pixels` converts pixels to these.
    """

    joints: np.ndarray  # (V,)
    offsets: np.ndarray  # (V, 3) metres, in the joint's axes
    cameras: np.ndarray  # (V,) index of the camera
    rotation: np.ndarray  # (C, 3, 3) world to camera
    translation: np.ndarray  # (C, 3) metres: camera = rotation @ world + translation
    perspective: np.ndarray  # (C,) bool
    measured: np.ndarray  # (T, V, 2); anything where the weight is 0
    weight: np.ndarray  # (T, V) 1 / rad^2, or 1 / m^2 for an orthographic camera; 0 for a missing sample
    loss: int = GEMAN_MCCLURE


def normalise_pixels(pixels: np.ndarray, scale: float | np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Return the measurements (..., 2) of a `ReprojectionTerm` for pixels (..., 2).

    Args:
        scale: Focal length in pixels, one or (fx, fy); of a scaled orthographic camera: pixels per metre.
        centre: (2,) the principal point, in pixels.
    """
    return np.ascontiguousarray((pixels - centre) / scale)


@register_term(ReprojectionTerm)
def add_reprojection_term(term, t, scale2, tree, pose, equations):
    """Add the images to the curvature and gradient of their bodies' twists. Returns the cost."""
    h, g, cost, position = equations.h, equations.g, 0.0, pose.position
    for k in range(len(term.joints)):
        precision = term.weight[t, k]
        if precision == 0.0:
            continue
        j, camera = term.joints[k], term.cameras[k]
        offset = term.offsets[k]
        x, y, z = multiply_vector(load_matrix(pose.rotation, j), offset[0], offset[1], offset[2])
        x, y, z = x + position[j, 0], y + position[j, 1], z + position[j, 2]
        m = load_matrix(term.rotation, camera)
        u, v, depth = multiply_vector(m, x, y, z)
        u, v, depth = u + term.translation[camera, 0], v + term.translation[camera, 1], depth + term.translation[camera, 2]
        du, dv = (m[0], m[1], m[2]), (m[3], m[4], m[5])
        if term.perspective[camera]:
            if not depth > MIN_CAMERA_DEPTH_M:
                continue
            u, v = u / depth, v / depth
            du = ((m[0] - u * m[6]) / depth, (m[1] - u * m[7]) / depth, (m[2] - u * m[8]) / depth)
            dv = ((m[3] - v * m[6]) / depth, (m[4] - v * m[7]) / depth, (m[5] - v * m[8]) / depth)
        eu, ev = u - term.measured[t, k, 0], v - term.measured[t, k, 1]
        if not eu * eu + ev * ev < np.inf:
            continue
        loss, weight = compute_robust_loss(term.loss, precision * (eu * eu + ev * ev), scale2)
        cost += loss
        w = precision * weight
        x, y, z = x - position[0, 0], y - position[0, 1], z - position[0, 2]
        u_row = (y * du[2] - z * du[1], z * du[0] - x * du[2], x * du[1] - y * du[0], du[0], du[1], du[2])
        v_row = (y * dv[2] - z * dv[1], z * dv[0] - x * dv[2], x * dv[1] - y * dv[0], dv[0], dv[1], dv[2])
        for a in range(6):
            g[j, a] += w * (u_row[a] * eu + v_row[a] * ev)
            for b in range(a + 1):
                h[j, a, b] += w * (u_row[a] * u_row[b] + v_row[a] * v_row[b])
    return cost


class DirectionTerm(NamedTuple):
    """Residual: (direction of the bone - measured) / standard deviation, both unit vectors, so in radians while small.

    SCOPE's part orientation field (Eq. 5).
    """

    joints: np.ndarray  # (D,) the joint whose body the bone belongs to
    bone_axes: np.ndarray  # (D, 3) unit vector along the bone, in its joint's axes
    measured: np.ndarray  # (T, D, 3) unit vector, in the world; anything where the weight is 0
    weight: np.ndarray  # (T, D) 1 / rad^2; 0 for a missing sample
    loss: int = GEMAN_MCCLURE


@register_term(DirectionTerm)
def add_direction_term(term, t, scale2, tree, pose, equations):
    """Add the directions to the curvature and gradient of their bodies' rotations. Returns the cost."""
    h, g, cost = equations.h, equations.g, 0.0
    for k in range(len(term.joints)):
        precision = term.weight[t, k]
        if precision == 0.0:
            continue
        j = term.joints[k]
        axis = term.bone_axes[k]
        x, y, z = multiply_vector(load_matrix(pose.rotation, j), axis[0], axis[1], axis[2])
        mx, my, mz = term.measured[t, k, 0], term.measured[t, k, 1], term.measured[t, k, 2]
        square = (x - mx) ** 2 + (y - my) ** 2 + (z - mz) ** 2
        if not square < np.inf:
            continue
        loss, weight = compute_robust_loss(term.loss, precision * square, scale2)
        cost += loss
        w = precision * weight
        h[j, 0, 0] += w * (y * y + z * z)
        h[j, 1, 0] -= w * x * y
        h[j, 1, 1] += w * (x * x + z * z)
        h[j, 2, 0] -= w * x * z
        h[j, 2, 1] -= w * y * z
        h[j, 2, 2] += w * (x * x + y * y)
        g[j, 0] -= w * (y * mz - z * my)  # d x (d - measured) = -d x measured
        g[j, 1] -= w * (z * mx - x * mz)
        g[j, 2] -= w * (x * my - y * mx)
    return cost


class OrientationTerm(NamedTuple):
    """Residual: the rotation vector from the measured orientation to the body's, over its standard deviation.

    Orientations are measured by an inertial sensor or a rigid cluster of markers.
    """

    joints: np.ndarray  # (O,)
    measured: np.ndarray  # (T, O, 3, 3) rotations, in the world; anything where the weight is 0
    weight: np.ndarray  # (T, O) 1 / rad^2; 0 for a missing sample
    loss: int = GEMAN_MCCLURE


@register_term(OrientationTerm)
def add_orientation_term(term, t, scale2, tree, pose, equations):
    """Add the orientations to the curvature and gradient of their bodies' rotations. Returns the cost."""
    h, g, measured, cost = equations.h, equations.g, term.measured[t], 0.0
    for k in range(len(term.joints)):
        precision = term.weight[t, k]
        if precision == 0.0:
            continue
        j = term.joints[k]
        error = multiply_matrices(load_matrix(pose.rotation, j), transpose_matrix(load_matrix(measured, k)))
        x, y, z, c = compute_logarithm(error)
        square = x * x + y * y + z * z
        if not square < np.inf:
            continue
        loss, weight = compute_robust_loss(term.loss, precision * square, scale2)
        cost += loss
        w = precision * weight
        jacobian = compute_left_jacobian_inverse(x, y, z, c)
        curvature = multiply_matrices(transpose_matrix(jacobian), jacobian)
        for a in range(3):
            for b in range(a + 1):
                h[j, a, b] += w * curvature[3 * a + b]
        g[j, 0] += w * x  # the logarithm's derivative maps its own vector to itself
        g[j, 1] += w * y
        g[j, 2] += w * z
    return cost
