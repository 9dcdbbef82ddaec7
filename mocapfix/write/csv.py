"""A take's markers as a plain CSV: what spreadsheets, pandas, MATLAB and R read without being told anything."""

import csv as rows
from pathlib import Path

from mocapfix.files import replacing
from mocapfix.take import Take
from mocapfix.write.own import DECIMALS, own
from mocapfix.write.trc import cells_of


def csv(target: str | Path, take: Take) -> None:
    """Write one line of column names, then a line a frame: frame, time_s, and LABEL_X_mm, LABEL_Y_mm, LABEL_Z_mm for every
    labelled marker, in the unit (mm, cm or m) and axes that the take's own file had; blank where missing.

    Frames keep the file's numbers, and the time of the first one is 0. UTF-8, commas, decimal points.

    Raises WriteError where `target` cannot be written.
    """
    form = own(take)
    with replacing(Path(target)) as part, part.open("w", encoding="utf-8", newline="") as file:
        writer = rows.writer(file, lineterminator="\n")
        labels = (" ".join(label.split()) for label in take.labels)  # one that holds a line's end would end the line of names
        writer.writerow(["frame", "time_s", *(f"{label}_{axis}_{form.name}" for label in labels for axis in "XYZ")])
        for t, row in enumerate(form.coordinates(take.markers).reshape(take.frames, -1).tolist()):
            writer.writerow([take.frame_number(t), f"{t / take.rate:.6f}", *cells_of(row, DECIMALS[form.name])])
