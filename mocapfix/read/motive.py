"""Reading OptiTrack Motive's CSV, format versions 1.2 and later: a column for each of a marker's coordinates.

The first line holds facts as key, value, key, value; rows of types, names and IDs stand over the columns (OptiTrack's
documentation, "Data Export: CSV"). Only positions of markers are taken: rigid bodies, bones, their rotations of whichever
type, qualities and errors are other columns and stay as they are.
"""

import re
from pathlib import Path

import numpy as np

from mocapfix.errors import ReadError
from mocapfix.files.layouts import TableLayout
from mocapfix.read.file_content import TextDocument, detect_delimiter, parse_document, split_head_lines
from mocapfix.read.marker_table import (
    MarkerTable,
    build_take,
    find_names_line,
    find_xyz_triples,
    read_first_frame,
    read_marker_table,
)
from mocapfix.read.point_types import is_unlabelled
from mocapfix.read.table_cells import check_frame_count, find_nonblank_lines, parse_fields, parse_rate, parse_unit_or_default
from mocapfix.take import Take

# MERGED: mocapfix.read.motive
MARKER_TYPE = "marker"
EXPECTED_MARKERS_NOTE = (
    "The file holds no measured markers, only the places that its bodies expect them at; export Markers as well."
)


def is_motive_csv(head: bytes) -> bool:
    """-> does a file that begins so claim to be one?"""
    return head[:20].lower().replace(b'"', b"").startswith(b"format version")


def read_motive_csv(path: Path, data: bytes) -> Take:
    """-> the take in the file's bytes. Where the measured markers were not exported, those that bodies expect are taken.

    Raises ReadError, naming file and line, where there are no markers or their coordinates are a body's own.
    """
    text = parse_document(path, data)
    between = detect_delimiter(text.get_line(0)) or ","
    facts = _parse_motive_header(text.split_cells(0, between))
    if facts.get("coordinate space", "").lower() == "local":
        raise text.build_error(0, "the coordinates are local to their bodies; export it with Coordinate Space Global.")
    axes = find_names_line(text, "columns")
    fields, labels, said = _find_marker_columns(text, axes, between)
    rows = list(find_nonblank_lines(text, axes + 1, between))
    unit, assumed = parse_unit_or_default(text, 0, facts.get("length units", ""), "m")
    rate = facts.get("export frame rate") or facts.get("capture frame rate", "")
    return read_marker_table(
        MarkerTable(
            document=text,
            delimiter=between,
            line_indices=rows,
            frame_field=0,
            field_indices=fields,
            labels=labels,
            unit_m=unit,
            rate=parse_rate(text, 0, rate, rows, between, time_field=1),
            default_up_axis="Y",
            declared_frame_count=facts.get("total exported frames", ""),
            notes=(*said, *assumed),
        )
    )


def _parse_motive_header(cells: list[str]) -> dict[str, str]:
    return {key.lower(): value for key, value in zip(cells[::2], cells[1::2], strict=False)}


def _find_marker_columns(text: TextDocument, axes: int, between: str) -> tuple[np.ndarray, list[str], tuple[str, ...]]:
    """-> the (P, 3) fields of the markers, their labels, and what must be said of them."""
    head = [text.split_cells(i, between) for i in range(1, axes) if text.get_line(i).strip(between + " ")]
    if len(head) < 2:
        raise text.build_error(axes, "no rows with the columns' types and names stand above; export it with its header.")
    letters = text.split_cells(axes, between)
    types, names = ([*row, *[""] * (len(letters) - len(row))] for row in head[:2])
    found = [(i, types[i].lower(), names[i]) for i in find_xyz_triples(letters)]
    measured = [each for each in found if each[1] == MARKER_TYPE]
    expected = [each for each in found if each[1].endswith(" marker")]
    if not measured and not expected:
        kinds = sorted({name.lower() for name in types[2:] if name}) or ["nothing"]
        raise text.build_error(axes, f"the columns hold {', '.join(kinds)} and no markers; export it with Markers.")
    said = ()
    if expected and all(is_unlabelled(name) for _, _, name in measured):
        measured, said = expected + measured, (EXPECTED_MARKERS_NOTE,)
    first = np.array([i for i, _, _ in measured])
    return first[:, None] + np.arange(3), [name for _, _, name in measured], said


