"""Writing a mended C3D: the original's bytes, with only the changed samples replaced."""

from pathlib import Path

import numpy as np

from mocapfix.c3d_layout import C3DLayout
from mocapfix.errors import WriteError
from mocapfix.files import replacing
from mocapfix.take import Take
from mocapfix.write.original import LARGEST, brought, changed, given_away, original

GONE = (0.0, 0.0, 0.0, -1.0)  # coordinates and residual of what is not there
LARGEST_COUNT = 32_767  # that a 16-bit word holds


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
    layout = before.layout
    if not isinstance(layout, C3DLayout):
        raise WriteError(f"{before.name}: was not read from a C3D, so there is no file to write the mended markers into.")
    data = original(Path(target), before.path, layout.start + layout.frames * layout.frame_bytes)
    words, came = layout.words(data), brought(before, after)
    frames, markers = np.nonzero(changed(before, after) & ~came)
    samples, stored = _samples(layout, after, frames, markers)
    theirs = words[np.nonzero(came)[0], after.sources[came]]
    words[frames, before.columns[markers]] = _encoded(layout, samples)
    words[np.nonzero(came)[0], before.columns[np.nonzero(came)[1]]] = theirs
    gone = given_away(before, after)
    words[gone] = _encoded(layout, np.tile(GONE, (len(gone[0]), 1)))
    with replacing(Path(target)) as part:
        part.write_bytes(data)
    lost = ~stored & ~np.isnan(after.markers[frames, markers]).any(-1)
    return [(int(t), int(m)) for t, m in zip(frames[lost], markers[lost], strict=True)]


def _samples(layout: C3DLayout, after: Take, frames: np.ndarray, markers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """-> (n, 4) numbers to store, and (n,) bool: is the position among them?"""
    xyz = after.markers[frames, markers] @ layout.axes / layout.unit
    counts = xyz.astype(np.float32) if layout.is_float else np.rint(xyz / layout.scale)
    largest = LARGEST if layout.is_float else LARGEST_COUNT
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
