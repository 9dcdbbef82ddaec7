"""Detection of jitter in a joint's rotation: noise that is independent from frame to frame, for some time.

Fourth differences contain almost nothing of a body's motion and amplify noise by a factor of eight. Two properties distinguish
jitter from fast motion where they are large. Second differences give the same size of jitter as fourth differences do, but a far
greater one of motion. And jitter is about all axes, whereas a kick, a landing or a clap jerks a joint about one axis.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import binary_closing, median_filter

from mocapfix.stats.constant_offsets import multiply_quaternions
from mocapfix.stats.sequences import find_runs

POWER_WINDOW_S = 0.2  # over which the size of jitter is measured
MIN_POWER_WINDOW_FRAMES = 7  # a kink, as of a foot that lands, shows in three differences
MIN_JITTER_DURATION_S = 0.15
MIN_JITTER_FRAMES = 5
MIN_JITTER_RAD = np.radians(1.0)  # standard deviation about each axis
MAX_MOTION_RAD_PER_S2 = 7.0  # times the squared frame time: contribution of motion, which matters at low frame rates
MEAN_TO_MEDIAN_RATIO = 1.27  # of the squared length of a normally distributed vector with three components
MIN_BACKGROUND_RATIO = 4.0  # to the usual jitter of the joint, the median over the animation
MIN_WINDOW_WHITENESS = 0.35  # ratio of the powers by fourth and by second differences in a window
MIN_BURST_WHITENESS = 0.7  # the same over a whole burst
MIN_MEDIAN_SHARE_ALL_AXES = 0.4  # ratio of the power by the median to that by the mean, for jitter about all axes
MIN_MEDIAN_SHARE_FEW_AXES = 0.15  # the same for jitter about fewer axes
MIN_AXIS_RATIO = 0.14  # of the weakest axis to the strongest, for jitter about all axes
MIN_ELSEWHERE_RATIO = 2.0  # of jitter about fewer axes to the 99th percentile of the same joint's differences elsewhere
ELSEWHERE_QUANTILE = 0.99
MIN_SINGLE_AXIS_FRAMES = 8  # for jitter about a single axis
MAX_SINGLE_AXIS_RATIO = 0.33  # of the second strongest axis to the strongest, for jitter about a single axis
FAINT_POWER_SHARE = 0.15  # of the minimum power, which a burst keeps up where it begins and ends
FAINT_GAP_FRAMES = 4  # length of the window in which gaps of a faint burst are closed
STENCIL_POWER_BY_ORDER = {2: 6.0, 4: 70.0}  # sums of the squared binomial coefficients


class JitterBurst(NamedTuple):
    """Jitter in the frames first..last, inclusive, with the standard deviation about each axis."""

    first: int
    last: int
    sd_rad: float


def detect_rotation_jitter(track: Float[np.ndarray, "T 4"], is_usable: Bool[np.ndarray, " T"], rate: float) -> list[JitterBurst]:
    """Detect the jitter bursts of a joint. `track` is twice its quaternions (x, y, z, w), without sign changes."""
    if len(track) < 2 * MIN_JITTER_FRAMES:
        return []
    known = np.where(is_usable[:, None], track, np.nan)
    differences = {order: _compute_axis_differences(known, order) for order in STENCIL_POWER_BY_ORDER}
    fourth_power, second_power = ((differences[order] ** 2).sum(1) / (3 * STENCIL_POWER_BY_ORDER[order]) for order in (4, 2))
    is_known = ~np.isnan(fourth_power)
    if not is_known.any():
        return []
    window = max(MIN_POWER_WINDOW_FRAMES, round(POWER_WINDOW_S * rate)) | 1
    power, reference = (
        MEAN_TO_MEDIAN_RATIO * median_filter(np.nan_to_num(each), window) for each in (fourth_power, second_power)
    )
    usual_sd = np.sqrt(MEAN_TO_MEDIAN_RATIO * np.median(fourth_power[is_known]))
    min_power = max(MIN_JITTER_RAD + MAX_MOTION_RAD_PER_S2 / rate**2, MIN_BACKGROUND_RATIO * usual_sd) ** 2
    is_strong = (power > min_power) & (power > MIN_WINDOW_WHITENESS * reference)
    min_faint_power = max(FAINT_POWER_SHARE * min_power, MIN_BACKGROUND_RATIO * usual_sd**2)
    is_faint = binary_closing(np.nan_to_num(fourth_power) > min_faint_power, np.ones(FAINT_GAP_FRAMES))
    bursts: list[JitterBurst] = []
    min_frames = max(MIN_JITTER_FRAMES, round(MIN_JITTER_DURATION_S * rate))
    for run_first, run_last in find_runs(is_strong | is_faint):
        first, last = run_first + 1, run_last - 1  # the outermost differences extend one frame beyond the burst
        if is_strong[run_first : run_last + 1].any() and last - first + 1 >= min_frames:
            burst = JitterBurst(first, last, float(np.sqrt(np.nanmean(fourth_power[first : last + 1]))))
            if burst.sd_rad**2 > min_power and _is_jitter(differences, burst):
                bursts.append(burst)
    return _merge_overlapping(bursts)


def _compute_axis_differences(track: Float[np.ndarray, "T 4"], order: int) -> Float[np.ndarray, "T 3"]:
    """Compute the differences of an order around each frame, in radians about the joint's axes; NaN where unknown."""
    half = order // 2
    rotated = multiply_quaternions(track[half:-half] / 2 * [-1, -1, -1, 1], np.diff(track, order, axis=0))
    return np.pad(rotated[:, :3], ((half, half), (0, 0)), constant_values=np.nan)


