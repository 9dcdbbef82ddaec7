"""Writing a mended C3D: the original's bytes, with only the changed samples replaced."""

from pathlib import Path

import numpy as np

from mocapfix.c3d_layout import C3DLayout
from mocapfix.errors import WriteError
from mocapfix.files import replacing
from mocapfix.take import Take

# The largest coordinate that a 16-bit word holds, and that a float word holds without reading as Cortex's 9999999.
GONE = (0.0, 0.0, 0.0, -1.0)  # coordinates and residual of what is not there
LARGEST_COUNT, LARGEST_FLOAT = 32_767, 8_999_999


def c3d(target: str | Path, before: Take, after: Take) -> list[tuple[int, int]]:
    """Write `before`'s file to `target` with the markers of `after`; -> (frame, marker) indices that could not be stored.

    A sample that came from another label, or from an unlabelled point, brings all of its words with it, bit for bit. Any other
    that differs gets its new coordinates and its predicted standard deviation (`after.deviation`; 1 where it
    has none) as residual, in counts clamped to 1..255, camera mask 0. One that is gone gets coordinates 0 and residual -1;
    so does one that an integer file cannot hold, for the file is never rescaled. Every other byte stays as it is
    (C3D User Guide, "The 3D Data Section").

    Raises WriteError where `target` is the input itself, where `before` was not read from a C3D that is still there, or
    where `target` cannot be written.
    """
    target = Path(target)
    layout, data = _original(target, before)
    own, words = before.sources, layout.words(data)
    came = after.seen & (after.sources != own) & (np.isnan(after.deviation) if after.deviation is not None else True)
    frames, markers = np.nonzero(_changed(before.markers, after.markers) & ~came)
    samples, stored = _samples(layout, after, frames, markers)
    brought = words[np.nonzero(came)[0], after.sources[came]]
    words[frames, before.columns[markers]] = _encoded(layout, samples)
    words[np.nonzero(came)[0], before.columns[np.nonzero(came)[1]]] = brought
    if before.unlabelled is not None and after.unlabelled is not None:
        given, points = np.nonzero(before.unlabelled.seen & ~after.unlabelled.seen)
        words[given, before.unlabelled.columns[points]] = _encoded(layout, np.tile(GONE, (len(given), 1)))
    with replacing(target) as part:
        part.write_bytes(data)
    lost = ~stored & ~np.isnan(after.markers[frames, markers]).any(-1)
    return [(int(t), int(m)) for t, m in zip(frames[lost], markers[lost], strict=True)]


def _original(target: Path, before: Take) -> tuple[C3DLayout, bytearray]:
    if before.path is None or not isinstance(before.layout, C3DLayout):
        raise WriteError(f"{before.name}: was not read from a C3D, so there is no file to write the mended markers into.")
    try:
        if target.exists() and target.samefile(before.path):
            raise WriteError(f"{target}: is the input itself, which stays as it is; choose another folder with --out.")
        data = bytearray(before.path.read_bytes())
    except OSError as error:
        raise WriteError(f"{before.path}: the original can no longer be read ({error.strerror}); put it back.") from error
    layout = before.layout
    if len(data) < layout.start + layout.frames * layout.frame_bytes:
        raise WriteError(f"{before.path}: the original has become shorter since it was read; clean it again.")
    return layout, data


def _changed(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """-> (T, M) bool: do the bits differ? NaN is NaN, whichever its bits."""
    return ~((before == after) & (np.signbit(before) == np.signbit(after)) | np.isnan(before) & np.isnan(after)).all(-1)


def _samples(layout: C3DLayout, after: Take, frames: np.ndarray, markers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """-> (n, 4) numbers to store, and (n,) bool: is the position among them?"""
    xyz = after.markers[frames, markers] @ layout.axes / layout.unit
    counts = xyz.astype(np.float32) if layout.is_float else np.rint(xyz / layout.scale)
    largest = LARGEST_FLOAT if layout.is_float else LARGEST_COUNT
    stored = np.all(np.abs(counts) <= largest, axis=-1) & np.any(counts != 0, axis=-1)  # all coordinates 0 would read as missing
    deviation = np.full(len(frames), np.nan) if after.deviation is None else after.deviation[frames, markers]
    residual = np.clip(np.nan_to_num(np.rint(deviation / layout.unit / layout.scale), nan=1.0), 1, 255)
    samples = np.c_[counts, residual]
    samples[~stored] = GONE
    return samples, stored


def _encoded(layout: C3DLayout, samples: np.ndarray) -> np.ndarray:
    """-> (n, 4) words as the file stores them."""
    if layout.is_float and layout.processor == 85:
        # A VAX F float is an IEEE one times 4 with its 16-bit halves swapped.
        bits = (samples * 4).astype("<f4").view("<u4")
        return (bits >> 16) | (bits << 16)
    return samples.astype(layout.word)
