"""Takes of a moving segment at the resolutions of files."""

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.model.take import Take

LABELS = ("A", "B", "C", "D")


def walking(rate=120.0, seconds=4.0, noise=0.0003):
    """Build a take of four markers on one segment that rotates and moves, with camera noise (metres)."""
    t = np.arange(round(rate * seconds)) / rate
    rng = np.random.default_rng(0)
    places = rng.normal(0, 0.12, (4, 3))
    swing = Rotation.from_euler("zyx", np.stack([0.6 * np.sin(5 * t), 0.4 * np.cos(3 * t), 0.3 * np.sin(4 * t)], -1)).as_matrix()
    path = np.stack([1.2 * t, 1 + 0.05 * np.sin(9 * t), 0.3 * np.cos(2 * t)], -1)
    markers = path[:, None] + np.einsum("tab,kb->tka", swing, places)
    return Take(markers + rng.normal(0, noise, markers.shape), LABELS, rate)


def as_floats(take):
    """Round the take to 32-bit floats in millimetres."""
    return take.replace_markers((take.markers * 1000).astype(np.float32).astype(float) / 1000)


def as_integers(take, scale=1e-4):
    """Round the take to multiples of `scale` metres."""
    return take.replace_markers(np.rint(take.markers / scale) * scale)
