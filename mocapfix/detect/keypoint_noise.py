"""Noise of 3-D keypoints: estimated for each point of a take, separated from its motion, and removed.

A keypoint is a program's estimate in one frame, with an error of one or a few centimetres that changes from frame to frame. What
the detectors of markers compare with millimetres would be found everywhere. A smooth trajectory, of the acceleration that the
point itself shows, has an error of a few millimetres, as a marker has; samples far from it are outliers.

The smoother weights a sample less the farther it lies away (iteratively reweighted least squares), so that outliers, and labels
that are exchanged for a moment, do not draw the trajectory away.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import uniform_filter1d

from mocapfix.solve.smoothing import MIN_ACCELERATION_POWER, MIN_POWER_SHARE
from mocapfix.stats.sequences import find_runs
from mocapfix.stats.smooth_paths import MAX_SAMPLE_VARIANCE, smooth_path

# Variance of the third difference of white noise, relative to that of the noise.
THIRD_DIFFERENCE_VARIANCE = 20.0
# Median of the square of a standard normal variable.
CHI_SQUARED_1_MEDIAN = 0.455
# Smallest noise that is estimated: positions in files are rounded.
MIN_NOISE_SD_M = 1e-4
# Steps of the second difference from which the acceleration is estimated, and the window of its mean.
KEYPOINT_ACCELERATION_STEP_S = 0.1
KEYPOINT_POWER_WINDOW_S = 1.0
# Fewer measured samples are not smoothed.
MIN_SMOOTHED_SAMPLES = 20
# A gap in which the trajectory is smoothed separately on both sides.
MAX_JOINED_GAP_S = 1.0
# Distance from the trajectory, in standard deviations per axis, beyond which a sample has less weight, and is an outlier.
MIN_DOWNWEIGHTED_DISTANCE_SD = 3.0
MIN_KEYPOINT_OUTLIER_SD = 5.0
# Smallest standard deviation with which an outlier is compared, relative to that of the set: a filtered file has little noise.
MIN_OUTLIER_NOISE_RATIO = 0.5
SMOOTHING_ROUNDS = 5


class SmoothedPoint(NamedTuple):
    """A keypoint's trajectory without noise.

    Attributes:
        path: Positions (T, 3) in metres, NaN where the point was not measured.
        is_outlier: Samples (T,) at a large distance from the trajectory.
        noise_sd_m: Standard deviation of the noise per axis.
    """

    path: np.ndarray
    is_outlier: np.ndarray
    noise_sd_m: float


def estimate_noise_sd(markers: Float[np.ndarray, "T M 3"]) -> Float[np.ndarray, " M"]:
    """Return the standard deviation per axis, in metres, of the noise of each point, from its third differences."""
    if len(markers) <= MIN_SMOOTHED_SAMPLES:
        return np.full(markers.shape[1], MIN_NOISE_SD_M)
    square = np.diff(markers, 3, axis=0) ** 2
    noise_sd_m = np.full(markers.shape[1], MIN_NOISE_SD_M)
    for m in range(markers.shape[1]):
        known = square[~np.isnan(square[:, m, 0]), m]
        if len(known) >= MIN_SMOOTHED_SAMPLES:
            variance = np.median(known, axis=0).mean() / CHI_SQUARED_1_MEDIAN / THIRD_DIFFERENCE_VARIANCE
            noise_sd_m[m] = max(MIN_NOISE_SD_M, float(np.sqrt(variance)))
    return noise_sd_m


def smooth_point(path: Float[np.ndarray, "T 3"], noise_sd_m: float, rate: float, point_sd_m: float) -> SmoothedPoint:
    """Smooth the trajectory of one keypoint.

    Args:
        path: Positions in metres, NaN where missing.
        noise_sd_m: Standard deviation of the noise per axis.
        rate: Frames a second.
        point_sd_m: Standard deviation per axis that the marker set states.
    """
    is_known, smooth, is_outlier = ~np.isnan(path[:, 0]), path.copy(), np.zeros(len(path), bool)
    for first, last in _join_short_gaps(is_known, rate):
        frames = slice(first, last + 1)
        if is_known[frames].sum() >= MIN_SMOOTHED_SAMPLES:
            smooth[frames], is_outlier[frames] = _smooth_run(path[frames], is_known[frames], noise_sd_m, rate, point_sd_m)
    smooth[~is_known] = np.nan
    return SmoothedPoint(smooth, is_outlier & is_known, noise_sd_m)


def _join_short_gaps(is_known: Bool[np.ndarray, " T"], rate: float) -> list[tuple[int, int]]:
    """Return the runs of known samples, joined across short gaps."""
    runs: list[tuple[int, int]] = []
    for first, last in find_runs(is_known):
        if runs and first - runs[-1][1] - 1 <= MAX_JOINED_GAP_S * rate:
            runs[-1] = runs[-1][0], last
        else:
            runs.append((first, last))
    return runs


def _smooth_run(
    path: Float[np.ndarray, "T 3"], is_known: Bool[np.ndarray, " T"], noise_sd_m: float, rate: float, point_sd_m: float
) -> tuple[Float[np.ndarray, "T 3"], Bool[np.ndarray, " T"]]:
    """Return the smooth path of one run, and its outliers."""
    measured, frames, weight = np.nan_to_num(path), np.arange(len(path)), np.ones(len(path))
    compared_sd_m = max(noise_sd_m, MIN_OUTLIER_NOISE_RATIO * point_sd_m)
    smooth = np.stack([np.interp(frames, frames[is_known], path[is_known, axis]) for axis in range(3)], axis=-1)
    noise_variance, distance_sd = noise_sd_m**2, np.zeros(len(path))
    for round_number in range(SMOOTHING_ROUNDS):
        is_sound = is_known & (weight > MIN_DOWNWEIGHTED_DISTANCE_SD / MIN_KEYPOINT_OUTLIER_SD)
        power = _estimate_power(smooth, is_sound, rate, noise_variance if round_number == 0 else 0.0)
        variance = np.where(is_known, noise_variance / weight**2, MAX_SAMPLE_VARIANCE)
        smooth = smooth_path(measured, variance, power, rate)
        distance_sd = np.where(is_known, np.linalg.norm(measured - smooth, axis=1), 0.0) / compared_sd_m
        weight = np.minimum(1.0, MIN_DOWNWEIGHTED_DISTANCE_SD / np.maximum(distance_sd, MIN_DOWNWEIGHTED_DISTANCE_SD))
        weight = np.where(distance_sd > MIN_KEYPOINT_OUTLIER_SD, weight**2, weight)
    return smooth, distance_sd > MIN_KEYPOINT_OUTLIER_SD


def _estimate_power(
    path: Float[np.ndarray, "T 3"], is_sound: Bool[np.ndarray, " T"], rate: float, noise_variance: float
) -> Float[np.ndarray, " T"]:
    """Return the power of the random acceleration of a path about each frame, less what noise contributes.

    The second difference of an integrated random acceleration over steps of h has the variance 2/3 power h^3, that of noise 6
    times its own.
    """
    h = max(1, round(KEYPOINT_ACCELERATION_STEP_S * rate))
    if len(path) < 4 * h:
        return np.ones(len(path))
    second = ((path[2 * h :] - 2 * path[h:-h] + path[: -2 * h]) ** 2).mean(axis=1)
    is_used = is_sound[2 * h :] & is_sound[h:-h] & is_sound[: -2 * h]
    if not is_used.any():
        return np.ones(len(path))
    window = max(1, round(KEYPOINT_POWER_WINDOW_S * rate))
    total = uniform_filter1d(np.where(is_used, second, 0.0), window, mode="nearest")
    share = uniform_filter1d(is_used.astype(float), window, mode="nearest")
    usable = np.flatnonzero(share > 1 / window)
    scale = 2 / 3 * (h / rate) ** 3
    power = np.maximum(total[usable] / share[usable] - 6 * noise_variance, 0.0) / scale
    smallest = max(MIN_ACCELERATION_POWER, MIN_POWER_SHARE * float(power.mean()))
    return np.maximum(np.interp(np.arange(len(path)), usable + h, power), smallest)
