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
from mocapfix.read.file_content import TextDocument, detect_delimiter, parse_document, split_head_lines
from mocapfix.read.marker_table import MarkerTable, find_xyz_triples, read_marker_table
from mocapfix.read.table_cells import parse_rate, parse_unit
from mocapfix.take import Take

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
SECTION_PADDING = ' ,;\t\r"'  # a section's name, where a spreadsheet saved the file


def is_nexus_csv(head: bytes) -> bool:
    """-> does a file that begins so claim to be one? A section's name stands alone in its line, its rate in the next."""
    lines = [line.strip(SECTION_PADDING).lower() for line in split_head_lines(head)]
    return any(name in SECTION_NAMES and rate[:1].isdecimal() for name, rate in pairwise(lines))


def read_nexus_csv(path: Path, data: bytes) -> Take:
    """-> the take in the file's bytes: its section of trajectories, of which velocities and accelerations are left.

    Raises ReadError, naming file and line, where it has no such section.
    """
    text = parse_document(path, data)
    sections = _find_sections(text)
    at = next((index for index, name in sections.items() if name == TRAJECTORY_SECTION), None)
    if at is None:
        raise ReadError(f"{path}: holds {', '.join(sorted({*sections.values()}))} and no trajectories; export those with it.")
    axes, between = _find_axes_line(text, at)
    names, letters = text.split_cells(axes - 1, between), text.split_cells(axes, between)
    names += [""] * (len(letters) - len(names))
    first = [i for i in find_xyz_triples(letters) if names[i]]
    if not first:
        raise text.build_error(axes - 1, "names no markers; export the trajectories with their labels.")
    units = _read_units(text, axes + 1, between)
    rows = _find_section_lines(text, axes + 1 + (units is not None), between, sections)
    if not rows:
        raise text.build_error(axes, "no frames follow; export the trial again.")
    rate = re.sub(r"[^\d.]+.*", "", text.split_cells(at + 1, between)[0])
    return read_marker_table(
        MarkerTable(
            document=text,
            delimiter=between,
            line_indices=rows,
            frame_field=0,
            field_indices=np.array(first)[:, None] + np.arange(3),
            labels=[names[i] for i in first],
            unit_m=parse_unit(text, axes + 1, next((cell for cell in (units or [])[first[0] :] if cell), "mm")),
            rate=parse_rate(text, at + 1, rate),
        )
    )


def _find_sections(text: TextDocument) -> dict[int, str]:
    """-> the name of each section, in lower case, by the index of its first line."""
    names = ((index, text.get_line(index).strip(SECTION_PADDING).lower()) for index in range(len(text.lines)))
    return {index: name for index, name in names if name in SECTION_NAMES}


def _find_axes_line(text: TextDocument, at: int) -> tuple[int, str]:
    """-> the index of the line over the numbers of the section that begins at `at`, and what stands between its fields."""
    for index in range(at + 2, min(at + 5, len(text.lines))):
        between = detect_delimiter(text.get_line(index)) or ","
        if text.split_cells(index, between)[0].lower().startswith(("frame", "field", "sample")):
            return index, between
    raise text.build_error(at, "no line that begins with Frame follows and names the axes; export the trajectories again.")


def _read_units(text: TextDocument, index: int, between: str) -> list[str] | None:
    """-> the cells of the line of units, None where numbers follow at once."""
    if index >= len(text.lines):
        return None
    cells = text.split_cells(index, between)
    return cells if not cells[0] and any(cells) else None


def _find_section_lines(text: TextDocument, start: int, between: str, ends: Container[int]) -> list[int]:
    """-> the indices of the lines up to a blank one or the next section."""
    rows = []
    for index in range(start, len(text.lines)):
        if index in ends or not text.lines[index].strip(between + " \r"):
            break
        rows.append(index)
    return rows
