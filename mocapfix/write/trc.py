"""A take's markers as a TRC, the text file that OpenSim, Cortex, MotionBuilder and Mokka read."""

from pathlib import Path

import numpy as np

from mocapfix.files import replacing
from mocapfix.take import Take
from mocapfix.write.own import DECIMALS, own

FACTS = ["DataRate", "CameraRate", "NumFrames", "NumMarkers", "Units", "OrigDataRate", "OrigDataStartFrame", "OrigNumFrames"]


def trc(target: str | Path, take: Take) -> None:
    """Write the labelled markers, in the unit and axes that the take's own file had, tabs between fields, blanks for what is
    missing. Frames keep the file's numbers, and times count from frame 1 (from frame 0, where the file does).

    Raises WriteError where `target` cannot be written.
    """
    target, form = Path(target), own(take)
    rate, first, frames = _rate(take.rate), take.first_frame, take.frames
    labels = [" ".join(label.split()) for label in take.labels]
    facts = [rate, rate, str(frames), str(len(labels)), form.name, rate, str(first), str(frames)]
    numbers = range(1, len(labels) + 1)
    head = [
        ["PathFileType", "4", "(X/Y/Z)", target.name],
        FACTS,
        facts,
        ["Frame#", "Time", *(cell for label in labels for cell in (label, "", ""))],
        ["", "", *(f"{axis}{i}" for i in numbers for axis in "XYZ")],
        [""],
    ]
    with replacing(target) as part, part.open("w", encoding="utf-8", newline="") as file:
        file.writelines("\t".join(row) + "\r\n" for row in head)
        for t, row in enumerate(form.coordinates(take.markers).reshape(frames, -1).tolist()):
            number = first + t
            cells = cells_of(row, DECIMALS[form.name])
            file.write("\t".join([str(number), f"{(number - min(1, first)) / take.rate:.6f}", *cells]) + "\r\n")


def cells_of(row: list[float], decimals: int) -> list[str]:
    """-> numbers as text, blank where NaN."""
    return ["" if x != x else f"{x:.{decimals}f}" for x in row]


def _rate(rate: float) -> str:
    """-> with two decimals, as everybody writes it, where those are enough."""
    return f"{rate:.2f}" if np.isclose(rate, round(rate, 2), rtol=1e-9) else f"{rate:.6f}"
