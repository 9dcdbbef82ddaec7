"""What is common to writing a mended copy of an input: its bytes, which of its samples differ, and what they may be."""

from pathlib import Path

import numpy as np

from mocapfix.errors import WriteError
from mocapfix.take import Take

LARGEST = 8_999_999  # file units: a coordinate that does not read as Cortex's 9999999, which is none

def original(target: Path, source: Path | None, needed: int = 0) -> bytearray:
    """-> the bytes of the file `source` that what is mended was read from.

    Raises WriteError where `target` is that file, where it can no longer be read, or where it has fewer bytes than `needed`.
    """
    if source is None:
        raise WriteError(f"{target}: what is mended was not read from a file, so there is none to write a mended copy of.")
    try:
        if target.exists() and target.samefile(source):
            raise WriteError(f"{target}: is the input itself, which stays as it is; choose another folder with --out.")
        data = bytearray(source.read_bytes())
    except OSError as error:
        raise WriteError(f"{source}: the original can no longer be read ({error.strerror}); put it back.") from error
    if len(data) < needed:
        raise shorter(source)
    return data


def shorter(source: Path | None) -> WriteError:
    """-> the error that an input no longer holds what was read from it."""
    return WriteError(f"{source}: the original has become shorter since it was read; clean it again.")


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
