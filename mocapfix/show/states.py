"""What became of every sample, and the colours that say so in the recording and on the page."""

import numpy as np

from mocapfix.faults import Faults
from mocapfix.take import Take

STATES = ("measured", "filled", "replaced", "relabelled", "taken over", "doubted", "empty")
MEASURED, FILLED, REPLACED, RELABELLED, TAKEN, DOUBTED, EMPTY = range(7)

GREEN, RED, AMBER, VIOLET, BLUE = "#1f9d57", "#d93a3a", "#e08a00", "#7a5bd0", "#3f7fc4"


def states(before: Take, labelled: Take, after: Take, faults: Faults) -> np.ndarray:
    """-> (T, M) indices into STATES: measured and kept; missing and filled; faulty and replaced; measured, but under another
    label before; given to another label, and nothing in its place; faulty, but kept; empty.

    labelled  the take with its labels put right: what is missing and faulty in it was filled and replaced
    """
    estimated = np.zeros(after.seen.shape, bool) if after.deviation is None else ~np.isnan(after.deviation)
    elsewhere = after.seen & (after.sources != before.sources)
    given = _given(before, after, elsewhere & ~estimated)
    conditions = [~after.seen & given, ~after.seen, estimated & ~labelled.seen, estimated, elsewhere, faults.doubted(labelled)]
    return np.select(conditions, [TAKEN, EMPTY, FILLED, REPLACED, RELABELLED, DOUBTED], MEASURED)


def _given(before: Take, after: Take, relabelled: np.ndarray) -> np.ndarray:
    """-> (T, M) bool: the samples of before that are under another label after, which `relabelled` (T, M) are."""
    own = before.columns if len(before.columns) else np.arange(len(before.labels))
    column = np.full(1 + max(own.max(initial=0), after.sources.max(initial=0)), -1)
    column[own] = np.arange(len(own))
    t, m = np.nonzero(relabelled)
    donor = column[after.sources[t, m]]
    given = np.zeros(before.seen.shape, bool)
    given[t[donor >= 0], donor[donor >= 0]] = True
    return given


def mended(state: np.ndarray) -> np.ndarray:
    """-> where mocapfix estimated the sample."""
    return (state == FILLED) | (state == REPLACED)


def former(seen: np.ndarray, state: np.ndarray) -> np.ndarray:
    """-> what the samples were before: measured; doubted, for they were replaced, taken out or only kept in doubt; or
    relabelled, for they belonged to another label. `seen`: was there one?"""
    other = np.isin(state, (RELABELLED, TAKEN, FILLED))
    return np.select([~seen, other, state != MEASURED], [EMPTY, RELABELLED, DOUBTED], MEASURED)
