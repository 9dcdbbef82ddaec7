"""Read a C3D file: its point block as one NumPy view, converted to a take in metres with Y up; and write a new one.

A new file has Intel floats, a header, the groups POINT and TRIAL, and the samples (c3d.org, "The C3D file format", sections 2 to
4). The bytes are built here, because the libraries that write C3D lose residual words or long takes.
"""

import struct
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.errors import ReadError, WriteError
from mocapfix.io import points
from mocapfix.io.c3d_blocks import locate_samples
from mocapfix.io.c3d_parameters import (
    FLOAT_TYPE,
    MAGIC_BYTE,
    MAX_PARAMETER_BLOCKS,
    MAX_TEXTS_PER_PARAMETER,
    WORD_TYPE,
    C3dParameters,
    build_group_record,
    build_list_records,
    build_number_record,
    build_text_record,
    join_records,
    read_c3d_parameters,
)
from mocapfix.io.conventions import DeclaredConvention, decide_convention
from mocapfix.io.coordinates import METRES_PER_UNIT, ROTATIONS_TO_Y_UP, find_valid_points, get_metres_per_unit, inspect_points
from mocapfix.io.files import replace_atomically
from mocapfix.io.frame_rate import MAX_RATE_CONTRADICTION, choose_rate
from mocapfix.io.source_file import FileFrame, get_file_frame
from mocapfix.model.take import C3D_BLOCK_BYTES, INTEL_PROCESSOR, MAX_C3D_WORD, MAX_RESIDUAL_COUNTS, C3dLayout, Take
from mocapfix.options import ReadOptions

DEFAULT_C3D_UNIT = "mm"  # if POINT:UNITS is missing
MAX_BLOCK_SAMPLES = 1 << 17  # that are converted at once


def is_c3d(head: bytes) -> bool:
    """Return whether a file with this beginning is a C3D."""
    return len(head) > 1 and head[1] == MAGIC_BYTE and b"\0" in head


def read_c3d(path: Path, data: bytes, options: ReadOptions) -> Take:
    """Return the take in the bytes of a C3D file.

    A sample is missing if its residual is below 0 or `find_valid_points` rejects its coordinates. Source:
    C3D User Guide, "The 3D Data Section".

    Raises:
        ReadError: If the file is not a complete C3D with markers. The message names the file and the remedy.
    """
    if len(data) < 2 * C3D_BLOCK_BYTES:
        raise ReadError(f"{path}: has only the first {len(data)} bytes of a C3D, without its data; copy or export it again.")
    try:
        parameters = read_c3d_parameters(data)
    except ValueError as error:
        raise ReadError(f"{path}: its header or parameters are damaged; copy or export it again.") from error
    layout, notes = _build_layout(path, parameters, data, options)
    stated_rate, stated_notes = _find_stated_rate(parameters, layout)
    rate, rate_notes = choose_rate(lambda sentence: ReadError(f"{path}: POINT:RATE: {sentence}"), stated_rate, options)
    visible, residual_words = _find_valid_samples(layout, data)
    labels = [*parameters.labels[: layout.point_count], *[""] * (layout.point_count - len(parameters.labels))]
    stated = points.DeclaredPoints(labels, parameters.descriptions, parameters.model_outputs, parameters.modelled_markers)
    types = points.classify_points(stated, visible, residual_words)
    points.check_point_types(path, types)
    inspected = inspect_points(types, layout.frame_count, rate, partial(_convert_to_metres, layout, data, visible))
    # The sign of Y_SCREEN is no evidence: it gives the viewer's side, and Qualisys writes -Z on Z-up data.
    screen_axis = parameters.screen_axis[-1:] if parameters.screen_axis[-1:] in ROTATIONS_TO_Y_UP else ""
    declared = DeclaredConvention(layout.unit_m, up_axis=screen_axis, up_basis="POINT:Y_SCREEN")
    convention = decide_convention(path, inspected, declared, options)
    layout = replace(layout, unit_m=convention.unit_m, rotation_y_up_file=convention.rotation_y_up_file)
    convert = partial(_convert_to_metres, layout, data, visible)
    functions = points.find_computed_markers(types, visible, convert)
    columns = np.setdiff1d(types.markers, list(functions))
    take = Take(
        convert(columns),
        tuple(types.labels[i] for i in columns),
        rate,
        parameters.first_frame,
        path,
        layout=layout,
        point_columns=columns,
        computed=points.detect_computed_samples(residual_words[:, columns], visible[:, columns]),
        uncaptured=points.detect_uncaptured_samples(residual_words[:, columns], visible[:, columns]),
        subject_names=parameters.subject_names,
        up_axis=convention.up_axis,
        notes=(*notes, *(() if options.rate_hz else stated_notes), *rate_notes, *convention.notes),
    )
    return points.add_other_points(take, types, functions, convert)


