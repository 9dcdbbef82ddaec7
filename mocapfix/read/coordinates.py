"""Coordinates in files: units of length, codes for missing points, and the up axis."""

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from mocapfix.take import Take

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
ROTATIONS_TO_Y_UP = {"X": np.eye(3)[[2, 0, 1]], "Y": np.eye(3), "Z": np.eye(3)[[1, 2, 0]]}
HEAD_LABEL_PATTERN = re.compile(r"head|[fb]hd$|hd[fb]$|ariel|c7$|cv7$|clav|sho$|shoulder", re.IGNORECASE)
FOOT_LABEL_PATTERN = re.compile(r"toe|hee$|hel$|heel|ank|mt[125]$|foot|fcc$|fm[125]$|cal$", re.IGNORECASE)
MIN_HEAD_ABOVE_FEET_M = 0.3  # median distance of head and foot markers along the up axis; less is not conclusive
MIN_HEIGHT_RATIO = 1.5  # of the extents along the other and the default axis; with arms out a person is nearly as wide as tall
MAX_INSPECTED_FRAMES = 200  # frames from which the up axis is estimated


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


def estimate_rotation_y_up(
    screen_axis: str, labels: Sequence[str], positions_file: Float[np.ndarray, "T M 3"], default_up_axis: str = "Z"
) -> Float[np.ndarray, "3 3"]:
    """Estimate the rotation from file axes to Y-up axes.

    Args:
        screen_axis: POINT:Y_SCREEN of a C3D file, such as "+Z", or "". Only its letter is used: the sign gives the viewer's
            side rather than the up direction, and Qualisys writes -Z on Z-up data.
        labels: Marker labels.
        positions_file: Positions (m) in file axes, NaN where missing. Used if `screen_axis` names no axis.
        default_up_axis: "Y" or "Z", the up axis of most files of the format.
    """
    letter = screen_axis[-1:]
    if letter not in ROTATIONS_TO_Y_UP:
        step = max(1, len(positions_file) // MAX_INSPECTED_FRAMES)
        letter = _estimate_up_axis(labels, positions_file[::step], default_up_axis)
    return ROTATIONS_TO_Y_UP[letter]


def rotate_to_up_axis(take: Take, up_axis: str) -> Take:
    """Return the take as it reads if the file's axis `up_axis` ("X", "Y" or "Z") points up."""
    rotation_y_up_file = ROTATIONS_TO_Y_UP[up_axis]
    # Without a layout the file axes are Y up.
    rotation = rotation_y_up_file if take.layout is None else rotation_y_up_file @ take.layout.rotation_y_up_file.T
    unlabelled, computed = take.unlabelled, take.computed_points
    rotated = computed and replace(computed.take, markers=computed.take.markers @ rotation.T)
    return replace(
        take,
        markers=take.markers @ rotation.T,
        layout=take.layout and replace(take.layout, rotation_y_up_file=rotation_y_up_file),
        unlabelled=unlabelled and replace(unlabelled, markers=unlabelled.markers @ rotation.T),
        computed_points=computed and rotated and replace(computed, take=rotated),
    )


def _estimate_up_axis(labels: Sequence[str], positions_file: Float[np.ndarray, "T M 3"], default_up_axis: str) -> str:
    """Return the axis along which heads are above feet; if the labels do not show it, the axis of the largest extent."""
    head_above_feet = np.abs(_compute_head_above_feet(labels, positions_file))
    if head_above_feet.max() > MIN_HEAD_ABOVE_FEET_M:
        return "XYZ"[head_above_feet.argmax()]
    visible = positions_file[np.isfinite(positions_file[..., 0]).any(1)]
    if not len(visible):
        return default_up_axis
    extents = dict(zip("XYZ", np.median(np.nanmax(visible, axis=1) - np.nanmin(visible, axis=1), axis=0), strict=True))
    other = "Y" if default_up_axis == "Z" else "Z"
    return other if extents[other] > MIN_HEIGHT_RATIO * extents[default_up_axis] else default_up_axis


def _compute_head_above_feet(labels: Sequence[str], positions_file: Float[np.ndarray, "T M 3"]) -> Float[np.ndarray, " 3"]:
    """Return the median vector (m) from the foot to the head markers over frames that show both; zero if there are none."""
    visible = np.isfinite(positions_file[..., 0])
    is_head = np.array([bool(HEAD_LABEL_PATTERN.search(label)) for label in labels], bool)
    is_foot = np.array([bool(FOOT_LABEL_PATTERN.search(label)) for label in labels], bool)
    both = visible[:, is_head].any(1) & visible[:, is_foot].any(1)
    if not both.any():
        return np.zeros(3)
    heads, feet = np.nanmean(positions_file[both][:, is_head], axis=1), np.nanmean(positions_file[both][:, is_foot], axis=1)
    return np.median(heads - feet, axis=0)
