"""What is left of a marker's place when what goes with the joints about it is taken away by a ridge regression."""

from typing import NamedTuple

import numpy as np


class Place(NamedTuple):
    """A marker's place in the N frames in which it is seen.

    explained  (N, 1 + F) what can be explained, a constant first: orthonormal but for the ridge
    left       (N, 3) metres: what of the place that leaves
    frames     (N,) indices
    """

    explained: np.ndarray
    left: np.ndarray
    frames: np.ndarray


def beside(features: np.ndarray, path: np.ndarray, frames: np.ndarray, ridge: float) -> Place:
    """-> a place (N, 3) metres, beside what goes with features (N, F), of which a change by `ridge` means nothing."""
    count = len(features)
    u, size, _ = np.linalg.svd(features - features.mean(0), full_matrices=False)
    gain = size**2 / (size**2 + count * ridge**2)
    explained = np.column_stack([np.full(count, count**-0.5), u * np.sqrt(gain)])
    return Place(explained, path - explained @ (explained.T @ path), frames)
