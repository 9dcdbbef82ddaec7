"""What is left of a marker's place when what goes with the joints about it is taken away by a ridge regression."""

from typing import NamedTuple

import numpy as np


# MERGED: mocapfix.detect.places
class RegressedPath(NamedTuple):
    """A marker's place in the N frames in which it is seen.

    explained  (N, 1 + F) what can be explained, a constant first: orthonormal but for the ridge
    left       (N, 3) metres: what of the place that leaves
    frames     (N,) indices
    """

    basis: np.ndarray
    residual: np.ndarray
    frames: np.ndarray


def regress_out(features: np.ndarray, path: np.ndarray, frames: np.ndarray, ridge: float) -> RegressedPath:
    """-> a place (N, 3) metres, beside what goes with features (N, F), of which a change by `ridge` means nothing."""
    count = len(features)
    u, size, _ = np.linalg.svd(features - features.mean(0), full_matrices=False)
    gain = size**2 / (size**2 + count * ridge**2)
    explained = np.column_stack([np.full(count, count**-0.5), u * np.sqrt(gain)])
    return RegressedPath(explained, path - explained @ (explained.T @ path), frames)


# MERGED: mocapfix.detect.changes
# A place that changes once: the ramp, of any beginning and end, that explains most of what is left of a place.
#
# Least squares beside what the joints about the marker explain, so that a change which comes with a change of pose is neither
# missed nor taken for more than it is. A ramp's product with a column is a difference of sums of sums: each ramp costs the same
# whatever its length, and all of them are tried.
class Ramp(NamedTuple):
    """A place that changes by `way` (3,) metres, in its segment's axes, from after sample `start` to sample `end`."""

    start: int
    end: int
    displacement: np.ndarray
    gain_m2: float  # square metres: what it explains of what was left

    @property
    def size_m(self) -> float:
        """metres"""
        return float(np.linalg.norm(self.displacement))

    def compute_progress(self, count: int) -> np.ndarray:
        """-> (N,) 0..1: how far it has come at each of `count` samples."""
        return np.clip((np.arange(count) - self.start) / (self.end - self.start), 0, 1)


def fit_best_ramp(path: RegressedPath, starts: np.ndarray, ends: np.ndarray) -> Ramp:
    """-> of the changes from starts (P,) to ends (P,), samples of a place, the one that explains most of what is left of it."""
    count, long = len(path.residual), ends - starts
    both = np.concatenate([path.residual, path.basis], axis=1)
    after = np.cumsum(np.cumsum(both[::-1], axis=0)[::-1], axis=0)  # sums of the products with the steps up to each sample
    product = (after[ends] - after[starts]) / long[:, None]
    square = (long + 1) * (2 * long + 1) / (6 * long) + count - 1 - ends
    own = np.maximum(square - (product[:, 3:] ** 2).sum(1), 1e-9)
    gain = (product[:, :3] ** 2).sum(1) / own
    most = int(gain.argmax())
    return Ramp(int(starts[most]), int(ends[most]), product[most, :3] / own[most], float(gain[most]))


def fit_step(path: RegressedPath, edge: int) -> Ramp | None:
    """-> the best change from one sample to the next, none within `edge` samples of the first and the last."""
    ends = np.arange(edge, len(path.residual) - edge + 1)
    return fit_best_ramp(path, ends - 1, ends) if len(ends) else None


def fit_slow_ramp(path: RegressedPath, min_length: int, step: int) -> Ramp | None:
    """-> the best change of at least `shortest` samples: its ends to `step` samples first, then to a fifth of that."""
    count = len(path.residual)
    grid = np.arange(0, count, step)
    rough = _fit_ramp_on_grid(path, grid, grid, min_length)
    if rough is None:
        return None
    about = np.arange(-step, step + 1, max(1, step // 5))
    return _fit_ramp_on_grid(path, (rough.start + about).clip(0, count - 1), (rough.end + about).clip(0, count - 1), min_length)


def _fit_ramp_on_grid(path: RegressedPath, starts: np.ndarray, ends: np.ndarray, min_length: int) -> Ramp | None:
    pairs = np.stack(np.meshgrid(starts, ends), -1).reshape(-1, 2)
    pairs = pairs[pairs[:, 1] - pairs[:, 0] >= min_length]
    return fit_best_ramp(path, pairs[:, 0], pairs[:, 1]) if len(pairs) else None


def compute_residual_rms(path: RegressedPath, ramp: Ramp, block_length: int) -> float:
    """-> metres: the root mean square of what a change leaves of a place, in means of so many samples together."""
    share = ramp.compute_progress(len(path.residual))
    left = path.residual - np.outer(share - path.basis @ (path.basis.T @ share), ramp.displacement)
    blocks = np.array_split(left, max(1, len(left) // block_length))
    return float(np.sqrt(np.mean([(block.mean(0) ** 2).sum() for block in blocks])))
