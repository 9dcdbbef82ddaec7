"""Reading a TRC, Motion Analysis' text file of trajectories, as OpenSim, Mokka and others write it too.

Three lines of facts, a line of marker names, a line of axes, and a line a frame (OpenSim's documentation, "Marker (.trc)
Files"). Writers agree on little else: tabs or commas, a blank line or none, facts that are right or not.
"""

import re
from pathlib import Path

import numpy as np

from mocapfix.read.file_content import TextDocument, detect_delimiter, parse_document
from mocapfix.read.marker_table import MarkerTable, find_names_line, read_marker_table
from mocapfix.read.table_cells import find_nonblank_lines, parse_rate, parse_unit_or_default, parse_whole_number
from mocapfix.take import Take

FIRST_MARKER_FIELD = 2  # the field of the first marker's x, behind frame and time
AXIS_PATTERN = re.compile(r"x\d*", re.IGNORECASE)


def is_trc(head: bytes) -> bool:
    """-> does a file that begins so claim to be a TRC?"""
    return head.lstrip()[:12].lower() in (b"pathfiletype", b"datarate\tcam", b"datarate,cam")


def read_trc(path: Path, data: bytes) -> Take:
    """-> the take in a TRC's bytes. Columns behind the last named marker are unlabelled trajectories, as Cortex writes them.

    Raises ReadError, naming file and line, for what cannot be a TRC's table; counts that the table contradicts are
    remarked on and not believed.
    """
    text = parse_document(path, data)
    at = find_names_line(text, "markers")
    between = detect_delimiter(text.get_line(at))
    if not between:
        raise text.build_error(at, "neither tabs nor commas stand between the names; export it again.")
    named = _parse_marker_names(text.split_cells(at, between)[FIRST_MARKER_FIELD:])
    if not named:
        raise text.build_error(at, "names no markers; export it again.")
    keys, facts = _parse_header(text, at)
    has_axes = at + 1 < len(text.lines) and any(AXIS_PATTERN.fullmatch(cell) for cell in text.split_cells(at + 1, between))
    rows = list(find_nonblank_lines(text, at + 1 + has_axes, between))
    widest = max((text.get_line(row).rstrip(between + " ").count(between) + 1 for row in rows), default=0)
    points = max(len(named), -(-(widest - FIRST_MARKER_FIELD) // 3))
    unit, said = parse_unit_or_default(text, keys + 1, facts.get("units", ""), "mm")
    return read_marker_table(
        MarkerTable(
            document=text,
            delimiter=between,
            line_indices=rows,
            frame_field=0,
            field_indices=FIRST_MARKER_FIELD + np.arange(3 * points).reshape(-1, 3),
            labels=[*named, *(f"*{i}" for i in range(len(named), points))],
            unit_m=unit,
            rate=parse_rate(text, keys + 1, facts.get("datarate", ""), rows, between, time_field=1),
            declared_frame_count=facts.get("numframes", ""),
            notes=(*said, *_check_marker_count(facts, len(named), points)),
        )
    )


def _parse_header(text: TextDocument, names: int) -> tuple[int, dict[str, str]]:
    """-> the index of the line of keys, and the value under each key, by its name in lower case."""
    for index in range(names):
        if text.get_line(index).lstrip(' "').lower().startswith("datarate"):
            between = detect_delimiter(text.get_line(index)) or "\t"
            keys, values = text.split_cells(index, between), text.split_cells(index + 1, between)
            return index, {key.lower(): value for key, value in zip(keys, values, strict=False) if key}
    raise text.build_error(names, "no line of facts (DataRate, NumFrames, Units) comes before the names; export it again.")


def _parse_marker_names(cells: list[str]) -> list[str]:
    """-> the markers' names: one in every three cells or, where they stand closer, one in each."""
    spread = cells[::3]
    if any(cell for i, cell in enumerate(cells) if i % 3):
        spread = cells
    while spread and not spread[-1]:
        spread = spread[:-1]
    return spread


def _check_marker_count(facts: dict[str, str], named: int, points: int) -> tuple[str, ...]:
    """-> what must be said of the header's number of markers."""
    said = parse_whole_number(facts.get("nummarkers", ""))
    if said is None or named <= said <= points:
        return ()
    return (f"The header promises {said} markers and {named} are named.",)
