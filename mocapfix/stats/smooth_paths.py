"""The smoothest path near samples of different certainty: a banded linear system."""

import numpy as np
from jaxtyping import Float
from scipy.linalg import solveh_banded

MAX_SAMPLE_VARIANCE = 1e4
"""Variance, in rad^2 or m^2, of a frame without information; larger values would make the system numerically singular."""
MAX_STIFFNESS_RATIO = 1e13
"""Largest stiffness of a smooth path relative to what the samples tell about a straight line: more would make the system
numerically singular, at thousands of frames a second. Such a path is straight already."""


def smooth_path(
    path: Float[np.ndarray, "T C"], variance: Float[np.ndarray, " T"], acceleration_power: Float[np.ndarray, " T"], rate: float
) -> Float[np.ndarray, "T C"]:
    """Return the x that minimises sum |x_t - path_t|^2 / variance_t + integral |x''|^2 / power.

    variance            per component
    acceleration_power  in squared units of the path / s^3
    """
    frames = len(path)
    if frames < 3:
        return path
    stiffness = rate**3 / acceleration_power[1:-1]  # of the second difference about each inner frame
    band = np.zeros((3, frames))
    information = 1 / np.minimum(variance, MAX_SAMPLE_VARIANCE)
    stiffness = np.minimum(stiffness, MAX_STIFFNESS_RATIO * _compute_line_information(information))
    band[2] = information
    for shift, coefficient in ((0, 1.0), (1, 4.0), (2, 1.0)):
        band[2, shift : shift + frames - 2] += coefficient * stiffness
    band[1, 1 : frames - 1] -= 2 * stiffness
    band[1, 2:] -= 2 * stiffness
    band[0, 2:] += stiffness
    return np.ascontiguousarray(solveh_banded(band, path * information[:, None], overwrite_ab=True, check_finite=False))


def _compute_line_information(information: Float[np.ndarray, " T"]) -> float:
    """Return the least information that the frames give about a straight line of unit length, which stiffness leaves free."""
    lines = np.linalg.qr(np.vander(np.linspace(-1, 1, len(information)), 2))[0]
    return float(np.linalg.eigvalsh(lines.T @ (information[:, None] * lines))[0])
