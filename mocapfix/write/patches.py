"""Changed copies of source files: the bytes of the original with only the changed values replaced.

The files are animations (BVH, AMC), C3D files, and text tables, of which only the fields of the changed samples are replaced.
"""

from collections import defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from mocapfix.animation import Animation
from mocapfix.errors import WriteError
from mocapfix.files.layouts import MAX_RESIDUAL_COUNTS, C3dLayout, TableLayout
from mocapfix.files.output_files import replace_atomically
from mocapfix.kernels.text_numbers import INTEGER_PART_BYTES, MAX_EXACT_PRODUCT, count_decimals, splice_numbers
from mocapfix.read.file_content import convert_to_utf_8, has_decimal_commas, restore_encoding
from mocapfix.take import Take
from mocapfix.write.source_file import (
    MAX_STORED_COORDINATE,
    build_truncated_error,
    find_assigned_points,
    find_changed_samples,
    find_relabelled_samples,
    read_source_bytes,
    read_take_bytes,
)
from mocapfix.write.text_tables import MAX_WRITTEN_DECIMALS
from mocapfix.write.verify_output import check_c3d_copy, check_table_copy

DEFAULT_DECIMALS = 6  # of a number in a file that has no number with decimals


def patch_animation(target: str | Path, source: Animation, values: Float[np.ndarray, "T C"]) -> None:
    """Write the file of `source` to `target` with the numbers that differ in `values`.

    All other bytes are unchanged: hierarchy, names, order of channels, line ends and the spelling of other numbers. New numbers
    have as many decimals as most numbers of the file that have any. A frame time that is not that of the rate is corrected.

    Args:
        target: The copy.
        source: The animation as it was read.
        values: Values of all channels, as in `Animation.values`.

    Raises:
        WriteError: If `target` is the input or is not writable, the input has changed since it was read, or a changed number
            is not finite.
    """
    target = Path(target)
    if (starts := source.value_byte_offsets) is None:
        raise WriteError(f"{source.name}: there is no file with these numbers, so it cannot be patched.")
    original = bytes(read_source_bytes(target, source.path))
    data, first_byte = convert_to_utf_8(target, original), int(starts[starts >= 0].min(initial=len(original)))
    if len(data) <= starts.max(initial=-1):
        raise build_truncated_error(source.path)
    has_commas = has_decimal_commas(data, first_byte)
    if has_commas:
        data = data[:first_byte] + data[first_byte:].replace(b",", b".")
    is_changed = ~((values == source.values) | (np.isnan(values) & np.isnan(source.values))) & (starts >= 0)
    offsets, numbers = starts[is_changed], _convert_to_file_units(source, values)[is_changed]
    order = np.argsort(offsets)
    text = np.frombuffer(data, np.uint8)
    counts = np.bincount(count_decimals(text, starts[starts >= 0]))
    decimals = min(int(counts[1:].argmax()) + 1, MAX_WRITTEN_DECIMALS) if counts[1:].any() else DEFAULT_DECIMALS
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


def _convert_to_file_units(source: Animation, values: Float[np.ndarray, "T C"]) -> Float[np.ndarray, "T C"]:
    """Return values with angles in radians if the file uses radians."""
    if not source.uses_radians:
        return values
    columns = np.concatenate([source.get_rotation_channels(joint)[0] for joint in range(len(source.names))])
    converted = values.copy()
    converted[:, columns] = np.radians(values[:, columns])
    return converted


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
    layout = before.layout
    if not isinstance(layout, C3dLayout):
        raise WriteError(f"{before.name}: was not read from a C3D file, so there is no file to patch.")
    stop_byte = layout.data_start_byte + layout.frame_count * layout.frame_stride_bytes
    data = read_take_bytes(Path(target), before, stop_byte)
    words, relabelled = layout.view_words(data), find_relabelled_samples(before, after)
    frames, markers = np.nonzero(find_changed_samples(before, after) & ~relabelled)
    samples, is_stored = _build_samples(layout, after, frames, markers)
    relabelled_frames, relabelled_markers = np.nonzero(relabelled)
    relabelled_words = words[relabelled_frames, after.source_points[relabelled]]  # a copy, made before any word is replaced
    words[frames, before.point_columns[markers]] = _encode_samples(layout, samples)
    words[relabelled_frames, before.point_columns[relabelled_markers]] = relabelled_words
    assigned = find_assigned_points(before, after)
    words[assigned] = _encode_samples(layout, np.tile(MISSING_SAMPLE, (len(assigned[0]), 1)))
    is_lost = ~is_stored & ~np.isnan(after.markers[frames, markers]).any(-1)
    lost = [(int(t), int(m)) for t, m in zip(frames[is_lost], markers[is_lost], strict=True)]
    with replace_atomically(Path(target)) as part:
        part.write_bytes(data)
        check_c3d_copy(Path(target), part, before, after, lost)
    return lost


def _build_samples(
    layout: C3dLayout, after: Take, frames: Int[np.ndarray, " n"], markers: Int[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "n 4"], Bool[np.ndarray, " n"]]:
    """Return coordinates and residual to store, and whether the position can be stored."""
    xyz = after.markers[frames, markers] @ layout.rotation_y_up_file / layout.unit_m
    counts = xyz.astype(np.float32) if layout.is_float else np.rint(xyz / layout.scale_factor)
    largest = MAX_STORED_COORDINATE if layout.is_float else MAX_INT16_COUNT
    # A sample with all coordinates 0 would read as missing.
    is_stored = np.all(np.abs(counts) <= largest, axis=-1) & np.any(counts != 0, axis=-1)
    sample_sd = np.full(len(frames), np.nan) if after.sample_sd is None else after.sample_sd[frames, markers]
    residual = np.nan_to_num(np.rint(sample_sd / layout.unit_m / layout.scale_factor), nan=1.0)
    samples = np.c_[counts, np.clip(residual, 1, MAX_RESIDUAL_COUNTS)]
    samples[~is_stored] = MISSING_SAMPLE
    return samples, is_stored


def encode_missing_sample(layout: C3dLayout) -> Shaped[np.ndarray, "4"]:
    """Return the words of a missing sample as the file stores them."""
    return _encode_samples(layout, np.array([MISSING_SAMPLE]))[0]


def _encode_samples(layout: C3dLayout, samples: Float[np.ndarray, "n 4"]) -> Shaped[np.ndarray, "n 4"]:
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
    layout = before.layout
    if not isinstance(layout, TableLayout) or not layout.has_field_per_sample:
        raise WriteError(f"{before.name}: does not have a field for every sample, so it cannot be patched.")
    lines = bytes(read_take_bytes(Path(target), before)).decode(layout.encoding, "replace").split(layout.newline)
    if len(lines) <= layout.line_indices.max():
        raise build_truncated_error(before.path)
    edits, lost = _build_edits(layout, lines, before, after)
    for index, fields in edits.items():
        lines[index] = _replace_fields(lines[index], layout.delimiter, fields)
    with replace_atomically(Path(target)) as part:
        part.write_bytes(layout.newline.join(lines).encode(layout.encoding))
        check_table_copy(Path(target), part, before, after, lost)
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
