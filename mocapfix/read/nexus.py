"""Reading Vicon Nexus' ASCII export, and Workstation's before it: sections, of which one holds the trajectories.

A section is its name, its rate, a line of names, a line of axes, mostly one of units, and a line a frame up to a blank one
(Vicon Nexus documentation, "Export data to ASCII").
"""

import re
from collections.abc import Container
from itertools import pairwise
from pathlib import Path

import numpy as np

from mocapfix.errors import ReadError
from mocapfix.read.cells import rate_of, unit_of
from mocapfix.read.table import Sheet, take_of, triples
from mocapfix.read.text import Document, delimiter, document, head_lines
from mocapfix.take import Take

TRAJECTORIES = "trajectories"
SECTIONS = {TRAJECTORIES, "model outputs", "devices", "joints", "segments", "analog", "forces", "events", "force plates"}
AROUND = ' ,;\t\r"'  # a section's name, where a spreadsheet saved the file


def recognises(head: bytes) -> bool:
    """-> does a file that begins so claim to be one? A section's name stands alone in its line, its rate in the next."""
    lines = [line.strip(AROUND).lower() for line in head_lines(head)]
    return any(name in SECTIONS and rate[:1].isdecimal() for name, rate in pairwise(lines))


def take(path: Path, data: bytes) -> Take:
    """-> the take in the file's bytes: its section of trajectories, of which velocities and accelerations are left.

    Raises ReadError, naming file and line, where it has no such section.
    """
    text = document(path, data)
    sections = _sections(text)
    at = next((index for index, name in sections.items() if name == TRAJECTORIES), None)
    if at is None:
        raise ReadError(f"{path}: holds {', '.join(sorted({*sections.values()}))} and no trajectories; export those with it.")
    axes, between = _axes_line(text, at)
    names, letters = text.cells(axes - 1, between), text.cells(axes, between)
    names += [""] * (len(letters) - len(names))
    first = [i for i in triples(letters) if names[i]]
    if not first:
        raise text.fault(axes - 1, "names no markers; export the trajectories with their labels.")
    units = _units(text, axes + 1, between)
    rows = _rows(text, axes + 1 + (units is not None), between, sections)
    if not rows:
        raise text.fault(axes, "no frames follow; export the trial again.")
    rate = re.sub(r"[^\d.]+.*", "", text.cells(at + 1, between)[0])
    return take_of(
        Sheet(
            document=text,
            delimiter=between,
            rows=rows,
            frame=0,
            fields=np.array(first)[:, None] + np.arange(3),
            labels=[names[i] for i in first],
            unit=unit_of(text, axes + 1, next((cell for cell in (units or [])[first[0] :] if cell), "mm")),
            rate=rate_of(text, at + 1, rate),
        )
    )


def _sections(text: Document) -> dict[int, str]:
    """-> the name of each section, in lower case, by the index of its first line."""
    names = ((index, text.line(index).strip(AROUND).lower()) for index in range(len(text.lines)))
    return {index: name for index, name in names if name in SECTIONS}


def _axes_line(text: Document, at: int) -> tuple[int, str]:
    """-> the index of the line over the numbers of the section that begins at `at`, and what stands between its fields."""
    for index in range(at + 2, min(at + 5, len(text.lines))):
        between = delimiter(text.line(index)) or ","
        if text.cells(index, between)[0].lower().startswith(("frame", "field", "sample")):
            return index, between
    raise text.fault(at, "no line that begins with Frame follows and names the axes; export the trajectories again.")


def _units(text: Document, index: int, between: str) -> list[str] | None:
    """-> the cells of the line of units, None where numbers follow at once."""
    if index >= len(text.lines):
        return None
    cells = text.cells(index, between)
    return cells if not cells[0] and any(cells) else None


def _rows(text: Document, start: int, between: str, ends: Container[int]) -> list[int]:
    """-> the indices of the lines up to a blank one or the next section."""
    rows = []
    for index in range(start, len(text.lines)):
        if index in ends or not text.lines[index].strip(between + " \r"):
            break
        rows.append(index)
    return rows
