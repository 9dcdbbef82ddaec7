"""Read the marker tables that OptiTrack Motive, Vicon Nexus and Qualisys Track Manager export.

Motive, since version 1.2, has a column for each coordinate of a marker. The first line has keys and values in turn, and rows of
types, names and IDs precede the columns (OptiTrack documentation, "Data Export: CSV"). Only positions of markers are read: rigid
bodies, bones, rotations, qualities and errors are other columns, which a patched copy leaves unchanged. In version 1.1 each row
begins with its type, and the comments of the file describe the rest (OptiTrack, "Format Information", in the file). A frame row
lists rigid bodies with eleven fields each, then the visible markers: X, Y, Z, ID and name, in metres. Missing samples have no
field, so the layout has no fields.

Nexus, and Workstation before it, has sections, one of which has the trajectories. A section has its name, its rate, a line of
names, a line of axes, usually a line of units, and one line per frame up to a blank line (Vicon Nexus documentation, "Export data
to ASCII").

Qualisys has header lines with a key in capitals and its values, among them the marker names. A line of column names follows if it
was exported. Then there is one line per frame, in millimetres, with or without frame number and time (QTM user manual, "TSV file
formats").
"""

import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from mocapfix.errors import ReadError, format_name_list
from mocapfix.io import marker_table
from mocapfix.io.file_content import TextDocument, detect_delimiter, parse_document, split_head_lines
from mocapfix.io.frame_rate import FrameTimes, find_frames, parse_time
from mocapfix.io.points import is_unlabelled
from mocapfix.model.take import TableLayout, Take
from mocapfix.options import ReadOptions

MARKER_TYPE = "marker"  # type of a column with a measured marker, in lower case
EXPECTED_MARKERS_NOTE = (
    "The file has no measured markers, only the positions at which its rigid bodies expect them; export Markers as well."
)

VERSION_LINE_PATTERN = re.compile(r'"?info"?,"?(version|framecount)"?,', re.IGNORECASE)  # version 1.1
FRAME_FIELD = 1  # of a frame row: its number
TIME_FIELD = 2  # of a frame row: its time (s)
BODY_COUNT_FIELD = 3  # of a frame row: the number of rigid bodies
FIELDS_PER_BODY = 11
FIELDS_PER_MARKER = 5
UNNAMED_MARKER_PATTERN = re.compile(r"|Marker-\d+|Unlabell?ed.*", re.IGNORECASE)  # names of markers outside rigid bodies
MOTIVE_ROWS_UNIT_M = 1.0


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
    cells = document.split_cells(header_index, delimiter)
    header = {key.lower(): value for key, value in zip(cells[::2], cells[1::2], strict=False)}
    if header.get("coordinate space", "").lower() == "local":
        raise document.build_error(
            header_index, "the coordinates are local to rigid bodies; export it with Coordinate Space Global."
        )
    axes_index = marker_table.find_names_line(document, "columns")
    field_indices, labels, notes = _find_marker_columns(document, header_index + 1, axes_index, delimiter)
    line_indices = list(marker_table.find_nonblank_lines(document, axes_index + 1, delimiter))
    marker_table.check_decimal_commas(document, line_indices, delimiter, len(document.split_cells(axes_index, delimiter)))
    unit_m, unit_notes = marker_table.parse_unit_or_default(
        document, header_index, options.unit or header.get("length units", ""), "m"
    )
    rate = header.get("export frame rate") or header.get("capture frame rate", "")
    declared, notes = header.get("total exported frames", ""), (*notes, *unit_notes)
    table = marker_table.MarkerTable(document, delimiter, line_indices, 0, field_indices, labels, unit_m, rate, header_index)
    table = replace(table, time_field=1, default_up_axis="Y", declared_frame_count=declared, notes=notes)
    return marker_table.read_marker_table(table, options)


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
    frame_numbers = marker_table.parse_fields(document, line_indices, ",", ".", np.array([FRAME_FIELD]))[:, 0]
    frames = find_frames(
        lambda row, sentence: document.build_error(line_indices[row], sentence),
        lambda sentence: document.build_error(line_indices[-1], sentence),
        len(line_indices),
        stated_rate="",
        times=FrameTimes(marker_table.parse_times(document, line_indices, ",", TIME_FIELD), 1.0),
        frame_numbers=frame_numbers,
        options=options,
    )
    info = [document.split_cells(index, ",") for index, row_type in enumerate(row_types) if row_type == "info"]
    declared = next((row[2] for row in info if row[1:2] == ["framecount"] and len(row) > 2), "")
    layout = TableLayout(document.encoding, document.newline, ",", ".", MOTIVE_ROWS_UNIT_M)
    points, known = frames.spread_rows(points), (frames.rate, frames.first_frame, "Y")
    notes = (*frames.notes, *marker_table.check_frame_count(declared, len(line_indices)))
    return marker_table.build_take(path, points, labels, layout, *known, notes=notes, options=options)


