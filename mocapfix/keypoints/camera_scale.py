"""The camera that saw the keypoints: scaled orthographic (MNN-IK, Eq. 5.2), its scale estimated as HybrIK-X does.

HybrIK-X (Eqs. 21-22) takes turns: a pose for the scale, then the scale in closed form, by least squares over the image of
that pose. A pose can lean towards the camera or away from it until it fits nearly any scale that is large enough, so that
taking turns creeps; what it creeps to, the scale that answers itself, is the same, and is found by the secant method.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

SCALE_TOLERANCE = 2e-3  # of a scale: nearer to its own answer it need not come
MAX_SCALE_STEP = 0.2  # of a scale, that one step goes at most
MAX_SCALE_EVALUATIONS = 12  # times at most that a scale is asked for its answer


@dataclass(frozen=True)
class KeypointCamera:
    """pixels = offset + scale * (the first two of rotation @ world): Eq. 5.2, with axes as an image's, y down.

    rotation  (3, 3) world to camera: x right, y down, z ahead
    scale     pixels per metre
    offset    (2,) pixels: the image of the world's origin
    """

    rotation: np.ndarray
    scale_px_m: float
    offset_px: np.ndarray

    def project(self, positions: np.ndarray) -> np.ndarray:
        """-> (..., 2) pixels, of places (..., 3) in metres."""
        return self.offset_px + self.scale_px_m * (positions @ self.rotation[:2].T)


def build_camera_rotation(pitch_down_rad: float) -> np.ndarray:
    """-> (3, 3) world to camera, of one that looks along -Z of the world and `down` radians down: whom it sees faces +Z."""
    sine, cosine = np.sin(pitch_down_rad), np.cos(pitch_down_rad)
    return np.array([[1.0, 0.0, 0.0], [0.0, -cosine, sine], [0.0, -sine, -cosine]])


def fit_camera_scale(flat: np.ndarray, pixels: np.ndarray, weight: np.ndarray) -> float:
    """-> pixels per metre: Eq. 22 in closed form, one for all frames, each frame's offset free.

    flat    (T, V, 2) metres: the points as the camera's axes see them
    pixels  (T, V, 2)
    weight  (T, V) how much each counts
    """
    a, b = subtract_weighted_mean(flat, weight), subtract_weighted_mean(pixels, weight)
    extent = (weight[..., None] * a * a).sum()
    return float((weight[..., None] * a * b).sum() / extent) if extent > 0 else np.nan


def subtract_weighted_mean(points: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """-> (..., V, 2) points from the weighted mean of their frame."""
    total = np.maximum(weight.sum(axis=-1), 1e-300)[..., None]
    return points - ((weight[..., None] * points).sum(axis=-2) / total)[..., None, :]


def solve_camera_scale(answer: Callable[[float], float], scale: float) -> float:
    """-> the scale that answers itself: answer(scale) = scale, by the secant method on logarithms.

    answer  the scale of Eq. 22 for the poses that a scale gives
    """
    here = np.log(scale)
    there = np.log(answer(scale)) - here
    step = np.clip(there, -MAX_SCALE_STEP, MAX_SCALE_STEP)
    for _ in range(MAX_SCALE_EVALUATIONS - 1):
        if abs(step) < SCALE_TOLERANCE:
            break
        here, before = here + step, there
        there = np.log(answer(float(np.exp(here)))) - here
        slope = (there - before) / step  # -1 where the answer does not depend on what was asked, 0 where it only echoes
        step = np.clip(there / max(-slope, 0.05), -MAX_SCALE_STEP, MAX_SCALE_STEP)
    return float(np.exp(here + step))
