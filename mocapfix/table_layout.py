"""Where each sample of a text file lies in its lines: what reading and patching must agree upon."""

from dataclasses import dataclass, field

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
    unit: float  # metres per file unit
    lines: np.ndarray = field(default_factory=lambda: np.zeros(0, int))  # (T,) index of each frame's line in the file
    fields: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), int))  # (P, 3) of a line, with a point's x, y, z
    style: str = ".6f"  # how a coordinate is written, as in format()
    missing: str = ""  # how a coordinate that is not there is written: "", "NaN", "0.000"
    axes: np.ndarray = field(default_factory=lambda: np.eye(3))  # rotation: file axes -> Y up

    @property
    def has_places(self) -> bool:
        """Is there a place in the file for every sample? Not where its lines list only what was seen."""
        return len(self.fields) > 0

    def text(self, coordinate: float) -> str:
        """-> a coordinate in file units as the file writes it; NaN is missing."""
        if coordinate != coordinate:
            return self.missing
        return format(coordinate, self.style).replace(".", self.decimal)
