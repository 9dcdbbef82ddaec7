"""Reading OptiTrack Motive's CSV, format versions 1.2 and later: a column for each of a marker's coordinates.

The first line holds facts as key, value, key, value; rows of types, names and IDs stand over the columns (OptiTrack's
documentation, "Data Export: CSV"). Only positions of markers are taken: rigid bodies, bones, their rotations of whichever
type, qualities and errors are other columns and stay as they are.
"""

from pathlib import Path

import numpy as np

from mocapfix.read.cells import filled_rows, rate_of, unit_said
from mocapfix.read.labels import is_nameless
from mocapfix.read.table import Sheet, names_line, take_of, triples
from mocapfix.read.text import Document, delimiter, document
from mocapfix.take import Take

MEASURED = "marker"
EXPECTED_ONLY = "The file holds no measured markers, only the places that its bodies expect them at; export Markers as well."


def recognises(head: bytes) -> bool:
    """-> does a file that begins so claim to be one?"""
    return head[:20].lower().replace(b'"', b"").startswith(b"format version")


def take(path: Path, data: bytes) -> Take:
    """-> the take in the file's bytes. Where the measured markers were not exported, those that bodies expect are taken.

    Raises ReadError, naming file and line, where there are no markers or their coordinates are a body's own.
    """
    text = document(path, data)
    between = delimiter(text.line(0)) or ","
    facts = _facts(text.cells(0, between))
    if facts.get("coordinate space", "").lower() == "local":
        raise text.fault(0, "the coordinates are local to their bodies; export it with Coordinate Space Global.")
    axes = names_line(text, "columns")
    fields, labels, said = _markers(text, axes, between)
    rows = list(filled_rows(text, axes + 1, between))
    unit, assumed = unit_said(text, 0, facts.get("length units", ""), "m")
    rate = facts.get("export frame rate") or facts.get("capture frame rate", "")
    return take_of(
        Sheet(
            document=text,
            delimiter=between,
            rows=rows,
            frame=0,
            fields=fields,
            labels=labels,
            unit=unit,
            rate=rate_of(text, 0, rate, rows, between, time=1),
            usual="Y",
            promised=facts.get("total exported frames", ""),
            notes=(*said, *assumed),
        )
    )


def _facts(cells: list[str]) -> dict[str, str]:
    return {key.lower(): value for key, value in zip(cells[::2], cells[1::2], strict=False)}


def _markers(text: Document, axes: int, between: str) -> tuple[np.ndarray, list[str], tuple[str, ...]]:
    """-> the (P, 3) fields of the markers, their labels, and what must be said of them."""
    head = [text.cells(i, between) for i in range(1, axes) if text.line(i).strip(between + " ")]
    if len(head) < 2:
        raise text.fault(axes, "no rows with the columns' types and names stand above; export it with its header.")
    letters = text.cells(axes, between)
    types, names = ([*row, *[""] * (len(letters) - len(row))] for row in head[:2])
    found = [(i, types[i].lower(), names[i]) for i in triples(letters)]
    measured = [each for each in found if each[1] == MEASURED]
    expected = [each for each in found if each[1].endswith(" marker")]
    if not measured and not expected:
        kinds = sorted({name.lower() for name in types[2:] if name}) or ["nothing"]
        raise text.fault(axes, f"the columns hold {', '.join(kinds)} and no markers; export it with Markers.")
    said = ()
    if expected and all(is_nameless(name) for _, _, name in measured):
        measured, said = expected + measured, (EXPECTED_ONLY,)
    first = np.array([i for i, _, _ in measured])
    return first[:, None] + np.arange(3), [name for _, _, name in measured], said
