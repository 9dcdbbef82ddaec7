"""Even subsampling of indices."""

import numpy as np
from jaxtyping import Int


def sample_evenly(count: int, max_count: int) -> Int[np.ndarray, " N"]:
    """Return at most `max_count` of the indices 0..count - 1, rising and evenly spaced; all of them if there are no more."""
    return np.unique(np.linspace(0, count - 1, min(count, max_count)).astype(int))
