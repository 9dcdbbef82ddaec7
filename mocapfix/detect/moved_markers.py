"""Markers that moved on their segment: one column for each position, since samples at one say nothing about another."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import groupby
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int, Shaped

from mocapfix.model.faults import Fault, MarkerShift
from mocapfix.model.take import Take

# Visible time of a marker at a position that makes it a position of its own.
MIN_EPOCH_DURATION_S = 0.5


@dataclass(frozen=True)
class MarkerEpochs:
    """A take in which each position of a moved marker has a column of its own.

    Attributes:
        take: The take with its M columns and one more for each additional position. The original column of a moved marker
            holds the position at which it is visible longest.
        column_marker: The marker (C,) of each column.
        is_active: The frames (T, C) in which a column represents its marker; one column for each marker and frame.
    """

    take: Take
    column_marker: np.ndarray
    is_active: np.ndarray

    @property
    def added_columns(self) -> Int[np.ndarray, " E"]:
        """The indices of the additional columns."""
        return np.arange(len(np.unique(self.column_marker)), len(self.column_marker))

    def find_column(self, marker: int, frame: int) -> int:
        """Return the column that represents a marker in a frame."""
        return int(np.flatnonzero((self.column_marker == marker) & self.is_active[frame])[0])

    def split_mask(self, mask: Bool[np.ndarray, "T M"]) -> Bool[np.ndarray, "T C"]:
        """Return a mask of columns from a mask of markers, False where another column represents the marker."""
        return mask[:, self.column_marker] & self.is_active

    def merge_columns(self, values: Shaped[np.ndarray, "T C *rest"]) -> Shaped[np.ndarray, "T M *rest"]:
        """Return values of markers from values of columns."""
        merged = values[:, : len(self.column_marker) - len(self.added_columns)].copy()
        for column in self.added_columns:
            frames = self.is_active[:, column]
            merged[frames, self.column_marker[column]] = values[frames, column]
        return merged


class _Epoch(NamedTuple):
    """The frames start..stop (exclusive) of a marker at one position, and active_start..active_stop that represent it."""

    start: int
    stop: int
    active_start: int
    active_stop: int


def split_moved_markers(take: Take, faults: Iterable[Fault]) -> MarkerEpochs:
    """Split the markers that moved into one column for each position.

    While a marker slides it is at neither position. Its samples then are in no column, although the take keeps them as measured.
    """
    count, frames = len(take.labels), np.arange(take.frame_count)
    column_marker, is_active = list(range(count)), [np.ones(take.frame_count, bool) for _ in range(count)]
    paths = [take.markers[:, m] for m in range(count)]
    shifts = sorted((fault for fault in faults if isinstance(fault, MarkerShift)), key=lambda fault: (fault.marker, fault.first))
    for m, group in groupby(shifts, key=lambda shift: shift.marker):
        visible = take.visible[:, m]
        epochs = _list_epochs(_select_lasting_shifts(list(group), visible, round(MIN_EPOCH_DURATION_S * take.rate)), len(visible))
        epochs.sort(key=lambda epoch, visible=visible: -visible[epoch.start : epoch.stop].sum())
        whole_path = take.markers[:, m]
        for n, epoch in enumerate(epochs):
            path = np.where(((frames >= epoch.start) & (frames < epoch.stop))[:, None], whole_path, np.nan)
            active = (frames >= epoch.active_start) & (frames < epoch.active_stop)
            if n == 0:
                paths[m], is_active[m] = path, active
            else:
                paths.append(path)
                is_active.append(active)
                column_marker.append(m)
    columns = np.array(column_marker, int)
    if len(columns) == count:
        return MarkerEpochs(take, columns, np.ones((take.frame_count, count), bool))
    labels = tuple(take.labels[m] for m in column_marker)
    computed = None if take.computed is None else take.computed[:, columns]
    uncaptured = None if take.uncaptured is None else take.uncaptured[:, columns]
    split = replace(
        take,
        markers=np.stack(paths, 1),
        labels=labels,
        computed=computed,
        uncaptured=uncaptured,
        point_columns=columns,
        relabelled_points=None,
    )
    return MarkerEpochs(split, columns, np.stack(is_active, 1))


def _list_epochs(shifts: list[MarkerShift], frame_count: int) -> list[_Epoch]:
    """List the epochs between the shifts of a marker, which are ordered by first frame."""
    starts = [0, *(shift.settled_frame for shift in shifts)]
    stops = [*(shift.first for shift in shifts), frame_count]
    middles = [(shift.first + shift.settled_frame) // 2 for shift in shifts]
    return [_Epoch(*each) for each in zip(starts, stops, [0, *middles], [*middles, frame_count], strict=True)]


def _select_lasting_shifts(shifts: list[MarkerShift], visible: np.ndarray, min_frames: int) -> list[MarkerShift]:
    """Select the shifts, ordered by first frame, with at least `min_frames` visible frames (T,) before and after them."""
    selected: list[MarkerShift] = []
    for shift in shifts:
        start = selected[-1].settled_frame if selected else 0
        if visible[start : shift.first].sum() >= min_frames and visible[shift.settled_frame :].sum() >= min_frames:
            selected.append(shift)
    return selected
