"""Comparison of a cleaned copy with its input before it is moved into place.

Whatever the code that writes the copy does, a difference that no change of a sample accounts for ends in an error, and nothing is
written. Both files are read again; which samples differ is asked of the takes.
"""

import io
from collections import defaultdict
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import BinaryIO

import numpy as np
from jaxtyping import Bool, Int, Shaped

from mocapfix.errors import REPORT_REQUEST, WriteError
from mocapfix.files.layouts import C3D_BLOCK_BYTES, C3dLayout, TableLayout
from mocapfix.read.c3d_blocks import locate_samples
from mocapfix.read.c3d_parameters import open_c3d_reader, read_c3d_parameters
from mocapfix.read.coordinates import find_valid_points
from mocapfix.take import Take
from mocapfix.write.source_file import find_assigned_points, find_changed_samples, find_relabelled_samples

BLOCK_BYTES = 1 << 23  # of both files that are compared at once
FLOAT_ROUNDING = 2e-7  # relative, of a coordinate that is stored as a float
COUNT_ROUNDING = 0.51  # of a count or of the last decimal
HASH_FACTORS = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9, 0xD6E8FEB86659FD93], np.uint64)
POINT_COUNT_BYTES, DATA_BLOCK_BYTES = range(2, 4), range(16, 18)  # of the header
LABEL_PARAMETERS = ("LABELS", "DESCRIPTIONS")
CELL_PADDING = ' "\r'

Unstorable = Collection[tuple[int, int]]
"""frame and marker of samples that the format of a file cannot store"""


