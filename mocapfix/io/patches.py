"""Changed copies of source files: the bytes of the original with only the changed values replaced.

The files are animations (BVH, AMC), C3D files, and text tables, of which only the fields of the changed samples are replaced. A
copy is compared with its input before it is moved into place: whatever the code that writes it does, a difference that no change
of a sample accounts for ends in an error, and nothing is written. Both files are read again; which samples differ is asked of the
takes.
"""

from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from mocapfix.errors import REPORT_REQUEST, WriteError
from mocapfix.io import source_file
from mocapfix.io.c3d_blocks import locate_samples
from mocapfix.io.c3d_parameters import C3dHead, read_c3d_parameters
from mocapfix.io.coordinates import find_valid_points
from mocapfix.io.file_content import convert_to_utf_8, has_decimal_commas, restore_encoding
from mocapfix.io.files import replace_atomically
from mocapfix.kernels.text_numbers import INTEGER_PART_BYTES, MAX_EXACT_PRODUCT, count_decimals, splice_numbers
from mocapfix.model.animation import Animation
from mocapfix.model.take import C3D_BLOCK_BYTES, MAX_RESIDUAL_COUNTS, C3dLayout, TableLayout, Take
from mocapfix.model.windows import iterate_blocks

BLOCK_BYTES = 1 << 23  # of both files that are compared at once
FLOAT_ROUNDING = 2e-7  # relative, of a coordinate that is stored as a float
COUNT_ROUNDING = 0.51  # of a count or of the last decimal
HASH_FACTORS = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9, 0xD6E8FEB86659FD93], np.uint64)
POINT_COUNT_BYTES, DATA_BLOCK_BYTES = range(2, 4), range(16, 18)  # of the header
LABEL_PARAMETERS = ("LABELS", "DESCRIPTIONS")
WRITTEN_CELL_PADDING = ' "\r'

Unstorable = Collection[tuple[int, int]]  # frame and marker of samples that the format of a file cannot store


def check_c3d_copy(target: Path, copy: Path, before: Take, after: Take, unstorable: Unstorable) -> None:
    """Compare a patched C3D with the file of `before`.

    Args:
        target: The name that the copy gets, for messages.
        before: The take as it was read.
        unstorable: Samples that became missing because the file cannot store them.

    Raises:
        WriteError: If a byte differs that no changed sample accounts for, or a changed sample does not have its new position.
    """
    layout = before.layout
    assert isinstance(layout, C3dLayout)
    refuse, bits = _build_refusal(target), f"u{layout.word_size_bytes}"
    with source_file.open_source(target, before.path, before.labelled_file) as old, copy.open("rb") as new:
        if old.read(layout.data_start_byte) != new.read(layout.data_start_byte):
            raise refuse("its header or parameters")
        for first, part, own_before, own_after in _iterate_blocks(layout, before, after):
            samples = _ChangedSamples(own_before, own_after, [(t - first, m) for t, m in unstorable])
            size = part.frame_count * part.frame_stride_bytes
            old_bytes, new_bytes = (file.read(size) for file in (old, new))
            if len(old_bytes) != size or len(new_bytes) != size:
                raise refuse("its length")
            old_analog, new_analog = (part.view_analog_words(each).view(bits) for each in (old_bytes, new_bytes))
            if not np.array_equal(old_analog, new_analog):
                raise refuse("its analog values")
            old_words, new_words = (part.view_words(each) for each in (old_bytes, new_bytes))
            differs = np.zeros((part.frame_count, part.point_count), bool)
            for word in range(4):
                differs |= old_words[..., word].view(bits) != new_words[..., word].view(bits)
            differs[samples.frames, before.point_columns[samples.markers]] = False
            assigned = source_file.find_assigned_points(own_before, own_after)
            differs[assigned] = False
            if differs.any():
                frame, point = np.argwhere(differs)[0]
                raise refuse(f"point {point + 1} in frame {before.get_frame_number(int(first + frame))}")
            samples.check_words(part, old_words, new_words, refuse)
            if not (part.decode_words(new_words[assigned][:, 3]) < 0).all():
                raise refuse("an unlabelled trajectory that was assigned to a marker")
        if old.read() != new.read():
            raise refuse("what follows its data")
    if before.labelled_file is not None and before.path is not None:
        _check_labelled_c3d(refuse, before.path, before.labelled_file, layout)


