"""Read Qualisys Track Manager's TSV of 3D trajectories.

Header lines have a key in capitals and its values, among them the marker names. A line of column names follows if it was
exported. Then there is one line per frame, in millimetres, with or without frame number and time (QTM user manual, "TSV file
formats").
"""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mocapfix.errors import ReadError
from mocapfix.io.file_content import TextDocument, parse_document
from mocapfix.io.frame_rate import parse_time
from mocapfix.io.marker_table import MAX_INSPECTED_LINES, MISSING_TEXTS, MarkerTable, find_nonblank_lines, read_marker_table
from mocapfix.model.take import Take
from mocapfix.options import ReadOptions

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
    line_indices = list(find_nonblank_lines(document, body + has_column_names, TAB))
    frequency = header.get("FREQUENCY", _HeaderValue(names_index, [""]))
    first_field, frame_field = _find_first_field(
        document, body, line_indices, has_column_names, 3 * len(labels), frequency.values[0]
    )
    if frame_field is None:  # a line of tabs only is a frame without visible markers
        line_indices = [index for index in range(body + has_column_names, len(document.lines)) if document.get_line(index)]
    return read_marker_table(
        MarkerTable(
            document=document,
            delimiter=TAB,
            line_indices=line_indices,
            frame_field=frame_field,
            field_indices=first_field + np.arange(3 * len(labels)).reshape(-1, 3),
            labels=labels,
            unit_m=QUALISYS_UNIT_M,
            rate_text=frequency.values[0],
            rate_line=frequency.line_index,
            time_field=first_field - 1 if first_field > (frame_field is not None) else None,
            declared_frame_count=header.get("NO_OF_FRAMES", _HeaderValue(0, [""])).values[0],
        ),
        options,
    )


def _parse_header(document: TextDocument) -> tuple[dict[str, _HeaderValue], int]:
    """Return the values of the keys, and the index of the first line after the header.

    The line after the marker names may be a frame whose first field is missing: blank, or spelled unlike a key, such as NULL.
    """
    header: dict[str, _HeaderValue] = {}
    for index in range(document.find_first_line(), len(document.lines)):
        key, *values = document.split_cells(index, TAB)
        is_missing = key.lower() in MISSING_TEXTS
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
    inspected = line_indices[:MAX_INSPECTED_LINES]
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