# MERGED: mocapfix.read.motive_rows
# Reading OptiTrack's CSV before Motive's columns, format version 1.1: a row a frame with the markers that were visible.
#
# Each row begins with what it is; the file's comments say what follows (OptiTrack's "Format Information", in the file). A
# frame row lists rigid bodies, eleven fields each, then markers: x, y, z, ID and name, in metres. A row holds visible
# markers only, so where a missing sample would have to be put there is no field: the take's layout has no places.
VERSION_LINE_PATTERN = re.compile(r'"?info"?,"?(version|framecount)"?,', re.IGNORECASE)
FRAME_FIELD, TIME_FIELD, BODY_COUNT_FIELD = (
    1,
    2,
    3,
)  # the fields of a frame row with its number, its time and the number of rigid bodies
FIELDS_PER_BODY, FIELDS_PER_MARKER = 11, 5  # fields of a rigid body and of a marker
UNNAMED_MARKER_PATTERN = re.compile(r"|Marker-\d+|Unlabell?ed.*", re.IGNORECASE)  # what a marker of no rigid body is called
MOTIVE_ROWS_UNIT_M = 1.0


def is_motive_rows_csv(head: bytes) -> bool:
    """-> does a file that begins so claim to be one?"""
    return any(VERSION_LINE_PATTERN.match(line) for line in split_head_lines(head))


def read_motive_rows_csv(path: Path, data: bytes) -> Take:
    """-> the take in the file's bytes: its markers by name, those that have none by their ID and as unlabelled.

    Raises ReadError, naming file and line, for a row that does not hold what it counts.
    """
    text = parse_document(path, data)
    heads = [text.get_line(index).partition(",")[0].strip('" ').lower() for index in range(len(text.lines))]
    rows = [index for index, head in enumerate(heads) if head == "frame"]
    if not rows:
        raise ReadError(f"{path}: holds no frames; export the trial again.")
    cells = [text.split_cells(index, ",") for index in rows]
    found = [_parse_row_markers(text, index, row) for index, row in zip(rows, cells, strict=True)]
    labels = list(dict.fromkeys(label for markers in found for label in markers))
    gone = [np.nan] * 3
    raw = np.array([[markers.get(label, gone) for label in labels] for markers in found]).reshape(len(rows), -1, 3)
    if "lefthanded" in heads:
        raw[..., 2] *= -1
    first, said = read_first_frame(text, rows, parse_fields(text, rows, ",", ".", np.array([FRAME_FIELD]))[:, 0])
    info = [text.split_cells(index, ",") for index, head in enumerate(heads) if head == "info"]
    promised = next((row[2] for row in info if row[1:2] == ["framecount"] and len(row) > 2), "")
    said += check_frame_count(promised, len(rows))
    rate = parse_rate(text, rows[-1], "", rows, ",", TIME_FIELD)
    layout = TableLayout(text.encoding, text.newline, ",", ".", unit_m=MOTIVE_ROWS_UNIT_M)
    return build_take(path, raw, labels, MOTIVE_ROWS_UNIT_M, rate, first, layout, default_up_axis="Y", notes=said)


def _parse_row_markers(text: TextDocument, index: int, cells: list[str]) -> dict[str, list[float]]:
    """-> x, y, z of the markers in a frame row, by label; an asterisk and its ID for one that nobody named."""
    try:
        start = BODY_COUNT_FIELD + 1 + FIELDS_PER_BODY * int(cells[BODY_COUNT_FIELD])
        behind = start + 1 + FIELDS_PER_MARKER * int(cells[start])
        if not BODY_COUNT_FIELD < start < behind <= len(cells):
            raise ValueError(cells[start])
        given = [cells[i : i + FIELDS_PER_MARKER] for i in range(start + 1, behind, FIELDS_PER_MARKER)]
        found = [(_build_label(name, number), [float(x), float(y), float(z)]) for x, y, z, number, name in given]
    except (ValueError, IndexError) as error:
        raise text.build_error(
            index, "does not hold the rigid bodies and markers that it counts; copy or export it again."
        ) from error
    if len(dict(found)) < len(found):
        raise text.build_error(index, "names two markers alike; give each a name of its own and export it again.")
    return dict(found)


def _build_label(name: str, number: str) -> str:
    return f"*{number}" if UNNAMED_MARKER_PATTERN.fullmatch(name) else name