def read_fill_sd(take: Take) -> Float[np.ndarray, "T M"]:
    """Return the standard deviations per axis (m) that mocapfix stored in the file of a take for its fills, NaN elsewhere.

    They are the residuals of samples to which no camera contributed; see `io.patches.patch_c3d`. Infinite for those at the
    largest residual that a file can store, which stands for all larger ones.
    """
    fill_sd = np.full(take.visible.shape, np.nan)
    layout = take.layout
    if not isinstance(layout, C3dLayout) or take.path is None or take.computed is None or not take.computed.any():
        return fill_sd
    stored = layout.view_words(take.path.read_bytes())[:, :, 3][:, take.point_indices]
    counts = layout.decode_words(stored[take.computed]) % (MAX_RESIDUAL_COUNTS + 1)
    fill_sd[take.computed] = np.where(counts < MAX_RESIDUAL_COUNTS, counts * (layout.scale_factor * layout.unit_m), np.inf)
    return fill_sd


def _convert_to_metres(
    layout: C3dLayout,
    data: bytes,
    visible: Bool[np.ndarray, "T P"],
    columns: Int[np.ndarray, " K"],
    frames: slice | Int[np.ndarray, " F"] = slice(None),
) -> Float[np.ndarray, "F K 3"]:
    """Return the positions (m) of K points in Y-up axes in some frames, NaN where not visible.

    The rotation is a permutation, and reordering coordinates is many times faster than a matrix product.
    """
    words, visible = layout.view_words(data)[frames], visible[frames]
    markers = np.empty((len(words), len(columns), 3))
    axes = np.abs(layout.rotation_y_up_file).argmax(1)
    signed_unit_m = layout.unit_m * layout.rotation_y_up_file.sum(1)
    for block in _list_frame_blocks(layout, len(words)):
        coordinates = layout.decode_words(words[block, columns[:, None], axes])
        if not layout.is_float:
            coordinates *= layout.scale_factor
        markers[block] = coordinates * signed_unit_m
        markers[block][~visible[block][:, columns]] = np.nan
    return markers


def _find_valid_samples(layout: C3dLayout, data: bytes) -> tuple[Bool[np.ndarray, "T P"], Float[np.ndarray, "T P"]]:
    """Return which samples are valid, and the residual word of each."""
    words = layout.view_words(data)
    residual_words = layout.decode_words(words[:, :, 3]).astype(np.float32)
    visible = np.empty(residual_words.shape, bool)
    for block in _list_frame_blocks(layout, len(words)):
        coordinates = layout.decode_words(words[block, :, :3])
        if not layout.is_float:
            coordinates *= layout.scale_factor
        visible[block] = find_valid_points(coordinates) & ~(residual_words[block] < 0)
    return visible, residual_words


