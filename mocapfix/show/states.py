"""What became of every sample, and the colours that say so in the recording and on the page."""

import numpy as np

from mocapfix.faults import Faults
from mocapfix.take import Take

STATES = ("measured", "filled", "replaced", "doubted", "empty")
MEASURED, FILLED, REPLACED, DOUBTED, EMPTY = range(5)

GREEN, RED, AMBER, VIOLET = "#1f9d57", "#d93a3a", "#e08a00", "#7a5bd0"


def states(before: Take, after: Take, faults: Faults) -> np.ndarray:
    """-> (T, M) indices into STATES: measured and kept; missing and filled; faulty and replaced; faulty, but kept; empty."""
    changed = (before.markers != after.markers).any(axis=-1)
    conditions = [~after.seen, ~before.seen, changed, faults.doubted(before)]
    return np.select(conditions, [EMPTY, FILLED, REPLACED, DOUBTED], MEASURED)


def mended(state: np.ndarray) -> np.ndarray:
    """-> where mocapfix put the sample there."""
    return (state == FILLED) | (state == REPLACED)


def faulty(seen: np.ndarray, state: np.ndarray) -> np.ndarray:
    """-> where a sample was `seen` before, but was replaced, taken out, or only kept in doubt."""
    return seen & (state != MEASURED)
