"""What is common to writing a mended copy of an input: its bytes, which of its samples differ, and what they may be."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mocapfix.errors import WriteError
from mocapfix.take import Take

# MERGED: mocapfix.write.original
MAX_STORED_COORDINATE = 8_999_999  # file units: a coordinate that does not read as Cortex's 9999999, which is none


def read_source_bytes(target: Path, source: Path | None, min_bytes: int = 0) -> bytearray:
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
    if len(data) < min_bytes:
        raise build_truncated_error(source)
    return data


def build_truncated_error(source: Path | None) -> WriteError:
    """-> the error that an input no longer holds what was read from it."""
    return WriteError(f"{source}: the original has become shorter since it was read; clean it again.")


def find_relabelled_samples(before: Take, after: Take) -> np.ndarray:
    """-> (T, M) bool: the samples of `after` that are another point's of the file, as they were measured."""
    measured = np.ones(after.visible.shape, bool) if after.sample_sd is None else np.isnan(after.sample_sd)
    return after.visible & (after.source_points != before.source_points) & measured


def find_changed_samples(before: Take, after: Take) -> np.ndarray:
    """-> (T, M) bool: do the coordinates' bits differ? NaN is NaN, whichever its bits."""
    a, b = before.markers, after.markers
    return ~((a == b) & (np.signbit(a) == np.signbit(b)) | np.isnan(a) & np.isnan(b)).all(-1)


def find_assigned_points(before: Take, after: Take) -> tuple[np.ndarray, np.ndarray]:
    """-> the frames and the file's points of unlabelled samples that went to a marker."""
    if before.unlabelled is None or after.unlabelled is None:
        return np.zeros(0, int), np.zeros(0, int)
    frames, points = np.nonzero(before.unlabelled.visible & ~after.unlabelled.visible)
    return frames, before.unlabelled.point_columns[points]


# MERGED: mocapfix.write.own
# The unit and axes in which a take is written: those of the file it came from, so that both can be laid side by side.
C3D_UNIT_NAMES = {0.001: "mm", 0.01: "cm", 1.0: "m"}
DECIMALS_BY_UNIT = {"mm": 5, "cm": 6, "m": 8}  # of a number in a text: a hundred-millionth of a metre
ROTATION_Y_UP_FROM_Z_UP = np.eye(3)[[1, 2, 0]]  # file axes -> Y up


@dataclass(frozen=True)
class FileFrame:
    """A unit and axes: name mm, cm or m; unit metres in it; axes (3, 3) rotation, file axes -> Y up."""

    unit_name: str
    unit_m: float
    rotation_y_up_file: np.ndarray

    def compute_coordinates(self, markers: np.ndarray) -> np.ndarray:
        """-> (..., 3) in the unit and axes, of metres, Y up."""
        return markers @ self.rotation_y_up_file / self.unit_m


def get_file_frame(take: Take) -> FileFrame:
    """-> the unit and axes of the file that a take came from; millimetres for one that had another unit than a C3D may have,
    millimetres and Z up, as laboratories have them, for a take from no file."""
    if take.layout is None:
        return FileFrame("mm", 0.001, ROTATION_Y_UP_FROM_Z_UP)
    unit = take.layout.unit_m if take.layout.unit_m in C3D_UNIT_NAMES else 0.001
    return FileFrame(C3D_UNIT_NAMES[unit], unit, take.layout.rotation_y_up_file)
