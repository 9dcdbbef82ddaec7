"""Coordinates in files: units of length, codes for missing points, and the up axis."""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from mocapfix.take import Take, UpAxis

METRES_PER_UNIT = {"mm": 0.001, "cm": 0.01, "m": 1.0, "in": 0.0254, "ft": 0.3048}
# Abbreviations of unit names without the plural s: "Millimetres", "Meters", "Inches".
UNIT_ABBREVIATIONS = {
    "millimeter": "mm",
    "millimetre": "mm",
    "centimeter": "cm",
    "centimetre": "cm",
    "meter": "m",
    "metre": "m",
    "inche": "in",
    "inch": "in",
    "foot": "ft",
    "feet": "ft",
}

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
    """Return the metres in a unit, given by its name or abbreviation in any case; None if the unit is unknown."""
    singular = name.strip().lower()
    return METRES_PER_UNIT.get(UNIT_ABBREVIATIONS.get(singular.removesuffix("s"), singular))


def find_valid_points(points_file: Float[np.ndarray, "T P 3"]) -> Bool[np.ndarray, "T P"]:
    """Return which points, in file units, are positions: not NaN, not all 0, and not a code for a missing point."""
    x, y, z = np.moveaxis(points_file, -1, 0)
    equal = (x == y) & (y == z)
    in_range = (
        (np.abs(x) < INVALID_COORDINATE_LIMIT) & (np.abs(y) < INVALID_COORDINATE_LIMIT) & (np.abs(z) < INVALID_COORDINATE_LIMIT)
    )
    return in_range & ~(equal & ((x == 0) | (np.abs(x) >= MISSING_CODE_LIMIT)))


def rotate_to_up_axis(take: Take, up_axis: str) -> Take:
    """Return the take as it reads if the file's axis `up_axis` ("X", "-X", "Y", ...) points up."""
    rotation_y_up_file = ROTATIONS_TO_Y_UP[up_axis]
    # Without a layout the file axes are Y up.
    rotation = rotation_y_up_file if take.layout is None else rotation_y_up_file @ take.layout.rotation_y_up_file.T
    unlabelled, computed = take.unlabelled, take.computed_points
    rotated = computed and replace(computed.take, markers=computed.take.markers @ rotation.T)
    return replace(
        take,
        up_axis=UpAxis(up_axis, "the option --up"),
        markers=take.markers @ rotation.T,
        layout=take.layout and replace(take.layout, rotation_y_up_file=rotation_y_up_file),
        unlabelled=unlabelled and replace(unlabelled, markers=unlabelled.markers @ rotation.T),
        computed_points=computed and rotated and replace(computed, take=rotated),
    )
