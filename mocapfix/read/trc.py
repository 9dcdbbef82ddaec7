"""Reading a TRC, Motion Analysis' text file of trajectories, as OpenSim, Mokka and others write it too.

Three lines of facts, a line of marker names, a line of axes, and a line a frame (OpenSim's documentation, "Marker (.trc)
Files"). Writers agree on little else: tabs or commas, a blank line or none, facts that are right or not.
"""

import re
from pathlib import Path

import numpy as np

from mocapfix.read.cells import filled_rows, rate_of, unit_said, whole
from mocapfix.read.table import Sheet, names_line, take_of
from mocapfix.read.text import Document, delimiter, document
from mocapfix.take import Take

FIRST = 2  # the field of the first marker's x, behind frame and time
AXIS = re.compile(r"x\d*", re.IGNORECASE)


def recognises(head: bytes) -> bool:
    """-> does a file that begins so claim to be a TRC?"""
    return head.lstrip()[:12].lower() in (b"pathfiletype", b"datarate\tcam", b"datarate,cam")


def take(path: Path, data: bytes) -> Take:
    """-> the take in a TRC's bytes. Columns behind the last named marker are unlabelled trajectories, as Cortex writes them.

    Raises ReadError, naming file and line, for what cannot be a TRC's table; counts that the table contradicts are
    remarked on and not believed.
    """
    text = document(path, data)
    at = names_line(text, "markers")
    between = delimiter(text.line(at))
    if not between:
        raise text.fault(at, "neither tabs nor commas stand between the names; export it again.")
    named = _names(text.cells(at, between)[FIRST:])
    if not named:
        raise text.fault(at, "names no markers; export it again.")
    keys, facts = _facts(text, at)
    has_axes = at + 1 < len(text.lines) and any(AXIS.fullmatch(cell) for cell in text.cells(at + 1, between))
    rows = list(filled_rows(text, at + 1 + has_axes, between))
    widest = max((text.line(row).rstrip(between + " ").count(between) + 1 for row in rows), default=0)
    points = max(len(named), -(-(widest - FIRST) // 3))
    unit, said = unit_said(text, keys + 1, facts.get("units", ""), "mm")
    return take_of(
        Sheet(
            document=text,
            delimiter=between,
            rows=rows,
            frame=0,
            fields=FIRST + np.arange(3 * points).reshape(-1, 3),
            labels=[*named, *(f"*{i}" for i in range(len(named), points))],
            unit=unit,
            rate=rate_of(text, keys + 1, facts.get("datarate", ""), rows, between, time=1),
            promised=facts.get("numframes", ""),
            notes=(*said, *_markers_said(facts, len(named), points)),
        )
    )


def _facts(text: Document, names: int) -> tuple[int, dict[str, str]]:
    """-> the index of the line of keys, and the value under each key, by its name in lower case."""
    for index in range(names):
        if text.line(index).lstrip(' "').lower().startswith("datarate"):
            between = delimiter(text.line(index)) or "\t"
            keys, values = text.cells(index, between), text.cells(index + 1, between)
            return index, {key.lower(): value for key, value in zip(keys, values, strict=False) if key}
    raise text.fault(names, "no line of facts (DataRate, NumFrames, Units) comes before the names; export it again.")


def _names(cells: list[str]) -> list[str]:
    """-> the markers' names: one in every three cells or, where they stand closer, one in each."""
    spread = cells[::3]
    if any(cell for i, cell in enumerate(cells) if i % 3):
        spread = cells
    while spread and not spread[-1]:
        spread = spread[:-1]
    return spread


def _markers_said(facts: dict[str, str], named: int, points: int) -> tuple[str, ...]:
    """-> what must be said of the header's number of markers."""
    said = whole(facts.get("nummarkers", ""))
    if said is None or named <= said <= points:
        return ()
    return (f"The header promises {said} markers and {named} are named.",)
