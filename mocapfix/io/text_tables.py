"""Text tables of markers: TRC and plain CSV, read and written; and those that Motive, Nexus and Qualisys export, read.

TRC is Motion Analysis' text format of trajectories, which OpenSim, Mokka and others write too: three lines of header, a line of
marker names, a line of axes, then one line per frame (OpenSim documentation, "Marker (.trc) Files"). Programs differ in the rest:
tabs or commas, with or without a blank line, with correct or wrong header values.

A plain CSV has a line of column names with LABEL_X, LABEL_Y, LABEL_Z of each marker side by side, then one line per frame. This
is what mocapfix writes (LFHD_X_mm, with the unit in the name), and what spreadsheets, scripts and some laboratories write. Label
and axis are separated by "_", ".", ":", "-" or a blank, fields by commas, semicolons or tabs.

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

import csv
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from mocapfix.errors import ReadError, format_name_list
from mocapfix.io import marker_table
from mocapfix.io.coordinates import METRES_PER_UNIT
from mocapfix.io.file_content import TextDocument, detect_delimiter, parse_document, split_head_lines
from mocapfix.io.files import replace_atomically
from mocapfix.io.frame_rate import FrameTimes, find_frames, parse_time
from mocapfix.io.points import is_unlabelled
from mocapfix.io.source_file import FileFrame, get_file_frame
from mocapfix.model.take import TableLayout, Take
from mocapfix.options import ReadOptions

FIRST_MARKER_FIELD = 2  # field of the first marker's X, after frame and time
AXIS_PATTERN = re.compile(r"x\d*", re.IGNORECASE)


def is_trc(head: bytes) -> bool:
    """Return whether a file with this beginning is a TRC."""
    return head.lstrip()[:12].lower() in (b"pathfiletype", b"datarate\tcam", b"datarate,cam")


def read_trc(path: Path, data: bytes, options: ReadOptions) -> Take:
    """Return the take in the bytes of a TRC.

    Columns after the last named marker are unlabelled trajectories, as in the files of Cortex.

    Raises:
        ReadError: If the table is invalid. The message names file and line. Counts in the header that the table contradicts are
            ignored and noted.
    """
    document = parse_document(path, data)
    names_index = marker_table.find_names_line(document, "markers")
    delimiter = detect_delimiter(document.get_line(names_index))
    if not delimiter:
        raise document.build_error(names_index, "there are neither tabs nor commas between the names; export it again.")
    cells = document.split_cells(names_index, delimiter)[FIRST_MARKER_FIELD:]
    names = cells if any(cell for i, cell in enumerate(cells) if i % 3) else cells[::3]  # else every cell is a name
    while names and not names[-1]:
        names = names[:-1]
    if not names:
        raise document.build_error(names_index, "names no markers; export it again.")
    keys_index, header = _parse_trc_header(document, names_index)
    axes_index = names_index + 1
    has_axes = axes_index < len(document.lines) and any(
        AXIS_PATTERN.fullmatch(cell) for cell in document.split_cells(axes_index, delimiter)
    )
    line_indices = list(marker_table.find_nonblank_lines(document, axes_index + has_axes, delimiter))
    marker_table.check_decimal_commas(document, line_indices, delimiter, FIRST_MARKER_FIELD + 3 * len(names))
    widest = max((document.get_line(i).rstrip(delimiter + " ").count(delimiter) + 1 for i in line_indices), default=0)
    point_count = max(len(names), -(-(widest - FIRST_MARKER_FIELD) // 3))
    unit_m, unit_notes = marker_table.parse_unit_or_default(
        document, keys_index + 1, options.unit or header.get("units", ""), "mm"
    )
    declared, notes = marker_table.parse_whole_number(header.get("nummarkers", "")), unit_notes
    if declared is not None and not len(names) <= declared <= point_count:
        notes = (*unit_notes, f"The header declares {declared} markers; {len(names)} are named.")
    field_indices = FIRST_MARKER_FIELD + np.arange(3 * point_count).reshape(-1, 3)
    labels = [*names, *(f"*{i}" for i in range(len(names), point_count))]
    table = marker_table.MarkerTable(
        document, delimiter, line_indices, 0, field_indices, labels, unit_m, header.get("datarate", "")
    )
    declared = header.get("numframes", "")
    table = replace(table, rate_line=keys_index + 1, time_field=1, declared_frame_count=declared, notes=notes)
    return marker_table.read_marker_table(table, options)


def _parse_trc_header(document: TextDocument, names_index: int) -> tuple[int, dict[str, str]]:
    """Return the index of the line of keys, and the value of each key in lower case."""
    for index in range(names_index):
        if document.get_line(index).lstrip(' "').lower().startswith("datarate"):
            delimiter = detect_delimiter(document.get_line(index)) or "\t"
            keys, values = document.split_cells(index, delimiter), document.split_cells(index + 1, delimiter)
            return index, {key.lower(): value for key, value in zip(keys, values, strict=False) if key}
    problem = "there is no header (DataRate, NumFrames, Units) before the names"
    raise document.build_error(names_index, f"{problem}; export it again.")


COLUMN_PATTERN = re.compile(r"(.*[^ _.:\-])[ _.:\-]+([XYZ])(?:[ _]?[(\[]?(mm|cm|m)[)\]]?)?", re.IGNORECASE)
FRAME_COLUMN_PATTERN = re.compile(r"(frame|field|sample)(\b.*|s|_?(number|num|no|nr|index|idx|id|count))", re.IGNORECASE)
TIME_COLUMN_PATTERN = re.compile(
    r"([a-z]+[ _.])?(times?|time[ _]?stamps?|seconds?|secs?|epoch|elapsed|t|milliseconds?|msecs?|ms)([ _.(\[].*)?", re.IGNORECASE
)
# Units of times in the names of their columns, the longer names first.
TIME_UNIT_PATTERN = re.compile(
    r"(?:.*[ _.(\[])?(?:(ms|msecs?|milliseconds?)|(us|µs|microseconds?)|(ns|nanoseconds?)|(s|secs?|seconds?))[\])]?",
    re.IGNORECASE,
)
TIME_PATTERN_UNITS_S = (1e-3, 1e-6, 1e-9, 1.0)
INSPECTED_FRAMES = 50  # from which the span of the coordinates is computed


def is_plain_csv(head: bytes) -> bool:
    """Return whether a file with this beginning is a plain table of markers."""
    line = split_head_lines(head)[0]
    delimiter = detect_delimiter(line)
    return bool(delimiter) and bool(_find_points([cell.strip(' "') for cell in line.split(delimiter)]))


def read_plain_csv(path: Path, data: bytes, options: ReadOptions) -> Take:
    """Return the take in the bytes of a plain table.

    If the columns name no unit, it is metres or millimetres, according to the span of the coordinates.

    Raises:
        ReadError: If a field is not a number, or the frame rate is unknown. The message names file and line.
    """
    document = parse_document(path, data)
    names_index = document.find_first_line()
    if "\r" in document.get_line(names_index):
        problem = "has another line end than the other lines; save the file with one kind of line ends."
        raise document.build_error(names_index, problem)
    delimiter = detect_delimiter(document.get_line(names_index))
    cells = document.split_cells(names_index, delimiter)
    points = _find_points(cells)
    if not points:
        raise document.build_error(names_index, "has no columns X, Y and Z of a marker side by side; export it again.")
    line_indices = list(marker_table.find_nonblank_lines(document, names_index + 1, delimiter))
    marker_table.check_decimal_commas(document, line_indices, delimiter, len(cells))
    others = [i for i in range(len(cells)) if not any(0 <= i - first < 3 for first, _, _ in points)]
    time_field = next((i for i in others if TIME_COLUMN_PATTERN.fullmatch(cells[i])), None)
    frame_field = next((i for i in others if FRAME_COLUMN_PATTERN.fullmatch(cells[i])), None)
    if time_field is None and options.rate_hz is None:
        remedy = "give it with --rate HZ, or add a column Time in seconds"
        raise document.build_error(names_index, f"there is no column for the time, so the rate is unknown; {remedy}.")
    field_indices = np.array([first for first, _, _ in points])[:, None] + np.arange(3)
    unit, notes = options.unit or next((unit for _, _, unit in points if unit), ""), ()
    if not unit:
        inspected = line_indices[:: max(1, len(line_indices) // INSPECTED_FRAMES)]
        decimal_sign = marker_table.detect_decimal_sign(document, inspected, delimiter)
        unit, note = marker_table.assume_unit(
            marker_table.parse_fields(document, inspected, delimiter, decimal_sign, field_indices.ravel())
        )
        notes = (note,)
    incomplete = dict.fromkeys(match[1] for i in others if (match := COLUMN_PATTERN.fullmatch(cells[i])))
    notes += (f"Not read, without X, Y and Z side by side: {format_name_list([*incomplete])}.",) * bool(incomplete)
    unit_of_time = TIME_UNIT_PATTERN.fullmatch(cells[time_field]) if time_field is not None else None
    times_s = zip(unit_of_time.groups() if unit_of_time else (), TIME_PATTERN_UNITS_S, strict=False)
    time_unit_s = next((unit_s for group, unit_s in times_s if group), None)
    labels, unit_m = [label for _, label, _ in points], METRES_PER_UNIT[unit]
    table = marker_table.MarkerTable(
        document, delimiter, line_indices, frame_field, field_indices, labels, unit_m, rate_line=names_index
    )
    return marker_table.read_marker_table(replace(table, time_field=time_field, time_unit_s=time_unit_s, notes=notes), options)


def _find_points(cells: list[str]) -> list[tuple[int, str, str]]:
    """Return the first column, label and unit ("" if none) of points whose three adjacent columns share label and unit."""
    matches = [COLUMN_PATTERN.fullmatch(cell) for cell in cells]
    columns = [(match[1], match[2].upper(), (match[3] or "").lower()) if match else ("", "", "") for match in matches]
    return [
        (i, label, unit)
        for i, (label, axis, unit) in enumerate(columns[:-2])
        if axis == "X" and columns[i + 1 : i + 3] == [(label, "Y", unit), (label, "Z", unit)]
    ]


DECIMALS_BY_UNIT = {"mm": 5, "cm": 6, "m": 8}  # of a coordinate in a text: 10 nm
TRC_HEADER_KEYS = (
    "DataRate", "CameraRate", "NumFrames", "NumMarkers", "Units", "OrigDataRate", "OrigDataStartFrame", "OrigNumFrames",
)  # fmt: skip


def write_trc(target: str | Path, take: Take) -> None:
    """Write the labelled markers as TRC, which OpenSim, Cortex, MotionBuilder and Mokka read.

    The file has the unit and axes of the source file, tabs between fields, and blanks for missing samples. Frames keep their
    numbers. Times count from frame 1, or from frame 0 if the take begins there.
    """
    target, frame = Path(target), get_file_frame(take)
    is_short = np.isclose(take.rate, round(take.rate, 2), rtol=1e-9)  # two decimals are usual
    rate, first = f"{take.rate:.{2 if is_short else 6}f}", take.first_frame
    labels, count = _list_written_labels(take), str(take.frame_count)
    header = [
        ["PathFileType", "4", "(X/Y/Z)", target.name],
        TRC_HEADER_KEYS,
        [rate, rate, count, str(len(labels)), frame.unit_name, rate, str(first), count],
        ["Frame#", "Time", *(cell for label in labels for cell in (label, "", ""))],
        ["", "", *(f"{axis}{i}" for i in range(1, len(labels) + 1) for axis in "XYZ")],
        [""],
    ]
    with replace_atomically(target) as part, part.open("w", encoding="utf-8", newline="") as file:
        file.writelines("\t".join(row) + "\r\n" for row in (*header, *_iterate_rows(take, frame, min(1, first))))


def write_csv(target: str | Path, take: Take) -> None:
    """Write the labelled markers as plain CSV: a line of column names, then one line per frame.

    Columns are frame, time_s, and LABEL_X_mm, LABEL_Y_mm, LABEL_Z_mm of each marker, in the unit (mm, cm or m) and axes of the
    source file. Missing samples are blank. Frames keep their numbers, and the time of the first one is 0. The file is UTF-8 with
    commas and decimal points.
    """
    frame = get_file_frame(take)
    names = [f"{label}_{axis}_{frame.unit_name}" for label in _list_written_labels(take) for axis in "XYZ"]
    with replace_atomically(Path(target)) as part, part.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["frame", "time_s", *names])
        writer.writerows(_iterate_rows(take, frame, take.first_frame))


def _list_written_labels(take: Take) -> list[str]:
    """Return the labels with blanks in place of tabs and line ends."""
    return [" ".join(label.split()) for label in take.labels]


def _iterate_rows(take: Take, frame: FileFrame, zero_frame: int) -> Iterator[Sequence[str]]:
    """Yield the cells of each frame: its number, its time since the frame of a number, and the coordinates, "" where missing."""
    decimals = DECIMALS_BY_UNIT[frame.unit_name]
    coordinates = frame.compute_coordinates(take.markers).reshape(take.frame_count, -1)
    for number, row in enumerate(coordinates.tolist(), start=take.first_frame):
        time_s = (number - zero_frame) / take.rate
        yield [str(number), f"{time_s:.6f}", *("" if x != x else f"{x:.{decimals}f}" for x in row)]


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
