"""Reading a plain table: one line of column names, each marker's LABEL_X, LABEL_Y, LABEL_Z side by side, a line a frame.

So mocapfix writes CSV itself (LFHD_X_mm: the unit in the name), and so do spreadsheets, scripts and some laboratories.
Between label and axis may stand "_", ".", ":", "-" or a blank; between fields commas, semicolons or tabs.
"""

import re
from pathlib import Path

import numpy as np

from mocapfix.read.cells import decimal_sign, filled_rows, numbers, rate_of
from mocapfix.read.table import Sheet, take_of
from mocapfix.read.text import Document, delimiter, document, head_lines
from mocapfix.read.units import METRES
from mocapfix.take import Take

COLUMN = re.compile(r"(.*[^ _.:\-])[ _.:\-]+([XYZ])(?:[ _]?[(\[]?(mm|cm|m)[)\]]?)?", re.IGNORECASE)
FRAME = re.compile(r"(frame|field|sample)\b.*", re.IGNORECASE)
TIME = re.compile(r"(time|seconds)(\b|_).*", re.IGNORECASE)
MILLISECONDS = re.compile(r".*(\b|_)(ms|msecs?|milliseconds?)(\b|_).*", re.IGNORECASE)
NO_ROOM = 20  # what spans more of its units is no capture in metres
LOOKED_AT = 50  # frames
LEAP = 2.5  # times the usual step in time; rounded times may take two at once


def recognises(head: bytes) -> bool:
    """-> does a file that begins so claim to be one?"""
    line = head_lines(head)[0]
    between = delimiter(line)
    return bool(between) and bool(_points([cell.strip(' "') for cell in line.split(between)]))


def take(path: Path, data: bytes) -> Take:
    """-> the take in the file's bytes; where its columns name no unit, metres or millimetres by how far they span.

    Raises ReadError, naming file and line, where a field is no number or nothing tells the frame rate.
    """
    text = document(path, data)
    if "\r" in text.line(0):
        raise text.fault(0, "ends otherwise than the other lines; save the file with one kind of line ends.")
    between = delimiter(text.line(0))
    cells = text.cells(0, between)
    points = _points(cells)
    if not points:
        raise text.fault(0, "names no marker's X, Y and Z side by side; export it again.")
    rows = list(filled_rows(text, 1, between))
    frame = next((i for i, cell in enumerate(cells) if FRAME.fullmatch(cell)), None)
    time = next((i for i, cell in enumerate(cells) if TIME.fullmatch(cell)), None)
    if time is None:
        raise text.fault(0, "no column is the time, so nothing tells the frame rate; add a column Time in seconds.")
    if frame is None:
        _check_times(text, rows, between, time)
    fields = np.array([field for field, _, _ in points])[:, None] + np.arange(3)
    unit, said = next((unit for _, _, unit in points if unit), ""), ()
    if not unit:
        unit, said = _spanned(text, rows, between, fields)
    return take_of(
        Sheet(
            document=text,
            delimiter=between,
            rows=rows,
            frame=frame,
            fields=fields,
            labels=[label for _, label, _ in points],
            unit=METRES[unit],
            rate=rate_of(text, 0, "", rows, between, time, 0.001 if MILLISECONDS.fullmatch(cells[time]) else 1.0),
            notes=said,
        )
    )


def _check_times(text: Document, rows: list[int], between: str, time: int) -> None:
    """Raise ReadError, naming the line, where times go back or leave frames out: without frame numbers nothing else tells."""
    steps = np.diff(numbers(text, rows, between, decimal_sign(text, rows, between), np.array([time]))[:, 0])
    usual = np.median(steps) if len(steps) else 0.0
    if (odd := np.flatnonzero((steps < 0) | ((steps > LEAP * usual) & (usual > 0)))).size:
        step = f"the time goes on by {steps[odd[0]]:g}, elsewhere by {usual:g}"
        raise text.fault(rows[odd[0] + 1], f"{step}; export the trial whole, or with its frame numbers.")


def _points(cells: list[str]) -> list[tuple[int, str, str]]:
    """-> the field of each point's x, its label and its unit, where three columns side by side are its x, y and z."""
    matches = [COLUMN.fullmatch(cell) for cell in cells]
    columns = [(match[1], match[2].upper(), (match[3] or "").lower()) if match else ("", "", "") for match in matches]
    return [
        (i, label, unit)
        for i, (label, axis, unit) in enumerate(columns[:-2])
        if axis == "X" and columns[i + 1 : i + 3] == [(label, "Y", unit), (label, "Z", unit)]
    ]


def _spanned(text: Document, rows: list[int], between: str, fields: np.ndarray) -> tuple[str, tuple[str, ...]]:
    """-> the unit in which a capture spans as far as the points at `fields` (P, 3) do, and that it was told so."""
    some = rows[:: max(1, len(rows) // LOOKED_AT)]
    places = numbers(text, some, between, decimal_sign(text, some, between), fields.ravel())
    places = places[np.isfinite(places)]
    unit = "mm" if len(places) and np.ptp(places) > NO_ROOM else "m"
    return unit, (f"The file does not name its unit; its coordinates span as far as {unit} do.",)
