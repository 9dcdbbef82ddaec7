"""Write a changed copy of a text table: the text of the original with only the fields of the changed samples replaced."""

from collections import defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

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

FIELD_PADDING = ' "'  # characters around the text of a field
LineEdits = dict[int, dict[int, str]]  # new texts, by line index and then by field index


def patch_table(target: str | Path, before: Take, after: Take) -> list[tuple[int, int]]:
    """Write the text file of `before` to `target` with the markers of `after`.

    A sample that comes from another label, or from an unlabelled trajectory, keeps its text. Any other sample that differs is
    written with the decimals of the file. A missing sample, or one that would read as missing, is written as the file spells
    missing ones. All other characters, the encoding and the line ends are unchanged.

    Returns:
        Frame and marker index of the samples that could not be stored.

    Raises:
        WriteError: If `target` is the input or is not writable, or if `before` was not read from a text file with a field for
            every sample that still exists.
    """
    layout = before.layout
    if not isinstance(layout, TableLayout) or not layout.has_field_per_sample:
        raise WriteError(f"{before.name}: does not have a field for every sample, so it cannot be patched.")
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
    """Return the new texts, and frame and marker index of the samples that cannot be stored."""
    edits: LineEdits = defaultdict(dict)
    line_indices, field_indices = layout.line_indices.tolist(), layout.field_indices.tolist()

    def add(frames: Int[np.ndarray, " n"], points: Int[np.ndarray, " n"], texts: Iterable[list[str]]) -> None:
        for frame, point, xyz_texts in zip(frames.tolist(), points.tolist(), texts, strict=True):
            edits[line_indices[frame]].update(zip(field_indices[point], xyz_texts, strict=True))

    missing = [layout.format_coordinate(np.nan)] * 3
    assigned_frames, assigned_points = find_assigned_points(before, after)
    add(assigned_frames, assigned_points, [missing] * len(assigned_frames))
    relabelled = find_relabelled_samples(before, after)
    frames, markers = np.nonzero(find_changed_samples(before, after) & ~relabelled)
    xyz = after.markers[frames, markers] @ layout.rotation_y_up_file / layout.unit_m
    texts = [[layout.format_coordinate(coordinate) for coordinate in sample] for sample in xyz.tolist()]
    is_lost = after.visible[frames, markers] & ~_is_storable(layout, xyz)
    stored_texts = [missing if lost else sample for lost, sample in zip(is_lost, texts, strict=True)]
    add(frames, before.point_columns[markers], stored_texts)
    relabelled_frames, relabelled_markers = np.nonzero(relabelled)
    source_texts = _read_field_texts(layout, lines, relabelled_frames, after.source_points[relabelled])
    add(relabelled_frames, before.point_columns[relabelled_markers], source_texts)
    return edits, [(int(t), int(m)) for t, m in zip(frames[is_lost], markers[is_lost], strict=True)]


def _read_field_texts(
    layout: TableLayout, lines: list[str], frames: Int[np.ndarray, " n"], points: Int[np.ndarray, " n"]
) -> Iterator[list[str]]:
    """Yield the texts of the coordinates of points in the file."""
    for frame, point in zip(frames, points, strict=True):
        cells = lines[layout.line_indices[frame]].rstrip("\r").split(layout.delimiter)
        yield [_split_padding(cells[field])[1] for field in layout.field_indices[point]]


def _is_storable(layout: TableLayout, xyz: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Return which coordinates in file units still read as a position after they are rounded."""
    rounded = np.array([[float(format(each, layout.number_format)) for each in sample] for sample in xyz.tolist()])
    rounded = rounded.reshape(-1, 3)
    return (rounded != 0).any(-1) & (np.abs(rounded) <= MAX_STORED_COORDINATE).all(-1)


def _replace_fields(line: str, delimiter: str, fields: dict[int, str]) -> str:
    """Return a line with other texts in some fields. Fields after its end are added."""
    end = "\r" if line.endswith("\r") else ""
    cells = line.removesuffix("\r").split(delimiter)
    cells += [""] * (max(fields) + 1 - len(cells))
    for field, text in fields.items():
        before, _, after = _split_padding(cells[field])
        cells[field] = before + text + after
    return delimiter.join(cells) + end


def _split_padding(cell: str) -> tuple[str, str, str]:
    """Return the text of a field, between the blanks and quotes before and after it."""
    text = cell.strip(FIELD_PADDING)
    before, _, after = cell.partition(text) if text else (cell, "", "")
    return before, text, after
