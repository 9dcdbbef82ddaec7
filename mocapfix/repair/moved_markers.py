"""Markers that moved on their segment, as one marker per place: what comes after a knock tells nothing of what was before."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np

from mocapfix.faults import Fault, MarkerShift
from mocapfix.take import Take

MIN_EPOCH_DURATION_S = 0.5  # seconds: what must be seen of a marker at a place for that to be one


@dataclass(frozen=True)
class MarkerEpochs:
    """A take in which each place of a moved marker has a column of its own.

    take    the take, its M columns and one more for every place besides; the marker's column is that of its longest stay
    marker  (C,) the marker that each column is of
    own     (T, C) bool: the frames in which the column speaks for its marker, one of them for each marker and frame
    """

    take: Take
    column_marker: np.ndarray
    is_active: np.ndarray

    @property
    def added_columns(self) -> np.ndarray:
        """(E,) the columns that were added."""
        return np.arange(len(np.unique(self.column_marker)), len(self.column_marker))

    def find_column(self, marker: int, frame: int) -> int:
        """The column that speaks for a marker in a frame."""
        return int(np.flatnonzero((self.column_marker == marker) & self.is_active[frame])[0])

    def split_mask(self, mask: np.ndarray) -> np.ndarray:
        """-> (T, C) what is so of each column, from what is so of each marker (T, M); False where another speaks."""
        return mask[:, self.column_marker] & self.is_active

    def merge_columns(self, values: np.ndarray) -> np.ndarray:
        """-> (T, M, ...) each marker's from its columns' (T, C, ...)."""
        out = values[:, : len(self.column_marker) - len(self.added_columns)].copy()
        for column in self.added_columns:
            frames = self.is_active[:, column]
            out[frames, self.column_marker[column]] = values[frames, column]
        return out


def split_moved_markers(take: Take, faults: Iterable[Fault]) -> MarkerEpochs:
    """-> the take with a column for every place of a marker that moved.

    While a marker slides it is at neither place: its samples there are in no column, though they stay as measured.
    """
    count, frames = len(take.labels), np.arange(take.frame_count)
    marker, own = list(range(count)), [np.ones(take.frame_count, bool) for _ in range(count)]
    paths = [take.markers[:, m] for m in range(count)]
    moved = sorted((fault for fault in faults if isinstance(fault, MarkerShift)), key=lambda fault: (fault.marker, fault.first))
    for m, each in groupby(moved, key=lambda fault: fault.marker):
        moves = _select_lasting_shifts(list(each), take.visible[:, m], round(MIN_EPOCH_DURATION_S * take.rate))
        starts = [0, *(fault.settled_frame for fault in moves)]
        stops = [*(fault.first for fault in moves), take.frame_count]
        middles = [(fault.first + fault.settled_frame) // 2 for fault in moves]
        stays = list(zip(starts, stops, [0, *middles], [*middles, take.frame_count], strict=True))
        stays.sort(key=lambda stay, m=m: -take.visible[stay[0] : stay[1], m].sum())
        whole = take.markers[:, m]
        for n, (start, stop, begin, end) in enumerate(stays):
            path = np.where(((frames >= start) & (frames < stop))[:, None], whole, np.nan)
            speaks = (frames >= begin) & (frames < end)
            if n == 0:
                paths[m], own[m] = path, speaks
            else:
                paths.append(path)
                own.append(speaks)
                marker.append(m)
    columns = np.array(marker, int)
    if len(columns) == count:
        return MarkerEpochs(take, columns, np.ones((take.frame_count, count), bool))
    labels = tuple(take.labels[m] for m in marker)
    computed = None if take.computed is None else take.computed[:, columns]
    parts = replace(
        take, markers=np.stack(paths, 1), labels=labels, computed=computed, point_columns=columns, relabelled_points=None
    )
    return MarkerEpochs(parts, columns, np.stack(own, 1))


def _select_lasting_shifts(shifts: list[MarkerShift], visible: np.ndarray, min_frames: int) -> list[MarkerShift]:
    """-> of a marker's moves, by first frame, those before and after which it is `seen` (T,) in so many frames."""
    kept: list[MarkerShift] = []
    for move in shifts:
        since = kept[-1].settled_frame if kept else 0
        if visible[since : move.first].sum() >= min_frames and visible[move.settled_frame :].sum() >= min_frames:
            kept.append(move)
    return kept
