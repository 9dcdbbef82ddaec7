"""Writing a mended C3D: the original's bytes, with only the changed samples replaced."""

from pathlib import Path

import numpy as np

from mocapfix.errors import WriteError
from mocapfix.files.layouts import C3dLayout
from mocapfix.files.output_files import replace_atomically
from mocapfix.take import Take
from mocapfix.write.source_file import (
    MAX_STORED_COORDINATE,
    find_assigned_points,
    find_changed_samples,
    find_relabelled_samples,
    read_source_bytes,
)

MISSING_SAMPLE = (0.0, 0.0, 0.0, -1.0)  # coordinates and residual of what is not there
MAX_INT16_COUNT = 32_767  # that a 16-bit word holds


def patch_c3d(target: str | Path, before: Take, after: Take) -> list[tuple[int, int]]:
    """Write `before`'s file to `target` with the markers of `after`; -> (frame, marker) indices that could not be stored.

    A sample that came from another label, or from an unlabelled point, brings all of its words with it, bit for bit. Any other
    that differs gets its new coordinates and its predicted standard deviation (`after.deviation`; 1 where it
    has none) as residual, in counts clamped to 1..255, camera mask 0. One that is gone gets coordinates 0 and residual -1;
    so does one that an integer file cannot hold, for the file is never rescaled. Every other byte stays as it is
    (C3D User Guide, "The 3D Data Section").

    Raises WriteError where `target` is the input itself, where `before` was not read from a C3D that is still there, or
    where `target` cannot be written.
    """
    layout = before.layout
    if not isinstance(layout, C3dLayout):
        raise WriteError(f"{before.name}: was not read from a C3D, so there is no file to write the mended markers into.")
    data = read_source_bytes(Path(target), before.path, layout.data_start_byte + layout.frame_count * layout.frame_stride_bytes)
    words, came = layout.view_words(data), find_relabelled_samples(before, after)
    frames, markers = np.nonzero(find_changed_samples(before, after) & ~came)
    samples, stored = _build_samples(layout, after, frames, markers)
    theirs = words[np.nonzero(came)[0], after.source_points[came]]
    words[frames, before.point_columns[markers]] = _encode_samples(layout, samples)
    words[np.nonzero(came)[0], before.point_columns[np.nonzero(came)[1]]] = theirs
    gone = find_assigned_points(before, after)
    words[gone] = _encode_samples(layout, np.tile(MISSING_SAMPLE, (len(gone[0]), 1)))
    with replace_atomically(Path(target)) as part:
        part.write_bytes(data)
    lost = ~stored & ~np.isnan(after.markers[frames, markers]).any(-1)
    return [(int(t), int(m)) for t, m in zip(frames[lost], markers[lost], strict=True)]


def _build_samples(layout: C3dLayout, after: Take, frames: np.ndarray, markers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """-> (n, 4) numbers to store, and (n,) bool: is the position among them?"""
    xyz = after.markers[frames, markers] @ layout.rotation_y_up_file / layout.unit_m
    counts = xyz.astype(np.float32) if layout.is_float else np.rint(xyz / layout.scale_factor)
    largest = MAX_STORED_COORDINATE if layout.is_float else MAX_INT16_COUNT
    stored = np.all(np.abs(counts) <= largest, axis=-1) & np.any(counts != 0, axis=-1)  # all coordinates 0 would read as missing
    deviation = np.full(len(frames), np.nan) if after.sample_sd is None else after.sample_sd[frames, markers]
    residual = np.clip(np.nan_to_num(np.rint(deviation / layout.unit_m / layout.scale_factor), nan=1.0), 1, 255)
    samples = np.c_[counts, residual]
    samples[~stored] = MISSING_SAMPLE
    return samples, stored


def _encode_samples(layout: C3dLayout, samples: np.ndarray) -> np.ndarray:
    """-> (n, 4) words as the file stores them."""
    if layout.is_float and layout.processor_type == 85:
        # A VAX F float is an IEEE one times 4 with its 16-bit halves swapped.
        bits = (samples * 4).astype("<f4").view("<u4")
        return (bits >> 16) | (bits << 16)
    return samples.astype(layout.word_dtype)
