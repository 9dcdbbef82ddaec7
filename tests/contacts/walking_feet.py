"""Paths of feet whose contacts are known: they do not move while they stand, and swing along an arc between two places."""

from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

Stance = tuple[float, float, tuple[float, float, float]]
"""first and last second, and the place in metres"""
ANKLE_ABOVE_TOE_M = 0.05
FOOT_LENGTH_M = 0.14
FIRST_STANCE_S = 0.5


def make_path(stances: list[Stance], seconds: float, rate: float, lift_m: float = 0.12) -> np.ndarray:
    """Return the path (T, 3) of a point that stands at places and is lifted between them."""
    time_s = np.arange(round(seconds * rate)) / rate
    path = np.tile(np.array(stances[0][2], float), (len(time_s), 1))
    for (_, leave, here), (arrive, _, there) in pairwise(stances):
        share = np.clip((time_s - leave) / (arrive - leave), 0, 1)
        is_after = time_s > leave
        smooth = share**3 * (10 - 15 * share + 6 * share**2)
        swing = np.array(here) + smooth[:, None] * (np.array(there) - np.array(here))
        swing[:, 1] += lift_m * np.sin(np.pi * share)
        path[is_after] = swing[is_after]
    return path


def find_true_stances(stances: list[Stance], seconds: float, rate: float) -> np.ndarray:
    """Return the frames (T,) in which such a point stands."""
    time_s = np.arange(round(seconds * rate)) / rate
    is_standing = np.zeros(len(time_s), bool)
    for first, last, _ in stances:
        is_standing |= (time_s >= first) & (time_s <= last)
    return is_standing


def walk(step_height_m: float = 0.0, stance_s: float = 0.7, swing_s: float = 0.4, steps: int = 4) -> tuple[list[Stance], ...]:
    """Return the stances of the toes of the left and the right foot of a person who walks along Z, each foot in turn."""
    cycle_s = stance_s + swing_s
    feet: list[list[Stance]] = []
    for side in (0, 1):
        start_s = FIRST_STANCE_S + 0.5 * cycle_s * side
        feet.append(
            [
                (
                    0.0 if k == 0 else start_s + k * cycle_s - stance_s,
                    start_s + k * cycle_s if k < steps - 1 else np.inf,
                    (0.1 - 0.2 * side, 0.025 + step_height_m * (2 * k + side), 0.35 * (2 * k + side)),
                )
                for k in range(steps)
            ]
        )
    return tuple(feet)


def make_feet(stances: tuple[list[Stance], ...], seconds: float, rate: float) -> np.ndarray:
    """Return the paths (T, 4, 3) of left ankle, left toes, right ankle and right toes."""
    to_ankle = np.array([0.0, ANKLE_ABOVE_TOE_M, -np.sqrt(FOOT_LENGTH_M**2 - ANKLE_ABOVE_TOE_M**2)])
    toes = [make_path(foot, seconds, rate) for foot in stances]
    return np.stack([toes[0] + to_ankle, toes[0], toes[1] + to_ankle, toes[1]], axis=1)


def tilt(position: np.ndarray, degrees: float) -> np.ndarray:
    """Return positions turned about the X axis."""
    return position @ Rotation.from_euler("x", degrees, degrees=True).as_matrix().T