def _iterate_blocks(layout: C3dLayout, before: Take, after: Take) -> Iterator[tuple[int, C3dLayout, Take, Take]]:
    """Yield the first index of frames with about BLOCK_BYTES, the layout of these bytes, and the takes in these frames."""
    length = max(1, BLOCK_BYTES // layout.frame_stride_bytes)
    pairs = zip(*(iterate_blocks(take, take.frame_count, length) for take in (before, after)), strict=True)
    for (frames, one), (_, other) in pairs:
        takes = (replace(take, first_frame=before.first_frame + frames.start) for take in (one, other))
        yield frames.start, replace(layout, data_start_byte=0, frame_count=frames.stop - frames.start), *takes


class _ChangedSamples:
    """The samples of markers that differ between two takes.

    Attributes:
        frames: Index of the frame of each.
        markers: Index of the marker.
        is_relabelled: Whether it comes from another point of the file as it is.
        source_points: The point of the file from which it comes.
    """

    def __init__(self, before: Take, after: Take, unstorable: Unstorable) -> None:
        relabelled = source_file.find_relabelled_samples(before, after)
        self.before, self.after = before, after
        self.frames, self.markers = np.nonzero(source_file.find_changed_samples(before, after) | relabelled)
        self.is_relabelled = relabelled[self.frames, self.markers]
        self.source_points = after.source_points[self.frames, self.markers]
        lost = np.array(list(unstorable), int).reshape(-1, 2)
        is_stored = after.visible.copy()
        is_stored[tuple(lost[(lost[:, 0] >= 0) & (lost[:, 0] < after.frame_count)].T)] = False
        self.is_missing = ~is_stored[self.frames, self.markers]

    def describe(self, index: int) -> str:
        """Return marker and frame of a changed sample."""
        frame = self.before.get_frame_number(int(self.frames[index]))
        return f"the new position of {self.before.labels[self.markers[index]]} in frame {frame}"

    def check_words(
        self,
        layout: C3dLayout,
        old_words: Shaped[np.ndarray, "T P 4"],
        new_words: Shaped[np.ndarray, "T P 4"],
        refuse: Callable[[str], WriteError],
    ) -> None:
        """Raise WriteError unless the changed samples have their new words."""
        words = new_words[self.frames, self.before.point_columns[self.markers]]
        values = layout.decode_words(words)
        unit_m = layout.unit_m if layout.is_float else layout.unit_m * layout.scale_factor
        positions = values[:, :3] @ layout.rotation_y_up_file.T * unit_m
        expected = self.after.markers[self.frames, self.markers]
        rounding = np.abs(expected) * FLOAT_ROUNDING if layout.is_float else COUNT_ROUNDING * unit_m
        is_equal = (np.abs(positions - expected) <= rounding + np.finfo(np.float32).tiny).all(-1) & (values[:, 3] >= 0)
        is_right = np.where(self.is_missing, values[:, 3] < 0, is_equal)
        moved = np.flatnonzero(self.is_relabelled)
        sources = old_words[self.frames[moved], self.source_points[moved]]
        is_right[moved] = (np.ascontiguousarray(sources).view(np.uint8) == words[moved].view(np.uint8)).all(-1)
        if not is_right.all():
            raise refuse(self.describe(int(np.argmin(is_right))))


def check_table_copy(target: Path, copy: Path, before: Take, after: Take, unstorable: Unstorable) -> None:
    """Compare a patched text table with the file of `before`, cell by cell. Arguments and errors as in `check_c3d_copy`."""
    layout, samples, refuse = before.layout, _ChangedSamples(before, after, unstorable), _build_refusal(target)
    assert isinstance(layout, TableLayout)
    with source_file.open_source(target, before.path, before.labelled_file) as source:
        # Bytes as characters are Latin-1, which has a character for each.
        is_wide = layout.encoding.lower().replace("_", "-").startswith(("utf-16", "utf-32"))
        texts = (data.decode(layout.encoding if is_wide else "latin-1") for data in (source.read(), copy.read_bytes()))
        old, new = (text.split(layout.newline) for text in texts)
    if len(old) != len(new):
        raise refuse("its number of lines")
    columns = before.point_columns[samples.markers]
    assigned_frames, assigned_points = source_file.find_assigned_points(before, after)
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
    missing = [layout.missing_text.strip(WRITTEN_CELL_PADDING)] * 3
    is_right = np.ones(len(samples.frames), bool)
    for k, line in enumerate(layout.line_indices[samples.frames].tolist()):
        if line < 0:
            continue
        old_cells, new_cells = cells[line]
        texts = [new_cells[field].strip(WRITTEN_CELL_PADDING) for field in fields[k]]
        if samples.is_relabelled[k]:
            sources = layout.field_indices[samples.source_points[k]]
            is_right[k] = texts == [old_cells[field].strip(WRITTEN_CELL_PADDING) for field in sources]
        elif samples.is_missing[k]:
            is_right[k] = texts == missing
        else:
            is_right[k] = all(
                _is_number(text, layout.decimal_sign, value, rounding * (abs(value) if has_exponents else 1.0))
                for text, value in zip(texts, expected[k], strict=True)
            )
    return is_right


def _is_number(text: str, decimal_sign: str, value: float, rounding: float) -> bool:
    try:
        return abs(float(text.replace(decimal_sign, ".")) - value) <= rounding + abs(value) * FLOAT_ROUNDING
    except ValueError:
        return False


def check_copy_with_events(target: Path, copy: Path, data: bytes, data_start_byte: int, group: str) -> None:
    """Compare a C3D to which events were added with what it was.

    Args:
        target: The name that the copy gets, for messages.
        data: The bytes of the file without these events.
        data_start_byte: Where its data begin.

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
    old_parameters, new_parameters = C3dHead(old).parameters, C3dHead(new).parameters
    for name in {**old_parameters, **new_parameters}:
        if old_parameters.get(name) != new_parameters.get(name) and not may_change(name):
            raise refuse(f"its parameter {name}")


def _build_refusal(target: Path) -> Callable[[str], WriteError]:
    """Return a function that builds the error about a difference."""
    return lambda what: WriteError(
        f"{target}: {what} would differ from the input without a change that accounts for it, so nothing was written; "
        f"{REPORT_REQUEST}."
    )


DEFAULT_DECIMALS = 6  # of a number in a file that has no number with decimals


def patch_animation(target: str | Path, source: Animation, values: Float[np.ndarray, "T C"]) -> None:
    """Write the file of `source` to `target` with the numbers that differ in `values`.

    All other bytes are unchanged: hierarchy, names, order of channels, line ends and the spelling of other numbers. New numbers
    have as many decimals as most numbers of the file that have any. A frame time that is not that of the rate is corrected.

    Args:
        source: The animation as it was read.
        values: Values of all channels, as in `Animation.values`.

    Raises:
        WriteError: If `target` is the input or is not writable, the input has changed since it was read, or a changed number
            is not finite.
    """
    target = Path(target)
    if (starts := source.value_byte_offsets) is None:
        raise WriteError(f"{source.name}: there is no file with these numbers, so it cannot be patched.")
    with source_file.open_source(target, source.path) as file:
        original = file.read()
    data, first_byte = convert_to_utf_8(target, original), int(starts[starts >= 0].min(initial=len(original)))
    if len(data) <= starts.max(initial=-1):
        raise source_file.build_truncated_error(source.path)
    has_commas = has_decimal_commas(data, first_byte)
    if has_commas:
        data = data[:first_byte] + data[first_byte:].replace(b",", b".")
    is_changed = ~((values == source.values) | (np.isnan(values) & np.isnan(source.values))) & (starts >= 0)
    if source.uses_radians:
        columns = np.concatenate([source.get_rotation_channels(joint)[0] for joint in range(len(source.names))])
        values = values.copy()
        values[:, columns] = np.radians(values[:, columns])
    offsets, numbers = starts[is_changed], values[is_changed]
    order = np.argsort(offsets)
    text = np.frombuffer(data, np.uint8)
    counts = np.bincount(count_decimals(text, starts[starts >= 0]))
    decimals = min(int(counts[1:].argmax()) + 1, source_file.MAX_WRITTEN_DECIMALS) if counts[1:].any() else DEFAULT_DECIMALS
    power = 10.0**decimals
    if not (np.abs(numbers) * power < MAX_EXACT_PRODUCT).all():
        frame, column = np.argwhere(is_changed & ~(np.abs(values) * power < MAX_EXACT_PRODUCT))[0]
        joint = next(name for name, own in zip(source.names, source.joint_columns, strict=True) if column in own)
        problem = f"in frame {source.first_frame + frame} a value of {joint} is {values[frame, column]}"
        raise WriteError(f"{target}: {problem}, which a file cannot hold.")
    out = np.empty(len(text) + len(offsets) * (INTEGER_PART_BYTES + decimals), np.uint8)
    size = splice_numbers(text, offsets[order], numbers[order], decimals, power, out)
    patched = out[:size].tobytes()
    if has_commas:
        patched = patched[:first_byte] + patched[first_byte:].replace(b".", b",")
    if source.wrong_rate_bytes is not None:
        start, stop = source.wrong_rate_bytes
        frame_time = f"{1 / source.rate:.10f}".replace(".", "," if has_commas else ".")
        patched = patched[:start] + frame_time.encode() + patched[stop:]
    with replace_atomically(target) as part:
        part.write_bytes(restore_encoding(patched, original))


MISSING_SAMPLE = (0.0, 0.0, 0.0, -1.0)  # coordinates and residual word
MAX_INT16_COUNT = 32_767  # largest coordinate in an integer file, in counts


def patch_c3d(target: str | Path, before: Take, after: Take) -> list[tuple[int, int]]:
    """Write the file of `before` to `target` with the markers of `after`.

    A sample that comes from another label, or from an unlabelled point, keeps all of its words, bit for bit. Any other sample
    that differs gets its new coordinates, camera mask 0, and its `sample_sd` as residual, in counts clamped to 1..255 (1 if it
    has none). A missing sample gets coordinates 0 and residual -1, and so does one that an integer file cannot store, because
    files are never rescaled. All other bytes are unchanged (C3D User Guide, "The 3D Data Section"), which is verified.

    Returns:
        Frame and marker index of the samples that could not be stored.

    Raises:
        WriteError: If `target` is the input or is not writable, if `before` was not read from a C3D that still exists, or if
            the copy differs where it must not.
    """
    layout, target = before.layout, Path(target)
    if not isinstance(layout, C3dLayout):
        raise WriteError(f"{before.name}: was not read from a C3D file, so there is no file to patch.")
    lost: list[tuple[int, int]] = []
    with source_file.open_source(target, before.path, before.labelled_file) as old, replace_atomically(target) as part:
        with part.open("wb") as new:
            new.write(old.read(layout.data_start_byte))
            for first, part_layout, old_frames, new_frames in _iterate_blocks(layout, before, after):
                data = bytearray(old.read(part_layout.frame_count * layout.frame_stride_bytes))
                if len(data) < part_layout.frame_count * layout.frame_stride_bytes:
                    raise source_file.build_truncated_error(before.path)
                lost += [(first + t, m) for t, m in _patch_block(part_layout, old_frames, new_frames, data)]
                new.write(data)
            new.write(old.read())
        check_c3d_copy(target, part, before, after, lost)
    return lost


def _patch_block(layout: C3dLayout, before: Take, after: Take, data: bytearray) -> list[tuple[int, int]]:
    """Change the samples in the bytes of some frames. Returns frame, counted from their first, and marker of lost samples."""
    words, relabelled = layout.view_words(data), source_file.find_relabelled_samples(before, after)
    frames, markers = np.nonzero(source_file.find_changed_samples(before, after) & ~relabelled)
    samples, is_stored = _build_samples(layout, after, frames, markers)
    relabelled_frames, relabelled_markers = np.nonzero(relabelled)
    relabelled_words = words[relabelled_frames, after.source_points[relabelled]]  # a copy, made before any word is replaced
    words[frames, before.point_columns[markers]] = encode_samples(layout, samples)
    words[relabelled_frames, before.point_columns[relabelled_markers]] = relabelled_words
    assigned = source_file.find_assigned_points(before, after)
    words[assigned] = encode_samples(layout, np.tile(MISSING_SAMPLE, (len(assigned[0]), 1)))
    is_lost = ~is_stored & ~np.isnan(after.markers[frames, markers]).any(-1)
    return [(int(t), int(m)) for t, m in zip(frames[is_lost], markers[is_lost], strict=True)]


def _build_samples(
    layout: C3dLayout, after: Take, frames: Int[np.ndarray, " n"], markers: Int[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "n 4"], Bool[np.ndarray, " n"]]:
    """Return coordinates and residual to store, and whether the position can be stored."""
    xyz = after.markers[frames, markers] @ layout.rotation_y_up_file / layout.unit_m
    counts = xyz.astype(np.float32) if layout.is_float else np.rint(xyz / layout.scale_factor)
    largest = source_file.MAX_STORED_COORDINATE if layout.is_float else MAX_INT16_COUNT
    # A sample with all coordinates 0 would read as missing.
    is_stored = np.all(np.abs(counts) <= largest, axis=-1) & np.any(counts != 0, axis=-1)
    residual = np.nan_to_num(np.rint(after.estimated_sd[frames, markers] / layout.unit_m / layout.scale_factor), nan=1.0)
    samples = np.c_[counts, np.clip(residual, 1, MAX_RESIDUAL_COUNTS)]
    samples[~is_stored] = MISSING_SAMPLE
    return samples, is_stored


def encode_samples(layout: C3dLayout, samples: Float[np.ndarray, "n 4"]) -> Shaped[np.ndarray, "n 4"]:
    """Return the words of samples as the file stores them."""
    if layout.has_vax_floats:
        bits = (samples * 4).astype("<f4").view("<u4")
        return (bits >> 16) | (bits << 16)
    return samples.astype(layout.word_dtype)


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
    layout, target = before.layout, Path(target)
    if not isinstance(layout, TableLayout) or not layout.has_field_per_sample:
        raise WriteError(f"{before.name}: does not have a field for every sample, so it cannot be patched.")
    with source_file.open_source(target, before.path, before.labelled_file) as file:
        lines = file.read().decode(layout.encoding, "replace").split(layout.newline)
    if len(lines) <= layout.line_indices.max():
        raise source_file.build_truncated_error(before.path)
    edits, lost = _build_edits(layout, lines, before, after)
    for index, fields in edits.items():
        lines[index] = _replace_fields(lines[index], layout.delimiter, fields)
    with replace_atomically(target) as part:
        part.write_bytes(layout.newline.join(lines).encode(layout.encoding))
        check_table_copy(target, part, before, after, lost)
    return lost


def _build_edits(layout: TableLayout, lines: list[str], before: Take, after: Take) -> tuple[LineEdits, list[tuple[int, int]]]:
    """Return the new texts, and frame and marker index of the samples that cannot be stored."""
    edits: LineEdits = defaultdict(dict)
    line_indices, field_indices = layout.line_indices.tolist(), layout.field_indices.tolist()

    def add(frames: Int[np.ndarray, " n"], points: Int[np.ndarray, " n"], texts: Iterable[list[str]]) -> None:
        for frame, point, xyz_texts in zip(frames.tolist(), points.tolist(), texts, strict=True):
            if line_indices[frame] >= 0:
                edits[line_indices[frame]].update(zip(field_indices[point], xyz_texts, strict=True))

    missing = [layout.format_coordinate(np.nan)] * 3
    assigned_frames, assigned_points = source_file.find_assigned_points(before, after)
    add(assigned_frames, assigned_points, [missing] * len(assigned_frames))
    relabelled = source_file.find_relabelled_samples(before, after)
    frames, markers = np.nonzero(source_file.find_changed_samples(before, after) & ~relabelled)
    xyz = after.markers[frames, markers] @ layout.rotation_y_up_file / layout.unit_m
    texts = [[layout.format_coordinate(coordinate) for coordinate in sample] for sample in xyz.tolist()]
    is_lost = after.visible[frames, markers] & ~_is_storable(layout, xyz)
    stored_texts = [missing if lost else sample for lost, sample in zip(is_lost, texts, strict=True)]
    add(frames, before.point_columns[markers], stored_texts)
    relabelled_frames, relabelled_markers = np.nonzero(relabelled)
    source_texts: list[list[str]] = []
    for frame, point in zip(relabelled_frames, after.source_points[relabelled], strict=True):
        cells = lines[layout.line_indices[frame]].rstrip("\r").split(layout.delimiter)
        source_texts.append([_split_padding(cells[field])[1] for field in layout.field_indices[point]])
    add(relabelled_frames, before.point_columns[relabelled_markers], source_texts)
    return edits, [(int(t), int(m)) for t, m in zip(frames[is_lost], markers[is_lost], strict=True)]


def _is_storable(layout: TableLayout, xyz: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Return which coordinates in file units still read as a position after they are rounded."""
    rounded = np.array([[float(format(each, layout.number_format)) for each in sample] for sample in xyz.tolist()])
    rounded = rounded.reshape(-1, 3)
    return (rounded != 0).any(-1) & (np.abs(rounded) <= source_file.MAX_STORED_COORDINATE).all(-1)


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
