"""What a file of bones does not say: how long its unit is, and which way is up. Both are told from the figure, and said."""

import re
from dataclasses import replace

import numpy as np

from mocapfix.animation import Animation
from mocapfix.read.coordinates import ROTATIONS_TO_Y_UP

# MERGED: mocapfix.read.figure
HEAD_JOINT_PATTERN = re.compile(r"head|skull", re.IGNORECASE)
FOOT_JOINT_PATTERN = re.compile(r"foot|feet|ankle|toe", re.IGNORECASE)
PERSON_HEIGHT_RANGE_M = (1.2, 2.2)  # metres: people
REACH_TO_HEIGHT_RATIO = 1.42  # of a person's height: the way along the bones from the tips of the fingers to those of the toes
CANDIDATE_UNITS_M = {
    "centimetres": 0.01,
    "metres": 1.0,
    "millimetres": 0.001,
    "CMU's units of 1/0.45 inch": 0.0254 / 0.45,
    "inches": 0.0254,
}
MIN_UP_AXIS_COSINE = 0.8  # cosine of the angle within which a body that stands is along an axis


def infer_unit(animation: Animation) -> Animation:
    """-> the animation with the unit by which its figure is as tall as people are: its own where that does, else the first
    of UNITS; its own where none does. A note says which unless they are centimetres."""
    reach = compute_reach(animation)
    fitting = {
        name: unit
        for name, unit in CANDIDATE_UNITS_M.items()
        if PERSON_HEIGHT_RANGE_M[0] <= reach * unit / REACH_TO_HEIGHT_RATIO <= PERSON_HEIGHT_RANGE_M[1]
    }
    if PERSON_HEIGHT_RANGE_M[0] <= reach * animation.unit_m / REACH_TO_HEIGHT_RATIO <= PERSON_HEIGHT_RANGE_M[1]:
        return animation
    if not fitting:
        tall = f"{reach * animation.unit_m / REACH_TO_HEIGHT_RATIO:.2g} m tall"
        note = f"Its unit of length is not said; it was taken as {animation.unit_m * 100:.4g} cm: the figure is {tall}."
        return replace(animation, notes=(*animation.notes, note))
    name, unit = next(iter(fitting.items()))
    note = f"Lengths were taken as {name}, by which the figure is {reach * unit / REACH_TO_HEIGHT_RATIO:.2f} m tall."
    return replace(animation, unit_m=unit, notes=(*animation.notes, note))


def compute_reach(animation: Animation) -> float:
    """-> the longest way along the bones from one tip of the figure to another, in the file's units."""
    deep = np.array([np.linalg.norm(ends, axis=1).max(initial=0.0) for ends in animation.end_sites])
    longest = deep.copy()
    for joint in range(len(deep) - 1, 0, -1):
        parent, way = animation.parents[joint], deep[joint] + np.linalg.norm(animation.offsets[joint])
        longest[parent] = max(longest[parent], longest[joint], deep[parent] + way)
        deep[parent] = max(deep[parent], way)
    return float(longest[0])


def infer_up_axis(animation: Animation) -> Animation:
    """-> the animation with Y up, as most are, or Z up where its head is above its feet along Z: most of the time, or, where
    it does not stand most of the time, in the rest pose. A note says so."""
    head = [j for j, name in enumerate(animation.names) if HEAD_JOINT_PATTERN.search(name)][:1]
    feet = [j for j, name in enumerate(animation.names) if FOOT_JOINT_PATTERN.search(name)]
    if not head or not feet:
        return animation
    few = animation.replace_values(animation.values[:: max(1, animation.frame_count // 200)])
    for positions in (few.compute_world_poses()[0], animation.compute_rest_positions()[None]):
        ways = positions[:, head[0]] - positions[:, feet].mean(1)
        way = ways[np.isfinite(ways).all(1)].sum(0)
        slope = way / max(np.linalg.norm(way), 1e-9)
        if slope[1] > MIN_UP_AXIS_COSINE:
            return animation
        if slope[2] > MIN_UP_AXIS_COSINE:
            note = "Its Z axis points up, for there the head is above the feet."
            return replace(animation, rotation_y_up_file=ROTATIONS_TO_Y_UP["Z"], notes=(*animation.notes, note))
    return animation


# MERGED: mocapfix.read.rates
# Frame times as files round them, and the rates they were rounded from.
COMMON_RATES_HZ = (
    24,
    25,
    30,
    48,
    50,
    60,
    72,
    75,
    80,
    90,
    96,
    100,
    120,
    125,
    144,
    150,
    160,
    180,
    200,
    240,
    250,
    256,
    300,
    360,
    400,
    480,
)
COMMON_RATES_HZ += (500, 512, 1000)
NTSC_RATES_HZ = tuple(base * 1000 / 1001 for base in (24, 30, 48, 60, 120, 240))  # television's rates
MAX_RATE_ROUNDING = 0.02  # of a rate: a frame time that says less than this says nothing
LAST_DECIMAL_TOLERANCE = 1e-6  # of a last decimal: for the rounding of the division
MIN_NOTED_RATE_CHANGE = 1e-5  # of a rate: too little to speak of, a frame in half an hour at 60 Hz


def infer_rate(frame_time_text: str) -> tuple[float, str]:
    """-> the rate in Hz of a frame time as it is spelled in seconds, and a note, "" where nothing was assumed.

    .0083 may be any rate from 119.8 to 121.2 Hz: it is taken as 120, the usual one that it may have been rounded from, or
    cut off from, to so many decimals.
    """
    seconds = float(frame_time_text)
    rate = 1 / seconds
    mantissa, _, exponent = frame_time_text.lower().partition("e")
    unit = 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2]))
    for rates, lowest in (
        (COMMON_RATES_HZ, -0.5),
        (NTSC_RATES_HZ, -0.5),
        (COMMON_RATES_HZ, 0.0),
        (NTSC_RATES_HZ, 0.0),
    ):  # rounded; cut off
        nearest = min(rates, key=lambda each: abs(each - rate))
        lost = (1 / nearest - seconds) / unit
        if (
            lowest - LAST_DECIMAL_TOLERANCE <= lost <= lowest + 1 + LAST_DECIMAL_TOLERANCE
            and abs(nearest / rate - 1) < MAX_RATE_ROUNDING
        ):
            far = abs(nearest / rate - 1) > MIN_NOTED_RATE_CHANGE
            return float(nearest), f"Its frame time {frame_time_text} s was taken as {nearest:g} Hz, rounded." if far else ""
    return rate, ""
