"""Trajectories of named points as a take: what every text format comes to, however it lists them."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from mocapfix.errors import ReadError
from mocapfix.read.axes import to_y_up
from mocapfix.read.labels import marker_columns, unlabelled_columns
from mocapfix.read.places import there
from mocapfix.read.text import Document
from mocapfix.table_layout import TableLayout
from mocapfix.take import Take


def take_of(
    path: Path,
    raw: np.ndarray,
    labels: Sequence[str],
    unit: float,
    rate: float,
    first: int,
    layout: TableLayout | None = None,
    usual: str = "Z",
    notes: tuple[str, ...] = (),
) -> Take:
    """-> the take of the points `raw` (T, P, 3) in units of `unit` metres, NaN, all 0 or all nines where missing.

    rate    frames a second;  first  the file's number of frame 0;  labels  of the P points
    layout  where they lie, its axes not known yet;  usual  as read.axes.to_y_up takes it

    Raises ReadError where no point is a labelled marker.
    """
    seen = there(raw)
    columns = marker_columns(labels, frozenset(), seen, np.zeros(seen.shape))
    if not len(columns):
        raise ReadError(f"{path}: none of its {len(labels)} trajectories is a labelled marker; label them and export it again.")
    positions = np.where(seen[..., None], raw * unit, np.nan)
    axes = to_y_up("", [labels[int(i)] for i in columns], positions[:, columns], usual)
    nameless = unlabelled_columns(labels, frozenset(), seen)

    def take(points: np.ndarray, **more) -> Take:
        names = tuple(labels[int(i)] for i in points)
        return Take(positions[:, points] @ axes.T, names, rate, first, path, columns=points, **more)

    return take(
        columns,
        layout=replace(layout, axes=axes) if layout else None,
        others=tuple(label for i, label in enumerate(labels) if i not in set(columns)),
        unlabelled=take(nameless) if len(nameless) else None,
        notes=notes,
    )


def first_frame(document: Document, rows: Sequence[int], count: np.ndarray) -> tuple[int, tuple[str, ...]]:
    """-> the file's number of its first frame, of those (T,) that the lines `rows` bear, and what must be said of the others.

    Raises ReadError naming the line where frames do not follow one another.
    """
    if (odd := np.flatnonzero(~(np.abs(count) < 2**53) | (count != np.rint(count)))).size:
        raise document.fault(rows[odd[0]], "does not begin with a frame's number; export it again.")
    steps = np.diff(count)
    step = steps[0] if len(steps) else 1.0
    if (odd := np.flatnonzero((steps != step) | (steps < 1))).size:
        t = odd[0]
        follows = f"frame {count[t + 1]:.0f} follows frame {count[t]:.0f}"
        raise document.fault(rows[t + 1], f"{follows}; export the trial whole.")
    first = int(count[0])
    if step == 1:
        return first, ()
    return first, (f"The file numbers its frames by {step:.0f}; here they are counted on from {first} by one.",)
