"""Reading a C3D: the point block as one NumPy view, out of it a take in metres with Y up."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from mocapfix.errors import ReadError
from mocapfix.files.layouts import C3dLayout
from mocapfix.read.c3d_parameters import C3dParameters, read_c3d_parameters
from mocapfix.read.coordinates import (
    MAX_INSPECTED_FRAMES,
    METRES_PER_UNIT,
    estimate_rotation_y_up,
    find_valid_points,
    get_metres_per_unit,
)
from mocapfix.read.point_types import (
    detect_computed_samples,
    detect_uncaptured_samples,
    find_marker_columns,
    find_unlabelled_columns,
)
from mocapfix.take import Take

DEFAULT_C3D_UNIT = "mm"  # where POINT:UNITS says nothing
C3D_MAGIC_BYTE, C3D_BLOCK_BYTES = 0x50, 512  # the second byte of every C3D; its sections end at multiples of a block


def is_c3d(head: bytes) -> bool:
    """-> does a file that begins so claim to be a C3D?"""
    return len(head) > 1 and head[1] == C3D_MAGIC_BYTE and b"\0" in head


def read_c3d(path: Path, data: bytes) -> Take:
    """-> the take in a C3D file's bytes.

    Markers are (T, M, 3) in metres, Y up, NaN where the file says invalid: by a residual below 0, or by coordinates that are
    no place (read.places). Model outputs and unlabelled points are named in `others`. Source: C3D User Guide, "The 3D Data
    Section".

    Raises ReadError, naming the file and what to do, for anything that is not a whole C3D with labelled markers.
    """
    if len(data) < 2 * C3D_BLOCK_BYTES:
        raise ReadError(f"{path}: is a C3D's first {len(data)} bytes, without its data; copy it again or export it anew.")
    try:
        said = read_c3d_parameters(data)
    except ValueError as error:
        raise ReadError(f"{path}: its header or parameters are damaged; copy it again or export it anew.") from error
    layout, notes = _build_layout(path, said, len(data))
    values = _decode_values(layout, data)
    words = np.ascontiguousarray(values[..., 3])
    seen = find_valid_points(values[..., :3]) & ~(words < 0)
    labels = [*said.labels[: layout.point_count], *[""] * (layout.point_count - len(said.labels))]
    columns = find_marker_columns(labels, said.model_outputs, seen, words)
    if not len(columns):
        raise ReadError(f"{path}: none of its {layout.point_count} points is a labelled marker; label them and export it again.")
    step = max(1, layout.frame_count // MAX_INSPECTED_FRAMES)
    few = _convert_to_metres(values[::step], seen[::step], columns, layout.unit_m, np.eye(3))
    axes = estimate_rotation_y_up(said.screen_axis, [labels[i] for i in columns], few)

    def of(points: np.ndarray, **more) -> Take:
        markers = _convert_to_metres(values, seen, points, layout.unit_m, axes)
        return Take(markers, tuple(labels[i] for i in points), said.rate, said.first_frame, path, point_columns=points, **more)

    nameless, markers = find_unlabelled_columns(labels, said.model_outputs, seen), set(columns.tolist())
    return of(
        columns,
        layout=replace(layout, rotation_y_up_file=axes),
        other_labels=tuple(label for i, label in enumerate(labels) if i not in markers),
        unlabelled=of(nameless) if len(nameless) else None,
        computed=detect_computed_samples(words, seen)[:, columns],
        uncaptured=detect_uncaptured_samples(words[:, columns], seen[:, columns]),
        subject_names=said.subject_names,
        notes=notes,
    )


def _convert_to_metres(values: np.ndarray, seen: np.ndarray, points: np.ndarray, unit: float, axes: np.ndarray) -> np.ndarray:
    """-> (T, K, 3) metres of the points (K,) in other axes, NaN where not `seen` (T, P); `values` (T, P, 4) are in file units.

    Axes are a permutation, and taking numbers in another order is many times faster than a product.
    """
    markers = values[:, points[:, None], axes.argmax(1)]
    markers *= unit
    markers[~seen[:, points]] = np.nan
    return markers


def _build_layout(path: Path, said: C3dParameters, size: int) -> tuple[C3dLayout, tuple[str, ...]]:
    """Where the samples lie, held against the file's size in bytes, and notes on that; its axes are not known yet."""
    unit = get_metres_per_unit(said.unit_name or DEFAULT_C3D_UNIT)
    if said.point_count == 0:
        raise ReadError(f"{path}: holds no points; export the marker trajectories with it.")
    if said.point_count != said.header_point_count:
        raise ReadError(
            f"{path}: holds {said.header_point_count} points by its header and {said.point_count} by POINT:USED; export it again."
        )
    if unit is None:
        raise ReadError(f"{path}: POINT:UNITS is {said.unit_name!r}; set it to one of {', '.join(METRES_PER_UNIT)}.")
    if not (np.isfinite(said.rate) and said.rate > 0):
        raise ReadError(f"{path}: POINT:RATE is {said.rate:g}; set it to the frames a second.")
    if not np.isfinite(said.scale_factor) or said.scale_factor == 0:
        raise ReadError(f"{path}: POINT:SCALE is {said.scale_factor:g}, which gives no coordinates; export it again.")
    is_float = said.scale_factor < 0
    frame_bytes = (4 * said.point_count + said.analog_values_per_frame) * (4 if is_float else 2)
    frames = _count_frames(path, said, size, frame_bytes)
    note = f"The header promises {said.declared_frame_count} frames and {frames} are there."
    layout = C3dLayout(
        said.processor_type,
        is_float,
        abs(said.scale_factor),
        said.data_start_byte,
        frame_bytes,
        said.point_count,
        frames,
        unit,
        np.eye(3),
    )
    return layout, () if frames in (said.declared_frame_count, said.header_frame_count) else (note,)


