"""Fit of one ramp to a marker's path on its segment: a position that changes once, suddenly or slowly.

The part of the path that varies with the rotations of the adjacent joints is removed by ridge regression. The ramp is fitted
together with that regression by least squares, so that a change of position that coincides with a change of pose is neither
missed nor overestimated. The product of a ramp with a column is a difference of cumulative sums. Therefore each ramp costs the
same, whatever its length, and all of them are tried.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int


class RegressedPath(NamedTuple):
    """A marker's path over the N frames in which it is visible, after the regression.

    Attributes:
        basis: Columns (N, 1 + F) of the regression, a constant first, orthonormal but for the ridge.
        residual: Residual (N, 3) of the position in metres.
        frames: Frame indices (N,).
    """

    basis: np.ndarray
    residual: np.ndarray
    frames: np.ndarray


def regress_out(
    features: Float[np.ndarray, "N F"], path: Float[np.ndarray, "N 3"], frames: Int[np.ndarray, " N"], ridge: float
) -> RegressedPath:
    """Remove the part of a path that varies with the features.

    Args:
        features: Features of each frame.
        path: Positions in metres.
        frames: Frame indices.
        ridge: Variation of a feature that is insignificant.
    """
    count = len(features)
    u, singular_values, _ = np.linalg.svd(features - features.mean(0), full_matrices=False)
    gain = singular_values**2 / (singular_values**2 + count * ridge**2)
    basis = np.column_stack([np.full(count, count**-0.5), u * np.sqrt(gain)])
    return RegressedPath(basis, path - basis @ (basis.T @ path), frames)


class Ramp(NamedTuple):
    """A change of position.

    Attributes:
        start: Index of the last sample at the old position.
        end: Index of the first sample at the new position.
        displacement: Displacement (3,) in metres in the segment's axes.
        gain_m2: Reduction of the sum of squared residuals, in square metres.
    """

    start: int
    end: int
    displacement: np.ndarray
    gain_m2: float

    @property
    def size_m(self) -> float:
        """Length of the displacement in metres."""
        return float(np.linalg.norm(self.displacement))

    def compute_progress(self, count: int) -> Float[np.ndarray, " N"]:
        """Compute the fraction of the displacement, 0..1, at each of `count` samples."""
        return np.clip((np.arange(count) - self.start) / (self.end - self.start), 0, 1)


def fit_best_ramp(path: RegressedPath, starts: Int[np.ndarray, " P"], ends: Int[np.ndarray, " P"]) -> Ramp:
    """Return the ramp with the largest gain among those from `starts` to `ends` (sample indices)."""
    count, lengths = len(path.residual), ends - starts
    columns = np.concatenate([path.residual, path.basis], axis=1)
    # sums of the products with the steps up to each sample
    cumulative = np.cumsum(np.cumsum(columns[::-1], axis=0)[::-1], axis=0)
    product = (cumulative[ends] - cumulative[starts]) / lengths[:, None]
    square = (lengths + 1) * (2 * lengths + 1) / (6 * lengths) + count - 1 - ends
    unexplained = np.maximum(square - (product[:, 3:] ** 2).sum(1), 1e-9)
    gain = (product[:, :3] ** 2).sum(1) / unexplained
    best = int(gain.argmax())
    return Ramp(int(starts[best]), int(ends[best]), product[best, :3] / unexplained[best], float(gain[best]))


def fit_step(path: RegressedPath, edge: int) -> Ramp | None:
    """Fit the best change from one sample to the next, at least `edge` samples and one from both ends."""
    edge = max(edge, 1)
    ends = np.arange(edge, len(path.residual) - edge + 1)
    return fit_best_ramp(path, ends - 1, ends) if len(ends) else None


def fit_slow_ramp(path: RegressedPath, min_length: int, step: int) -> Ramp | None:
    """Fit the best change over at least `min_length` samples, its ends first to `step` samples, then to a fifth of that."""
    count, min_length, step = len(path.residual), max(min_length, 1), max(step, 1)
    grid = np.arange(0, count, step)
    coarse = _fit_ramp_on_grid(path, grid, grid, min_length)
    if coarse is None:
        return None
    offsets = np.arange(-step, step + 1, max(1, step // 5))
    starts, ends = (coarse.start + offsets).clip(0, count - 1), (coarse.end + offsets).clip(0, count - 1)
    return _fit_ramp_on_grid(path, starts, ends, min_length)


def _fit_ramp_on_grid(path: RegressedPath, starts: np.ndarray, ends: np.ndarray, min_length: int) -> Ramp | None:
    pairs = np.stack(np.meshgrid(starts, ends), -1).reshape(-1, 2)
    pairs = pairs[pairs[:, 1] - pairs[:, 0] >= min_length]
    return fit_best_ramp(path, pairs[:, 0], pairs[:, 1]) if len(pairs) else None


def compute_residual_rms(path: RegressedPath, ramp: Ramp, block_length: int) -> float:
    """Compute the root mean square in metres of the residual with the ramp removed, averaged over blocks of samples."""
    progress = ramp.compute_progress(len(path.residual))
    residual = path.residual - np.outer(progress - path.basis @ (path.basis.T @ progress), ramp.displacement)
    block_count = max(1, len(residual) // max(block_length, 1))
    if block_count < len(residual):
        residual = np.array([block.mean(0) for block in np.array_split(residual, block_count)])
    return float(np.sqrt(np.mean((residual**2).sum(1))))