def _list_frame_blocks(layout: C3dLayout, frame_count: int) -> list[slice]:
    """Return the blocks of frames that are converted at once: a whole file in double precision would take thrice its memory."""
    length = max(1, MAX_BLOCK_SAMPLES // layout.point_count)
    return [slice(first, first + length) for first in range(0, frame_count, length)]


def _build_layout(path: Path, parameters: C3dParameters, data: bytes, options: ReadOptions) -> tuple[C3dLayout, tuple[str, ...]]:
    """Return the layout without its rotation, and notes on words of the header and parameters that are wrong."""
    unit_m = get_metres_per_unit(options.unit or parameters.unit_name or DEFAULT_C3D_UNIT)
    if parameters.point_count == 0:
        raise ReadError(f"{path}: has no points; export the marker trajectories as well.")
    if unit_m is None:
        choices = ", ".join(METRES_PER_UNIT)
        raise ReadError(f"{path}: POINT:UNITS is {parameters.unit_name!r}; give the unit with --unit, one of {choices}.")
    if not np.isfinite(parameters.scale_factor) or parameters.scale_factor == 0:
        raise ReadError(f"{path}: POINT:SCALE is {parameters.scale_factor:g}, which gives no coordinates; export it again.")
    blocks, notes = locate_samples(path, parameters, data)
    return blocks.build_layout(parameters.processor_type, abs(parameters.scale_factor), unit_m), notes


def _find_stated_rate(parameters: C3dParameters, layout: C3dLayout) -> tuple[float, tuple[str, ...]]:
    """Return the frames per second and a note if header and POINT:RATE differ: the header's if the analog rate confirms it."""
    rate, other = parameters.rate, parameters.header_rate
    if not (np.isfinite(other) and other > 0) or np.isclose(rate, other, rtol=MAX_RATE_CONTRADICTION):
        return rate, ()
    samples = layout.analog_word_count / (parameters.analog_channel_count or np.inf)
    by_analog = parameters.analog_rate / samples if samples > 0 else np.nan
    if np.isclose(by_analog, other, rtol=MAX_RATE_CONTRADICTION) and not np.isclose(by_analog, rate, rtol=MAX_RATE_CONTRADICTION):
        return other, (f"POINT:RATE says {rate:g} Hz; the header and the analog rate say {other:g} Hz, which was used.",)
    return rate, (f"The header says {other:g} Hz; POINT:RATE, {rate:g} Hz, was used.",)


RESIDUAL_COUNT_M = 1e-4  # metres per count of the residual
MISSING_RESIDUAL = -1  # residual word of a missing sample
MEASURED_RESIDUAL = 0  # residual word of a measured sample
UNKNOWN_SD_RESIDUAL = 1  # residual word of an estimated sample without a standard deviation
RIGHT_AXIS_NAMES = {0: "+Y", 1: "+X", 2: "+X"}  # axis that points right, by the index of the up axis


def write_c3d(target: str | Path, take: Take) -> None:
    """Write the markers of a take, followed by its unlabelled trajectories, in the unit and axes of the source file.

    A measured sample has the residual word 0. An estimated one has its predicted standard deviation in counts of 0.1 mm, clamped
    to 1..255, and camera mask 0. A missing one has coordinates 0 and residual -1. Labels beyond 255 are stored in LABELS2 and so
    on, and frame numbers beyond 65535 in TRIAL and POINT:LONG_FRAMES. C3D counts frames from 0 on, so a take whose frame numbers
    are negative is numbered from 1.

    Raises:
        WriteError: If the take has more or longer labels than a C3D can hold, or `target` is not writable.
    """
    target, frame = Path(target), get_file_frame(take)
    labels = [*take.labels, *(take.unlabelled.labels if take.unlabelled else ())]
    encoded = [label.encode("utf-8") or b" " for label in labels]
    if too_long := next((label for label in encoded if len(label) > MAX_TEXTS_PER_PARAMETER), None):
        problem = f"the label {too_long.decode()[:30]}... is longer than the {MAX_TEXTS_PER_PARAMETER} bytes a C3D can hold"
        raise WriteError(f"{target}: {problem}; shorten it.")
    first = take.first_frame if take.first_frame >= 0 else 1
    last, point_count = first + take.frame_count - 1, len(labels)
    data_block = 2 + len(_encode_parameters(frame, take, encoded, first, 0)) // C3D_BLOCK_BYTES
    if point_count > MAX_C3D_WORD or data_block - 2 > MAX_PARAMETER_BLOCKS:
        problem = f"{point_count} points with such labels are more than a C3D can hold"
        raise WriteError(f"{target}: {problem}; write another format.")
    scale, ends = RESIDUAL_COUNT_M / frame.unit_m, (min(first, MAX_C3D_WORD), min(last, MAX_C3D_WORD))
    header = struct.pack("<BBHHHHHfHHf", 2, MAGIC_BYTE, point_count, 0, *ends, 0, -scale, data_block, 0, take.rate)
    with replace_atomically(target) as part, part.open("wb") as file:
        file.write(_pad_to_block(header) + _encode_parameters(frame, take, encoded, first, data_block))
        data = _build_words(frame, take).tobytes()
        # If the header cannot give the last frame, ezc3d reads padding in the last block as frames.
        file.write(data if last > MAX_C3D_WORD else _pad_to_block(data))


def _encode_parameters(frame: FileFrame, take: Take, labels: Sequence[bytes], first: int, data_block: int) -> bytes:
    """Return the groups POINT and TRIAL in complete blocks. `data_block` is the number of the first block of samples."""
    last, up = first + take.frame_count - 1, int(np.abs(frame.rotation_y_up_file[1]).argmax())
    up_axis = f"{'+' if frame.rotation_y_up_file[1, up] > 0 else '-'}{'XYZ'[up]}"
    point = [
        build_group_record("POINT", 1),
        build_number_record("USED", 1, WORD_TYPE, (), [len(labels)]),
        build_number_record("FRAMES", 1, WORD_TYPE, (), [min(take.frame_count, MAX_C3D_WORD)]),
        build_number_record("LONG_FRAMES", 1, FLOAT_TYPE, (), [take.frame_count]),
        build_number_record("DATA_START", 1, WORD_TYPE, (), [data_block]),
        build_number_record("SCALE", 1, FLOAT_TYPE, (), [-RESIDUAL_COUNT_M / frame.unit_m]),
        build_number_record("RATE", 1, FLOAT_TYPE, (), [take.rate]),
        build_text_record("UNITS", 1, frame.unit_name.encode()),
        build_text_record("X_SCREEN", 1, RIGHT_AXIS_NAMES[up].encode()),
        build_text_record("Y_SCREEN", 1, up_axis.encode()),
        *build_list_records("LABELS", 1, labels),
        *build_list_records("DESCRIPTIONS", 1, [b" "] * len(labels)),
    ]
    trial = [
        build_group_record("TRIAL", 2),
        build_number_record("ACTUAL_START_FIELD", 2, WORD_TYPE, (2,), [first, first >> 16]),
        build_number_record("ACTUAL_END_FIELD", 2, WORD_TYPE, (2,), [last, last >> 16]),
        build_number_record("CAMERA_RATE", 2, FLOAT_TYPE, (), [take.rate]),
    ]
    records = join_records((*point, *trial))
    blocks = len(_pad_to_block(bytes(4) + records)) // C3D_BLOCK_BYTES
    return _pad_to_block(struct.pack("BBBB", 1, MAGIC_BYTE, min(blocks, MAX_PARAMETER_BLOCKS), INTEL_PROCESSOR) + records)


def _pad_to_block(data: bytes) -> bytes:
    """Return the data followed by zeros up to the end of its last block."""
    return data + bytes(-len(data) % C3D_BLOCK_BYTES)


def _build_words(frame: FileFrame, take: Take) -> Float[np.ndarray, "T P 4"]:
    """Return X, Y, Z in the unit and axes of the file and the residual word, for markers and unlabelled trajectories."""
    unlabelled = take.unlabelled.markers if take.unlabelled else np.zeros((take.frame_count, 0, 3))
    xyz = frame.compute_coordinates(np.concatenate([take.markers, unlabelled], axis=1))
    words = np.zeros((*xyz.shape[:2], 4), "<f4")
    words[..., :3] = xyz
    residual_words = np.where(take.measured | ~take.visible, MEASURED_RESIDUAL, UNKNOWN_SD_RESIDUAL).astype(float)
    if take.sample_sd is not None:
        residuals = np.clip(np.rint(take.sample_sd / RESIDUAL_COUNT_M), 1, MAX_RESIDUAL_COUNTS)
        residual_words = np.where(np.isnan(residuals), residual_words, residuals)
    words[:, : len(take.labels), 3] = residual_words
    words[np.isnan(xyz).any(-1)] = (0, 0, 0, MISSING_RESIDUAL)
    return words
