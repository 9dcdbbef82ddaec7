"""Read TRC, Motion Analysis' text format of trajectories, which OpenSim, Mokka and others write too.

Three lines of header, a line of marker names, a line of axes, then one line per frame (OpenSim documentation, "Marker (.trc)
Files"). Programs differ in the rest: tabs or commas, with or without a blank line, with correct or wrong header values.
"""

import re
from pathlib import Path

import numpy as np

from mocapfix.io.file_content import TextDocument, detect_delimiter, parse_document
from mocapfix.io.marker_table import (
    MarkerTable,
    check_decimal_commas,
    find_names_line,
    find_nonblank_lines,
    parse_unit_or_default,
    parse_whole_number,
    read_marker_table,
)
from mocapfix.model.take import Take
from mocapfix.options import ReadOptions

FIRST_MARKER_FIELD = 2  # field of the first marker's X, after frame and time
AXIS_PATTERN = re.compile(r"x\d*", re.IGNORECASE)


def is_trc(head: bytes) -> bool:
    """Return whether a file with this beginning is a TRC."""
    return head.lstrip()[:12].lower() in (b"pathfiletype", b"datarate\tcam", b"datarate,cam")


def read_trc(path: Path, data: bytes, options: ReadOptions) -> Take:
    """Return the take in the bytes of a TRC.

    Columns after the last named marker are unlabelled trajectories, as in the files of Cortex.

    Raises:
        ReadError: If the table is invalid. The message names file and line. Counts in the header that the table contradicts are
            ignored and noted.
    """
    document = parse_document(path, data)
    names_index = find_names_line(document, "markers")
    delimiter = detect_delimiter(document.get_line(names_index))
    if not delimiter:
        raise document.build_error(names_index, "there are neither tabs nor commas between the names; export it again.")
    names = _parse_marker_names(document.split_cells(names_index, delimiter)[FIRST_MARKER_FIELD:])
    if not names:
        raise document.build_error(names_index, "names no markers; export it again.")
    keys_index, header = _parse_header(document, names_index)
    axes_index = names_index + 1
    has_axes = axes_index < len(document.lines) and any(
        AXIS_PATTERN.fullmatch(cell) for cell in document.split_cells(axes_index, delimiter)
    )
    line_indices = list(find_nonblank_lines(document, axes_index + has_axes, delimiter))
    check_decimal_commas(document, line_indices, delimiter, FIRST_MARKER_FIELD + 3 * len(names))
    widest = max((document.get_line(i).rstrip(delimiter + " ").count(delimiter) + 1 for i in line_indices), default=0)
    point_count = max(len(names), -(-(widest - FIRST_MARKER_FIELD) // 3))
    unit_m, unit_notes = parse_unit_or_default(document, keys_index + 1, options.unit or header.get("units", ""), "mm")
    return read_marker_table(
        MarkerTable(
            document=document,
            delimiter=delimiter,
            line_indices=line_indices,
            frame_field=0,
            field_indices=FIRST_MARKER_FIELD + np.arange(3 * point_count).reshape(-1, 3),
            labels=[*names, *(f"*{i}" for i in range(len(names), point_count))],
            unit_m=unit_m,
            rate_text=header.get("datarate", ""),
            rate_line=keys_index + 1,
            time_field=1,
            declared_frame_count=header.get("numframes", ""),
            notes=(*unit_notes, *_check_marker_count(header, len(names), point_count)),
        ),
        options,
    )


def _parse_header(document: TextDocument, names_index: int) -> tuple[int, dict[str, str]]:
    """Return the index of the line of keys, and the value of each key in lower case."""
    for index in range(names_index):
        if document.get_line(index).lstrip(' "').lower().startswith("datarate"):
            delimiter = detect_delimiter(document.get_line(index)) or "\t"
            keys, values = document.split_cells(index, delimiter), document.split_cells(index + 1, delimiter)
            return index, {key.lower(): value for key, value in zip(keys, values, strict=False) if key}
    problem = "there is no header (DataRate, NumFrames, Units) before the names"
    raise document.build_error(names_index, f"{problem}; export it again.")


def _parse_marker_names(cells: list[str]) -> list[str]:
    """Return the marker names: every third cell, or every cell if names are adjacent."""
    names = cells if any(cell for i, cell in enumerate(cells) if i % 3) else cells[::3]
    while names and not names[-1]:
        names = names[:-1]
    return names


def _check_marker_count(header: dict[str, str], named: int, point_count: int) -> tuple[str, ...]:
    """Return a note if the header declares a number of markers that does not fit the table."""
    declared = parse_whole_number(header.get("nummarkers", ""))
    if declared is None or named <= declared <= point_count:
        return ()
    return (f"The header declares {declared} markers; {named} are named.",)
