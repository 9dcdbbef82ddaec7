"""Trajectories of named points as a take: what every text format comes to, however it lists them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mocapfix.errors import ReadError
from mocapfix.files.layouts import TableLayout
from mocapfix.read.coordinates import estimate_rotation_y_up, find_valid_points
from mocapfix.read.file_content import TextDocument
from mocapfix.read.point_types import find_marker_columns, find_unlabelled_columns
from mocapfix.read.table_cells import (
    CELL_PADDING,
    MAX_INSPECTED_LINES,
    check_frame_count,
    detect_decimal_sign,
    infer_number_format,
    parse_fields,
    parse_whole_number,
    split_fields,
)
from mocapfix.take import Take


# MERGED: mocapfix.read.trajectories
def build_take(
    path: Path,
    points_file: np.ndarray,
    labels: Sequence[str],
    unit_m: float,
    rate: float,
    first_frame: int,
    layout: TableLayout | None = None,
    default_up_axis: str = "Z",
    notes: tuple[str, ...] = (),
) -> Take:
    """-> the take of the points `raw` (T, P, 3) in units of `unit` metres, NaN, all 0 or all nines where missing.

    rate    frames a second;  first  the file's number of frame 0;  labels  of the P points
    layout  where they lie, its axes not known yet;  usual  as read.axes.to_y_up takes it

    Raises ReadError where no point is a labelled marker.
    """
    seen = find_valid_points(points_file)
    columns = find_marker_columns(labels, frozenset(), seen, np.zeros(seen.shape))
    if not len(columns):
        raise ReadError(f"{path}: none of its {len(labels)} trajectories is a labelled marker; label them and export it again.")
    positions = np.where(seen[..., None], points_file * unit_m, np.nan)
    axes = estimate_rotation_y_up("", [labels[int(i)] for i in columns], positions[:, columns], default_up_axis)
    nameless = find_unlabelled_columns(labels, frozenset(), seen)

    def take(points: np.ndarray, **more) -> Take:
        names = tuple(labels[int(i)] for i in points)
        return Take(positions[:, points] @ axes.T, names, rate, first_frame, path, point_columns=points, **more)

    return take(
        columns,
        layout=replace(layout, rotation_y_up_file=axes) if layout else None,
        other_labels=tuple(label for i, label in enumerate(labels) if i not in set(columns)),
        unlabelled=take(nameless) if len(nameless) else None,
        notes=notes,
    )


def read_first_frame(
    document: TextDocument, line_indices: Sequence[int], frame_numbers: np.ndarray
) -> tuple[int, tuple[str, ...]]:
    """-> the file's number of its first frame, of those (T,) that the lines `rows` bear, and what must be said of the others.

    Raises ReadError naming the line where frames do not follow one another.
    """
    if (odd := np.flatnonzero(~(np.abs(frame_numbers) < 2**53) | (frame_numbers != np.rint(frame_numbers)))).size:
        raise document.build_error(line_indices[odd[0]], "does not begin with a frame's number; export it again.")
    steps = np.diff(frame_numbers)
    step = steps[0] if len(steps) else 1.0
    if (odd := np.flatnonzero((steps != step) | (steps < 1))).size:
        t = odd[0]
        follows = f"frame {frame_numbers[t + 1]:.0f} follows frame {frame_numbers[t]:.0f}"
        raise document.build_error(line_indices[t + 1], f"{follows}; export the trial whole.")
    first = int(frame_numbers[0])
    if step == 1:
        return first, ()
    return first, (f"The file numbers its frames by {step:.0f}; here they are counted on from {first} by one.",)


# MERGED: mocapfix.read.table
# A table of trajectories, a line a frame and three fields a point: what most text formats of marker takes have in common.
#
# Each format's own module says where the table lies and what its columns are; here it is read.
MAX_HEADER_LINES = 15  # lines, within which what the columns are must be named


@dataclass(frozen=True)
class MarkerTable:
    """Where a table lies in a document, and what its columns are.

    rows      indices of its lines, a frame each
    frame     the field with the frame's number; None: counted from 1
    fields    (P, 3) the fields with each point's x, y and z;  labels  of the P points
    unit      metres per file unit;  rate  frames a second
    promised  how many frames the file says it has, as it says it
    usual, notes  as read.trajectories.take_of takes them
    """

    document: TextDocument
    delimiter: str
    line_indices: Sequence[int]
    frame_field: int | None
    field_indices: np.ndarray
    labels: Sequence[str]
    unit_m: float
    rate: float
    declared_frame_count: str = ""
    default_up_axis: str = "Z"
    notes: tuple[str, ...] = ()


def find_names_line(document: TextDocument, content: str) -> int:
    """-> the index of the line that begins with Frame, or Frame#, and names `what` the table has.

    Raises ReadError where it does not come within the first HEADER lines.
    """
    for index in range(min(MAX_HEADER_LINES, len(document.lines))):
        if document.get_line(index).lstrip(CELL_PADDING).lower().startswith("frame"):
            return index
    if len(document.lines) < MAX_HEADER_LINES:
        raise document.build_error(
            len(document.lines) - 1, f"the file ends before its {content} are named; copy or export it again."
        )
    raise ReadError(
        f"{document.path}: none of its first {MAX_HEADER_LINES} lines begins with Frame and names its {content}; export it again."
    )


def find_xyz_triples(axes: Sequence[str]) -> list[int]:
    """-> the fields of a line of axes at which an X, a Y and a Z stand side by side, in either case: a point's first ones."""
    letters = [axis.upper() for axis in axes]
    return [i for i in range(len(letters) - 2) if letters[i : i + 3] == ["X", "Y", "Z"]]


