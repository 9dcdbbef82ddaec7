"""Read OptiTrack Motive's CSV, in the two forms that it has had.

Since version 1.2 there is a column for each coordinate of a marker. The first line has keys and values in turn, and rows of
types, names and IDs precede the columns (OptiTrack documentation, "Data Export: CSV"). Only positions of markers are read:
rigid bodies, bones, rotations, qualities and errors are other columns, which a patched copy leaves unchanged.

In version 1.1 each row begins with its type, and the comments of the file describe the rest (OptiTrack, "Format
Information", in the file). A frame row lists rigid bodies with eleven fields each, then the visible markers: X, Y, Z, ID and
name, in metres. Missing samples have no field, so the layout has no fields.
"""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from mocapfix.errors import ReadError, format_name_list
from mocapfix.io.file_content import TextDocument, detect_delimiter, parse_document, split_head_lines
from mocapfix.io.frame_rate import FrameTimes, find_frames
from mocapfix.io.marker_table import (
    MarkerTable,
    build_take,
    check_decimal_commas,
    check_frame_count,
    find_names_line,
    find_nonblank_lines,
    find_xyz_triples,
    parse_fields,
    parse_times,
    parse_unit_or_default,
    read_marker_table,
)
from mocapfix.io.points import is_unlabelled
from mocapfix.model.take import TableLayout, Take
from mocapfix.options import ReadOptions

MARKER_TYPE = "marker"  # type of a column with a measured marker, in lower case
EXPECTED_MARKERS_NOTE = (
    "The file has no measured markers, only the positions at which its rigid bodies expect them; export Markers as well."
)

# Version 1.1
VERSION_LINE_PATTERN = re.compile(r'"?info"?,"?(version|framecount)"?,', re.IGNORECASE)
FRAME_FIELD = 1  # of a frame row: its number
TIME_FIELD = 2  # of a frame row: its time (s)
BODY_COUNT_FIELD = 3  # of a frame row: the number of rigid bodies
FIELDS_PER_BODY = 11
FIELDS_PER_MARKER = 5
UNNAMED_MARKER_PATTERN = re.compile(r"|Marker-\d+|Unlabell?ed.*", re.IGNORECASE)  # names of markers outside rigid bodies
MOTIVE_ROWS_UNIT_M = 1.0


class _MarkerColumns(NamedTuple):
    """The columns of the P markers, and notes on the choice."""

    field_indices: Int[np.ndarray, "P 3"]
    labels: list[str]
    notes: tuple[str, ...]


def is_motive_csv(head: bytes) -> bool:
    """Return whether a file with this beginning is a Motive CSV of version 1.2 or later."""
    return head[:20].lower().replace(b'"', b"").startswith(b"format version")


def read_motive_csv(path: Path, data: bytes, options: ReadOptions) -> Take:
    """Return the take in the bytes of a Motive CSV of version 1.2 or later.

    If measured markers were not exported, the positions at which rigid bodies expect them are read instead.

    Raises:
        ReadError: If there are no markers, or coordinates are local to bodies. The message names file and line.
    """
    document = parse_document(path, data)
    header_index = document.find_first_line()
    delimiter = detect_delimiter(document.get_line(header_index)) or ","
    header = _parse_motive_header(document.split_cells(header_index, delimiter))
    if header.get("coordinate space", "").lower() == "local":
        raise document.build_error(
            header_index, "the coordinates are local to rigid bodies; export it with Coordinate Space Global."
        )
    axes_index = find_names_line(document, "columns")
    columns = _find_marker_columns(document, header_index + 1, axes_index, delimiter)
    line_indices = list(find_nonblank_lines(document, axes_index + 1, delimiter))
    check_decimal_commas(document, line_indices, delimiter, len(document.split_cells(axes_index, delimiter)))
    unit_m, unit_notes = parse_unit_or_default(document, header_index, options.unit or header.get("length units", ""), "m")
    rate = header.get("export frame rate") or header.get("capture frame rate", "")
    return read_marker_table(
        MarkerTable(
            document=document,
            delimiter=delimiter,
            line_indices=line_indices,
            frame_field=0,
            field_indices=columns.field_indices,
            labels=columns.labels,
            unit_m=unit_m,
            rate_text=rate,
            rate_line=header_index,
            time_field=1,
            default_up_axis="Y",
            declared_frame_count=header.get("total exported frames", ""),
            notes=(*columns.notes, *unit_notes),
        ),
        options,
    )


def is_motive_rows_csv(head: bytes) -> bool:
    """Return whether a file with this beginning is a Motive CSV of version 1.1."""
    return any(VERSION_LINE_PATTERN.match(line) for line in split_head_lines(head))