def check_c3d_copy(target: Path, copy: Path, before: Take, after: Take, unstorable: Unstorable) -> None:
    """Compare a patched C3D with the file of `before`.

    Args:
        target: The name that the copy gets, for messages.
        copy: The copy.
        before: The take as it was read.
        after: The cleaned take.
        unstorable: Samples that became missing because the file cannot store them.

    Raises:
        WriteError: If a byte differs that no changed sample accounts for, or a changed sample does not have its new position.
    """
    layout = before.layout
    assert isinstance(layout, C3dLayout)
    samples = _ChangedSamples(before, after, unstorable)
    may_change = np.zeros((layout.frame_count, layout.point_count), bool)
    may_change[samples.frames, before.point_columns[samples.markers]] = True
    assigned_frames, assigned_points = find_assigned_points(before, after)
    may_change[assigned_frames, assigned_points] = True
    refuse = _build_refusal(target)
    with _open_source(before) as old, copy.open("rb") as new:
        if old.read(layout.data_start_byte) != new.read(layout.data_start_byte):
            raise refuse("its header or parameters")
        stride, point_bytes = layout.frame_stride_bytes, 4 * layout.word_size_bytes
        block_length = max(1, BLOCK_BYTES // stride)
        for first in range(0, layout.frame_count, block_length):
            count = min(block_length, layout.frame_count - first)
            rows = [np.frombuffer(file.read(count * stride), np.uint8) for file in (old, new)]
            if rows[0].size != count * stride or rows[1].size != rows[0].size:
                raise refuse("its length")
            before_rows, after_rows = (each.reshape(count, stride) for each in rows)
            analog_start = point_bytes * layout.point_count
            if not np.array_equal(before_rows[:, analog_start:], after_rows[:, analog_start:]):
                raise refuse("its analog values")
            old_words, new_words = (
                np.ascontiguousarray(each[:, :analog_start]).reshape(count, layout.point_count, point_bytes)
                for each in (before_rows, after_rows)
            )
            differs = (old_words != new_words).any(-1) & ~may_change[first : first + count]
            if differs.any():
                frame, point = np.argwhere(differs)[0]
                raise refuse(f"point {point + 1} in frame {before.get_frame_number(int(first + frame))}")
            old_words, new_words = (each.view(layout.word_dtype) for each in (old_words, new_words))
            samples.check_words(layout, first, old_words, new_words, refuse)
            own = (assigned_frames >= first) & (assigned_frames < first + count)
            if not (layout.decode_words(new_words[assigned_frames[own] - first, assigned_points[own], 3]) < 0).all():
                raise refuse("an unlabelled trajectory that was assigned to a marker")
        if old.read() != new.read():
            raise refuse("what follows its data")
    if before.labelled_file is not None and before.path is not None:
        _check_labelled_c3d(refuse, before.path, before.labelled_file, layout)


class _ChangedSamples:
    """The samples of markers that differ between two takes.

    Attributes:
        frames: Index of the frame of each.
        markers: Index of the marker.
        is_relabelled: Whether it comes from another point of the file as it is.
        source_points: The point of the file from which it comes.
    """

    def __init__(self, before: Take, after: Take, unstorable: Unstorable) -> None:
        relabelled = find_relabelled_samples(before, after)
        self.before, self.after = before, after
        self.frames, self.markers = np.nonzero(find_changed_samples(before, after) | relabelled)
        self.is_relabelled = relabelled[self.frames, self.markers]
        self.source_points = after.source_points[self.frames, self.markers]
        is_unstorable = np.zeros(before.visible.shape, bool)
        if unstorable:
            is_unstorable[tuple(np.array(list(unstorable)).T)] = True
        self.is_missing = ~after.visible[self.frames, self.markers] | is_unstorable[self.frames, self.markers]

    def describe(self, index: int) -> str:
        """Return marker and frame of a changed sample."""
        frame = self.before.get_frame_number(int(self.frames[index]))
        return f"the new position of {self.before.labels[self.markers[index]]} in frame {frame}"

    def check_words(
        self,
        layout: C3dLayout,
        first: int,
        old_words: Shaped[np.ndarray, "F P 4"],
        new_words: Shaped[np.ndarray, "F P 4"],
        refuse: Callable[[str], WriteError],
    ) -> None:
        """Raise WriteError unless the changed samples of F frames from `first` on have their new words."""
        start, stop = np.searchsorted(self.frames, (first, first + len(new_words)))
        frames, markers = self.frames[start:stop] - first, self.markers[start:stop]
        words = new_words[frames, self.before.point_columns[markers]]
        values = layout.decode_words(words)
        unit_m = layout.unit_m if layout.is_float else layout.unit_m * layout.scale_factor
        positions = values[:, :3] @ layout.rotation_y_up_file.T * unit_m
        expected = self.after.markers[frames + first, markers]
        rounding = np.abs(expected) * FLOAT_ROUNDING if layout.is_float else COUNT_ROUNDING * unit_m
        is_equal = (np.abs(positions - expected) <= rounding + np.finfo(np.float32).tiny).all(-1) & (values[:, 3] >= 0)
        is_right = np.where(self.is_missing[start:stop], values[:, 3] < 0, is_equal)
        moved = np.flatnonzero(self.is_relabelled[start:stop])
        sources = old_words[frames[moved], self.source_points[start:stop][moved]]
        is_right[moved] = (np.ascontiguousarray(sources).view(np.uint8) == words[moved].view(np.uint8)).all(-1)
        if not is_right.all():
            raise refuse(self.describe(int(start + np.argmin(is_right))))


def check_table_copy(target: Path, copy: Path, before: Take, after: Take, unstorable: Unstorable) -> None:
    """Compare a patched text table with the file of `before`, cell by cell. Arguments and errors as in `check_c3d_copy`."""
    layout, samples, refuse = before.layout, _ChangedSamples(before, after, unstorable), _build_refusal(target)
    assert isinstance(layout, TableLayout)
    with _open_source(before) as source:
        old, new = (_split_lines(layout, data) for data in (source.read(), copy.read_bytes()))
    if len(old) != len(new):
        raise refuse("its number of lines")
    columns = before.point_columns[samples.markers]
    assigned_frames, assigned_points = find_assigned_points(before, after)
    frames, points = np.concatenate([samples.frames, assigned_frames]), np.concatenate([columns, assigned_points])
    may_change: dict[int, set[int]] = defaultdict(set)
    for line, fields in zip(layout.line_indices[frames].tolist(), layout.field_indices[points].tolist(), strict=True):
        if line >= 0:  # a frame without a line has none in the copy either
            may_change[line].update(fields)
    cells = {index: (_split_cells(layout, old[index]), _split_cells(layout, new[index])) for index in may_change}
    for index, (old_line, new_line) in enumerate(zip(old, new, strict=True)):
        if old_line != new_line:
            is_end_equal = old_line.endswith("\r") == new_line.endswith("\r")
            if index not in cells or not is_end_equal or _find_other_change(*cells[index], may_change[index]):
                raise refuse(f"line {index + 1}")
    is_right = _check_cells(layout, samples, cells)
    if not is_right.all():
        raise refuse(samples.describe(int(np.argmin(is_right))))


def _split_lines(layout: TableLayout, data: bytes) -> list[str]:
    """Return the lines of a table; one whose characters are bytes as Latin-1, which has a character for each."""
    is_wide = layout.encoding.lower().replace("_", "-").startswith(("utf-16", "utf-32"))
    return data.decode(layout.encoding if is_wide else "latin-1").split(layout.newline)


def _split_cells(layout: TableLayout, line: str) -> list[str]:
    return line.removesuffix("\r").split(layout.delimiter)


def _find_other_change(old_cells: list[str], new_cells: list[str], fields: set[int]) -> bool:
    """Return whether two lines differ in a field that is not one of `fields`. A field after the end of a line is empty."""
    length = max(len(old_cells), len(new_cells), max(fields) + 1)
    old_cells, new_cells = ([*each, *[""] * (length - len(each))] for each in (old_cells, new_cells))
    for field in fields:
        old_cells[field] = new_cells[field]
    return old_cells != new_cells


def _check_cells(
    layout: TableLayout, samples: _ChangedSamples, cells: Mapping[int, tuple[list[str], list[str]]]
) -> Bool[np.ndarray, " n"]:
    """Return which changed samples have their new texts; `cells` are the old and new ones of their lines."""
    expected = (samples.after.markers[samples.frames, samples.markers] @ layout.rotation_y_up_file / layout.unit_m).tolist()
    rounding = COUNT_ROUNDING * 10.0 ** -int(layout.number_format[1:-1] or 0)
    has_exponents = layout.number_format.endswith("e")  # its last decimal is then relative
    fields = layout.field_indices[samples.before.point_columns[samples.markers]].tolist()
    missing = [layout.missing_text.strip(CELL_PADDING)] * 3
    is_right = np.ones(len(samples.frames), bool)
    for k, line in enumerate(layout.line_indices[samples.frames].tolist()):
        if line < 0:
            continue
        old_cells, new_cells = cells[line]
        texts = [new_cells[field].strip(CELL_PADDING) for field in fields[k]]
        if samples.is_relabelled[k]:
            sources = layout.field_indices[samples.source_points[k]]
            is_right[k] = texts == [old_cells[field].strip(CELL_PADDING) for field in sources]
        elif samples.is_missing[k]:
            is_right[k] = texts == missing
        else:
            is_right[k] = all(
                _is_number(text, layout.decimal_sign, value, rounding * (abs(value) if has_exponents else 1.0))
                for text, value in zip(texts, expected[k], strict=True)
            )
    return is_right


def _is_number(text: str, decimal_sign: str, value: float, rounding: float) -> bool:
    """Return whether a text is a number but for rounding."""
    try:
        return abs(float(text.replace(decimal_sign, ".")) - value) <= rounding + abs(value) * FLOAT_ROUNDING
    except ValueError:
        return False


def check_copy_with_events(target: Path, copy: Path, data: bytes, data_start_byte: int, group: str) -> None:
    """Compare a C3D to which events were added with what it was.

    Args:
        target: The name that the copy gets, for messages.
        copy: The copy.
        data: The bytes of the file without these events.
        data_start_byte: Where its data begin.
        group: The group of the events.

    Raises:
        WriteError: If anything but the group, POINT:DATA_START and the header's first block differs.
    """
    refuse, new = _build_refusal(target), copy.read_bytes()
    try:
        new_start = C3D_BLOCK_BYTES * (read_c3d_parameters(new).header_data_block - 1)
    except ValueError as error:
        raise refuse("its header") from error
    _check_head(refuse, data, new, DATA_BLOCK_BYTES, lambda name: name.startswith(f"{group}:") or name == "POINT:DATA_START")
    if memoryview(data)[data_start_byte:] != memoryview(new)[new_start:]:
        raise refuse("its data")


def _check_labelled_c3d(refuse: Callable[[str], WriteError], path: Path, labelled: bytes, layout: C3dLayout) -> None:
    """Raise WriteError if a file with labels has other samples, analog values or parameters than the file at `path`."""
    data = path.read_bytes()
    original = locate_samples(path, parameters := read_c3d_parameters(data), data)[0].build_layout(parameters.processor_type)
    _check_head(refuse, data, labelled, (*POINT_COUNT_BYTES, *DATA_BLOCK_BYTES), _is_point_parameter)
    if original.frame_count != layout.frame_count or original.word_dtype != layout.word_dtype:
        raise refuse("its frames")
    old_analog, new_analog = (each.view_analog_words(file) for each, file in ((original, data), (layout, labelled)))
    bits = f"u{layout.word_size_bytes}"
    if not np.array_equal(old_analog.view(bits), new_analog.view(bits)):
        raise refuse("its analog values")
    if not np.array_equal(_sum_samples(original, data), _sum_samples(layout, labelled)):
        raise refuse("the samples of its points")


def _is_point_parameter(name: str) -> bool:
    group, _, parameter = name.partition(":")
    return group == "POINT" and (parameter.rstrip("0123456789") in LABEL_PARAMETERS or parameter in ("USED", "DATA_START"))


def _sum_samples(layout: C3dLayout, data: bytes) -> Int[np.ndarray, " T"]:
    """Return a number of each frame that depends on its valid samples and not on their order."""
    words, sums = layout.view_words(data), np.zeros(layout.frame_count, np.uint64)
    length = max(1, BLOCK_BYTES // layout.frame_stride_bytes)
    for first in range(0, layout.frame_count, length):
        own = np.ascontiguousarray(words[first : first + length])
        values = layout.decode_words(own)
        is_valid = find_valid_points(values[..., :3]) & ~(values[..., 3] < 0)
        hashes = (own.view(f"u{layout.word_size_bytes}").astype(np.uint64) * HASH_FACTORS).sum(-1, dtype=np.uint64)
        hashes ^= hashes >> np.uint64(29)
        sums[first : first + length] = np.where(is_valid, hashes * HASH_FACTORS[0], np.uint64(0)).sum(-1, dtype=np.uint64)
    return sums


def _check_head(
    refuse: Callable[[str], WriteError], old: bytes, new: bytes, header_bytes: Collection[int], may_change: Callable[[str], bool]
) -> None:
    """Raise WriteError if headers differ but in some bytes, or parameters but those for which `may_change` is true."""
    for index in range(C3D_BLOCK_BYTES):
        if old[index] != new[index] and index not in header_bytes:
            raise refuse(f"byte {index + 1} of its header")
    old_parameters, new_parameters = _list_parameters(old), _list_parameters(new)
    for name in {**old_parameters, **new_parameters}:
        if old_parameters.get(name) != new_parameters.get(name) and not may_change(name):
            raise refuse(f"its parameter {name}")


def _list_parameters(data: bytes) -> Mapping[str, tuple[object, ...]]:
    """Return type, dimensions and bytes of each parameter."""
    return {
        f"{group_name}:{name}": (each.bytes_per_element, tuple(each.dimensions), bytes(each.bytes)[: each.total_bytes])
        for group_name, group in open_c3d_reader(data).group_items()
        for name, each in group.param_items()
    }


def _open_source(take: Take) -> BinaryIO:
    """Return the file of a take, with the labels that mocapfix gave it."""
    assert take.path is not None
    return take.path.open("rb") if take.labelled_file is None else io.BytesIO(take.labelled_file)


def _build_refusal(target: Path) -> Callable[[str], WriteError]:
    """Return a function that builds the error about a difference."""
    return lambda what: WriteError(
        f"{target}: {what} would differ from the input without a change that accounts for it, so nothing was written; "
        f"{REPORT_REQUEST}."
    )
