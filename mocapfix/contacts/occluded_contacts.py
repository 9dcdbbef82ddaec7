"""Infer the contacts of a foot while no marker shows it: a foot that stands at one place before and after stood there between."""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import binary_dilation

from mocapfix.stats.sequences import find_runs

MAX_SHOWN_JOINT_SD_M = 0.03
"""Standard deviation above which a joint's position is never known."""
MAX_SD_RATIO = 1.5
"""Standard deviation, relative to the take's usual one, above which the joint lacks its markers."""
BORDER_S = 0.08
"""Time beside unknown frames in which the smoothness of the motion carries their error into known ones."""
USUAL_SD_PERCENTILE = 25
MAX_PLACE_CHANGE_M = 0.025
"""Distance between the places before and after up to which they are one: a foot that stands rolls by 10 to 20 mm."""
MAX_CERTAIN_GAP_S = 0.5
"""A foot cannot step away and return to its place in this time."""
MAX_OTHER_STEPS = 1
"""Steps of the other foot in a longer gap, above which the person may be walking on the spot."""
STILL_TIME_S = 1.0
"""Time beside a gap at the beginning or the end of a take for which both feet stand, if the person stands still."""
MAX_END_GAP_S = 2.0
"""Longest such gap: in a longer one a person may have stood on the other leg."""
PLACE_WINDOW_S = 0.1
"""Time over which the place beside a gap is averaged."""


def find_known_frames(position_sd: Float[np.ndarray, " T"], rate: float) -> Bool[np.ndarray, " T"]:
    """Return the frames whose markers show a joint, by the predicted standard deviation (T,) of its position in metres."""
    usual = float(np.percentile(position_sd, USUAL_SD_PERCENTILE)) if len(position_sd) else 0.0
    is_unknown = position_sd > min(max(MAX_SD_RATIO * usual, 1e-9), MAX_SHOWN_JOINT_SD_M)
    return np.logical_not(binary_dilation(is_unknown, iterations=max(1, round(BORDER_S * rate))))


def find_certain_occlusions(
    is_standing: Bool[np.ndarray, " T"],
    position: Float[np.ndarray, "T 3"],
    is_known: Bool[np.ndarray, " T"],
    other_standing: Bool[np.ndarray, " T"],
    is_other_known: Bool[np.ndarray, " T"],
    rate: float,
) -> Bool[np.ndarray, " T"]:
    """Return the unknown frames in which a joint must have stood all the time, since it stands at one place before and after.

    At the beginning and the end of a take it must have stood if the other foot stands there, and both do for a while beside.

    is_standing     when it stands, found without the speed in unknown frames
    position        (T, 3) m: of the joint; what it is in unknown frames is not used
    other_standing  when the other foot stands
    is_other_known  when markers show the other foot
    """
    is_certain = np.zeros(len(is_known), bool)
    window = max(1, round(PLACE_WINDOW_S * rate))
    for first, last in find_runs(~is_known):
        if not is_standing[max(0, first - 1) : last + 2].all():
            continue
        if first == 0 or last == len(is_known) - 1:
            beside = _find_frames_beside(first, last, len(is_known), rate)
            span = np.union1d(beside, np.arange(first, last + 1))
            is_still = len(beside) > 0 and bool((is_known & is_standing)[beside].all())
            is_certain[first : last + 1] = is_still and bool((other_standing & is_other_known)[span].all())
            continue
        before, after = slice(max(0, first - window), first), slice(last + 1, last + 1 + window)
        places = [position[side][is_known[side] & is_standing[side]].mean(0) for side in (before, after)]
        steps = len(find_runs(~other_standing[first : last + 1]))
        is_short = last + 1 - first <= MAX_CERTAIN_GAP_S * rate
        is_same_place = np.linalg.norm(places[1] - places[0]) <= MAX_PLACE_CHANGE_M
        is_certain[first : last + 1] = is_same_place and (is_short or steps <= MAX_OTHER_STEPS)
    return is_certain


def _find_frames_beside(first: int, last: int, frame_count: int, rate: float) -> Int[np.ndarray, " N"]:
    """Return the frames beside a gap at an end of a take in which a person who stands still stands; none if there are too few."""
    still = round(STILL_TIME_S * rate)
    start = last + 1 if first == 0 else first - still
    if last + 1 - first > MAX_END_GAP_S * rate or start < 0 or start + still > frame_count:
        return np.zeros(0, int)
    return np.arange(start, start + still)