def read_marker_table(table: MarkerTable) -> Take:
    """-> the take in a table: metres, Y up, NaN where a coordinate is blank, spelled as missing, or all three are 0.

    Raises ReadError, naming file and line, where a field is no number, frames do not follow one another, the last line is
    cut off, or no point is a labelled marker.
    """
    document, rows = table.document, table.line_indices
    said = (*table.notes, *_check_completeness(table))
    decimal = detect_decimal_sign(document, rows, table.delimiter)
    wanted = table.field_indices.ravel() if table.frame_field is None else np.r_[table.field_indices.ravel(), table.frame_field]
    told, first = parse_fields(document, rows, table.delimiter, decimal, wanted), 1
    raw = told[:, : table.field_indices.size].reshape(len(rows), -1, 3)
    if table.frame_field is not None:
        first, counted = read_first_frame(document, rows, told[:, -1])
        said += counted
    layout = _build_table_layout(table, decimal, find_valid_points(raw))
    return build_take(document.path, raw, table.labels, table.unit_m, table.rate, first, layout, table.default_up_axis, said)


def _check_completeness(sheet: MarkerTable) -> tuple[str, ...]:
    """-> what must be said of the number of frames that was promised.

    Raises ReadError where there are none, or the file ends within a line or, before its promise is kept, without a line's
    end: so does a copy that was cut off. Fewer whole lines are what somebody left of a longer trial.
    """
    document, frames, promised = sheet.document, len(sheet.line_indices), parse_whole_number(sheet.declared_frame_count)
    if not frames:
        raise ReadError(f"{document.path}: holds no frames; export the trial again.")
    last, needed = sheet.line_indices[-1], int(sheet.field_indices.max()) + 1
    is_last = last == len(document.lines) - 1
    fields = document.get_line(last).count(sheet.delimiter) + 1
    if is_last and fields < needed:
        raise document.build_error(
            last, f"is cut off: {fields} fields are there and {needed} belong there; copy or export it again."
        )
    if is_last and promised is not None and promised > frames:
        raise document.build_error(
            last, f"is cut off: {promised} frames are promised, {frames} are there; copy or export it again."
        )
    return check_frame_count(sheet.declared_frame_count, frames)


def _build_table_layout(sheet: MarkerTable, decimal: str, seen: np.ndarray) -> TableLayout:
    """-> where the samples lie, their axes not known yet; how they are written is told from lines all through the file."""
    document, cells = sheet.document, {True: [], False: []}
    for t in np.unique(np.linspace(0, len(sheet.line_indices) - 1, MAX_INSPECTED_LINES).astype(int)):
        line = split_fields(document.get_line(sheet.line_indices[t]), sheet.delimiter, decimal)
        for x, is_there in zip(sheet.field_indices[:, 0].tolist(), seen[t].tolist(), strict=True):
            if x < len(line):
                cells[is_there].append(line[x].strip(CELL_PADDING))
    style, missing = infer_number_format(cells[True], cells[False], sheet.unit_m)
    return TableLayout(
        encoding=document.encoding,
        newline=document.newline,
        delimiter=sheet.delimiter,
        decimal_sign=decimal,
        unit_m=sheet.unit_m,
        line_indices=np.asarray(sheet.line_indices, int),
        field_indices=sheet.field_indices,
        number_format=style,
        missing_text=missing.replace(".", decimal),
    )
