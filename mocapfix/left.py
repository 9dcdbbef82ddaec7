"""What a cleaning leaves empty."""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from mocapfix.take import Take


@dataclass(frozen=True)
class Left:
    """Samples that stay missing: a marker over first..last (indices into the take, inclusive), and why."""

    marker: int
    first: int
    last: int
    reason: str


def reasons(left: Iterable[Left], shape: tuple[int, int]) -> np.ndarray:
    """-> `shape` (T, M) object: why each sample is left empty, "" where nobody said."""
    said = np.full(shape, "", object)
    for each in left:
        said[each.first : each.last + 1, each.marker] = each.reason
    return said


def named(after: Take, said: np.ndarray) -> tuple[Left, ...]:
    """-> what is missing in a take, in runs of one reason each, by marker and first frame; `said` (T, M) as `reasons`."""
    found = []
    for m in range(len(after.labels)):
        for reason, frames in groupby(np.flatnonzero(~after.seen[:, m]), key=lambda t, m=m: said[t, m]):
            each = list(frames)
            breaks = np.flatnonzero(np.diff(each) > 1)
            for a, b in zip([0, *(breaks + 1)], [*breaks, len(each) - 1], strict=True):
                found.append(Left(m, int(each[a]), int(each[b]), reason))
    return tuple(sorted(found, key=lambda one: (one.marker, one.first)))
