"""Read Vicon Nexus' ASCII export, and Workstation's before it: sections, one of which has the trajectories.

A section has its name, its rate, a line of names, a line of axes, usually a line of units, and one line per frame up to a
blank line (Vicon Nexus documentation, "Export data to ASCII").
"""

import re
from collections.abc import Container
from itertools import pairwise
from pathlib import Path

import numpy as np

from mocapfix.errors import ReadError, format_name_list
from mocapfix.io.file_content import TextDocument, detect_delimiter, parse_document, split_head_lines
from mocapfix.io.marker_table import MarkerTable, check_decimal_commas, find_xyz_triples, parse_unit, read_marker_table
from mocapfix.model.take import Take
from mocapfix.options import ReadOptions

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
SECTION_PADDING = ' ,;\t\r"'  # characters around the name of a section in a file that a spreadsheet saved


def is_nexus_csv(head: bytes) -> bool:
    """Return whether a file with this beginning is a Nexus export: a section's name alone in a line, its rate in the next."""
    lines = [line.strip(SECTION_PADDING).lower() for line in split_head_lines(head)]
    return any(name in SECTION_NAMES and rate[:1].isdecimal() for name, rate in pairwise(lines))


def read_nexus_csv(path: Path, data: bytes, options: ReadOptions) -> Take:
    """Return the take in the bytes of a Nexus export: the positions in its section of trajectories.

    Raises:
        ReadError: If there is no such section. The message names file and line.
    """
    document = parse_document(path, data)
    sections = _find_sections(document)
    start = next((index for index, name in sections.items() if name == TRAJECTORY_SECTION), None)
    if start is None:
        present = format_name_list(sorted({*sections.values()}))
        raise ReadError(f"{path}: has {present} and no trajectories; export the trajectories as well.")
    axes_index, delimiter = _find_axes_line(document, start)
    names, axes = document.split_cells(axes_index - 1, delimiter), document.split_cells(axes_index, delimiter)
    names += [""] * (len(axes) - len(names))
    first_fields = [i for i in find_xyz_triples(axes) if names[i]]
    if not first_fields:
        raise document.build_error(axes_index - 1, "names no markers; export the trajectories with their labels.")
    units = _read_units(document, axes_index + 1, delimiter)
    line_indices = _find_section_lines(document, axes_index + 1 + (units is not None), delimiter, sections)
    if not line_indices:
        raise document.build_error(axes_index, "no frames follow; export the trial again.")
    check_decimal_commas(document, line_indices, delimiter, len(axes))
    unit = next((cell for cell in (units or [])[first_fields[0] :] if cell), "mm")
    rate = re.sub(r"[^\d.]+.*", "", document.split_cells(start + 1, delimiter)[0])
    return read_marker_table(
        MarkerTable(
            document=document,
            delimiter=delimiter,
            line_indices=line_indices,
            frame_field=0,
            field_indices=np.array(first_fields)[:, None] + np.arange(3),
            labels=[names[i] for i in first_fields],
            unit_m=parse_unit(document, axes_index + 1, options.unit or unit),
            rate_text=rate,
            rate_line=start + 1,
        ),
        options,
    )


def _find_sections(document: TextDocument) -> dict[int, str]:
    """Return the name of each section, in lower case, by the index of its first line."""
    names = ((index, document.get_line(index).strip(SECTION_PADDING).lower()) for index in range(len(document.lines)))
    return {index: name for index, name in names if name in SECTION_NAMES}


def _find_axes_line(document: TextDocument, start: int) -> tuple[int, str]:
    """Return the index of the line of axes in the section that begins at `start`, and the field separator."""
    for index in range(start + 2, min(start + 5, len(document.lines))):
        delimiter = detect_delimiter(document.get_line(index)) or ","
        if document.split_cells(index, delimiter)[0].lower().startswith(("frame", "field", "sample")):
            return index, delimiter
    problem = "no line that begins with Frame and names the axes follows"
    raise document.build_error(start, f"{problem}; export the trajectories again.")


def _read_units(document: TextDocument, index: int, delimiter: str) -> list[str] | None:
    """Return the cells of the line of units, None if the line has numbers."""
    if index >= len(document.lines):
        return None
    cells = document.split_cells(index, delimiter)
    return cells if not cells[0] and any(cells) else None


def _find_section_lines(document: TextDocument, start: int, delimiter: str, sections: Container[int]) -> list[int]:
    """Return the indices of the lines up to a blank one or the next section."""
    line_indices: list[int] = []
    for index in range(start, len(document.lines)):
        if index in sections or not document.lines[index].strip(delimiter + " \r"):
            break
        line_indices.append(index)
    return line_indices
