"""What is common to writing a mended copy of an input: its bytes, and which of its samples differ."""

from pathlib import Path

import numpy as np

from mocapfix.errors import WriteError
from mocapfix.take import Take


def original(target: Path, before: Take) -> bytearray:
    """-> the bytes of the file that `before` was read from.

    Raises WriteError where `target` is that file, or where it can no longer be read.
    """
    if before.path is None or before.layout is None:
        raise WriteError(f"{before.name}: was not read from a C3D or a text file that mended markers could be put into.")
    try:
        if target.exists() and target.samefile(before.path):
            raise WriteError(f"{target}: is the input itself, which stays as it is; choose another folder with --out.")
        return bytearray(before.path.read_bytes())
    except OSError as error:
        raise WriteError(f"{before.path}: the original can no longer be read ({error.strerror}); put it back.") from error


def brought(before: Take, after: Take) -> np.ndarray:
    """-> (T, M) bool: the samples of `after` that are another point's of the file, as they were measured."""
    measured = np.ones(after.seen.shape, bool) if after.deviation is None else np.isnan(after.deviation)
    return after.seen & (after.sources != before.sources) & measured


def changed(before: Take, after: Take) -> np.ndarray:
    """-> (T, M) bool: do the coordinates' bits differ? NaN is NaN, whichever its bits."""
    a, b = before.markers, after.markers
    return ~((a == b) & (np.signbit(a) == np.signbit(b)) | np.isnan(a) & np.isnan(b)).all(-1)


def given_away(before: Take, after: Take) -> tuple[np.ndarray, np.ndarray]:
    """-> the frames and the file's points of unlabelled samples that went to a marker."""
    if before.unlabelled is None or after.unlabelled is None:
        return np.zeros(0, int), np.zeros(0, int)
    frames, points = np.nonzero(before.unlabelled.seen & ~after.unlabelled.seen)
    return frames, before.unlabelled.columns[points]