def _find_marker_columns(
    document: TextDocument, start: int, axes_index: int, delimiter: str
) -> tuple[Int[np.ndarray, "P 3"], list[str], tuple[str, ...]]:
    """Return the columns (P, 3) and labels of the markers, which the rows from `start` on describe, and notes on the choice."""
    header_rows = [
        document.split_cells(i, delimiter) for i in range(start, axes_index) if document.get_line(i).strip(delimiter + " ")
    ]
    if len(header_rows) < 2:
        problem = "there are no rows with the types and names of the columns above"
        raise document.build_error(axes_index, f"{problem}; export it with its header.")
    axes = document.split_cells(axes_index, delimiter)
    types, names = ([*row, *[""] * (len(axes) - len(row))] for row in header_rows[:2])
    triples = [(i, types[i].lower(), names[i]) for i in marker_table.find_xyz_triples(axes)]
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
    return first_fields[:, None] + np.arange(3), [name for _, _, name in markers], notes


def _parse_row_markers(document: TextDocument, index: int, cells: list[str]) -> dict[str, list[float]]:
    """Return X, Y, Z of the markers in a frame row by label; the label of an unnamed marker is an asterisk and its ID."""
    try:
        start = BODY_COUNT_FIELD + 1 + FIELDS_PER_BODY * int(cells[BODY_COUNT_FIELD])
        stop = start + 1 + FIELDS_PER_MARKER * int(cells[start])
        if not BODY_COUNT_FIELD < start < stop <= len(cells):
            raise ValueError(cells[start])
        groups = [cells[i : i + FIELDS_PER_MARKER] for i in range(start + 1, stop, FIELDS_PER_MARKER)]
        labels = [f"*{group[3]}" if UNNAMED_MARKER_PATTERN.fullmatch(group[4]) else group[4] for group in groups]
        markers = [(label, [float(x), float(y), float(z)]) for label, (x, y, z, _, _) in zip(labels, groups, strict=True)]
    except (ValueError, IndexError) as error:
        problem = "does not have the rigid bodies and markers that it declares"
        raise document.build_error(index, f"{problem}; copy or export it again.") from error
    if len(dict(markers)) < len(markers):
        raise document.build_error(index, "has two markers of the same name; give each its own name and export it again.")
    return dict(markers)


TRAJECTORY_SECTION = "trajectories"
SECTION_NAMES = {
    TRAJECTORY_SECTION,
    "model outputs",
    "devices",
    "joints",
    "segments",
    "analog",
    "forces",
    "events",
    "force plates",
}
SECTION_PADDING = ' ,;\t\r"'  # characters around the name of a section in a file that a spreadsheet saved


def is_nexus_csv(head: bytes) -> bool:
    """Return whether a file with this beginning is a Nexus export: a section's name alone in a line, its rate in the next."""
    lines = [line.strip(SECTION_PADDING).lower() for line in split_head_lines(head)]
    return any(name in SECTION_NAMES and rate[:1].isdecimal() for name, rate in pairwise(lines))


