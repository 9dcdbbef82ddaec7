"""Where each sample of a text file lies in its lines: what reading and patching must agree upon."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class TableLayout:
    """The geometry of a table of trajectories, a line a frame, and the map from its coordinates to mocapfix's.

    A point is three fields of each frame's line. mocapfix's metres, Y up, are `axes @ xyz * unit`, and the file's own
    `axes.T @ markers / unit`.
    """

    encoding: str  # of the file; a byte-order mark is the first character of its text
    newline: str  # between lines; of "\r\n" the "\r" is each line's last character
    delimiter: str  # between fields
    decimal: str  # the decimal sign: "." or ","
    lines: np.ndarray  # (T,) index of each frame's line in the file
    fields: np.ndarray  # (P, 3) index of each point's x, y and z among a line's fields
    style: str  # how a coordinate is written, as in format(): ".5f"
    missing: str  # how a coordinate that is not there is written: "", "NaN", "0.000"
    unit: float  # metres per file unit
    axes: np.ndarray  # (3, 3) rotation: file axes -> Y up

    def text(self, coordinate: float) -> str:
        """-> a coordinate in file units as the file writes it; NaN is missing."""
        if np.isnan(coordinate):
            return self.missing
        return format(coordinate, self.style).replace(".", self.decimal)
