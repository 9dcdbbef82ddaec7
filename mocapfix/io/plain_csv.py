"""Read a plain table: a line of column names with LABEL_X, LABEL_Y, LABEL_Z of each marker side by side, then one line per frame.

This is the CSV that mocapfix writes (LFHD_X_mm, with the unit in the name), and that of spreadsheets, scripts and some
laboratories. Label and axis are separated by "_", ".", ":", "-" or a blank, fields by commas, semicolons or tabs.
"""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from mocapfix.io.coordinates import METRES_PER_UNIT
from mocapfix.io.file_content import TextDocument, detect_delimiter, parse_document, split_head_lines
from mocapfix.io.marker_table import (
    MarkerTable,
    check_decimal_commas,
    detect_decimal_sign,
    find_nonblank_lines,
    parse_fields,
    read_marker_table,
)
from mocapfix.model.take import Take
from mocapfix.options import ReadOptions

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
MAX_CAPTURE_SPAN_M = 20  # coordinates that span more units than this are not in metres
INSPECTED_FRAMES = 50  # from which the span of the coordinates is computed


class _PointColumns(NamedTuple):
    """The first field of a point, its label, and the unit in its column name, "" if there is none."""

    first_field: int
    label: str
    unit: str


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
    others = [i for i in range(len(cells)) if not any(0 <= i - point.first_field < 3 for point in points)]
    time_field = next((i for i in others if TIME_COLUMN_PATTERN.fullmatch(cells[i])), None)
    frame_field = next((i for i in others if FRAME_COLUMN_PATTERN.fullmatch(cells[i])), None)
    if time_field is None and options.rate_hz is None:
        remedy = "give it with --rate HZ, or add a column Time in seconds"
        raise document.build_error(names_index, f"there is no column for the time, so the rate is unknown; {remedy}.")
    field_indices = np.array([point.first_field for point in points])[:, None] + np.arange(3)
    unit, notes = options.unit or next((point.unit for point in points if point.unit), ""), ()
    if not unit:
        unit = _infer_unit(document, line_indices, delimiter, field_indices)
        notes = (f"The file names no unit; {unit} is assumed, from the span of its coordinates.",)
    return read_marker_table(
        MarkerTable(
            document=document,
            delimiter=delimiter,
            line_indices=line_indices,
            frame_field=frame_field,
            field_indices=field_indices,
            labels=[point.label for point in points],
            unit_m=METRES_PER_UNIT[unit],
            rate_line=names_index,
            time_field=time_field,
            time_unit_s=None if time_field is None else _get_time_unit(cells[time_field]),
            notes=notes,
        ),
        options,
    )


def _get_time_unit(name: str) -> float | None:
    """Return the seconds in the unit that the name of a time column gives, None if it gives none."""
    match = TIME_UNIT_PATTERN.fullmatch(name)
    if not match:
        return None
    return next(unit_s for group, unit_s in zip(match.groups(), TIME_PATTERN_UNITS_S, strict=True) if group)


def _find_points(cells: list[str]) -> list[_PointColumns]:
    """Return the points whose X, Y and Z are three adjacent columns with the same label and unit."""
    matches = [COLUMN_PATTERN.fullmatch(cell) for cell in cells]
    columns = [(match[1], match[2].upper(), (match[3] or "").lower()) if match else ("", "", "") for match in matches]
    return [
        _PointColumns(i, label, unit)
        for i, (label, axis, unit) in enumerate(columns[:-2])
        if axis == "X" and columns[i + 1 : i + 3] == [(label, "Y", unit), (label, "Z", unit)]
    ]


def _infer_unit(document: TextDocument, line_indices: list[int], delimiter: str, field_indices: Int[np.ndarray, "P 3"]) -> str:
    """Return "mm" if the coordinates of the points span more than a capture in metres does, else "m"."""
    inspected = line_indices[:: max(1, len(line_indices) // INSPECTED_FRAMES)]
    decimal_sign = detect_decimal_sign(document, inspected, delimiter)
    coordinates = parse_fields(document, inspected, delimiter, decimal_sign, field_indices.ravel())
    coordinates = coordinates[np.isfinite(coordinates)]
    return "mm" if len(coordinates) and np.ptp(coordinates) > MAX_CAPTURE_SPAN_M else "m"
