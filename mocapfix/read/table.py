"""A table of trajectories, a line a frame and three fields a point: what most text formats of marker takes have in common.

Each format's own module says where the table lies and what its columns are; here it is read.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mocapfix.errors import ReadError
from mocapfix.read import trajectories
from mocapfix.read.cells import AROUND, LOOKED_AT, decimal_sign, miscounted, numbers, split, whole, written
from mocapfix.read.places import there
from mocapfix.read.text import Document
from mocapfix.table_layout import TableLayout
from mocapfix.take import Take

HEADER = 15  # lines, within which what the columns are must be named


@dataclass(frozen=True)
class Sheet:
    """Where a table lies in a document, and what its columns are.

    rows      indices of its lines, a frame each
    frame     the field with the frame's number; None: counted from 1
    fields    (P, 3) the fields with each point's x, y and z;  labels  of the P points
    unit      metres per file unit;  rate  frames a second
    promised  how many frames the file says it has, as it says it
    usual, notes  as read.trajectories.take_of takes them
    """

    document: Document
    delimiter: str
    rows: Sequence[int]
    frame: int | None
    fields: np.ndarray
    labels: Sequence[str]
    unit: float
    rate: float
    promised: str = ""
    usual: str = "Z"
    notes: tuple[str, ...] = ()


def names_line(document: Document, what: str) -> int:
    """-> the index of the line that begins with Frame, or Frame#, and names `what` the table has.

    Raises ReadError where it does not come within the first HEADER lines.
    """
    for index in range(min(HEADER, len(document.lines))):
        if document.line(index).lstrip(AROUND).lower().startswith("frame"):
            return index
    if len(document.lines) < HEADER:
        raise document.fault(len(document.lines) - 1, f"the file ends before its {what} are named; copy or export it again.")
    raise ReadError(f"{document.path}: none of its first {HEADER} lines begins with Frame and names its {what}; export it again.")


def triples(axes: Sequence[str]) -> list[int]:
    """-> the fields of a line of axes at which an X, a Y and a Z stand side by side, in either case: a point's first ones."""
    letters = [axis.upper() for axis in axes]
    return [i for i in range(len(letters) - 2) if letters[i : i + 3] == ["X", "Y", "Z"]]


def take_of(sheet: Sheet) -> Take:
    """-> the take in a table: metres, Y up, NaN where a coordinate is blank, spelled as missing, or all three are 0.

    Raises ReadError, naming file and line, where a field is no number, frames do not follow one another, the last line is
    cut off, or no point is a labelled marker.
    """
    document, rows = sheet.document, sheet.rows
    said = (*sheet.notes, *_check_end(sheet))
    decimal = decimal_sign(document, rows, sheet.delimiter)
    wanted = sheet.fields.ravel() if sheet.frame is None else np.r_[sheet.fields.ravel(), sheet.frame]
    told, first = numbers(document, rows, sheet.delimiter, decimal, wanted), 1
    raw = told[:, : sheet.fields.size].reshape(len(rows), -1, 3)
    if sheet.frame is not None:
        first, counted = trajectories.first_frame(document, rows, told[:, -1])
        said += counted
    layout = _layout(sheet, decimal, there(raw))
    return trajectories.take_of(document.path, raw, sheet.labels, sheet.unit, sheet.rate, first, layout, sheet.usual, said)


def _check_end(sheet: Sheet) -> tuple[str, ...]:
    """-> what must be said of the number of frames that was promised.

    Raises ReadError where there are none, or the file ends within a line or, before its promise is kept, without a line's
    end: so does a copy that was cut off. Fewer whole lines are what somebody left of a longer trial.
    """
    document, frames, promised = sheet.document, len(sheet.rows), whole(sheet.promised)
    if not frames:
        raise ReadError(f"{document.path}: holds no frames; export the trial again.")
    last, needed = sheet.rows[-1], int(sheet.fields.max()) + 1
    is_last = last == len(document.lines) - 1
    fields = document.line(last).count(sheet.delimiter) + 1
    if is_last and fields < needed:
        raise document.fault(last, f"is cut off: {fields} fields are there and {needed} belong there; copy or export it again.")
    if is_last and promised is not None and promised > frames:
        raise document.fault(last, f"is cut off: {promised} frames are promised, {frames} are there; copy or export it again.")
    return miscounted(sheet.promised, frames)


def _layout(sheet: Sheet, decimal: str, seen: np.ndarray) -> TableLayout:
    """-> where the samples lie, their axes not known yet; how they are written is told from lines all through the file."""
    document, cells = sheet.document, {True: [], False: []}
    for t in np.unique(np.linspace(0, len(sheet.rows) - 1, LOOKED_AT).astype(int)):
        line = split(document.line(sheet.rows[t]), sheet.delimiter, decimal)
        for x, is_there in zip(sheet.fields[:, 0].tolist(), seen[t].tolist(), strict=True):
            if x < len(line):
                cells[is_there].append(line[x].strip(AROUND))
    style, missing = written(cells[True], cells[False], sheet.unit)
    return TableLayout(
        encoding=document.encoding,
        newline=document.newline,
        delimiter=sheet.delimiter,
        decimal=decimal,
        unit=sheet.unit,
        lines=np.asarray(sheet.rows, int),
        fields=sheet.fields,
        style=style,
        missing=missing.replace(".", decimal),
    )
