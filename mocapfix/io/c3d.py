"""Read a C3D file: its point block as one NumPy view, converted to a take in metres with Y up."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.errors import ReadError
from mocapfix.io.body_evidence import inspect_points
from mocapfix.io.c3d_blocks import locate_samples
from mocapfix.io.c3d_parameters import C3dParameters, read_c3d_parameters
from mocapfix.io.conventions import DeclaredConvention, decide_convention
from mocapfix.io.coordinates import (
    METRES_PER_UNIT,
    ROTATIONS_TO_Y_UP,
    find_valid_points,
    get_metres_per_unit,
)
from mocapfix.io.frame_rate import MAX_RATE_CONTRADICTION, choose_rate
from mocapfix.io.points import (
    DeclaredPoints,
    add_other_points,
    check_point_types,
    classify_points,
    detect_computed_samples,
    detect_uncaptured_samples,
    find_computed_markers,
)
from mocapfix.model.take import C3D_BLOCK_BYTES, MAX_RESIDUAL_COUNTS, C3dLayout, Take
from mocapfix.options import ReadOptions

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
    layout, notes = _build_layout(path, parameters, data, options)
    stated_rate, stated_notes = _find_stated_rate(parameters, layout)
    rate, rate_notes = choose_rate(lambda sentence: ReadError(f"{path}: POINT:RATE: {sentence}"), stated_rate, options)
    visible, residual_words = _find_valid_samples(layout, data)
    labels = [*parameters.labels[: layout.point_count], *[""] * (layout.point_count - len(parameters.labels))]
    stated = DeclaredPoints(labels, parameters.descriptions, parameters.model_outputs, parameters.modelled_markers)
    types = classify_points(stated, visible, residual_words)
    check_point_types(path, types)
    inspected = inspect_points(types, layout.frame_count, rate, partial(_convert_to_metres, layout, data, visible))
    declared = DeclaredConvention(layout.unit_m, up_axis=get_screen_axis(parameters.screen_axis), up_basis="POINT:Y_SCREEN")
    convention = decide_convention(path, inspected, declared, options)
    layout = replace(layout, unit_m=convention.unit_m, rotation_y_up_file=convention.rotation_y_up_file)
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
        up_axis=convention.up_axis,
        notes=(*notes, *(() if options.rate_hz else stated_notes), *rate_notes, *convention.notes),
    )
    return add_other_points(take, types, functions, convert)


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


def get_screen_axis(screen_axis: str) -> str:
    """Return the letter of the axis that POINT:Y_SCREEN, such as "+Z", declares to be vertical; "" if it names no axis.

    Its sign is no evidence: it gives the viewer's side rather than the up direction, and Qualisys writes -Z on Z-up data.
    """
    letter = screen_axis[-1:]
    return letter if letter in ROTATIONS_TO_Y_UP else ""


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
