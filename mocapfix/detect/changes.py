"""A place that changes once: the ramp, of any beginning and end, that explains most of what is left of a place.

Least squares beside what the joints about the marker explain, so that a change which comes with a change of pose is neither
missed nor taken for more than it is. A ramp's product with a column is a difference of sums of sums: each ramp costs the same
whatever its length, and all of them are tried.
"""

from typing import NamedTuple

import numpy as np

from mocapfix.detect.places import Place


class Change(NamedTuple):
    """A place that changes by `way` (3,) metres, in its segment's axes, from after sample `start` to sample `end`."""

    start: int
    end: int
    way: np.ndarray
    gain: float  # square metres: what it explains of what was left

    @property
    def size(self) -> float:
        """metres"""
        return float(np.linalg.norm(self.way))

    def share(self, count: int) -> np.ndarray:
        """-> (N,) 0..1: how far it has come at each of `count` samples."""
        return np.clip((np.arange(count) - self.start) / (self.end - self.start), 0, 1)


def best(there: Place, starts: np.ndarray, ends: np.ndarray) -> Change:
    """-> of the changes from starts (P,) to ends (P,), samples of a place, the one that explains most of what is left of it."""
    count, long = len(there.left), ends - starts
    both = np.concatenate([there.left, there.explained], axis=1)
    after = np.cumsum(np.cumsum(both[::-1], axis=0)[::-1], axis=0)  # sums of the products with the steps up to each sample
    product = (after[ends] - after[starts]) / long[:, None]
    square = (long + 1) * (2 * long + 1) / (6 * long) + count - 1 - ends
    own = np.maximum(square - (product[:, 3:] ** 2).sum(1), 1e-9)
    gain = (product[:, :3] ** 2).sum(1) / own
    most = int(gain.argmax())
    return Change(int(starts[most]), int(ends[most]), product[most, :3] / own[most], float(gain[most]))


def sudden(there: Place, edge: int) -> Change | None:
    """-> the best change from one sample to the next, none within `edge` samples of the first and the last."""
    ends = np.arange(edge, len(there.left) - edge + 1)
    return best(there, ends - 1, ends) if len(ends) else None


def slow(there: Place, shortest: int, step: int) -> Change | None:
    """-> the best change of at least `shortest` samples: its ends to `step` samples first, then to a fifth of that."""
    count = len(there.left)
    grid = np.arange(0, count, step)
    rough = _of_grid(there, grid, grid, shortest)
    if rough is None:
        return None
    about = np.arange(-step, step + 1, max(1, step // 5))
    return _of_grid(there, (rough.start + about).clip(0, count - 1), (rough.end + about).clip(0, count - 1), shortest)


def _of_grid(there: Place, starts: np.ndarray, ends: np.ndarray, shortest: int) -> Change | None:
    pairs = np.stack(np.meshgrid(starts, ends), -1).reshape(-1, 2)
    pairs = pairs[pairs[:, 1] - pairs[:, 0] >= shortest]
    return best(there, pairs[:, 0], pairs[:, 1]) if len(pairs) else None


def rest(there: Place, change: Change, together: int) -> float:
    """-> metres: the root mean square of what a change leaves of a place, in means of so many samples together."""
    share = change.share(len(there.left))
    left = there.left - np.outer(share - there.explained @ (there.explained.T @ share), change.way)
    blocks = np.array_split(left, max(1, len(left) // together))
    return float(np.sqrt(np.mean([(block.mean(0) ** 2).sum() for block in blocks])))
