"""Coordinates in files: units of length, codes for missing points, and the up axis."""

import numpy as np
from jaxtyping import Bool, Float

METRES_PER_UNIT = {"mm": 0.001, "cm": 0.01, "m": 1.0, "in": 0.0254, "ft": 0.3048}
# Names of units, of which a file may have the first letters only: the field for POINT:UNITS often has four characters.
UNIT_NAMES = {
    "millimeters": "mm",
    "millimetres": "mm",
    "centimeters": "cm",
    "centimetres": "cm",
    "meters": "m",
    "metres": "m",
    "mtrs": "m",
    "inches": "in",
    "foot": "ft",
    "feet": "ft",
}
MIN_UNIT_LETTERS = 3  # of a name that was cut off

INVALID_COORDINATE_LIMIT = 9_000_000  # file units; a coordinate from here on is missing: Cortex writes 9999999
MISSING_CODE_LIMIT = 9999  # file units; three equal coordinates from here on are missing, such as -9999.99

# Rotations of file axes to Y-up axes, by the up axis. All are proper. Z up: (x, y, z) -> (y, z, x), as in CMU's releases.
# Y down: (x, y, z) -> (x, -y, -z), which makes a camera's axes those of an image whose Y points up.
ROTATIONS_TO_Y_UP = {
    "X": np.eye(3)[[2, 0, 1]],
    "-X": np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]),
    "Y": np.eye(3),
    "-Y": np.diag([1.0, -1, -1]),
    "Z": np.eye(3)[[1, 2, 0]],
    "-Z": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
}


def get_metres_per_unit(name: str) -> float | None:
    """Return the metres in a unit, given by its abbreviation or its name, which may be cut off, in any case; None if unknown."""
    text = name.strip().lower().rstrip(".")
    found = {unit for full, unit in UNIT_NAMES.items() if len(text) >= MIN_UNIT_LETTERS and full.startswith(text)}
    return METRES_PER_UNIT.get(found.pop() if len(found) == 1 else text)


def format_length(length_m: float) -> str:
    """Return a length with three significant digits, a large one without an exponent."""
    return f"{float(f'{length_m:.3g}'):,.15g} m"


def find_valid_points(points_file: Float[np.ndarray, "T P 3"]) -> Bool[np.ndarray, "T P"]:
    """Return which points, in file units, are positions: not NaN, not all 0, and not a code for a missing point."""
    x, y, z = np.moveaxis(points_file, -1, 0)
    equal = (x == y) & (y == z)
    in_range = (
        (np.abs(x) < INVALID_COORDINATE_LIMIT) & (np.abs(y) < INVALID_COORDINATE_LIMIT) & (np.abs(z) < INVALID_COORDINATE_LIMIT)
    )
    return in_range & ~(equal & ((x == 0) | (np.abs(x) >= MISSING_CODE_LIMIT)))
