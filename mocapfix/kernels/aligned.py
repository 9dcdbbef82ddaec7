"""Laying one direction on another."""

import numpy as np
from scipy.spatial.transform import Rotation


def shortest_turn(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """-> (3, 3) the smallest rotation that takes the direction of `before` (3,) to that of `after` (3,), of any lengths.

    Of opposite ones it is half a turn about some axis across them, and none where either has no length.
    """
    if not (np.linalg.norm(before) > 0 and np.linalg.norm(after) > 0):
        return np.eye(3)
    return Rotation.align_vectors(after[None], before[None])[0].as_matrix()
