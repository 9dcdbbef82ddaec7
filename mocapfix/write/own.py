"""The unit and axes in which a take is written: those of the file it came from, so that both can be laid side by side."""

from dataclasses import dataclass

import numpy as np

from mocapfix.take import Take

NAMES = {0.001: "mm", 0.01: "cm", 1.0: "m"}
DECIMALS = {"mm": 5, "cm": 6, "m": 8}  # of a number in a text: a hundred-millionth of a metre
Z_UP = np.eye(3)[[1, 2, 0]]  # file axes -> Y up


@dataclass(frozen=True)
class Own:
    """A unit and axes: name mm, cm or m; unit metres in it; axes (3, 3) rotation, file axes -> Y up."""

    name: str
    unit: float
    axes: np.ndarray

    def coordinates(self, markers: np.ndarray) -> np.ndarray:
        """-> (..., 3) in the unit and axes, of metres, Y up."""
        return markers @ self.axes / self.unit


def own(take: Take) -> Own:
    """-> the unit and axes of the file that a take came from; millimetres for one that had another unit than a C3D may have,
    millimetres and Z up, as laboratories have them, for a take from no file."""
    if take.layout is None:
        return Own("mm", 0.001, Z_UP)
    unit = take.layout.unit if take.layout.unit in NAMES else 0.001
    return Own(NAMES[unit], unit, take.layout.axes)
