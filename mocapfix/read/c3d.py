"""Reading a C3D: the point block as one NumPy view, out of it a take in metres with Y up."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from mocapfix.c3d_layout import C3DLayout
from mocapfix.errors import ReadError
from mocapfix.read.axes import ENOUGH_FRAMES, to_y_up
from mocapfix.read.computed import blind, computed
from mocapfix.read.labels import marker_columns, unlabelled_columns
from mocapfix.read.parameters import Parameters, parameters
from mocapfix.read.places import there
from mocapfix.read.units import METRES, metres
from mocapfix.take import Take

USUAL = "mm"  # where POINT:UNITS says nothing
MAGIC, BLOCK = 0x50, 512  # the second byte of every C3D; its sections end at multiples of a block


def recognises(head: bytes) -> bool:
    """-> does a file that begins so claim to be a C3D?"""
    return len(head) > 1 and head[1] == MAGIC and b"\0" in head


def take(path: Path, data: bytes) -> Take:
    """-> the take in a C3D file's bytes.

    Markers are (T, M, 3) in metres, Y up, NaN where the file says invalid: by a residual below 0, or by coordinates that are
    no place (read.places). Model outputs and unlabelled points are named in `others`. Source: C3D User Guide, "The 3D Data
    Section".

    Raises ReadError, naming the file and what to do, for anything that is not a whole C3D with labelled markers.
    """
    if len(data) < 2 * BLOCK:
        raise ReadError(f"{path}: is a C3D's first {len(data)} bytes, without its data; copy it again or export it anew.")
    try:
        said = parameters(data)
    except ValueError as error:
        raise ReadError(f"{path}: its header or parameters are damaged; copy it again or export it anew.") from error
    layout, notes = _layout(path, said, len(data))
    values = _values(layout, data)
    words = np.ascontiguousarray(values[..., 3])
    seen = there(values[..., :3]) & ~(words < 0)
    labels = [*said.labels[: layout.points], *[""] * (layout.points - len(said.labels))]
    columns = marker_columns(labels, said.outputs, seen, words)
    if not len(columns):
        raise ReadError(f"{path}: none of its {layout.points} points is a labelled marker; label them and export it again.")
    step = max(1, layout.frames // ENOUGH_FRAMES)
    few = _metres(values[::step], seen[::step], columns, layout.unit, np.eye(3))
    axes = to_y_up(said.vertical, [labels[i] for i in columns], few)

    def of(points: np.ndarray, **more) -> Take:
        markers = _metres(values, seen, points, layout.unit, axes)
        return Take(markers, tuple(labels[i] for i in points), said.rate, said.first_frame, path, columns=points, **more)

    nameless, markers = unlabelled_columns(labels, said.outputs, seen), set(columns.tolist())
    return of(
        columns,
        layout=replace(layout, axes=axes),
        others=tuple(label for i, label in enumerate(labels) if i not in markers),
        unlabelled=of(nameless) if len(nameless) else None,
        computed=computed(words, seen)[:, columns],
        blind=blind(words[:, columns], seen[:, columns]),
        subjects=said.subjects,
        notes=notes,
    )


def _metres(values: np.ndarray, seen: np.ndarray, points: np.ndarray, unit: float, axes: np.ndarray) -> np.ndarray:
    """-> (T, K, 3) metres of the points (K,) in other axes, NaN where not `seen` (T, P); `values` (T, P, 4) are in file units.

    Axes are a permutation, and taking numbers in another order is many times faster than a product.
    """
    markers = values[:, points[:, None], axes.argmax(1)]
    markers *= unit
    markers[~seen[:, points]] = np.nan
    return markers


def _layout(path: Path, said: Parameters, size: int) -> tuple[C3DLayout, tuple[str, ...]]:
    """Where the samples lie, held against the file's size in bytes, and notes on that; its axes are not known yet."""
    unit = metres(said.units or USUAL)
    if said.points == 0:
        raise ReadError(f"{path}: holds no points; export the marker trajectories with it.")
    if said.points != said.header_points:
        raise ReadError(
            f"{path}: holds {said.header_points} points by its header and {said.points} by POINT:USED; export it again."
        )
    if unit is None:
        raise ReadError(f"{path}: POINT:UNITS is {said.units!r}; set it to one of {', '.join(METRES)}.")
    if not (np.isfinite(said.rate) and said.rate > 0):
        raise ReadError(f"{path}: POINT:RATE is {said.rate:g}; set it to the frames a second.")
    if not np.isfinite(said.scale) or said.scale == 0:
        raise ReadError(f"{path}: POINT:SCALE is {said.scale:g}, which gives no coordinates; export it again.")
    is_float = said.scale < 0
    frame_bytes = (4 * said.points + said.analog) * (4 if is_float else 2)
    frames = _frames(path, said, size, frame_bytes)
    note = f"The header promises {said.promised} frames and {frames} are there."
    layout = C3DLayout(said.processor, is_float, abs(said.scale), said.start, frame_bytes, said.points, frames, unit, np.eye(3))
    return layout, () if frames in (said.promised, said.header_frames) else (note,)


def _frames(path: Path, said: Parameters, size: int, frame_bytes: int) -> int:
    """How many frames the file of `size` bytes has: what is promised, if it is there.

    A file that ends with the header's last frame is whole, though a parameter left over from a longer trial promise more; and so
    is one that somebody shortened with its header left as it was, which ends with a frame and not, as what was lost on the way
    may, with a block. A file may also hold more frames than a word can promise, and say so nowhere.
    """
    held = max(0, size - said.start) // frame_bytes
    if said.promised < 1:
        raise ReadError(f"{path}: holds no frames; export the trial again.")
    if said.promised <= held:
        return held if said.saturated and (held - said.promised) * frame_bytes >= BLOCK else said.promised
    if said.header_frames > 0 and 0 <= size - said.start - said.header_frames * frame_bytes < BLOCK:
        return said.header_frames
    if held and not (size - said.start) % frame_bytes and size % BLOCK:
        return held
    raise ReadError(f"{path}: is cut off: {said.promised} frames are promised, {held} are there; copy or export it again.")


def _values(layout: C3DLayout, data: bytes) -> np.ndarray:
    """-> (T, P, 4): X Y Z in file units and the residual word."""
    words = layout.words(data)
    is_vax = layout.is_float and layout.processor == 85
    if is_vax:  # a VAX F float is an IEEE one times 4 with its 16-bit halves swapped
        words = ((words >> 16) | (words << 16)).view("<f4")
    with np.errstate(invalid="ignore"):  # damaged bytes may spell a NaN that signals
        values = words.astype(float) / (4 if is_vax else 1)
    if not layout.is_float:
        values[..., :3] *= layout.scale
    return values
