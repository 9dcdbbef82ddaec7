"""Marker tables: text files with one line per frame and three fields per point, as most text formats have them.

The module of each format finds the table and its columns; this module reads it. That is not left to a library: the available ones
(kineticstoolkit, pyomeca, trc-data-reader) depend on pandas, report neither the line of an error nor the spelling of missing
values, and lose the place of each number, which a patched copy of the file needs.
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import ceil, log10
from operator import itemgetter
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.errors import ReadError, format_name_list
from mocapfix.io.conventions import Convention, DeclaredConvention, decide_convention
from mocapfix.io.coordinates import METRES_PER_UNIT, find_valid_points, get_metres_per_unit, inspect_points
from mocapfix.io.file_content import NOT_A_NUMBER_PATTERN, TextDocument
from mocapfix.io.frame_rate import FrameTimes, find_frames, parse_time
from mocapfix.io.points import DeclaredPoints, add_other_points, check_point_types, classify_points, find_computed_markers
from mocapfix.model.take import TableLayout, Take, UpAxis
from mocapfix.options import ReadOptions

MISSING_TEXTS = {"", "n/a", "na", "null", "none", "-", "--"}  # in lower case
DECIMAL_COMMA_PATTERN = re.compile(r"\d,\d")
CELL_PADDING = ' \t"'  # characters around the text of a cell
MAX_INSPECTED_LINES = 200  # lines from which number formats are inferred
WRITTEN_RESOLUTION_M = 1e-5  # least resolution of a written coordinate
MIN_SPLIT_NUMBER_RATIO = 1.5  # of fields to columns, if decimal commas split numbers in two
MAX_TABLE_DECIMALS = 9  # of a written coordinate
MIN_EXPONENT_DECIMALS = 6  # of a coordinate written with an exponent


def find_nonblank_lines(document: TextDocument, start: int, delimiter: str) -> Iterator[int]:
    """Yield the indices of the lines from `start` on that have any content."""
    blank = delimiter + " \t\r"
    return (i for i in range(start, len(document.lines)) if document.lines[i].strip(blank))


def parse_fields(
    document: TextDocument, line_indices: Sequence[int], delimiter: str, decimal_sign: str, field_indices: Int[np.ndarray, " F"]
) -> Float[np.ndarray, "T F"]:
    """Return the numbers in F fields of T lines, NaN where a number is missing or the line ends before the field.

    Raises:
        ReadError: If a field is not a number. The message names line and field.
    """
    wanted, numbers = field_indices.tolist(), np.empty((len(line_indices), len(field_indices)))
    select = itemgetter(*wanted) if len(wanted) > 1 else lambda cells: (cells[wanted[0]],)
    width = max(wanted) + 1
    for t, index in enumerate(line_indices):
        cells = split_fields(document.get_line(index), delimiter, decimal_sign)
        cells += [""] * (width - len(cells))
        try:
            numbers[t] = [float(cell) if cell else np.nan for cell in select(cells)]
        except ValueError:
            numbers[t] = [_parse_field(document, index, field, cells[field]) for field in wanted]
    return numbers


def _parse_field(document: TextDocument, index: int, field: int, cell: str) -> float:
    text = cell.strip(CELL_PADDING)
    if text.lower() in MISSING_TEXTS or NOT_A_NUMBER_PATTERN.fullmatch(text):
        return np.nan
    try:
        return float(text)
    except ValueError as error:
        raise document.build_error(index, f"field {field + 1} is {text[:20]!r} and not a number; export it again.") from error


def split_fields(line: str, delimiter: str, decimal_sign: str) -> list[str]:
    """Return the fields of a line, with decimal points."""
    return (line.replace(",", ".") if decimal_sign == "," else line).split(delimiter)


def detect_decimal_sign(document: TextDocument, line_indices: Sequence[int], delimiter: str) -> str:
    """Return "," if numbers are written with decimal commas and commas are not the delimiter, else "."."""
    inspected = (document.get_line(index) for index in line_indices[:MAX_INSPECTED_LINES])
    return "," if delimiter != "," and any(DECIMAL_COMMA_PATTERN.search(line) for line in inspected) else "."


def parse_whole_number(text: str) -> int | None:
    """Return the whole number in a header field, None if it has none."""
    try:
        return int(float(text.replace(",", ".")))
    except (ValueError, OverflowError):
        return None


def check_frame_count(declared: str, frame_count: int) -> tuple[str, ...]:
    """Return a note if the header field `declared` gives another number of frames than the file has."""
    if parse_whole_number(declared) in (None, frame_count):
        return ()
    return (f"The header declares {parse_whole_number(declared)} frames; the file has {frame_count}.",)


def parse_unit(document: TextDocument, index: int, name: str) -> float:
    """Return the metres in the unit that the line at `index` names."""
    if (unit_m := get_metres_per_unit(name)) is None:
        raise document.build_error(index, f"the unit is {name!r}; give it with --unit, one of {', '.join(METRES_PER_UNIT)}.")
    return unit_m


def parse_unit_or_default(document: TextDocument, index: int, name: str, default_unit: str) -> tuple[float, tuple[str, ...]]:
    """Return the metres in the unit that the line at `index` names, and a note if the default is used because it names none."""
    if name.strip():
        return parse_unit(document, index, name), ()
    return METRES_PER_UNIT[default_unit], (f"The header names no unit; {default_unit}, the usual one, is assumed.",)


def parse_times(document: TextDocument, line_indices: Sequence[int], delimiter: str, time_field: int) -> Float[np.ndarray, " T"]:
    """Return the times in one field of T lines as `parse_time` reads them, NaN where there is none."""
    cells = (document.get_line(index).split(delimiter, time_field + 1) for index in line_indices)
    texts = (line[time_field].strip(CELL_PADDING) if len(line) > time_field else "" for line in cells)
    return np.array([parse_time(text) if text else np.nan for text in texts], float)


def check_decimal_commas(document: TextDocument, line_indices: Sequence[int], delimiter: str, column_count: int) -> None:
    """Raise ReadError for decimal commas between commas: lines have twice as many fields as columns, and no points."""
    if delimiter != "," or not line_indices:
        return
    index = line_indices[0]
    line = document.get_line(index)
    if "." not in line and line.rstrip(", ").count(",") + 1 >= MIN_SPLIT_NUMBER_RATIO * column_count:
        problem = (
            f"has {line.count(',') + 1} fields for {column_count} columns: its decimal commas cannot be told from those between"
        )
        raise document.build_error(index, f"{problem}; export it with semicolons, tabs or decimal points.")


def infer_number_format(present: Sequence[str], missing: Sequence[str], unit_m: float) -> tuple[str, str]:
    """Infer how a file writes coordinates.

    Args:
        present: Cells with coordinates.
        missing: Cells of missing coordinates.
        unit_m: Metres per file unit.

    Returns:
        Format specification of a coordinate, as for `format`, and the text of a missing one. The format has as many decimals
        as the longest cell, and enough for 0.01 mm.
    """
    missing_text = max(sorted(set(missing)), key=missing.count) if missing else ""
    mantissas = [cell.lower().partition("e")[0] for cell in present]
    decimals = max((len(mantissa.partition(".")[2]) for mantissa in mantissas), default=0)
    if 2 * sum("e" in cell.lower() for cell in present) > len(present):
        return f".{max(decimals, MIN_EXPONENT_DECIMALS)}e", missing_text
    needed = ceil(log10(unit_m / WRITTEN_RESOLUTION_M) - 1e-9)
    return f".{min(max(decimals, needed), MAX_TABLE_DECIMALS)}f", missing_text


MAX_HEADER_LINES = 15  # lines within which the column names must begin


@dataclass(frozen=True)
class MarkerTable:
    """Where a table is in a document, and what its columns are."""

    document: TextDocument  # the file
    delimiter: str  # field separator
    line_indices: Sequence[int]  # index of the line of each frame
    frame_field: int | None  # field with the frame number; None if frames are counted from 1
    field_indices: Int[np.ndarray, "P 3"]  # index of the X, Y and Z field of each of the P points
    labels: Sequence[str]  # labels of the points
    unit_m: float  # metres per file unit
    rate_text: str = ""  # frames per second as the header gives them, "" if it does not
    rate_line: int = 0  # index of the line that gives them, for messages
    time_field: int | None = None  # field with the time; None if there is none
    time_unit_s: float | None = 1.0  # seconds in the unit of the time; None if it is not known
    declared_frame_count: str = ""  # number of frames as the header gives it, "" if it does not
    default_up_axis: str = "Z"  # up axis of most files of the format, "Y" or "Z"
    notes: tuple[str, ...] = ()  # sentences about assumptions made so far


MAX_CAPTURE_SPAN_M = 20  # coordinates that span more units than this are not in metres


def assume_unit(coordinates: Float[np.ndarray, "*shape"]) -> tuple[str, str]:
    """Return "mm" if coordinates span more than a capture in metres does, else "m", and a note that this is assumed."""
    finite = coordinates[np.isfinite(coordinates)]
    unit = "mm" if len(finite) and np.ptp(finite) > MAX_CAPTURE_SPAN_M else "m"
    return unit, f"The file names no unit; {unit} is assumed, from the span of its coordinates."


def find_names_line(document: TextDocument, content: str) -> int:
    """Return the index of the line that begins with Frame or Frame# and names the columns.

    Args:
        content: What the line names, for error messages.
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

    Points are missing where a coordinate is blank or spelled as missing, where `find_valid_points` rejects them, and in frames
    that frame numbers or times omit.

    Raises:
        ReadError: If a field is not a number, frame numbers are not in order, the last line is incomplete, no rate is possible,
            or no point is a labelled marker. The message names file and line.
    """
    document, line_indices, field_indices = table.document, table.line_indices, table.field_indices
    _check_completeness(table)
    decimal_sign = detect_decimal_sign(document, line_indices, table.delimiter)
    wanted = field_indices.ravel() if table.frame_field is None else np.r_[field_indices.ravel(), table.frame_field]
    numbers = parse_fields(document, line_indices, table.delimiter, decimal_sign, wanted)
    times = None
    if table.time_field is not None:
        times = FrameTimes(parse_times(document, line_indices, table.delimiter, table.time_field), table.time_unit_s)
    frames = find_frames(
        lambda row, sentence: document.build_error(line_indices[row], sentence),
        lambda sentence: document.build_error(table.rate_line, sentence),
        len(line_indices),
        stated_rate=table.rate_text,
        times=times,
        frame_numbers=None if table.frame_field is None else numbers[:, -1],
        options=options,
    )
    rows_file = numbers[:, : field_indices.size].reshape(len(line_indices), -1, 3)
    visible = find_valid_points(rows_file)
    is_part = np.isfinite(rows_file).any(2) & np.isnan(rows_file).any(2)
    parts = format_name_list([table.labels[p] for p in np.flatnonzero(is_part.any(0)).tolist()])
    part_notes = [f"Samples without all three coordinates are read as missing: {parts} ({is_part.sum():,} in all)."] * bool(
        is_part.any()
    )
    layout = _build_table_layout(table, decimal_sign, visible)
    counted = parse_whole_number(table.declared_frame_count) == frames.frame_count
    count_notes = () if counted else check_frame_count(table.declared_frame_count, len(line_indices))
    points, layout = frames.spread_rows(rows_file), replace(layout, line_indices=frames.spread_rows(layout.line_indices, -1))
    known, notes = (
        (frames.rate, frames.first_frame, table.default_up_axis),
        (*table.notes, *part_notes, *count_notes, *frames.notes),
    )
    take = build_take(document.path, points, table.labels, layout, *known, notes=notes, options=options)
    assert isinstance(take.layout, TableLayout)
    if take.layout.unit_m == table.unit_m:
        return take
    corrected = _build_table_layout(replace(table, unit_m=take.layout.unit_m), decimal_sign, visible)
    return replace(take, layout=replace(take.layout, number_format=corrected.number_format))


def build_take(
    path: Path,
    points_file: Float[np.ndarray, "T P 3"],
    labels: Sequence[str],
    layout: TableLayout,
    rate: float,
    first_frame: int,
    default_up_axis: str,
    *,
    notes: tuple[str, ...],
    options: ReadOptions,
) -> Take:
    """Build a take from the trajectories of P points.

    Args:
        points_file: Coordinates in file units and axes; points that `find_valid_points` rejects are missing.
        layout: Where the samples lie in the file, and its unit; its rotation is set here.
        rate: Frames per second.
        first_frame: Number that the file gives to frame index 0.
        default_up_axis: Up axis of most files of the format, "Y" or "Z".
        notes: Sentences about assumptions made so far.
        options: What is known about the file.
    """
    visible = find_valid_points(points_file)
    types = classify_points(DeclaredPoints(labels), visible, np.zeros(visible.shape))
    check_point_types(path, types)
    points_file = np.where(visible[..., None], points_file, np.nan)

    def convert_from(
        convention: Convention, columns: Int[np.ndarray, " K"], frames: slice | Int[np.ndarray, " F"] = slice(None)
    ) -> Float[np.ndarray, "F K 3"]:
        return convention.apply(points_file[frames][:, columns])

    declared = DeclaredConvention(layout.unit_m, default_up_axis)
    in_file = partial(convert_from, Convention(layout.unit_m, np.eye(3), UpAxis("Y", "")))
    convention = decide_convention(path, inspect_points(types, len(points_file), rate, in_file), declared, options)
    convert = partial(convert_from, convention)

    functions = find_computed_markers(types, visible, convert)
    columns = np.setdiff1d(types.markers, list(functions))
    take = Take(
        convert(columns),
        tuple(types.labels[int(i)] for i in columns),
        rate,
        first_frame,
        path,
        layout=replace(layout, unit_m=convention.unit_m, rotation_y_up_file=convention.rotation_y_up_file),
        point_columns=columns,
        up_axis=convention.up_axis,
        notes=(*notes, *convention.notes),
    )
    return add_other_points(take, types, functions, convert)


def _check_completeness(table: MarkerTable) -> None:
    """Raise ReadError if there are no frames, or the file was cut off.

    Fewer complete lines than declared are accepted: the trial was shortened. A copy that was cut off ends within a line or,
    with too few frames, without a line end.
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


def _build_table_layout(table: MarkerTable, decimal_sign: str, visible: Bool[np.ndarray, "T P"]) -> TableLayout:
    """Return the layout without its rotation. Number formats are inferred from lines throughout the file."""
    document, cells = table.document, {True: list[str](), False: list[str]()}
    for t in np.unique(np.linspace(0, len(table.line_indices) - 1, MAX_INSPECTED_LINES).astype(int)):
        line = split_fields(document.get_line(table.line_indices[t]), table.delimiter, decimal_sign)
        for x, is_present in zip(table.field_indices[:, 0].tolist(), visible[t].tolist(), strict=True):
            if x < len(line):
                cells[is_present].append(line[x].strip(CELL_PADDING))
    number_format, missing_text = infer_number_format(cells[True], cells[False], table.unit_m)
    lines, missing_text = np.asarray(table.line_indices, int), missing_text.replace(".", decimal_sign)
    layout = TableLayout(document.encoding, document.newline, table.delimiter, decimal_sign, table.unit_m, lines)
    return replace(layout, field_indices=table.field_indices, number_format=number_format, missing_text=missing_text)
