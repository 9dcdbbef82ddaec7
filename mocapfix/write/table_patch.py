"""Writing a mended text file: the original's characters, with only the changed samples' fields replaced."""

from collections import defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from mocapfix.errors import WriteError
from mocapfix.files.layouts import TableLayout
from mocapfix.files.output_files import replace_atomically
from mocapfix.take import Take
from mocapfix.write.source_file import (
    MAX_STORED_COORDINATE,
    build_truncated_error,
    find_assigned_points,
    find_changed_samples,
    find_relabelled_samples,
    read_source_bytes,
)

FIELD_PADDING = ' "'  # a field's text
LineEdits = dict[int, dict[int, str]]  # by a line's index, then by a field's: what is to stand there


def patch_table(target: str | Path, before: Take, after: Take) -> list[tuple[int, int]]:
    """Write `before`'s text file to `target` with the markers of `after`; -> (frame, marker) indices that could not be stored.

    A sample that came from another label, or from an unlabelled trajectory, brings that one's text with it. Any other that
    differs is written with the file's own decimals, and as the file spells missing ones where it is gone (or where it would
    read as missing, as all zeros do). Every other character stays as it is, with the file's encoding and line ends.

    Raises WriteError where `target` is the input itself, where `before` was not read from a text file that has a place for
    every sample and is still there, or where `target` cannot be written.
    """
    layout = before.layout
    if not isinstance(layout, TableLayout) or not layout.has_field_per_sample:
        raise WriteError(f"{before.name}: has no place for every sample, so the mended markers cannot be written into a copy.")
    lines = bytes(read_source_bytes(Path(target), before.path)).decode(layout.encoding, "replace").split(layout.newline)
    if len(lines) <= layout.line_indices.max():
        raise build_truncated_error(before.path)
    edits, lost = _build_edits(layout, lines, before, after)
    for index, fields in edits.items():
        lines[index] = _replace_fields(lines[index], layout.delimiter, fields)
    with replace_atomically(Path(target)) as part:
        part.write_bytes(layout.newline.join(lines).encode(layout.encoding))
    return lost


def _build_edits(layout: TableLayout, lines: list[str], before: Take, after: Take) -> tuple[LineEdits, list[tuple[int, int]]]:
    """-> what is to be replaced, and the (frame, marker) indices of what cannot be stored."""
    edits: LineEdits = defaultdict(dict)
    at, fields = layout.line_indices.tolist(), layout.field_indices.tolist()

    def put(frames: np.ndarray, points: np.ndarray, texts: Iterable[list[str]]) -> None:
        for frame, point, three in zip(frames.tolist(), points.tolist(), texts, strict=True):
            edits[at[frame]].update(zip(fields[point], three, strict=True))

    missing = [layout.format_coordinate(np.nan)] * 3
    frames, points = find_assigned_points(before, after)
    put(frames, points, [missing] * len(frames))
    came = find_relabelled_samples(before, after)
    frames, markers = np.nonzero(find_changed_samples(before, after) & ~came)
    xyz = after.markers[frames, markers] @ layout.rotation_y_up_file / layout.unit_m
    texts = [[layout.format_coordinate(each) for each in three] for three in xyz.tolist()]
    lost = after.visible[frames, markers] & ~_is_storable(layout, xyz)
    put(frames, before.point_columns[markers], [missing if gone else three for gone, three in zip(lost, texts, strict=True)])
    to, markers_to = np.nonzero(came)
    put(to, before.point_columns[markers_to], _read_field_texts(layout, lines, to, after.source_points[came]))
    return edits, [(int(t), int(m)) for t, m in zip(frames[lost], markers[lost], strict=True)]


def _read_field_texts(layout: TableLayout, lines: list[str], frames: np.ndarray, points: np.ndarray) -> Iterator[list[str]]:
    """-> what the file has for each frame's point."""
    for frame, point in zip(frames, points, strict=True):
        cells = lines[layout.line_indices[frame]].rstrip("\r").split(layout.delimiter)
        yield [_split_padding(cells[field])[1] for field in layout.field_indices[point]]


def _is_storable(layout: TableLayout, xyz: np.ndarray) -> np.ndarray:
    """-> (n,) bool: does a sample (n, 3), as it is written, still say a place when it is read again?"""
    rounded = np.array([[float(format(each, layout.number_format)) for each in three] for three in xyz.tolist()]).reshape(-1, 3)
    return (rounded != 0).any(-1) & (np.abs(rounded) <= MAX_STORED_COORDINATE).all(-1)


def _replace_fields(line: str, delimiter: str, fields: dict[int, str]) -> str:
    """-> the line with other texts in some fields, which it is made longer for where it ends before them."""
    end = "\r" if line.endswith("\r") else ""
    cells = line.removesuffix("\r").split(delimiter)
    cells += [""] * (max(fields) + 1 - len(cells))
    for field, text in fields.items():
        before, _, after = _split_padding(cells[field])
        cells[field] = before + text + after
    return delimiter.join(cells) + end


def _split_padding(cell: str) -> tuple[str, str, str]:
    """-> a field's text between the blanks and quotes before it and behind it."""
    text = cell.strip(FIELD_PADDING)
    before, _, after = cell.partition(text) if text else (cell, "", "")
    return before, text, after
