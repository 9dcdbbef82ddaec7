"""Markers that moved on their segment, as one marker per place: what comes after a knock tells nothing of what was before."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np

from mocapfix.faults import Fault, Moved
from mocapfix.take import Take

LEAST = 0.5  # seconds: what must be seen of a marker at a place for that to be one


@dataclass(frozen=True)
class Parts:
    """A take in which each place of a moved marker has a column of its own.

    take    the take, its M columns and one more for every place besides; the marker's column is that of its longest stay
    marker  (C,) the marker that each column is of
    own     (T, C) bool: the frames in which the column speaks for its marker, one of them for each marker and frame
    """

    take: Take
    marker: np.ndarray
    own: np.ndarray

    @property
    def more(self) -> np.ndarray:
        """(E,) the columns that were added."""
        return np.arange(len(np.unique(self.marker)), len(self.marker))

    def column(self, marker: int, frame: int) -> int:
        """The column that speaks for a marker in a frame."""
        return int(np.flatnonzero((self.marker == marker) & self.own[frame])[0])

    def split(self, mask: np.ndarray) -> np.ndarray:
        """-> (T, C) what is so of each column, from what is so of each marker (T, M); False where another speaks."""
        return mask[:, self.marker] & self.own

    def joined(self, each: np.ndarray) -> np.ndarray:
        """-> (T, M, ...) each marker's from its columns' (T, C, ...)."""
        out = each[:, : len(self.marker) - len(self.more)].copy()
        for column in self.more:
            frames = self.own[:, column]
            out[frames, self.marker[column]] = each[frames, column]
        return out


def parted(take: Take, faults: Iterable[Fault]) -> Parts:
    """-> the take with a column for every place of a marker that moved.

    While a marker slides it is at neither place: its samples there are in no column, though they stay as measured.
    """
    count, frames = len(take.labels), np.arange(take.frames)
    marker, own = list(range(count)), [np.ones(take.frames, bool) for _ in range(count)]
    paths = [take.markers[:, m] for m in range(count)]
    moved = sorted((fault for fault in faults if isinstance(fault, Moved)), key=lambda fault: (fault.marker, fault.first))
    for m, each in groupby(moved, key=lambda fault: fault.marker):
        moves = _lasting(list(each), take.seen[:, m], round(LEAST * take.rate))
        starts = [0, *(fault.settled for fault in moves)]
        stops = [*(fault.first for fault in moves), take.frames]
        middles = [(fault.first + fault.settled) // 2 for fault in moves]
        stays = list(zip(starts, stops, [0, *middles], [*middles, take.frames], strict=True))
        stays.sort(key=lambda stay, m=m: -take.seen[stay[0] : stay[1], m].sum())
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
        return Parts(take, columns, np.ones((take.frames, count), bool))
    labels = tuple(take.labels[m] for m in marker)
    computed = None if take.computed is None else take.computed[:, columns]
    parts = replace(take, markers=np.stack(paths, 1), labels=labels, computed=computed, columns=columns, source=None)
    return Parts(parts, columns, np.stack(own, 1))


def _lasting(moves: list[Moved], seen: np.ndarray, least: int) -> list[Moved]:
    """-> of a marker's moves, by first frame, those before and after which it is `seen` (T,) in so many frames."""
    kept: list[Moved] = []
    for move in moves:
        since = kept[-1].settled if kept else 0
        if seen[since : move.first].sum() >= least and seen[move.settled :].sum() >= least:
            kept.append(move)
    return kept
