"""Read a C3D file: its point block as one NumPy view, converted to a take in metres with Y up."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from mocapfix.errors import ReadError
from mocapfix.files.layouts import C3D_BLOCK_BYTES, MAX_RESIDUAL_COUNTS, C3dLayout
from mocapfix.files.read_options import ReadOptions
from mocapfix.read.c3d_parameters import C3dParameters, read_c3d_parameters
from mocapfix.read.coordinates import (
    METRES_PER_UNIT,
    ROTATIONS_TO_Y_UP,
    find_valid_points,
    get_metres_per_unit,
)
from mocapfix.read.frame_rate import choose_rate
from mocapfix.read.point_takes import add_other_points, find_computed_markers
from mocapfix.read.point_types import (
    DeclaredPoints,
    check_point_types,
    classify_points,
    detect_computed_samples,
    detect_uncaptured_samples,
)
from mocapfix.read.up_axis import estimate_up_axis
from mocapfix.take import Take, UpAxis

DEFAULT_C3D_UNIT = "mm"  # if POINT:UNITS is missing
MAX_BLOCK_SAMPLES = 1 << 17  # that are converted at once
C3D_MAGIC_BYTE = 0x50  # second byte of every C3D file


def is_c3d(head: bytes) -> bool:
    """Return whether a file with this beginning is a C3D."""
    return len(head) > 1 and head[1] == C3D_MAGIC_BYTE and b"\0" in head


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
    layout, notes = _build_layout(path, parameters, len(data))
    rate, rate_notes = choose_rate(lambda sentence: ReadError(f"{path}: POINT:RATE: {sentence}"), float(parameters.rate), options)
    visible, residual_words = _find_valid_samples(layout, data)
    labels = [*parameters.labels[: layout.point_count], *[""] * (layout.point_count - len(parameters.labels))]
    declared = DeclaredPoints(labels, parameters.descriptions, parameters.model_outputs, parameters.modelled_markers)
    types = classify_points(declared, visible, residual_words)
    check_point_types(path, types)
    up_axis = get_screen_up_axis(parameters.screen_axis)
    if up_axis is None:
        inspected = types.markers if len(types.markers) else types.unlabelled
        in_file = _convert_to_metres(layout, data, visible, inspected)
        up_axis = estimate_up_axis([types.labels[i] for i in inspected], in_file, rate)
        del in_file
    layout = replace(layout, rotation_y_up_file=ROTATIONS_TO_Y_UP[up_axis.letter])
    convert = partial(_convert_to_metres, layout, data, visible)
    functions = find_computed_markers(types, visible, convert)
    columns = np.setdiff1d(types.markers, list(functions))
    take = Take(
        convert(columns),
        tuple(types.labels[i] for i in columns),
        rate,
        parameters.first_frame,
        path,
        layout=layout,
        point_columns=columns,
        computed=detect_computed_samples(residual_words[:, columns], visible[:, columns]),
        uncaptured=detect_uncaptured_samples(residual_words[:, columns], visible[:, columns]),
        subject_names=parameters.subject_names,
        up_axis=up_axis,
        notes=(*notes, *rate_notes),
    )
    return add_other_points(take, types, functions, convert)


def read_fill_sd(take: Take) -> Float[np.ndarray, "T M"]:
    """Return the standard deviations per axis (m) that mocapfix stored in the file of a take for its fills, NaN elsewhere.

    They are the residuals of samples to which no camera contributed; see `write.patches.patch_c3d`. Infinite for those at the
    largest residual that a file can store, which stands for all larger ones.
    """
    fill_sd = np.full(take.visible.shape, np.nan)
    layout = take.layout
    if not isinstance(layout, C3dLayout) or take.path is None or take.computed is None or not take.computed.any():
        return fill_sd
    stored = layout.view_words(take.path.read_bytes())[:, :, 3][:, take.point_indices]
    counts = _decode_words(layout, stored[take.computed]) % (MAX_RESIDUAL_COUNTS + 1)
    fill_sd[take.computed] = np.where(counts < MAX_RESIDUAL_COUNTS, counts * (layout.scale_factor * layout.unit_m), np.inf)
    return fill_sd


def get_screen_up_axis(screen_axis: str) -> UpAxis | None:
    """Return the up axis by POINT:Y_SCREEN, such as "+Z"; None if it names no axis.

    Only its letter is used: the sign gives the viewer's side rather than the up direction, and Qualisys writes -Z on Z-up data.
    """
    letter = screen_axis[-1:]
    return UpAxis(letter, "POINT:Y_SCREEN of the file") if letter in ROTATIONS_TO_Y_UP else None


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
        coordinates = _decode_words(layout, words[block, columns[:, None], axes])
        if not layout.is_float:
            coordinates *= layout.scale_factor
        markers[block] = coordinates * signed_unit_m
        markers[block][~visible[block][:, columns]] = np.nan
    return markers


def _find_valid_samples(layout: C3dLayout, data: bytes) -> tuple[Bool[np.ndarray, "T P"], Float[np.ndarray, "T P"]]:
    """Return which samples are valid, and the residual word of each."""
    words = layout.view_words(data)
    residual_words = _decode_words(layout, words[:, :, 3]).astype(np.float32)
    visible = np.empty(residual_words.shape, bool)
    for block in _list_frame_blocks(layout, len(words)):
        coordinates = _decode_words(layout, words[block, :, :3])
        if not layout.is_float:
            coordinates *= layout.scale_factor
        visible[block] = find_valid_points(coordinates) & ~(residual_words[block] < 0)
    return visible, residual_words


def _list_frame_blocks(layout: C3dLayout, frame_count: int) -> list[slice]:
    """Return the blocks of frames that are converted at once: a whole file in double precision would take thrice its memory."""
    length = max(1, MAX_BLOCK_SAMPLES // layout.point_count)
    return [slice(first, first + length) for first in range(0, frame_count, length)]


def _build_layout(path: Path, parameters: C3dParameters, file_bytes: int) -> tuple[C3dLayout, tuple[str, ...]]:
    """Return the layout without its rotation, checked against the size of the file, and a note on the number of frames."""
    unit_m = get_metres_per_unit(parameters.unit_name or DEFAULT_C3D_UNIT)
    points, header_points = parameters.point_count, parameters.header_point_count
    if points == 0:
        raise ReadError(f"{path}: has no points; export the marker trajectories as well.")
    if points != header_points:
        raise ReadError(f"{path}: has {header_points} points by its header and {points} by POINT:USED; export it again.")
    if unit_m is None:
        choices = ", ".join(METRES_PER_UNIT)
        raise ReadError(f"{path}: POINT:UNITS is {parameters.unit_name!r}; set it to one of {choices}.")
    if not np.isfinite(parameters.scale_factor) or parameters.scale_factor == 0:
        raise ReadError(f"{path}: POINT:SCALE is {parameters.scale_factor:g}, which gives no coordinates; export it again.")
    is_float = parameters.scale_factor < 0
    frame_bytes = (4 * points + parameters.analog_values_per_frame) * (4 if is_float else 2)
    frame_count = _count_frames(path, parameters, file_bytes, frame_bytes)
    layout = C3dLayout(
        processor_type=parameters.processor_type,
        is_float=is_float,
        scale_factor=abs(parameters.scale_factor),
        data_start_byte=parameters.data_start_byte,
        frame_stride_bytes=frame_bytes,
        point_count=points,
        frame_count=frame_count,
        unit_m=unit_m,
        rotation_y_up_file=np.eye(3),
    )
    if frame_count in (parameters.declared_frame_count, parameters.header_frame_count):
        return layout, ()
    return layout, (f"The header declares {parameters.declared_frame_count} frames; the file has {frame_count}.",)


def _count_frames(path: Path, parameters: C3dParameters, file_bytes: int, frame_bytes: int) -> int:
    """Return the number of frames: the declared one, if the file is large enough.

    A file that ends with the last frame of its header is complete even if a parameter, left over from a longer trial, declares
    more. So is a file that was shortened without changing its header: it ends with a frame and not with a block, as a file
    that was cut off in a transfer may. A file may also have more frames than a word can declare.
    """
    declared, data_bytes = parameters.declared_frame_count, file_bytes - parameters.data_start_byte
    stored = max(0, data_bytes) // frame_bytes
    if declared < 1:
        raise ReadError(f"{path}: has no frames; export the trial again.")
    if declared <= stored:
        has_more = parameters.is_count_saturated and (stored - declared) * frame_bytes >= C3D_BLOCK_BYTES
        return stored if has_more else declared
    header_frame_count = parameters.header_frame_count
    if header_frame_count > 0 and 0 <= data_bytes - header_frame_count * frame_bytes < C3D_BLOCK_BYTES:
        return header_frame_count
    if stored and not data_bytes % frame_bytes and file_bytes % C3D_BLOCK_BYTES:
        return stored
    problem = f"is cut off: {declared} frames are declared and {stored} are there"
    raise ReadError(f"{path}: {problem}; copy or export it again.")


def _decode_words(layout: C3dLayout, words: Shaped[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Return stored words as numbers: coordinates in file units, or of integer files in counts."""
    if layout.has_vax_floats:
        words = ((words >> 16) | (words << 16)).view("<f4")
    with np.errstate(invalid="ignore"):  # damaged bytes may spell a signalling NaN
        return words.astype(float) / (4 if layout.has_vax_floats else 1)
