"""Marker tables: text files with one line per frame and three fields per point, as most text formats have them.

The module of each format finds the table and its columns; this module reads it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.errors import ReadError
from mocapfix.files.layouts import TableLayout
from mocapfix.files.read_options import ReadOptions
from mocapfix.read.coordinates import ROTATIONS_TO_Y_UP, find_valid_points
from mocapfix.read.file_content import TextDocument
from mocapfix.read.point_takes import add_other_points, find_computed_markers
from mocapfix.read.point_types import DeclaredPoints, check_point_types, classify_points
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
from mocapfix.read.up_axis import estimate_up_axis
from mocapfix.take import Take

MAX_HEADER_LINES = 15  # lines within which the column names must begin
MAX_FRAME_NUMBER = 2**53  # larger whole numbers are not exact as floats


@dataclass(frozen=True)
class MarkerTable:
    """Where a table is in a document, and what its columns are.

    Attributes:
        document: The file.
        delimiter: Field separator.
        line_indices: Index of the line of each frame.
        frame_field: Field with the frame number; None if frames are counted from 1.
        field_indices: Index of the X, Y and Z field of each of the P points.
        labels: Labels of the points.
        unit_m: Metres per file unit.
        rate: Frames per second.
        declared_frame_count: Number of frames as the header gives it, "" if it does not.
        default_up_axis: Up axis of most files of the format, "Y" or "Z".
        notes: Sentences about assumptions made so far.
    """

    document: TextDocument
    delimiter: str
    line_indices: Sequence[int]
    frame_field: int | None
    field_indices: Int[np.ndarray, "P 3"]
    labels: Sequence[str]
    unit_m: float
    rate: float
    declared_frame_count: str = ""
    default_up_axis: str = "Z"
    notes: tuple[str, ...] = ()


def find_names_line(document: TextDocument, content: str) -> int:
    """Return the index of the line that begins with Frame or Frame# and names the columns.

    Args:
        document: The file.
        content: What the line names, for error messages.

    Raises:
        ReadError: If none of the first lines begins so.
    """
    for index in range(min(MAX_HEADER_LINES, len(document.lines))):
        if document.get_line(index).lstrip(CELL_PADDING).lower().startswith("frame"):
            return index
    if len(document.lines) < MAX_HEADER_LINES:
        raise document.build_error(
            len(document.lines) - 1, f"the file ends before its {content} are named; copy or export it again."
        )
    problem = f"none of its first {MAX_HEADER_LINES} lines begins with Frame and names its {content}"
    raise ReadError(f"{document.path}: {problem}; export it again.")


def find_xyz_triples(axes: Sequence[str]) -> list[int]:
    """Return the index of the first of every three adjacent fields that are X, Y, Z in either case."""
    letters = [axis.upper() for axis in axes]
    return [i for i in range(len(letters) - 2) if letters[i : i + 3] == ["X", "Y", "Z"]]


def read_marker_table(table: MarkerTable, options: ReadOptions) -> Take:
    """Return the take in a table.

    Points are missing where a coordinate is blank or spelled as missing, and where `find_valid_points` rejects them.

    Raises:
        ReadError: If a field is not a number, frame numbers are not consecutive, the last line is incomplete, or no point is
            a labelled marker. The message names file and line.
    """
    document, line_indices, field_indices = table.document, table.line_indices, table.field_indices
    notes = (*table.notes, *_check_completeness(table))
    decimal_sign = detect_decimal_sign(document, line_indices, table.delimiter)
    wanted = field_indices.ravel() if table.frame_field is None else np.r_[field_indices.ravel(), table.frame_field]
    numbers = parse_fields(document, line_indices, table.delimiter, decimal_sign, wanted)
    points_file = numbers[:, : field_indices.size].reshape(len(line_indices), -1, 3)
    first_frame = 1
    if table.frame_field is not None:
        first_frame, numbering_notes = read_first_frame(document, line_indices, numbers[:, -1])
        notes += numbering_notes
    return build_take(
        document.path,
        points_file,
        table.labels,
        unit_m=table.unit_m,
        rate=table.rate,
        first_frame=first_frame,
        layout=_build_table_layout(table, decimal_sign, find_valid_points(points_file)),
        default_up_axis=table.default_up_axis,
        notes=notes,
        options=options,
    )


def build_take(
    path: Path,
    points_file: Float[np.ndarray, "T P 3"],
    labels: Sequence[str],
    *,
    unit_m: float,
    rate: float,
    first_frame: int,
    layout: TableLayout,
    default_up_axis: str = "Z",
    notes: tuple[str, ...] = (),
    options: ReadOptions,
) -> Take:
    """Build a take from the trajectories of P points.

    Args:
        path: The file.
        points_file: Coordinates in file units and axes; points that `find_valid_points` rejects are missing.
        labels: Labels of the points.
        unit_m: Metres per file unit.
        rate: Frames per second.
        first_frame: Number that the file gives to frame index 0.
        layout: Where the samples lie in the file; its rotation is set here.
        default_up_axis: Up axis of most files of the format, "Y" or "Z".
        notes: Sentences about assumptions made so far.
        options: What is known about the file.

    Raises:
        ReadError: If no point is a marker.
    """
    visible = find_valid_points(points_file)
    types = classify_points(DeclaredPoints(labels), visible, np.zeros(visible.shape))
    check_point_types(path, types)
    positions_file = np.where(visible[..., None], points_file * unit_m, np.nan)
    inspected = types.markers if len(types.markers) else types.unlabelled
    up_axis = estimate_up_axis([types.labels[i] for i in inspected], positions_file[:, inspected], rate, default_up_axis)
    rotation = ROTATIONS_TO_Y_UP[up_axis.letter]

    def convert(
        columns: Int[np.ndarray, " K"], frames: slice | Int[np.ndarray, " F"] = slice(None)
    ) -> Float[np.ndarray, "F K 3"]:
        return positions_file[frames][:, columns] @ rotation.T

    functions = find_computed_markers(types, visible, convert)
    columns = np.setdiff1d(types.markers, list(functions))
    take = Take(
        convert(columns),
        tuple(types.labels[int(i)] for i in columns),
        rate,
        first_frame,
        path,
        layout=replace(layout, rotation_y_up_file=rotation),
        point_columns=columns,
        up_axis=up_axis,
        notes=notes,
    )
    return add_other_points(take, types, functions, convert)


def read_first_frame(
    document: TextDocument, line_indices: Sequence[int], frame_numbers: Float[np.ndarray, " T"]
) -> tuple[int, tuple[str, ...]]:
    """Return the number of the first frame, and a note if frame numbers increase by more than one.

    Raises:
        ReadError: If frame numbers are not consecutive. The message names the line.
    """
    is_invalid = ~(np.abs(frame_numbers) < MAX_FRAME_NUMBER) | (frame_numbers != np.rint(frame_numbers))
    if (invalid := np.flatnonzero(is_invalid)).size:
        raise document.build_error(line_indices[invalid[0]], "does not begin with a frame number; export it again.")
    steps = np.diff(frame_numbers)
    step = steps[0] if len(steps) else 1.0
    if (irregular := np.flatnonzero((steps != step) | (steps < 1))).size:
        t = irregular[0]
        problem = f"frame {frame_numbers[t + 1]:.0f} follows frame {frame_numbers[t]:.0f}"
        raise document.build_error(line_indices[t + 1], f"{problem}; export the complete trial.")
    first = int(frame_numbers[0])
    if step == 1:
        return first, ()
    return first, (f"Frame numbers in the file increase by {step:.0f}; they are counted here from {first} in steps of one.",)


def _check_completeness(table: MarkerTable) -> tuple[str, ...]:
    """Return a note if the header declares another number of frames than the table has.

    Fewer complete lines than declared are accepted: the trial was shortened. A copy that was cut off ends within a line or,
    with too few frames, without a line end.

    Raises:
        ReadError: If there are no frames, or the file was cut off.
    """
    document, frame_count = table.document, len(table.line_indices)
    declared = parse_whole_number(table.declared_frame_count)
    if not frame_count:
        raise ReadError(f"{document.path}: has no frames; export the trial again.")
    last, needed = table.line_indices[-1], int(table.field_indices.max()) + 1
    has_no_line_end = last == len(document.lines) - 1
    fields = document.get_line(last).count(table.delimiter) + 1
    if has_no_line_end and fields < needed:
        raise document.build_error(last, f"the file is cut off: {fields} of {needed} fields; copy or export it again.")
    if has_no_line_end and declared is not None and declared > frame_count:
        problem = f"{declared} frames are declared and {frame_count} are there"
        raise document.build_error(last, f"the file is cut off: {problem}; copy or export it again.")
    return check_frame_count(table.declared_frame_count, frame_count)


def _build_table_layout(table: MarkerTable, decimal_sign: str, visible: Bool[np.ndarray, "T P"]) -> TableLayout:
    """Return the layout without its rotation. Number formats are inferred from lines throughout the file."""
    document, cells = table.document, {True: list[str](), False: list[str]()}
    for t in np.unique(np.linspace(0, len(table.line_indices) - 1, MAX_INSPECTED_LINES).astype(int)):
        line = split_fields(document.get_line(table.line_indices[t]), table.delimiter, decimal_sign)
        for x, is_present in zip(table.field_indices[:, 0].tolist(), visible[t].tolist(), strict=True):
            if x < len(line):
                cells[is_present].append(line[x].strip(CELL_PADDING))
    number_format, missing_text = infer_number_format(cells[True], cells[False], table.unit_m)
    return TableLayout(
        encoding=document.encoding,
        newline=document.newline,
        delimiter=table.delimiter,
        decimal_sign=decimal_sign,
        unit_m=table.unit_m,
        line_indices=np.asarray(table.line_indices, int),
        field_indices=table.field_indices,
        number_format=number_format,
        missing_text=missing_text.replace(".", decimal_sign),
    )
