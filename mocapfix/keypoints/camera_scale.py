"""The scaled orthographic camera of the keypoints (MNN-IK, Eq. 5.2), and the estimation of its scale.

HybrIK-X (Eqs. 21-22) alternates: a pose for the scale, then the scale in closed form, by least squares over the image of that
pose. As a pose can lean towards the camera or away from it until it fits nearly any scale that is large enough, the alternation
converges slowly. Its fixed point, the scale that reproduces itself, is found by the secant method instead.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from mocapfix.solve.constraints import Camera

SCALE_TOLERANCE = 2e-3  # of the scale's logarithm: a smaller step ends the search
MAX_SCALE_STEP = 0.2  # of the scale's logarithm
MAX_SCALE_EVALUATIONS = 12
MIN_DAMPING_SLOPE = 0.05  # least slope of the secant method, for scales that nearly reproduce any scale
MIN_WEIGHT = 1e-300  # of a frame, by which a mean is divided


def build_camera(rotation: Float[np.ndarray, "3 3"], scale_px_m: float, origin_px: Float[np.ndarray, "2"]) -> Camera:
    """Return a scaled orthographic camera.

    rotation    world to camera: x right, y down, z ahead
    scale_px_m  pixels per metre
    origin_px   the image of the world's origin
    """
    return Camera(rotation, (0.0, 0.0, 0.0), scale_px_m, origin_px, perspective=False)


def build_camera_rotation(pitch_down_rad: float) -> Float[np.ndarray, "3 3"]:
    """Return the rotation from world to camera of a camera that faces -Z, pitched down.

    It sees the front of a person who faces +Z.
    """
    sine, cosine = np.sin(pitch_down_rad), np.cos(pitch_down_rad)
    return np.array([[1.0, 0.0, 0.0], [0.0, -cosine, sine], [0.0, -sine, -cosine]])


def fit_camera_scale(
    flat: Float[np.ndarray, "T V 2"], position_px: Float[np.ndarray, "T V 2"], weight: Float[np.ndarray, "T V"]
) -> float:
    """Return pixels per metre: Eq. 22 in closed form, one for all frames, each frame's offset free; NaN without points.

    flat  metres: the points projected to the camera's image plane
    """
    a, b = subtract_weighted_mean(flat, weight), subtract_weighted_mean(position_px, weight)
    extent = (weight[..., None] * a * a).sum()
    return float((weight[..., None] * a * b).sum() / extent) if extent > 0 else np.nan


def subtract_weighted_mean(
    points: Float[np.ndarray, "*batch V 2"], weight: Float[np.ndarray, "*batch V"]
) -> Float[np.ndarray, "*batch V 2"]:
    """Return points relative to the weighted mean of their frame."""
    total = np.maximum(weight.sum(axis=-1), MIN_WEIGHT)[..., None]
    return points - ((weight[..., None] * points).sum(axis=-2) / total)[..., None, :]


def solve_camera_scale(estimate_scale: Callable[[float], float], initial_scale: float) -> float:
    """Return the fixed point estimate_scale(scale) = scale, by the secant method on logarithms.

    estimate_scale  the scale of Eq. 22 for the poses that are solved with a scale
    """
    log_scale = np.log(initial_scale)
    error = np.log(estimate_scale(initial_scale)) - log_scale
    step = np.clip(error, -MAX_SCALE_STEP, MAX_SCALE_STEP)
    for _ in range(MAX_SCALE_EVALUATIONS - 1):
        if abs(step) < SCALE_TOLERANCE:
            break
        log_scale, previous_error = log_scale + step, error
        error = np.log(estimate_scale(float(np.exp(log_scale)))) - log_scale
        slope = (error - previous_error) / step  # -1 if the estimate does not depend on the scale, 0 if it always equals it
        step = np.clip(error / max(-slope, MIN_DAMPING_SLOPE), -MAX_SCALE_STEP, MAX_SCALE_STEP)
    return float(np.exp(log_scale + step))
