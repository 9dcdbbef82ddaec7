"""Reading Qualisys Track Manager's TSV of 3D trajectories.

Facts come first, a line each with its key in capitals, and among them the markers' names; then, if it was asked for, a line
of column names; then a line a frame, in millimetres, with the frame's number and time or without (QTM user manual, "TSV
file formats").
"""

import re
from pathlib import Path

import numpy as np

from mocapfix.errors import ReadError
from mocapfix.read.file_content import TextDocument, parse_document
from mocapfix.read.marker_table import MarkerTable, read_marker_table
from mocapfix.read.table_cells import MISSING_TEXTS, find_nonblank_lines, parse_rate
from mocapfix.take import Take

TAB = "\t"
KEY_PATTERN = re.compile(r"[A-Z][A-Z0-9_]+")
QUALISYS_UNIT_M = 0.001
MAX_TIME_ERROR_FRAMES = 0.1  # frames: how far off a time may be that was written with few digits
OTHER_EXPORTS = {"BODY_NAMES": "rigid bodies (6D)", "NO_OF_BODIES": "rigid bodies (6D)", "CHANNEL_NAMES": "analog signals"}
OTHER_EXPORTS |= {"NO_OF_SAMPLES": "analog signals", "SKELETON_NAMES": "a skeleton", "NO_OF_SKELETONS": "a skeleton"}


def is_qualisys_tsv(head: bytes) -> bool:
    """-> does a file that begins so claim to be a Qualisys export, of trajectories or of something else?"""
    first = head.lstrip().split(b"\t", 1)[0]
    return first in (b"NO_OF_FRAMES", b"NO_OF_CAMERAS", b"NO_OF_SAMPLES", b"NO_OF_SKELETONS", b"MARKER_NAMES")


def read_qualisys_tsv(path: Path, data: bytes) -> Take:
    """-> the take in the file's bytes. Blanks and 0 0 0 are missing; frames without numbers are counted from 1.

    Raises ReadError, naming file and line, for QTM's other exports and for a table that does not fit its names.
    """
    text = parse_document(path, data)
    facts, body = _parse_header(text)
    if "MARKER_NAMES" not in facts:
        what = next((what for key, what in OTHER_EXPORTS.items() if key in facts), "no names of markers")
        raise ReadError(f"{path}: holds {what}; export its trajectories as TSV (3D data).")
    at, labels = facts["MARKER_NAMES"]
    while labels and not labels[-1]:
        labels.pop()
    if not labels:
        raise text.build_error(at, "names no markers; export it again.")
    named = body < len(text.lines) and any(cell.strip().upper().endswith("X") for cell in text.split_cells(body, TAB))
    rows = list(find_nonblank_lines(text, body + named, TAB))
    at_rate, frequency = facts.get("FREQUENCY", (at, [""]))
    rate = parse_rate(text, at_rate, frequency[0])
    first, frame = _find_first_field(text, body, rows, named, rate)
    if frame is None:  # a line of tabs alone is a frame that shows nothing
        rows = [index for index in range(body + named, len(text.lines)) if text.get_line(index)]
    return read_marker_table(
        MarkerTable(
            document=text,
            delimiter=TAB,
            line_indices=rows,
            frame_field=frame,
            field_indices=first + np.arange(3 * len(labels)).reshape(-1, 3),
            labels=labels,
            unit_m=QUALISYS_UNIT_M,
            rate=rate,
            declared_frame_count=facts.get("NO_OF_FRAMES", (0, [""]))[1][0],
        )
    )


def _parse_header(text: TextDocument) -> tuple[dict[str, tuple[int, list[str]]], int]:
    """-> the line and the values of every key, and the index of the first line behind them.

    Behind the markers' names that may be a frame whose first field is missing, blank or spelled as no key is (NULL).
    """
    facts: dict[str, tuple[int, list[str]]] = {}
    for index in range(len(text.lines)):
        key, *values = text.split_cells(index, TAB)
        missing = key.lower() in MISSING_TEXTS
        if (values and "MARKER_NAMES" in facts) if missing else not KEY_PATTERN.fullmatch(key):
            return facts, index
        if not missing:
            facts.setdefault(key, (index, values or [""]))
    return facts, len(text.lines)


def _find_first_field(text: TextDocument, body: int, rows: list[int], named: bool, rate: float) -> tuple[int, int | None]:
    """-> the field of the first marker's x, and that of the frame's number, None where there is none.

    Without column names, a whole number that rises by one is the frame's, and one behind it that rises by a frame's seconds
    is the time.
    """
    if named:
        cells = [cell.upper() for cell in text.split_cells(body, TAB)]
        return next(i for i, cell in enumerate(cells) if cell.endswith("X")), 0 if cells[0] == "FRAME" else None
    if len(rows) < 2:
        return 0, None
    (a, s), (b, t) = ([*text.split_cells(row, TAB), ""][:2] for row in rows[:2])
    if not (a.isdecimal() and b.isdecimal() and int(b) == int(a) + 1):
        return 0, None
    try:
        frames = rate * (float(t.replace(",", ".")) - float(s.replace(",", ".")))
    except ValueError:
        return 1, 0
    return 2 if abs(frames - 1) < MAX_TIME_ERROR_FRAMES else 1, 0