def _is_jitter(differences: dict[int, Float[np.ndarray, "T 3"]], burst: JitterBurst) -> bool:
    """Return True if a burst is white, steady, and either about all axes or unlike the rest of the joint's motion.

    differences  by their order, 2 and 4
    """
    covariance: dict[int, Float[np.ndarray, "3 3"]] = {}
    for order, margin in ((4, 0), (2, 1)):
        rows = differences[order][max(0, burst.first - margin) : burst.last + 1 + margin]
        rows = rows[~np.isnan(rows[:, 0])]
        covariance[order] = rows.T @ rows / max(len(rows), 1) / STENCIL_POWER_BY_ORDER[order]
    power = np.trace(covariance[4])
    inside = _compute_squared_amplitudes(differences[4][burst.first : burst.last + 1])
    axis_power = np.linalg.eigvalsh(covariance[4])  # ascending
    is_about_all_axes = axis_power[0] > MIN_AXIS_RATIO**2 * axis_power[2]
    min_median_share = MIN_MEDIAN_SHARE_ALL_AXES if is_about_all_axes else MIN_MEDIAN_SHARE_FEW_AXES
    if power < MIN_BURST_WHITENESS * np.trace(covariance[2]):
        return False
    if MEAN_TO_MEDIAN_RATIO * np.median(inside) < min_median_share * power:
        return False
    if is_about_all_axes:
        return True
    elsewhere = _compute_squared_amplitudes(np.delete(differences[4], slice(max(0, burst.first - 4), burst.last + 5), axis=0))
    is_long_enough = len(inside) >= MIN_SINGLE_AXIS_FRAMES or axis_power[1] > MAX_SINGLE_AXIS_RATIO**2 * axis_power[2]
    if not is_long_enough or not len(elsewhere):
        return False
    return bool(power > MIN_ELSEWHERE_RATIO**2 * np.quantile(elsewhere, ELSEWHERE_QUANTILE))


def _compute_squared_amplitudes(fourth_differences: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " m"]:
    """Compute the squared jitter amplitudes of the fourth differences that are known."""
    return (fourth_differences[~np.isnan(fourth_differences[:, 0])] ** 2).sum(1) / STENCIL_POWER_BY_ORDER[4]


def _merge_overlapping(bursts: list[JitterBurst]) -> list[JitterBurst]:
    """Merge bursts that overlap or adjoin."""
    merged: list[JitterBurst] = []
    for burst in bursts:
        if merged and burst.first <= merged[-1].last + 1:
            previous = merged.pop()
            burst = JitterBurst(previous.first, max(previous.last, burst.last), max(previous.sd_rad, burst.sd_rad))
        merged.append(burst)
    return merged
