"""A take's markers as a TRC, the text file that OpenSim, Cortex, MotionBuilder and Mokka read."""

import csv as rows
from pathlib import Path

import numpy as np

from mocapfix.files.output_files import replace_atomically
from mocapfix.take import Take
from mocapfix.write.source_file import DECIMALS_BY_UNIT, get_file_frame

# MERGED: mocapfix.write.trc
HEADER_KEYS = [
    "DataRate",
    "CameraRate",
    "NumFrames",
    "NumMarkers",
    "Units",
    "OrigDataRate",
    "OrigDataStartFrame",
    "OrigNumFrames",
]


def write_trc(target: str | Path, take: Take) -> None:
    """Write the labelled markers, in the unit and axes that the take's own file had, tabs between fields, blanks for what is
    missing. Frames keep the file's numbers, and times count from frame 1 (from frame 0, where the file does).

    Raises WriteError where `target` cannot be written.
    """
    target, form = Path(target), get_file_frame(take)
    rate, first, frames = _format_rate(take.rate), take.first_frame, take.frame_count
    labels = [" ".join(label.split()) for label in take.labels]
    facts = [rate, rate, str(frames), str(len(labels)), form.unit_name, rate, str(first), str(frames)]
    numbers = range(1, len(labels) + 1)
    head = [
        ["PathFileType", "4", "(X/Y/Z)", target.name],
        HEADER_KEYS,
        facts,
        ["Frame#", "Time", *(cell for label in labels for cell in (label, "", ""))],
        ["", "", *(f"{axis}{i}" for i in numbers for axis in "XYZ")],
        [""],
    ]
    with replace_atomically(target) as part, part.open("w", encoding="utf-8", newline="") as file:
        file.writelines("\t".join(row) + "\r\n" for row in head)
        for t, row in enumerate(form.compute_coordinates(take.markers).reshape(frames, -1).tolist()):
            number = first + t
            cells = format_cells(row, DECIMALS_BY_UNIT[form.unit_name])
            file.write("\t".join([str(number), f"{(number - min(1, first)) / take.rate:.6f}", *cells]) + "\r\n")


def format_cells(row: list[float], decimals: int) -> list[str]:
    """-> numbers as text, blank where NaN."""
    return ["" if x != x else f"{x:.{decimals}f}" for x in row]


def _format_rate(rate: float) -> str:
    """-> with two decimals, as everybody writes it, where those are enough."""
    return f"{rate:.2f}" if np.isclose(rate, round(rate, 2), rtol=1e-9) else f"{rate:.6f}"


# MERGED: mocapfix.write.csv
# A take's markers as a plain CSV: what spreadsheets, pandas, MATLAB and R read without being told anything.
def write_csv(target: str | Path, take: Take) -> None:
    """Write one line of column names, then a line a frame: frame, time_s, and LABEL_X_mm, LABEL_Y_mm, LABEL_Z_mm for every
    labelled marker, in the unit (mm, cm or m) and axes that the take's own file had; blank where missing.

    Frames keep the file's numbers, and the time of the first one is 0. UTF-8, commas, decimal points.

    Raises WriteError where `target` cannot be written.
    """
    form = get_file_frame(take)
    with replace_atomically(Path(target)) as part, part.open("w", encoding="utf-8", newline="") as file:
        writer = rows.writer(file, lineterminator="\n")
        labels = (" ".join(label.split()) for label in take.labels)  # one that holds a line's end would end the line of names
        writer.writerow(["frame", "time_s", *(f"{label}_{axis}_{form.unit_name}" for label in labels for axis in "XYZ")])
        for t, row in enumerate(form.compute_coordinates(take.markers).reshape(take.frame_count, -1).tolist()):
            writer.writerow(
                [take.get_frame_number(t), f"{t / take.rate:.6f}", *format_cells(row, DECIMALS_BY_UNIT[form.unit_name])]
            )
