"""Frame windows: the parts of a take that are solved, and which of them changed since the take was solved before.

A round of detection changes the samples of a few frames. Only these frames are solved again, with the neighbours that smoothing
connects them to; all others keep their solution. A long take is solved in several windows, which limits the memory.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.stats.sequences import find_runs

SMOOTHING_REACH_S = 0.5
"""Time over which a frame affects the solution of others: twice the windows in which accelerations are measured."""
MAX_WINDOW_SHARE = 0.6
"""Share of the take in windows above which the whole take is solved."""
MAX_WINDOW_FRAMES = 8192
"""Frames of a window; the arrays of one hold 50 kB per frame."""


class FrameChanges(NamedTuple):
    """The frames of a take (T,) that must be solved again.

    is_restarted  their samples changed, so that they start in closed form
    is_affected   their samples, markers or subject changed
    """

    is_restarted: np.ndarray
    is_affected: np.ndarray


class FrameWindow(NamedTuple):
    """The frames first..stop - 1, and the frames outer_first..outer_stop - 1 that are solved with them."""

    first: int
    stop: int
    outer_first: int
    outer_stop: int

    @property
    def frames(self) -> slice:
        """The frames."""
        return slice(self.first, self.stop)

    @property
    def outer_frames(self) -> slice:
        """All frames that are solved."""
        return slice(self.outer_first, self.outer_stop)

    @property
    def inner_frames(self) -> slice:
        """The frames, counted from the first that is solved."""
        return slice(self.first - self.outer_first, self.stop - self.outer_first)


def change_all_frames(frame_count: int) -> FrameChanges:
    """Return the changes of a take that was not solved before."""
    return FrameChanges(np.ones(frame_count, bool), np.ones(frame_count, bool))


def find_changed_frames(
    old_markers: Float[np.ndarray, "T K 3"], new_markers: Float[np.ndarray, "T L 3"], *, is_same_subject: bool
) -> FrameChanges:
    """Return the changes between two takes in metres, NaN where a sample is not used.

    The first markers of both are the same; the others are places of moved markers, which were fitted to the solution that has to
    be improved: their frames start from it.
    """
    count = min(old_markers.shape[1], new_markers.shape[1])
    old, new = old_markers[:, :count], new_markers[:, :count]
    is_restarted = ~((old == new) | (np.isnan(old) & np.isnan(new))).all(axis=(1, 2))
    is_extended = ~np.isnan(new_markers[:, count:]).all(axis=(1, 2))
    is_reduced = ~np.isnan(old_markers[:, count:]).all(axis=(1, 2))
    return FrameChanges(is_restarted, is_restarted | is_extended | is_reduced | (not is_same_subject))


def select_windows(is_affected: Bool[np.ndarray, " T"], rate: float) -> list[FrameWindow]:
    """Return the windows in which the frames that changes affect must be solved."""
    frame_count, reach = len(is_affected), round(SMOOTHING_REACH_S * rate)
    inner_mask = _dilate(is_affected, reach)
    if _dilate(inner_mask, reach).sum() > MAX_WINDOW_SHARE * frame_count:
        inner_mask[:] = True
    windows: list[FrameWindow] = []
    for first, last in find_runs(inner_mask):
        count = -(-(last + 1 - first) // MAX_WINDOW_FRAMES)
        bounds = np.linspace(first, last + 1, count + 1).astype(int).tolist()
        windows += [FrameWindow(a, b, max(0, a - reach), min(frame_count, b + reach)) for a, b in pairwise(bounds)]
    return windows


def list_window_frames(windows: list[FrameWindow]) -> Int[np.ndarray, " N"]:
    """Return the indices of all frames of some windows."""
    return np.concatenate([np.arange(window.first, window.stop) for window in windows] or [np.zeros(0, int)])


def _dilate(mask: Bool[np.ndarray, " T"], reach: int) -> Bool[np.ndarray, " T"]:
    """Return the mask with `reach` further frames on either side of its runs."""
    dilated = np.zeros_like(mask)
    for first, last in find_runs(mask):
        dilated[max(0, first - reach) : last + 1 + reach] = True
    return dilated