def read_nexus_csv(path: Path, data: bytes, options: ReadOptions) -> Take:
    """Return the take in the bytes of a Nexus export: the positions in its section of trajectories."""
    document = parse_document(path, data)
    names = ((index, document.get_line(index).strip(SECTION_PADDING).lower()) for index in range(len(document.lines)))
    sections = {index: name for index, name in names if name in SECTION_NAMES}
    start = next((index for index, name in sections.items() if name == TRAJECTORY_SECTION), None)
    if start is None:
        present = format_name_list(sorted({*sections.values()}))
        raise ReadError(f"{path}: has {present} and no trajectories; export the trajectories as well.")
    axes_index, delimiter = _find_axes_line(document, start)
    names, axes = document.split_cells(axes_index - 1, delimiter), document.split_cells(axes_index, delimiter)
    names += [""] * (len(axes) - len(names))
    first_fields = [i for i in marker_table.find_xyz_triples(axes) if names[i]]
    if not first_fields:
        raise document.build_error(axes_index - 1, "names no markers; export the trajectories with their labels.")
    below = document.split_cells(axes_index + 1, delimiter) if axes_index + 1 < len(document.lines) else [""]
    units = below if not below[0] and any(below) else []  # none if the line has numbers
    line_indices: list[int] = []
    for index in range(axes_index + 1 + bool(units), len(document.lines)):
        if index in sections or not document.lines[index].strip(delimiter + " \r"):
            break
        line_indices.append(index)
    if not line_indices:
        raise document.build_error(axes_index, "no frames follow; export the trial again.")
    marker_table.check_decimal_commas(document, line_indices, delimiter, len(axes))
    unit = next((cell for cell in units[first_fields[0] :] if cell), "mm")
    rate = re.sub(r"[^\d.]+.*", "", document.split_cells(start + 1, delimiter)[0])
    field_indices, labels = np.array(first_fields)[:, None] + np.arange(3), [names[i] for i in first_fields]
    unit_m = marker_table.parse_unit(document, axes_index + 1, options.unit or unit)
    table = marker_table.MarkerTable(document, delimiter, line_indices, 0, field_indices, labels, unit_m, rate, start + 1)
    return marker_table.read_marker_table(table, options)


def _find_axes_line(document: TextDocument, start: int) -> tuple[int, str]:
    """Return the index of the line of axes in the section that begins at `start`, and the field separator."""
    for index in range(start + 2, min(start + 5, len(document.lines))):
        delimiter = detect_delimiter(document.get_line(index)) or ","
        if document.split_cells(index, delimiter)[0].lower().startswith(("frame", "field", "sample")):
            return index, delimiter
    problem = "no line that begins with Frame and names the axes follows"
    raise document.build_error(start, f"{problem}; export the trajectories again.")


TAB = "\t"
KEY_PATTERN = re.compile(r"[A-Z][A-Z0-9_]+")
QUALISYS_UNIT_M = 0.001
MAX_FRAME_DIGITS = 15  # of a number of a frame; longer ones are no numbers of frames
MAX_TIME_STEP_DEVIATION = 0.15  # of time steps from the usual one: times may be written with few digits, at 1000 Hz with five
# What other exports of the program contain, by a key in their header.
OTHER_EXPORTS = {
    "BODY_NAMES": "rigid bodies (6D)",
    "NO_OF_BODIES": "rigid bodies (6D)",
    "CHANNEL_NAMES": "analog signals",
    "NO_OF_SAMPLES": "analog signals",
    "SKELETON_NAMES": "a skeleton",
    "NO_OF_SKELETONS": "a skeleton",
}


class _HeaderValue(NamedTuple):
    """The values of a key, and the index of its line."""

    line_index: int
    values: list[str]


def is_qualisys_tsv(head: bytes) -> bool:
    """Return whether a file with this beginning is a Qualisys export, of trajectories or of something else."""
    first = head.lstrip().split(b"\t", 1)[0]
    return first in (b"NO_OF_FRAMES", b"NO_OF_CAMERAS", b"NO_OF_SAMPLES", b"NO_OF_SKELETONS", b"MARKER_NAMES")


