"""Reading a plain table: one line of column names, each marker's LABEL_X, LABEL_Y, LABEL_Z side by side, a line a frame.

So mocapfix writes CSV itself (LFHD_X_mm: the unit in the name), and so do spreadsheets, scripts and some laboratories.
Between label and axis may stand "_", ".", ":", "-" or a blank; between fields commas, semicolons or tabs.
"""

import re
from pathlib import Path

import numpy as np

from mocapfix.read.coordinates import METRES_PER_UNIT
from mocapfix.read.file_content import TextDocument, detect_delimiter, parse_document, split_head_lines
from mocapfix.read.marker_table import MarkerTable, read_marker_table
from mocapfix.read.table_cells import detect_decimal_sign, find_nonblank_lines, parse_fields, parse_rate
from mocapfix.take import Take

COLUMN_PATTERN = re.compile(r"(.*[^ _.:\-])[ _.:\-]+([XYZ])(?:[ _]?[(\[]?(mm|cm|m)[)\]]?)?", re.IGNORECASE)
FRAME_COLUMN_PATTERN = re.compile(r"(frame|field|sample)\b.*", re.IGNORECASE)
TIME_COLUMN_PATTERN = re.compile(r"(time|seconds)(\b|_).*", re.IGNORECASE)
MILLISECONDS_PATTERN = re.compile(r".*(\b|_)(ms|msecs?|milliseconds?)(\b|_).*", re.IGNORECASE)
MAX_CAPTURE_SPAN_M = 20  # what spans more of its units is no capture in metres
INSPECTED_FRAMES = 50  # frames
MAX_TIME_STEP_RATIO = 2.5  # times the usual step in time; rounded times may take two at once


def is_plain_csv(head: bytes) -> bool:
    """-> does a file that begins so claim to be one?"""
    line = split_head_lines(head)[0]
    between = detect_delimiter(line)
    return bool(between) and bool(_find_points([cell.strip(' "') for cell in line.split(between)]))


def read_plain_csv(path: Path, data: bytes) -> Take:
    """-> the take in the file's bytes; where its columns name no unit, metres or millimetres by how far they span.

    Raises ReadError, naming file and line, where a field is no number or nothing tells the frame rate.
    """
    text = parse_document(path, data)
    if "\r" in text.get_line(0):
        raise text.build_error(0, "ends otherwise than the other lines; save the file with one kind of line ends.")
    between = detect_delimiter(text.get_line(0))
    cells = text.split_cells(0, between)
    points = _find_points(cells)
    if not points:
        raise text.build_error(0, "names no marker's X, Y and Z side by side; export it again.")
    rows = list(find_nonblank_lines(text, 1, between))
    frame = next((i for i, cell in enumerate(cells) if FRAME_COLUMN_PATTERN.fullmatch(cell)), None)
    time = next((i for i, cell in enumerate(cells) if TIME_COLUMN_PATTERN.fullmatch(cell)), None)
    if time is None:
        raise text.build_error(0, "no column is the time, so nothing tells the frame rate; add a column Time in seconds.")
    if frame is None:
        _check_times(text, rows, between, time)
    fields = np.array([field for field, _, _ in points])[:, None] + np.arange(3)
    unit, said = next((unit for _, _, unit in points if unit), ""), ()
    if not unit:
        unit, said = _infer_unit(text, rows, between, fields)
    return read_marker_table(
        MarkerTable(
            document=text,
            delimiter=between,
            line_indices=rows,
            frame_field=frame,
            field_indices=fields,
            labels=[label for _, label, _ in points],
            unit_m=METRES_PER_UNIT[unit],
            rate=parse_rate(text, 0, "", rows, between, time, 0.001 if MILLISECONDS_PATTERN.fullmatch(cells[time]) else 1.0),
            notes=said,
        )
    )


def _check_times(text: TextDocument, rows: list[int], between: str, time: int) -> None:
    """Raise ReadError, naming the line, where times go back or leave frames out: without frame numbers nothing else tells."""
    steps = np.diff(parse_fields(text, rows, between, detect_decimal_sign(text, rows, between), np.array([time]))[:, 0])
    usual = np.median(steps) if len(steps) else 0.0
    if (odd := np.flatnonzero((steps < 0) | ((steps > MAX_TIME_STEP_RATIO * usual) & (usual > 0)))).size:
        step = f"the time goes on by {steps[odd[0]]:g}, elsewhere by {usual:g}"
        raise text.build_error(rows[odd[0] + 1], f"{step}; export the trial whole, or with its frame numbers.")


def _find_points(cells: list[str]) -> list[tuple[int, str, str]]:
    """-> the field of each point's x, its label and its unit, where three columns side by side are its x, y and z."""
    matches = [COLUMN_PATTERN.fullmatch(cell) for cell in cells]
    columns = [(match[1], match[2].upper(), (match[3] or "").lower()) if match else ("", "", "") for match in matches]
    return [
        (i, label, unit)
        for i, (label, axis, unit) in enumerate(columns[:-2])
        if axis == "X" and columns[i + 1 : i + 3] == [(label, "Y", unit), (label, "Z", unit)]
    ]


def _infer_unit(text: TextDocument, rows: list[int], between: str, fields: np.ndarray) -> tuple[str, tuple[str, ...]]:
    """-> the unit in which a capture spans as far as the points at `fields` (P, 3) do, and that it was told so."""
    some = rows[:: max(1, len(rows) // INSPECTED_FRAMES)]
    places = parse_fields(text, some, between, detect_decimal_sign(text, some, between), fields.ravel())
    places = places[np.isfinite(places)]
    unit = "mm" if len(places) and np.ptp(places) > MAX_CAPTURE_SPAN_M else "m"
    return unit, (f"The file does not name its unit; its coordinates span as far as {unit} do.",)
