"""Hidden stretches: visible parts of the take that are treated as missing, to measure the errors of estimates.

A stretch imitates a gap: it is as long, the same markers are hidden together, and the samples beside it are visible. Where the
take shows no stretch that long, a shorter one is used, which is worth less.
"""

import numpy as np
from jaxtyping import Bool, Int

from mocapfix.fill.fill_methods import GapWindow
from mocapfix.stats.sequences import sample_evenly

MAX_HIDDEN_STRETCHES = 12
"""Stretches that are hidden for one gap."""
MIN_STRETCH_STARTS = 2
"""First frames that must be possible for stretches of a length."""
MIN_STARTS_PER_LENGTH = 0.05
"""The same, relative to the length."""
SHORTER_STRETCH_RATIO = 0.7
"""Ratio by which stretches are shortened at a time while too few first frames are possible."""
MAX_EXAMINED_STARTS = 4000
"""First frames that are examined."""
MAX_GAP_POINTS = 7
"""Points along a gap at which errors are measured."""
MAX_EDGE_SAMPLES = 4
"""Samples at each edge of a gap that are used."""
EDGE_CONTEXT_S = 0.06
"""Time on either side of a gap whose samples determine position and velocity at its edge."""


def choose_hidden_stretches(is_usable: Bool[np.ndarray, " T"], first: int, last: int, rate: float) -> GapWindow:
    """Return the window of a gap first..last.

    is_usable  frames in which all markers are visible that the gap hides
    rate       frame rate in Hz
    """
    length, reach = last - first + 1, max(1, round(EDGE_CONTEXT_S * rate))
    before = -1 - find_adjacent_samples(is_usable[max(0, first - reach) : first][::-1])[::-1]
    steps = find_adjacent_samples(is_usable[last + 1 : last + 1 + reach])
    lead, tail = (-int(before[0]) if len(before) else 0), (int(steps[-1]) + 1 if len(steps) else 0)
    hidden_length, starts = find_stretches(is_usable, length, lead, tail)
    count = min(length, MAX_GAP_POINTS)
    return GapWindow(
        first, length, before, length + steps, space_points(length, count),
        starts, hidden_length, hidden_length + steps, space_points(hidden_length, count),
    )  # fmt: skip


def find_adjacent_samples(is_usable: Bool[np.ndarray, " N"]) -> Int[np.ndarray, " A"]:
    """Return indices of usable samples, the first and some others, if the first is usable; otherwise none."""
    usable = np.flatnonzero(is_usable)
    return usable[sample_evenly(len(usable), MAX_EDGE_SAMPLES)] if len(usable) and usable[0] == 0 else usable[:0]


def space_points(length: int, count: int) -> Int[np.ndarray, " S"]:
    """Return the offsets of evenly spaced points from the first to the last frame of a gap."""
    return np.round(np.linspace(0, length - 1, count)).astype(int)


def find_stretches(is_usable: Bool[np.ndarray, " T"], length: int, lead: int, tail: int) -> tuple[int, Int[np.ndarray, " K"]]:
    """Return the length of the stretches, the gap's own if the take has enough of them, and their first frames.

    lead, tail  frames before and after a stretch that must be usable too
    """
    missing_before = np.concatenate([[0], np.cumsum(~is_usable)])
    while True:
        span = lead + length + tail
        step = 1 + max(0, len(is_usable) - span) // MAX_EXAMINED_STARTS
        starts = np.arange(0, len(is_usable) - span + 1, step)
        starts = starts[missing_before[starts + span] == missing_before[starts]] + lead
        if length == 1 or len(starts) * step >= max(MIN_STRETCH_STARTS, MIN_STARTS_PER_LENGTH * length):
            return length, starts[sample_evenly(len(starts), MAX_HIDDEN_STRETCHES)] if len(starts) else starts
        length = max(1, int(length * SHORTER_STRETCH_RATIO))
