"""Write a changed copy of a C3D file: the bytes of the original with only the changed samples replaced."""

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from mocapfix.errors import WriteError
from mocapfix.files.layouts import MAX_RESIDUAL_COUNTS, C3dLayout
from mocapfix.files.output_files import replace_atomically
from mocapfix.take import Take
from mocapfix.write.source_file import (
    MAX_STORED_COORDINATE,
    find_assigned_points,
    find_changed_samples,
    find_relabelled_samples,
    read_source_bytes,
)

MISSING_SAMPLE = (0.0, 0.0, 0.0, -1.0)  # coordinates and residual word
MAX_INT16_COUNT = 32_767  # largest coordinate in an integer file, in counts


def patch_c3d(target: str | Path, before: Take, after: Take) -> list[tuple[int, int]]:
    """Write the file of `before` to `target` with the markers of `after`.

    A sample that comes from another label, or from an unlabelled point, keeps all of its words, bit for bit. Any other sample
    that differs gets its new coordinates, camera mask 0, and its `sample_sd` as residual, in counts clamped to 1..255 (1 if it
    has none). A missing sample gets coordinates 0 and residual -1, and so does one that an integer file cannot store, because
    files are never rescaled. All other bytes are unchanged (C3D User Guide, "The 3D Data Section").

    Returns:
        Frame and marker index of the samples that could not be stored.

    Raises:
        WriteError: If `target` is the input or is not writable, or if `before` was not read from a C3D that still exists.
    """
    layout = before.layout
    if not isinstance(layout, C3dLayout):
        raise WriteError(f"{before.name}: was not read from a C3D file, so there is no file to patch.")
    stop_byte = layout.data_start_byte + layout.frame_count * layout.frame_stride_bytes
    data = read_source_bytes(Path(target), before.path, stop_byte)
    words, relabelled = layout.view_words(data), find_relabelled_samples(before, after)
    frames, markers = np.nonzero(find_changed_samples(before, after) & ~relabelled)
    samples, is_stored = _build_samples(layout, after, frames, markers)
    relabelled_frames, relabelled_markers = np.nonzero(relabelled)
    relabelled_words = words[relabelled_frames, after.source_points[relabelled]]  # a copy, made before any word is replaced
    words[frames, before.point_columns[markers]] = _encode_samples(layout, samples)
    words[relabelled_frames, before.point_columns[relabelled_markers]] = relabelled_words
    assigned = find_assigned_points(before, after)
    words[assigned] = _encode_samples(layout, np.tile(MISSING_SAMPLE, (len(assigned[0]), 1)))
    with replace_atomically(Path(target)) as part:
        part.write_bytes(data)
    is_lost = ~is_stored & ~np.isnan(after.markers[frames, markers]).any(-1)
    return [(int(t), int(m)) for t, m in zip(frames[is_lost], markers[is_lost], strict=True)]


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


def _encode_samples(layout: C3dLayout, samples: Float[np.ndarray, "n 4"]) -> Shaped[np.ndarray, "n 4"]:
    """Return the words of samples as the file stores them."""
    if layout.has_vax_floats:
        bits = (samples * 4).astype("<f4").view("<u4")
        return (bits >> 16) | (bits << 16)
    return samples.astype(layout.word_dtype)