def read_motive_rows_csv(path: Path, data: bytes, options: ReadOptions) -> Take:
    """Return the take in the bytes of a Motive CSV of version 1.1. Unnamed markers are unlabelled, with their ID as label.

    Raises:
        ReadError: If a row does not have what it declares. The message names file and line.
    """
    document = parse_document(path, data)
    row_types = [document.get_line(index).partition(",")[0].strip('" ').lower() for index in range(len(document.lines))]
    line_indices = [index for index, row_type in enumerate(row_types) if row_type == "frame"]
    if not line_indices:
        raise ReadError(f"{path}: has no frames; export the trial again.")
    rows = [document.split_cells(index, ",") for index in line_indices]
    marker_rows = [_parse_row_markers(document, index, row) for index, row in zip(line_indices, rows, strict=True)]
    labels = list(dict.fromkeys(label for row in marker_rows for label in row))
    missing = [np.nan] * 3
    points = np.array([[row.get(label, missing) for label in labels] for row in marker_rows]).reshape(len(line_indices), -1, 3)
    if "lefthanded" in row_types:
        points[..., 2] *= -1
    frame_numbers = parse_fields(document, line_indices, ",", ".", np.array([FRAME_FIELD]))[:, 0]
    frames = find_frames(
        lambda row, sentence: document.build_error(line_indices[row], sentence),
        lambda sentence: document.build_error(line_indices[-1], sentence),
        len(line_indices),
        stated_rate="",
        times=FrameTimes(parse_times(document, line_indices, ",", TIME_FIELD), 1.0),
        frame_numbers=frame_numbers,
        options=options,
    )
    info = [document.split_cells(index, ",") for index, row_type in enumerate(row_types) if row_type == "info"]
    declared = next((row[2] for row in info if row[1:2] == ["framecount"] and len(row) > 2), "")
    return build_take(
        path,
        frames.spread_rows(points),
        labels,
        unit_m=MOTIVE_ROWS_UNIT_M,
        rate=frames.rate,
        first_frame=frames.first_frame,
        layout=TableLayout(document.encoding, document.newline, ",", ".", unit_m=MOTIVE_ROWS_UNIT_M),
        default_up_axis="Y",
        options=options,
        notes=(*frames.notes, *check_frame_count(declared, len(line_indices))),
    )


def _parse_motive_header(cells: list[str]) -> dict[str, str]:
    """Return the values of the first line by key, in lower case."""
    return {key.lower(): value for key, value in zip(cells[::2], cells[1::2], strict=False)}


def _find_marker_columns(document: TextDocument, start: int, axes_index: int, delimiter: str) -> _MarkerColumns:
    """Return the columns of the markers, which the rows from `start` on describe."""
    header_rows = [
        document.split_cells(i, delimiter) for i in range(start, axes_index) if document.get_line(i).strip(delimiter + " ")
    ]
    if len(header_rows) < 2:
        problem = "there are no rows with the types and names of the columns above"
        raise document.build_error(axes_index, f"{problem}; export it with its header.")
    axes = document.split_cells(axes_index, delimiter)
    types, names = ([*row, *[""] * (len(axes) - len(row))] for row in header_rows[:2])
    triples = [(i, types[i].lower(), names[i]) for i in find_xyz_triples(axes)]
    markers = [triple for triple in triples if triple[1] == MARKER_TYPE]
    expected = [triple for triple in triples if triple[1].endswith(" marker")]
    if not markers and not expected:
        present = sorted({name.lower() for name in types[2:] if name}) or ["nothing"]
        problem = f"the columns have {format_name_list(present)} and no markers"
        raise document.build_error(axes_index, f"{problem}; export it with Markers.")
    notes = ()
    if expected and all(is_unlabelled(name) for _, _, name in markers):
        markers, notes = expected + markers, (EXPECTED_MARKERS_NOTE,)
    first_fields = np.array([i for i, _, _ in markers])
    return _MarkerColumns(first_fields[:, None] + np.arange(3), [name for _, _, name in markers], notes)


def _parse_row_markers(document: TextDocument, index: int, cells: list[str]) -> dict[str, list[float]]:
    """Return X, Y, Z of the markers in a frame row by label; the label of an unnamed marker is an asterisk and its ID."""
    try:
        start = BODY_COUNT_FIELD + 1 + FIELDS_PER_BODY * int(cells[BODY_COUNT_FIELD])
        stop = start + 1 + FIELDS_PER_MARKER * int(cells[start])
        if not BODY_COUNT_FIELD < start < stop <= len(cells):
            raise ValueError(cells[start])
        groups = [cells[i : i + FIELDS_PER_MARKER] for i in range(start + 1, stop, FIELDS_PER_MARKER)]
        markers = [(_build_label(name, number), [float(x), float(y), float(z)]) for x, y, z, number, name in groups]
    except (ValueError, IndexError) as error:
        problem = "does not have the rigid bodies and markers that it declares"
        raise document.build_error(index, f"{problem}; copy or export it again.") from error
    if len(dict(markers)) < len(markers):
        raise document.build_error(index, "has two markers of the same name; give each its own name and export it again.")
    return dict(markers)


def _build_label(name: str, number: str) -> str:
    return f"*{number}" if UNNAMED_MARKER_PATTERN.fullmatch(name) else name
