"""What an output takes from the file that its take was read from: bytes, changed samples, unit and axes."""

from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.errors import WriteError
from mocapfix.kernels.text_numbers import INTEGER_PART_BYTES, MAX_EXACT_PRODUCT, write_rows
from mocapfix.model.take import Take

MAX_STORED_COORDINATE = 8_999_999  # file units; larger ones read as missing, as Cortex's 9999999 does
C3D_UNIT_NAMES = {0.001: "mm", 0.01: "cm", 1.0: "m"}
ROTATION_Y_UP_FROM_Z_UP = np.eye(3)[[1, 2, 0]]


@dataclass(frozen=True)
class FileFrame:
    """Unit and axes of the coordinates in a file."""

    unit_name: str  # "mm", "cm" or "m"
    unit_m: float  # metres per unit
    rotation_y_up_file: Float[np.ndarray, "3 3"]  # rotation from file axes to Y-up axes

    def compute_coordinates(self, positions: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """Convert positions (m, Y up) to the unit and axes of the file."""
        return positions @ self.rotation_y_up_file / self.unit_m


def get_file_frame(take: Take) -> FileFrame:
    """Return the unit and axes in which a take is written, so that it can be compared with the file that it was read from.

    These are the unit and axes of that file; millimetres if its unit is not one of mm, cm and m; and millimetres with Z up, the
    convention of laboratories, if the take has no file.
    """
    if take.layout is None:
        return FileFrame("mm", 0.001, ROTATION_Y_UP_FROM_Z_UP)
    unit_m = take.layout.unit_m if take.layout.unit_m in C3D_UNIT_NAMES else 0.001
    return FileFrame(C3D_UNIT_NAMES[unit_m], unit_m, take.layout.rotation_y_up_file)


def open_source(target: Path, source: Path | None, labelled_file: bytes | None = None) -> BinaryIO:
    """Return the file of which `target` will be a changed copy, or its bytes with labels.

    Raises:
        WriteError: If there is no source file, it is `target`, or it is no longer readable.
    """
    if source is None:
        raise WriteError(f"{target}: there is no source file of which it could be a changed copy.")
    try:
        if target.exists() and target.samefile(source):
            raise WriteError(f"{target}: is the input itself, which is never changed; choose another folder with --out.")
        return source.open("rb") if labelled_file is None else BytesIO(labelled_file)
    except OSError as error:
        raise WriteError(f"{source}: can no longer be read ({error.strerror}); restore it.") from error


def build_truncated_error(source: Path | None) -> WriteError:
    """Return the error that an input file has become shorter since it was read."""
    return WriteError(f"{source}: has become shorter since it was read; clean it again.")


def append_computed_points(take: Take) -> Take:
    """Return the take with its computed points as further markers, as they are written to a copy of its file."""
    computed = take.computed_points
    if computed is None:
        return take
    return replace(
        take,
        markers=np.concatenate([take.markers, computed.take.markers], axis=1),
        labels=(*take.labels, *computed.take.labels),
        point_columns=np.concatenate([take.point_indices, computed.take.point_indices]),
        sample_sd=np.concatenate([take.estimated_sd, computed.take.estimated_sd], axis=1),
        computed=None,
        uncaptured=None,
        relabelled_points=np.concatenate([take.source_points, computed.take.source_points], axis=1),
        computed_points=None,
    )


def find_relabelled_samples(before: Take, after: Take) -> Bool[np.ndarray, "T M"]:
    """Return which samples of `after` are measured ones that come from another point of the file than in `before`."""
    return after.visible & (after.source_points != before.source_points) & np.isnan(after.estimated_sd)


def find_changed_samples(before: Take, after: Take) -> Bool[np.ndarray, "T M"]:
    """Return the samples whose coordinates differ in any bit. All NaNs are equal."""
    a, b = before.markers, after.markers
    is_same = (a == b) & (np.signbit(a) == np.signbit(b)) | np.isnan(a) & np.isnan(b)
    return ~(is_same[..., 0] & is_same[..., 1] & is_same[..., 2])


def find_assigned_points(before: Take, after: Take) -> tuple[Int[np.ndarray, " N"], Int[np.ndarray, " N"]]:
    """Return frame and point of the unlabelled samples that were assigned to a marker."""
    if before.unlabelled is None or after.unlabelled is None:
        return np.zeros(0, int), np.zeros(0, int)
    frames, points = np.nonzero(before.unlabelled.visible & ~after.unlabelled.visible)
    return frames, before.unlabelled.point_columns[points]


MAX_WRITTEN_DECIMALS = 15


def format_rows(values: Float[np.ndarray, "T C"], decimals: int) -> bytes:
    """Return one line of text for each row, with a blank between its numbers.

    Numbers are exactly those of f"{value:.6f}" with `decimals` (0 to 15) decimals, including the sign of -0.0.

    Raises:
        ValueError: If a number is not finite.
    """
    values = np.ascontiguousarray(values, float)
    if not np.isfinite(values).all():
        raise ValueError("a number that is not finite cannot be written")
    power = 10.0**decimals
    if values.size == 0 or decimals > MAX_WRITTEN_DECIMALS or np.abs(values).max() >= MAX_EXACT_PRODUCT / power:
        template = " ".join([f"%.{decimals}f"] * values.shape[1]) + "\n"
        return "".join([template % tuple(row) for row in values.tolist()]).encode()
    separator, line_end = (np.frombuffer(text, np.uint8) for text in (b" ", b"\n"))
    out = np.empty(values.size * (INTEGER_PART_BYTES + decimals + 1) + len(values), np.uint8)
    return out[: write_rows(values, decimals, power, separator, line_end, out)].tobytes()
