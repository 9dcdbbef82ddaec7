"""Which way is up in a capture: laboratories write Z up, animation tools Y up, a few X up."""

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mocapfix.take import Take

# MERGED: mocapfix.read.axes
# Rotations of file axes to Y up; all are proper, so left stays left. Z up: (x, y, z) -> (y, z, x), as CMU's releases.
ROTATIONS_TO_Y_UP = {"X": np.eye(3)[[2, 0, 1]], "Y": np.eye(3), "Z": np.eye(3)[[1, 2, 0]]}
HEAD_LABEL_PATTERN = re.compile(r"head|[fb]hd$|hd[fb]$|ariel|c7$|cv7$|clav|sho$|shoulder", re.IGNORECASE)
FOOT_LABEL_PATTERN = re.compile(r"toe|hee$|hel$|heel|ank|mt[125]$|foot|fcc$|fm[125]$|cal$", re.IGNORECASE)
MIN_HEAD_ABOVE_FEET_M = 0.3  # metres: heads above feet by less than this say nothing
MIN_HEIGHT_RATIO = 1.5  # arms held sideways make a person nearly as wide as tall; the usual axis has the doubt
MAX_INSPECTED_FRAMES = 200


def estimate_rotation_y_up(
    screen_axis: str, labels: Sequence[str], positions: np.ndarray, default_up_axis: str = "Z"
) -> np.ndarray:
    """-> (3, 3) rotation, file axes -> Y up.

    vertical   the file's POINT:Y_SCREEN ("+Z"); its sign tells the viewer's side, not where the sky is (Qualisys
               writes -Z on Z-up data), so only the letter counts
    labels     M marker labels
    positions  (T, M, 3) metres in the file's axes, NaN where not seen; asked where `vertical` says nothing
    usual      "Y" or "Z": the axis that is up in most files of the kind
    """
    letter = screen_axis[-1:]
    return ROTATIONS_TO_Y_UP[
        letter
        if letter in ROTATIONS_TO_Y_UP
        else _estimate_up_axis(labels, positions[:: max(1, len(positions) // MAX_INSPECTED_FRAMES)], default_up_axis)
    ]


def rotate_to_up_axis(take: Take, up_axis: str) -> Take:
    """-> the take as if its file's axis `up` ("X", "Y" or "Z") pointed to the sky, whatever was told from the file."""
    axes = ROTATIONS_TO_Y_UP[up_axis]
    turn = axes if take.layout is None else axes @ take.layout.rotation_y_up_file.T  # without a layout the file's axes are Y up
    loose = take.unlabelled
    return replace(
        take,
        markers=take.markers @ turn.T,
        layout=take.layout and replace(take.layout, rotation_y_up_file=axes),
        unlabelled=loose and replace(loose, markers=loose.markers @ turn.T),
    )


def _estimate_up_axis(labels: Sequence[str], positions: np.ndarray, usual: str) -> str:
    """The axis along which heads lie above feet; where the labels do not say, the one along which the body is tallest."""
    rise = np.abs(_compute_head_above_feet(labels, positions))
    if rise.max() > MIN_HEAD_ABOVE_FEET_M:
        return "XYZ"[rise.argmax()]
    some = positions[np.isfinite(positions[..., 0]).any(1)]
    if not len(some):
        return usual
    tall = dict(zip("XYZ", np.median(np.nanmax(some, axis=1) - np.nanmin(some, axis=1), axis=0), strict=True))
    other = "Y" if usual == "Z" else "Z"
    return other if tall[other] > MIN_HEIGHT_RATIO * tall[usual] else usual


def _compute_head_above_feet(labels: Sequence[str], positions: np.ndarray) -> np.ndarray:
    """(3,) the median way from the foot markers to the head markers, over the frames that show both; else zero."""
    seen = np.isfinite(positions[..., 0])
    high, low = (
        np.array([bool(kind.search(label)) for label in labels], bool) for kind in (HEAD_LABEL_PATTERN, FOOT_LABEL_PATTERN)
    )
    both = seen[:, high].any(1) & seen[:, low].any(1)
    if not both.any():
        return np.zeros(3)
    heads, feet = (np.nanmean(positions[both][:, kind], axis=1) for kind in (high, low))
    return np.median(heads - feet, axis=0)


# MERGED: mocapfix.read.places
# Which coordinates of a file are a place, and which say that there is none.
INVALID_COORDINATE_LIMIT = 9_000_000  # file units; Cortex writes 9999999 for an occluded marker
MISSING_CODE_LIMIT = 9999  # file units; three times the same from there on is no place: -9999.99


def find_valid_points(xyz: np.ndarray) -> np.ndarray:
    """-> (T, P) bool: is each point of `xyz` (T, P, 3) in file units a place? Neither NaN, nor all 0, nor all nines."""
    x, y, z = np.moveaxis(xyz, -1, 0)
    alike = (x == y) & (y == z)
    near = (
        (np.abs(x) < INVALID_COORDINATE_LIMIT) & (np.abs(y) < INVALID_COORDINATE_LIMIT) & (np.abs(z) < INVALID_COORDINATE_LIMIT)
    )
    return near & ~(alike & ((x == 0) | (np.abs(x) >= MISSING_CODE_LIMIT)))


# MERGED: mocapfix.read.units
# The units of length that files name, and how long they are.
METRES_PER_UNIT = {"mm": 0.001, "cm": 0.01, "m": 1.0, "in": 0.0254, "ft": 0.3048}
# What a unit is called where it is written out, "Millimetres" or "Meters", without its plural.
UNIT_ABBREVIATIONS = {"millimeter": "mm", "millimetre": "mm", "centimeter": "cm", "centimetre": "cm", "meter": "m", "metre": "m"}
UNIT_ABBREVIATIONS |= {"inche": "in", "inch": "in", "foot": "ft", "feet": "ft"}


def get_metres_per_unit(name: str) -> float | None:
    """-> metres in the unit of that name, short or written out, in either case; None where it is none."""
    plain = name.strip().lower()
    return METRES_PER_UNIT.get(UNIT_ABBREVIATIONS.get(plain.removesuffix("s"), plain))
