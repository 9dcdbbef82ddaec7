"""Reading OptiTrack's CSV before Motive's columns, format version 1.1: a row a frame with the markers that were visible.

Each row begins with what it is; the file's comments say what follows (OptiTrack's "Format Information", in the file). A
frame row lists rigid bodies, eleven fields each, then markers: x, y, z, ID and name, in metres. A row holds visible
markers only, so where a missing sample would have to be put there is no field: the take's layout has no places.
"""

import re
from pathlib import Path

import numpy as np

from mocapfix.errors import ReadError
from mocapfix.read.cells import miscounted, numbers, rate_of
from mocapfix.read.text import Document, document, head_lines
from mocapfix.read.trajectories import first_frame, take_of
from mocapfix.table_layout import TableLayout
from mocapfix.take import Take

VERSION = re.compile(r'"?info"?,"?(version|framecount)"?,', re.IGNORECASE)
FRAME, TIME, BODIES = 1, 2, 3  # the fields of a frame row with its number, its time and the number of rigid bodies
BODY, MARKER = 11, 5  # fields of a rigid body and of a marker
NAMELESS = re.compile(r"|Marker-\d+|Unlabell?ed.*", re.IGNORECASE)  # what a marker of no rigid body is called
METRES = 1.0


def recognises(head: bytes) -> bool:
    """-> does a file that begins so claim to be one?"""
    return any(VERSION.match(line) for line in head_lines(head))


def take(path: Path, data: bytes) -> Take:
    """-> the take in the file's bytes: its markers by name, those that have none by their ID and as unlabelled.

    Raises ReadError, naming file and line, for a row that does not hold what it counts.
    """
    text = document(path, data)
    heads = [text.line(index).partition(",")[0].strip('" ').lower() for index in range(len(text.lines))]
    rows = [index for index, head in enumerate(heads) if head == "frame"]
    if not rows:
        raise ReadError(f"{path}: holds no frames; export the trial again.")
    cells = [text.cells(index, ",") for index in rows]
    found = [_markers(text, index, row) for index, row in zip(rows, cells, strict=True)]
    labels = list(dict.fromkeys(label for markers in found for label in markers))
    gone = [np.nan] * 3
    raw = np.array([[markers.get(label, gone) for label in labels] for markers in found]).reshape(len(rows), -1, 3)
    if "lefthanded" in heads:
        raw[..., 2] *= -1
    first, said = first_frame(text, rows, numbers(text, rows, ",", ".", np.array([FRAME]))[:, 0])
    info = [text.cells(index, ",") for index, head in enumerate(heads) if head == "info"]
    promised = next((row[2] for row in info if row[1:2] == ["framecount"] and len(row) > 2), "")
    said += miscounted(promised, len(rows))
    rate = rate_of(text, rows[-1], "", rows, ",", TIME)
    layout = TableLayout(text.encoding, text.newline, ",", ".", unit=METRES)
    return take_of(path, raw, labels, METRES, rate, first, layout, usual="Y", notes=said)


def _markers(text: Document, index: int, cells: list[str]) -> dict[str, list[float]]:
    """-> x, y, z of the markers in a frame row, by label; an asterisk and its ID for one that nobody named."""
    try:
        start = BODIES + 1 + BODY * int(cells[BODIES])
        behind = start + 1 + MARKER * int(cells[start])
        if not BODIES < start < behind <= len(cells):
            raise ValueError(cells[start])
        given = [cells[i : i + MARKER] for i in range(start + 1, behind, MARKER)]
        found = [(_label(name, number), [float(x), float(y), float(z)]) for x, y, z, number, name in given]
    except (ValueError, IndexError) as error:
        raise text.fault(index, "does not hold the rigid bodies and markers that it counts; copy or export it again.") from error
    if len(dict(found)) < len(found):
        raise text.fault(index, "names two markers alike; give each a name of its own and export it again.")
    return dict(found)


def _label(name: str, number: str) -> str:
    return f"*{number}" if NAMELESS.fullmatch(name) else name
