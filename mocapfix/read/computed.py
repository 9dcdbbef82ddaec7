"""Telling samples that a program put into a C3D from those that cameras measured."""

import numpy as np

RESIDUAL_BYTE = 255
KEEPS = 0.9  # of the samples: where so many carry their cameras, the others have none because none saw them
MOST = 0.5  # of the samples: where more have a residual and no cameras, the file keeps no cameras and all were measured


def computed(words: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """-> (T, P) bool: samples with a residual that no camera contributed to, as mocapfix fills gaps, in a file whose other
    samples carry their cameras or nothing at all.

    words  (T, P) residual words: cameras in the high byte, residual in the low one; seen  (T, P) bool: the sample is valid
    """
    filled = seen & (words >= 1) & (words <= RESIDUAL_BYTE) & (words == np.rint(words))
    return filled if filled.sum() <= MOST * seen.sum() else np.zeros_like(filled)


def blind(words: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """-> (T, P) bool: samples that no camera contributed to, in a file that keeps the cameras; `words`, `seen` as above."""
    without = seen & (words <= RESIDUAL_BYTE)
    return without if without.sum() <= (1 - KEEPS) * seen.sum() else np.zeros_like(without)
