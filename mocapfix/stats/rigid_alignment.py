"""Laying one direction on another."""

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.kernels.rigid_registration import compute_cross_covariance, fit_rotations, transform_to_body_axes


# MERGED: mocapfix.kernels.aligned
def compute_shortest_rotation(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """-> (3, 3) the smallest rotation that takes the direction of `before` (3,) to that of `after` (3,), of any lengths.

    Of opposite ones it is half a turn about some axis across them, and none where either has no length.
    """
    if not (np.linalg.norm(before) > 0 and np.linalg.norm(after) > 0):
        return np.eye(3)
    return Rotation.align_vectors(after[None], before[None])[0].as_matrix()


# MERGED: mocapfix.kernels.trunk
# The axes of a body of which nothing is known but its markers: a common shape, on which every frame is laid.
MIN_MARKER_SD_M = 0.002  # metres: how still on the body a marker can be, so that none alone decides the alignment


def align_to_common_shape(markers: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """-> turn (T, 3, 3) and origin (T, 3) of the body's axes in the world, and (T,) bool: three or more markers tell them.

    Each marker counts by how still it lies on the common shape: the trunk leads (Theobald & Wuttke 2006, PNAS 103, the
    maximum-likelihood form of Procrustes alignment).
    """
    seen = ~np.isnan(markers[..., 0])
    shape, variance = markers[np.argmax(seen.sum(1))], np.ones(markers.shape[1])
    shape = shape - np.nanmean(shape, 0)
    for _ in range(6):
        weight = seen * ~np.isnan(shape[:, 0]) / (MIN_MARKER_SD_M**2 + variance)
        placed = (weight > 0).sum(1) >= 3
        cross, here, there = compute_cross_covariance(markers, np.nan_to_num(shape), weight)
        turn = fit_rotations(cross)
        if not placed.any():
            break
        shape, variance = compute_common_shape(markers, seen & placed[:, None], turn, here - np.einsum("tab,tb->ta", turn, there))
        shape -= np.nanmean(shape, 0)
    return turn, here - np.einsum("tab,tb->ta", turn, there), placed


def compute_common_shape(
    markers: np.ndarray, use: np.ndarray, turn: np.ndarray, origin: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """-> where markers (T, M, 3) lie in the body's axes on average over the samples to `use` (T, M), and their variance (M,)."""
    laid = transform_to_body_axes(markers, origin, turn)
    laid[~use] = 0.0
    count = np.where(use.any(0), use.sum(0), np.nan)[:, None]
    shape = laid.sum(0) / count
    laid -= shape
    laid[~use] = 0.0
    return shape, np.nan_to_num(np.einsum("tma,tma->ma", laid, laid) / count).mean(1)
