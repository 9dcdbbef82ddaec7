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
from mocapfix.files.read_options import ReadOptions
from mocapfix.read.file_content import TextDocument, parse_document
from mocapfix.read.marker_table import MarkerTable, read_marker_table
from mocapfix.read.table_cells import MISSING_TEXTS, find_nonblank_lines, parse_rate
from mocapfix.take import Take

TAB = "\t"
KEY_PATTERN = re.compile(r"[A-Z][A-Z0-9_]+")
QUALISYS_UNIT_M = 0.001
MAX_TIME_ERROR_FRAMES = 0.1  # of a time step that is one frame: times may be written with few digits
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
    rate = parse_rate(document, frequency.line_index, frequency.values[0])
    first_field, frame_field = _find_first_field(document, body, line_indices, has_column_names, rate)
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
            rate=rate,
            declared_frame_count=header.get("NO_OF_FRAMES", _HeaderValue(0, [""])).values[0],
        ),
        options,
    )


def _parse_header(document: TextDocument) -> tuple[dict[str, _HeaderValue], int]:
    """Return the values of the keys, and the index of the first line after the header.

    The line after the marker names may be a frame whose first field is missing: blank, or spelled unlike a key, such as NULL.
    """
    header: dict[str, _HeaderValue] = {}
    for index in range(len(document.lines)):
        key, *values = document.split_cells(index, TAB)
        is_missing = key.lower() in MISSING_TEXTS
        if (values and "MARKER_NAMES" in header) if is_missing else not KEY_PATTERN.fullmatch(key):
            return header, index
        if not is_missing:
            header.setdefault(key, _HeaderValue(index, values or [""]))
    return header, len(document.lines)


def _find_first_field(
    document: TextDocument, body: int, line_indices: list[int], has_column_names: bool, rate: float
) -> tuple[int, int | None]:
    """Return the field of the first marker's X, and that of the frame number, None if there is none.

    Without column names, a whole number that increases by one is the frame number, and a number after it that increases by the
    duration of a frame is the time.
    """
    if has_column_names:
        cells = [cell.upper() for cell in document.split_cells(body, TAB)]
        return next(i for i, cell in enumerate(cells) if cell.endswith("X")), 0 if cells[0] == "FRAME" else None
    if len(line_indices) < 2:
        return 0, None
    (frame_0, time_0), (frame_1, time_1) = ([*document.split_cells(i, TAB), ""][:2] for i in line_indices[:2])
    if not (frame_0.isdecimal() and frame_1.isdecimal() and int(frame_1) == int(frame_0) + 1):
        return 0, None
    try:
        frames = rate * (float(time_1.replace(",", ".")) - float(time_0.replace(",", ".")))
    except ValueError:
        return 1, 0
    return 2 if abs(frames - 1) < MAX_TIME_ERROR_FRAMES else 1, 0