def read_qualisys_tsv(path: Path, data: bytes, options: ReadOptions) -> Take:
    """Return the take in the bytes of a Qualisys TSV. Blanks and 0 0 0 are missing; frames without numbers are counted from 1.

    Raises:
        ReadError: If the file is another export of QTM, or the table does not fit its names. The message names file and line.
    """
    document = parse_document(path, data)
    header, body = _parse_header(document)
    if "MARKER_NAMES" not in header:
        content = next((content for key, content in OTHER_EXPORTS.items() if key in header), "no marker names")
        raise ReadError(f"{path}: has {content}; export its trajectories as TSV (3D data).")
    names_index, labels = header["MARKER_NAMES"]
    while labels and not labels[-1]:
        labels.pop()
    if not labels:
        raise document.build_error(names_index, "names no markers; export it again.")
    has_column_names = body < len(document.lines) and any(
        cell.strip().upper().endswith("X") for cell in document.split_cells(body, TAB)
    )
    line_indices = list(marker_table.find_nonblank_lines(document, body + has_column_names, TAB))
    frequency = header.get("FREQUENCY", _HeaderValue(names_index, [""]))
    first_field, frame_field = _find_first_field(
        document, body, line_indices, has_column_names, 3 * len(labels), frequency.values[0]
    )
    if frame_field is None:  # a line of tabs only is a frame without visible markers
        line_indices = [index for index in range(body + has_column_names, len(document.lines)) if document.get_line(index)]
    field_indices = first_field + np.arange(3 * len(labels)).reshape(-1, 3)
    time_field = first_field - 1 if first_field > (frame_field is not None) else None
    declared = header.get("NO_OF_FRAMES", _HeaderValue(0, [""])).values[0]
    table = marker_table.MarkerTable(document, TAB, line_indices, frame_field, field_indices, labels, QUALISYS_UNIT_M)
    rate, rate_line = frequency.values[0], frequency.line_index
    table = replace(table, rate_text=rate, rate_line=rate_line, time_field=time_field, declared_frame_count=declared)
    return marker_table.read_marker_table(table, options)


def _parse_header(document: TextDocument) -> tuple[dict[str, _HeaderValue], int]:
    """Return the values of the keys, and the index of the first line after the header.

    The line after the marker names may be a frame whose first field is missing: blank, or spelled unlike a key, such as NULL.
    """
    header: dict[str, _HeaderValue] = {}
    for index in range(document.find_first_line(), len(document.lines)):
        key, *values = document.split_cells(index, TAB)
        is_missing = key.lower() in marker_table.MISSING_TEXTS
        if (values and "MARKER_NAMES" in header) if is_missing else not KEY_PATTERN.fullmatch(key):
            return header, index
        if not is_missing:
            header.setdefault(key, _HeaderValue(index, values or [""]))
    return header, len(document.lines)


def _find_first_field(
    document: TextDocument, body: int, line_indices: list[int], has_column_names: bool, coordinate_count: int, rate_text: str
) -> tuple[int, int | None]:
    """Return the field of the first marker's X, and that of the frame number, None if there is none.

    Without column names, whole numbers that increase are the frame number. Numbers after it that increase with it are the time if
    the lines have a field more than coordinates need, or if they increase by the duration of a frame.
    """
    if has_column_names:
        cells = [cell.upper() for cell in document.split_cells(body, TAB)]
        return next(i for i, cell in enumerate(cells) if cell.endswith("X")), 0 if cells[0] == "FRAME" else None
    inspected = line_indices[: marker_table.MAX_INSPECTED_LINES]
    if len(inspected) < 2:
        return 0, None
    rows = [[*document.split_cells(i, TAB), ""] for i in inspected]
    if not all(row[0].isdecimal() and len(row[0]) <= MAX_FRAME_DIGITS for row in rows):
        return 0, None
    frame_steps = np.diff([int(row[0]) for row in rows])
    if (frame_steps < 1).any() or np.median(frame_steps) != 1:
        return 0, None
    step_s = np.diff([parse_time(row[1]) for row in rows]) / frame_steps
    usual_s, rate = float(np.median(step_s)), parse_time(rate_text)
    is_steady = usual_s > 0 and bool((np.abs(step_s - usual_s) <= MAX_TIME_STEP_DEVIATION * usual_s).all())
    width = max(i + 1 for row in rows for i, cell in enumerate(row) if cell)
    is_time = is_steady and (width >= coordinate_count + 2 or abs(usual_s * rate - 1) < MAX_TIME_STEP_DEVIATION)
    return 2 if is_time else 1, 0