def _count_frames(path: Path, said: C3dParameters, size: int, frame_bytes: int) -> int:
    """How many frames the file of `size` bytes has: what is promised, if it is there.

    A file that ends with the header's last frame is whole, though a parameter left over from a longer trial promise more; and so
    is one that somebody shortened with its header left as it was, which ends with a frame and not, as what was lost on the way
    may, with a block. A file may also hold more frames than a word can promise, and say so nowhere.
    """
    held = max(0, size - said.data_start_byte) // frame_bytes
    if said.declared_frame_count < 1:
        raise ReadError(f"{path}: holds no frames; export the trial again.")
    if said.declared_frame_count <= held:
        return (
            held
            if said.is_count_saturated and (held - said.declared_frame_count) * frame_bytes >= C3D_BLOCK_BYTES
            else said.declared_frame_count
        )
    if said.header_frame_count > 0 and 0 <= size - said.data_start_byte - said.header_frame_count * frame_bytes < C3D_BLOCK_BYTES:
        return said.header_frame_count
    if held and not (size - said.data_start_byte) % frame_bytes and size % C3D_BLOCK_BYTES:
        return held
    raise ReadError(
        f"{path}: is cut off: {said.declared_frame_count} frames are promised, {held} are there; copy or export it again."
    )


def _decode_values(layout: C3dLayout, data: bytes) -> np.ndarray:
    """-> (T, P, 4): X Y Z in file units and the residual word."""
    words = layout.view_words(data)
    is_vax = layout.is_float and layout.processor_type == 85
    if is_vax:  # a VAX F float is an IEEE one times 4 with its 16-bit halves swapped
        words = ((words >> 16) | (words << 16)).view("<f4")
    with np.errstate(invalid="ignore"):  # damaged bytes may spell a NaN that signals
        values = words.astype(float) / (4 if is_vax else 1)
    if not layout.is_float:
        values[..., :3] *= layout.scale_factor
    return values
