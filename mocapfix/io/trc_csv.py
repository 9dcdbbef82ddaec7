"""Read and write TRC and plain CSV.

TRC is Motion Analysis' text format of trajectories, which OpenSim, Mokka and others write too: three lines of header, a line of
marker names, a line of axes, then one line per frame (OpenSim documentation, "Marker (.trc) Files"). Programs differ in the rest:
tabs or commas, with or without a blank line, with correct or wrong header values.

A plain CSV has a line of column names with LABEL_X, LABEL_Y, LABEL_Z of each marker side by side, then one line per frame. This
is what mocapfix writes (LFHD_X_mm, with the unit in the name), and what spreadsheets, scripts and some laboratories write. Label
and axis are separated by "_", ".", ":", "-" or a blank, fields by commas, semicolons or tabs.
"""

import csv
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from mocapfix.io.coordinates import METRES_PER_UNIT
from mocapfix.io.file_content import TextDocument, detect_delimiter, parse_document, split_head_lines
from mocapfix.io.files import replace_atomically
from mocapfix.io.marker_table import (
    MarkerTable,
    assume_unit,
    check_decimal_commas,
    detect_decimal_sign,
    find_names_line,
    find_nonblank_lines,
    parse_fields,
    parse_unit_or_default,
    parse_whole_number,
    read_marker_table,
)
from mocapfix.io.source_file import FileFrame, get_file_frame
from mocapfix.model.take import Take
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
    names_index = find_names_line(document, "markers")
    delimiter = detect_delimiter(document.get_line(names_index))
    if not delimiter:
        raise document.build_error(names_index, "there are neither tabs nor commas between the names; export it again.")
    cells = document.split_cells(names_index, delimiter)[FIRST_MARKER_FIELD:]
    names = cells if any(cell for i, cell in enumerate(cells) if i % 3) else cells[::3]  # else every cell is a name
    while names and not names[-1]:
        names = names[:-1]
    if not names:
        raise document.build_error(names_index, "names no markers; export it again.")
    keys_index, header = _parse_header(document, names_index)
    axes_index = names_index + 1
    has_axes = axes_index < len(document.lines) and any(
        AXIS_PATTERN.fullmatch(cell) for cell in document.split_cells(axes_index, delimiter)
    )
    line_indices = list(find_nonblank_lines(document, axes_index + has_axes, delimiter))
    check_decimal_commas(document, line_indices, delimiter, FIRST_MARKER_FIELD + 3 * len(names))
    widest = max((document.get_line(i).rstrip(delimiter + " ").count(delimiter) + 1 for i in line_indices), default=0)
    point_count = max(len(names), -(-(widest - FIRST_MARKER_FIELD) // 3))
    unit_m, unit_notes = parse_unit_or_default(document, keys_index + 1, options.unit or header.get("units", ""), "mm")
    declared, notes = parse_whole_number(header.get("nummarkers", "")), unit_notes
    if declared is not None and not len(names) <= declared <= point_count:
        notes = (*unit_notes, f"The header declares {declared} markers; {len(names)} are named.")
    field_indices = FIRST_MARKER_FIELD + np.arange(3 * point_count).reshape(-1, 3)
    labels = [*names, *(f"*{i}" for i in range(len(names), point_count))]
    table = MarkerTable(document, delimiter, line_indices, 0, field_indices, labels, unit_m, header.get("datarate", ""))
    declared = header.get("numframes", "")
    table = replace(table, rate_line=keys_index + 1, time_field=1, declared_frame_count=declared, notes=notes)
    return read_marker_table(table, options)


def _parse_header(document: TextDocument, names_index: int) -> tuple[int, dict[str, str]]:
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
    line_indices = list(find_nonblank_lines(document, names_index + 1, delimiter))
    check_decimal_commas(document, line_indices, delimiter, len(cells))
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
        decimal_sign = detect_decimal_sign(document, inspected, delimiter)
        unit, note = assume_unit(parse_fields(document, inspected, delimiter, decimal_sign, field_indices.ravel()))
        notes = (note,)
    unit_of_time = TIME_UNIT_PATTERN.fullmatch(cells[time_field]) if time_field is not None else None
    times_s = zip(unit_of_time.groups() if unit_of_time else (), TIME_PATTERN_UNITS_S, strict=False)
    time_unit_s = next((unit_s for group, unit_s in times_s if group), None)
    labels, unit_m = [label for _, label, _ in points], METRES_PER_UNIT[unit]
    table = MarkerTable(document, delimiter, line_indices, frame_field, field_indices, labels, unit_m, rate_line=names_index)
    return read_marker_table(replace(table, time_field=time_field, time_unit_s=time_unit_s, notes=notes), options)


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
