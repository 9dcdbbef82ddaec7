"""Quaternions (x, y, z, w) and axes: files have Y up, Blender has Z up and -Y in front."""

import numpy as np

BLENDER_FROM_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""rotation from axes with Y up to Blender's"""


def convert_points(points: np.ndarray) -> np.ndarray:
    """Return points or offsets (..., 3) with Y up in Blender's axes."""
    return points @ BLENDER_FROM_Y_UP.T


def rotate_quaternions(quaternions: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Return the rotations R of quaternions (..., 4) in other axes: M R M^T, for a rotation M (3, 3). Signs do not change."""
    return np.concatenate([quaternions[..., :3] @ rotation.T, quaternions[..., 3:]], axis=-1)


def multiply_quaternions(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return the product of quaternions (..., 4)."""
    a, b, s, t = left[..., :3], right[..., :3], left[..., 3:], right[..., 3:]
    return np.concatenate([s * b + t * a + np.cross(a, b), s * t - (a * b).sum(-1, keepdims=True)], axis=-1)


def conjugate_quaternions(quaternions: np.ndarray) -> np.ndarray:
    """Return the inverses of unit quaternions (..., 4)."""
    return quaternions * [-1.0, -1.0, -1.0, 1.0]


def make_quaternions(matrices: np.ndarray) -> np.ndarray:
    """Return the quaternions (..., 4) of rotation matrices (..., 3, 3)."""
    trace = matrices.trace(axis1=-2, axis2=-1)
    x, y, z = (matrices[..., i, i] for i in range(3))
    squares = np.stack([1 + 2 * x - trace, 1 + 2 * y - trace, 1 + 2 * z - trace, 1 + trace], axis=-1)
    sums = {(i, j): matrices[..., i, j] + matrices[..., j, i] for i, j in ((0, 1), (0, 2), (1, 2))}
    turns = [matrices[..., j, i] - matrices[..., i, j] for i, j in ((1, 2), (2, 0), (0, 1))]
    # Row k is the quaternion times four of its component k; the row of the largest component is the most accurate.
    rows = np.stack([
        np.stack([squares[..., 0], sums[0, 1], sums[0, 2], turns[0]], axis=-1),
        np.stack([sums[0, 1], squares[..., 1], sums[1, 2], turns[1]], axis=-1),
        np.stack([sums[0, 2], sums[1, 2], squares[..., 2], turns[2]], axis=-1),
        np.stack([turns[0], turns[1], turns[2], squares[..., 3]], axis=-1),
    ], axis=-2)  # fmt: skip
    best = squares.argmax(-1)
    chosen = np.take_along_axis(rows, best[..., None, None], axis=-2)[..., 0, :]
    return chosen / np.linalg.norm(chosen, axis=-1, keepdims=True)


def make_matrices(quaternions: np.ndarray) -> np.ndarray:
    """Return the rotation matrices (..., 3, 3) of unit quaternions (..., 4)."""
    x, y, z, w = np.moveaxis(quaternions, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def align_signs(quaternions: np.ndarray) -> np.ndarray:
    """Return quaternions (T, ..., 4) with signs such that consecutive ones lie on the same half of the sphere."""
    dots = (quaternions[1:] * quaternions[:-1]).sum(-1, keepdims=True)
    signs = np.cumprod(np.where(dots < 0, -1.0, 1.0), axis=0)
    return np.concatenate([quaternions[:1], quaternions[1:] * signs])
