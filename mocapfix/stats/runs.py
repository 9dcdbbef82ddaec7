"""Runs of consecutive frames in a mask."""

import numpy as np
from jaxtyping import Bool


def find_runs(mask: Bool[np.ndarray, " T"]) -> list[tuple[int, int]]:
    """Return the runs of True in `mask` as (first, last) indices, both inclusive."""
    edges = np.flatnonzero(np.diff(np.r_[False, mask, False].astype(np.int8)))
    return [(int(a), int(b) - 1) for a, b in zip(edges[::2], edges[1::2], strict=True)]
