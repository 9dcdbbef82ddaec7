"""Write takes as tables of text: TRC and CSV, with a fixed number of decimals."""

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from mocapfix.files.output_files import replace_atomically
from mocapfix.kernels.text_numbers import INTEGER_PART_BYTES, MAX_EXACT_PRODUCT, write_rows
from mocapfix.take import Take
from mocapfix.write.source_file import DECIMALS_BY_UNIT, get_file_frame

MAX_WRITTEN_DECIMALS = 15


def format_rows(values: Float[np.ndarray, "T C"], decimals: int, separator: str = " ", line_end: str = "\n") -> bytes:
    """Return one line of text for each row.

    Numbers are exactly those of f"{value:.6f}" with `decimals` (0 to 15) decimals, including the sign of -0.0.

    Raises:
        ValueError: If a number is not finite.
    """
    values = np.ascontiguousarray(values, float)
    if not np.isfinite(values).all():
        raise ValueError("a number that is not finite cannot be written")
    power = 10.0**decimals
    if values.size == 0 or decimals > MAX_WRITTEN_DECIMALS or np.abs(values).max() >= MAX_EXACT_PRODUCT / power:
        template = separator.join([f"%.{decimals}f"] * values.shape[1]) + line_end
        return "".join([template % tuple(row) for row in values.tolist()]).encode()
    separator_bytes = np.frombuffer(separator.encode(), np.uint8)
    line_end_bytes = np.frombuffer(line_end.encode(), np.uint8)
    size = values.size * (INTEGER_PART_BYTES + decimals + len(separator_bytes)) + len(values) * len(line_end_bytes)
    out = np.empty(size, np.uint8)
    return out[: write_rows(values, decimals, power, separator_bytes, line_end_bytes, out)].tobytes()


TRC_HEADER_KEYS = (
    "DataRate",
    "CameraRate",
    "NumFrames",
    "NumMarkers",
    "Units",
    "OrigDataRate",
    "OrigDataStartFrame",
    "OrigNumFrames",
)


def write_trc(target: str | Path, take: Take) -> None:
    """Write the labelled markers as TRC, which OpenSim, Cortex, MotionBuilder and Mokka read.

    The file has the unit and axes of the source file, tabs between fields, and blanks for missing samples. Frames keep their
    numbers. Times count from frame 1, or from frame 0 if the take begins there.

    Raises:
        WriteError: If `target` is not writable.
    """
    target, frame = Path(target), get_file_frame(take)
    rate, first = _format_rate(take.rate), take.first_frame
    labels = [" ".join(label.split()) for label in take.labels]
    count, marker_count = str(take.frame_count), str(len(labels))
    header = [
        ["PathFileType", "4", "(X/Y/Z)", target.name],
        TRC_HEADER_KEYS,
        [rate, rate, count, marker_count, frame.unit_name, rate, str(first), count],
        ["Frame#", "Time", *(cell for label in labels for cell in (label, "", ""))],
        ["", "", *(f"{axis}{i}" for i in range(1, len(labels) + 1) for axis in "XYZ")],
        [""],
    ]
    coordinates = frame.compute_coordinates(take.markers).reshape(take.frame_count, -1)
    with replace_atomically(target) as part, part.open("w", encoding="utf-8", newline="") as file:
        file.writelines("\t".join(row) + "\r\n" for row in header)
        for t, row in enumerate(coordinates.tolist()):
            number = first + t
            time_s = (number - min(1, first)) / take.rate
            cells = format_cells(row, DECIMALS_BY_UNIT[frame.unit_name])
            file.write("\t".join([str(number), f"{time_s:.6f}", *cells]) + "\r\n")


def write_csv(target: str | Path, take: Take) -> None:
    """Write the labelled markers as plain CSV: a line of column names, then one line per frame.

    Columns are frame, time_s, and LABEL_X_mm, LABEL_Y_mm, LABEL_Z_mm of each marker, in the unit (mm, cm or m) and axes of the
    source file. Missing samples are blank. Frames keep their numbers, and the time of the first one is 0. The file is UTF-8 with
    commas and decimal points.

    Raises:
        WriteError: If `target` is not writable.
    """
    frame = get_file_frame(take)
    labels = [" ".join(label.split()) for label in take.labels]  # a label must not contain a line end
    coordinates = frame.compute_coordinates(take.markers).reshape(take.frame_count, -1)
    with replace_atomically(Path(target)) as part, part.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["frame", "time_s", *(f"{label}_{axis}_{frame.unit_name}" for label in labels for axis in "XYZ")])
        for t, row in enumerate(coordinates.tolist()):
            cells = format_cells(row, DECIMALS_BY_UNIT[frame.unit_name])
            writer.writerow([take.get_frame_number(t), f"{t / take.rate:.6f}", *cells])


def format_cells(row: Sequence[float], decimals: int) -> list[str]:
    """Return numbers as text, "" for NaN."""
    return ["" if x != x else f"{x:.{decimals}f}" for x in row]


def _format_rate(rate: float) -> str:
    """Return a rate with two decimals, as is usual, if these suffice, else with six."""
    return f"{rate:.2f}" if np.isclose(rate, round(rate, 2), rtol=1e-9) else f"{rate:.6f}"
