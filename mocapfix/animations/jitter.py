"""A joint that trembles for a while, each frame by itself.

Differences of the fourth order hold nearly nothing of what bodies do, and eight times the tremble. Where they are large, two
things tell a tremble from a joint that only moves fast. A tremble is as large by its second differences as by its fourth, motion
by the second far greater. And a tremble is about all axes, while a body that kicks, lands or claps jerks a joint about one.
"""

from typing import NamedTuple

import numpy as np
from scipy.ndimage import binary_closing, median_filter

from mocapfix.stats.constant_offsets import multiply_quaternions
from mocapfix.stats.runs import find_runs

POWER_WINDOW_S, MIN_JITTER_DURATION_S = 0.2, 0.15  # seconds: over which the size is measured, and that a tremble lasts
MIN_JITTER_FRAMES, MIN_POWER_WINDOW_FRAMES = (
    5,
    7,
)  # frames: of a tremble, and at least of the window, for a kink as of a foot that lands shows in three
MIN_JITTER_RAD, MAX_MOTION_RAD_PER_S2 = (
    np.radians(1.0),
    7.0,
)  # radians, and rad/s^2: of a tremble; what motion may leave, at low rates only
MEAN_TO_MEDIAN_RATIO = 1.27  # times the median of the squares of three axes is their mean
MIN_BACKGROUND_RATIO = 4.0  # times the joint's own tremble over the take, by its median
MIN_WHITENESS = 0.35, 0.7  # of the size that second differences tell, squared: of a moment, and of the whole tremble
MIN_MEDIAN_SHARE_ALL_AXES, MIN_MEDIAN_SHARE_FEW_AXES = (
    0.4,
    0.15,
)  # of the size, squared, that its median tells: about all axes, about fewer
MIN_AXIS_RATIO = 0.14  # of the size about the axis of the most that there is about that of the least
MIN_ELSEWHERE_RATIO = 2.0  # times what one moment in a hundred has elsewhere, a tremble not about all axes is larger
MIN_SINGLE_AXIS_FRAMES, MAX_SINGLE_AXIS_RATIO = (
    8,
    0.33,
)  # frames of a tremble about a single axis: less than that share of it is about the next one
FAINT_POWER_SHARE = 0.15  # of the smallest size that counts, squared: where a tremble has begun or not yet ended
STENCIL_POWER_BY_ORDER = {2: 6.0, 4: 70.0}  # the squares of the binomial coefficients, summed


class JitterBurst(NamedTuple):
    """Frames first..last, inclusive, that tremble by so many radians about each axis."""

    first: int
    last: int
    sd_rad: float


def detect_rotation_jitter(track: np.ndarray, is_usable: np.ndarray, rate: float) -> list[JitterBurst]:
    """-> where a joint trembles: its course (T, 4), twice its quaternions without changes of sign, where `usable` (T,)."""
    if len(track) < 2 * MIN_JITTER_FRAMES:
        return []
    known = np.where(is_usable[:, None], track, np.nan)
    about = {order: _compute_axis_differences(known, order) for order in STENCIL_POWER_BY_ORDER}
    fourth, second = ((about[order] ** 2).sum(1) / (3 * STENCIL_POWER_BY_ORDER[order]) for order in (4, 2))
    told = ~np.isnan(fourth)
    if not told.any():
        return []
    window = max(MIN_POWER_WINDOW_FRAMES, round(POWER_WINDOW_S * rate)) | 1
    size, against = (MEAN_TO_MEDIAN_RATIO * median_filter(np.nan_to_num(each), window) for each in (fourth, second))
    own = np.sqrt(MEAN_TO_MEDIAN_RATIO * np.median(fourth[told]))
    limit = max(MIN_JITTER_RAD + MAX_MOTION_RAD_PER_S2 / rate**2, MIN_BACKGROUND_RATIO * own) ** 2
    trembles = (size > limit) & (size > MIN_WHITENESS[0] * against)
    kept = []
    faintly = binary_closing(np.nan_to_num(fourth) > max(FAINT_POWER_SHARE * limit, MIN_BACKGROUND_RATIO * own**2), np.ones(4))
    for a, b in find_runs(trembles | faintly):
        if trembles[a : b + 1].any():
            first, last = a + 1, b - 1  # the outermost differences reach a frame beyond
            if last - first + 1 >= max(MIN_JITTER_FRAMES, round(MIN_JITTER_DURATION_S * rate)):
                each = JitterBurst(int(first), int(last), float(np.sqrt(np.nanmean(fourth[first : last + 1]))))
                if each.sd_rad**2 > limit and _is_jitter(about, each):
                    kept.append(each)
    return _merge_overlapping(kept)


def _compute_axis_differences(track: np.ndarray, order: int) -> np.ndarray:
    """-> (T, 3) the differences of an order about each frame, radians in the joint's own axes; NaN where they are not known."""
    beside = order // 2
    turned = multiply_quaternions(track[beside:-beside] / 2 * [-1, -1, -1, 1], np.diff(track, order, axis=0))
    return np.pad(turned[:, :3], ((beside, beside), (0, 0)), constant_values=np.nan)


def _is_jitter(differences: dict[int, np.ndarray], burst: JitterBurst) -> bool:
    """-> bool: is it white, steady, and about all axes or like nothing else that the joint does? about: differences (T, 3) by
    their order."""
    spread = {}
    for order, reach in ((4, 0), (2, 1)):
        rows = differences[order][max(0, burst.first - reach) : burst.last + 1 + reach]
        rows = rows[~np.isnan(rows[:, 0])]
        spread[order] = rows.T @ rows / max(len(rows), 1) / STENCIL_POWER_BY_ORDER[order]
    size = np.trace(spread[4])
    inside = _compute_squared_amplitudes(differences[4][burst.first : burst.last + 1])
    axes = np.linalg.eigvalsh(spread[4])
    all_round = axes[0] > MIN_AXIS_RATIO**2 * axes[2]
    if (
        size < MIN_WHITENESS[1] * np.trace(spread[2])
        or MEAN_TO_MEDIAN_RATIO * np.median(inside)
        < (MIN_MEDIAN_SHARE_ALL_AXES if all_round else MIN_MEDIAN_SHARE_FEW_AXES) * size
    ):
        return False
    if all_round:
        return True
    elsewhere = _compute_squared_amplitudes(np.delete(differences[4], slice(max(0, burst.first - 4), burst.last + 5), axis=0))
    enough = len(inside) >= MIN_SINGLE_AXIS_FRAMES or axes[1] > MAX_SINGLE_AXIS_RATIO**2 * axes[2]
    return enough and len(elsewhere) > 0 and bool(size > MIN_ELSEWHERE_RATIO**2 * np.quantile(elsewhere, 0.99))


def _compute_squared_amplitudes(fourth_differences: np.ndarray) -> np.ndarray:
    """-> (n,) the squares of the tremble that fourth differences (T, 3) tell, where they are known."""
    return (fourth_differences[~np.isnan(fourth_differences[:, 0])] ** 2).sum(1) / STENCIL_POWER_BY_ORDER[4]


def _merge_overlapping(bursts: list[JitterBurst]) -> list[JitterBurst]:
    """-> those that do not overlap, those that do being one."""
    kept: list[JitterBurst] = []
    for each in bursts:
        if kept and each.first <= kept[-1].last + 1:
            last = kept.pop()
            each = JitterBurst(last.first, max(last.last, each.last), max(last.sd_rad, each.sd_rad))
        kept.append(each)
    return kept
