"""Tracklets of columns: each column of a file is one or several trajectories."""

import numpy as np
from jaxtyping import Float

from mocapfix.labelling.points import UnlabelledPoints
from mocapfix.stats.sequences import find_runs

MAX_JOINED_GAP_S = 0.1
"""Longest gap in a column across which a trajectory may continue."""
MAX_JOIN_ERROR_M = 0.015
"""Distance of the continued trajectory from a straight line through its last two samples, up to which it is one trajectory."""
MAX_JOIN_ERROR_M_PER_S = 0.3
"""The same, added for every second of the gap."""


def cut_columns(positions: Float[np.ndarray, "T C 3"], rate: float) -> UnlabelledPoints:
    """Return the points of columns with a tracklet for every run of samples; a run continues across a short gap on a straight line.

    Args:
        positions: Metres, NaN where missing.
        rate: Frames per second.
    """
    indices, first_frames = np.full(positions.shape[:2], -1), list[int]()
    for column in range(positions.shape[1]):
        previous = -1
        for first, last in find_runs(~np.isnan(positions[:, column, 0])):
            if previous < 0 or not _continues(positions[:, column], previous, first, rate):
                first_frames.append(first)
            indices[first : last + 1, column] = len(first_frames) - 1
            previous = last
    rank = np.empty(len(first_frames) + 1, int)
    rank[np.argsort(first_frames, kind="stable")] = np.arange(len(first_frames))
    rank[-1] = -1
    return UnlabelledPoints(positions, rank[indices], rate)


def _continues(path: Float[np.ndarray, "T 3"], last: int, first: int, rate: float) -> bool:
    """Return whether a trajectory that ends at `last` and the one that begins at `first` in the same column are one."""
    gap = first - last
    if gap / rate > MAX_JOINED_GAP_S:
        return False
    velocity = path[last] - path[last - 1] if last > 0 and not np.isnan(path[last - 1, 0]) else np.zeros(3)
    error = np.linalg.norm(path[first] - path[last] - velocity * gap)
    return bool(error < MAX_JOIN_ERROR_M + MAX_JOIN_ERROR_M_PER_S * gap / rate)
