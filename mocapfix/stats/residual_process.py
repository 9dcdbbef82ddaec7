"""Interpolation of a residual across a gap, from the samples on both sides.

The part of a marker's motion that its segment does not explain (skin, and the solve's own error), or of a joint's that a
prediction does not, is a smooth random process about zero: a Gaussian process with Matern-3/2 covariance (Rasmussen & Williams
2006, Eq. 4.17), of which a part is rough (Matern-1/2), as the residual itself shows. Given the samples on both sides of a gap,
its mean continues them smoothly and decays towards zero in the middle of a long gap; its variance is the uncertainty.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from mocapfix.stats.gaussian_process import evaluate_matern
from mocapfix.stats.sequences import find_runs, sample_evenly

MAX_SAMPLES_PER_SIDE = 6  # of a gap, that the interpolation uses
ROUGHNESS_LAG_S = 0.025  # lag at which a residual's change shows its roughness
CHI2_MEDIAN_3_DOF = 2.366  # median of the chi-squared distribution with three degrees of freedom
NORMAL_MEDIAN_FACTOR = 2.2  # mean square over median square of a normal residual; the median ignores outliers


class InterpolatedResidual(NamedTuple):
    """A residual over T frames, zero outside the gaps."""

    mean: Float[np.ndarray, "T 3"]
    variance: Float[np.ndarray, " T"]  # per axis
    signal_power: float  # the variance per axis far from any known sample


def interpolate_residual(
    residual: Float[np.ndarray, "T 3"],
    is_gap: Bool[np.ndarray, " T"],
    rate: float,
    *,
    time_scale_s: float,
    margin_s: float,
    noise_sd: float,
    min_sd: float,
) -> InterpolatedResidual:
    """Return the process of a residual (T, 3), in any unit and NaN where unknown, in the frames `is_gap` (T,).

    rate          Hz
    time_scale_s  of the residual's correlation
    margin_s      on either side of a gap that is used
    noise_sd      of a single sample, in the residual's unit
    min_sd        least standard deviation of the process, likewise
    """
    is_known = ~np.isnan(residual[:, 0])
    mean, variance = np.zeros_like(residual), np.zeros(len(residual))
    median_square = float(np.median(residual[is_known] ** 2)) if is_known.any() else 0.0
    power = max(median_square * NORMAL_MEDIAN_FACTOR, min_sd**2)
    roughness = estimate_roughness(residual, rate, time_scale_s, noise_sd, power)
    steps = max(1, round(margin_s * rate))
    offsets = sample_evenly(steps, MAX_SAMPLES_PER_SIDE)
    for first, last in find_runs(is_gap):
        before, after = first - 1 - offsets, last + 1 + offsets
        near = np.r_[before[before >= 0], after[after < len(residual)]]
        near = near[is_known[near]]
        gap = np.arange(first, last + 1)
        if len(near) == 0:
            variance[gap] = power
            continue
        among = power * compute_residual_correlation((near[:, None] - near[None]) / rate, time_scale_s, roughness)
        among = among + noise_sd**2 * np.eye(len(near))
        cross = power * compute_residual_correlation((gap[:, None] - near[None]) / rate, time_scale_s, roughness)
        weight = np.linalg.solve(among, cross.T).T
        mean[gap] = weight @ residual[near]
        variance[gap] = np.maximum(power - (weight * cross).sum(1), 0.0)
    return InterpolatedResidual(mean, variance, power)


def build_residual_map(
    known_s: Float[np.ndarray, " N"],
    wanted_s: Float[np.ndarray, " P"],
    *,
    time_scale_s: float,
    roughness: float,
    noise_ratio: float,
) -> Float[np.ndarray, "P N"]:
    """Return the linear map from a residual's known samples to its expectation at other times, in seconds.

    noise_ratio  variance of a sample's noise relative to the power of the process
    """
    among = compute_residual_correlation(known_s[:, None] - known_s, time_scale_s, roughness) + noise_ratio * np.eye(len(known_s))
    return np.linalg.solve(among, compute_residual_correlation(known_s[:, None] - wanted_s, time_scale_s, roughness)).T


def estimate_roughness(
    residual: Float[np.ndarray, "T 3"], rate: float, time_scale_s: float, noise_sd: float, power: float
) -> float:
    """Return the rough part of a residual's power: 0 for a smooth process, 1 for one that moves in independent steps.

    Estimated from the median square of its change over a short lag, which is small for a smooth process.
    """
    step = max(1, round(ROUGHNESS_LAG_S * rate))
    change = residual[step:] - residual[:-step]
    change = change[~np.isnan(change[:, 0])]
    if len(change) < MAX_SAMPLES_PER_SIDE:
        return 0.0
    lag_s = np.array([step / rate])
    smooth, rough = (float(compute_residual_correlation(lag_s, time_scale_s, part)[0]) for part in (0.0, 1.0))
    decorrelation = (NORMAL_MEDIAN_FACTOR * float(np.median(change**2)) - 2 * noise_sd**2) / (2 * power)
    return float(np.clip((decorrelation - (1 - smooth)) / (smooth - rough), 0.0, 1.0))


def compute_residual_correlation(
    lag_s: Float[np.ndarray, "*shape"], time_scale_s: float, roughness: float
) -> Float[np.ndarray, "*shape"]:
    """Return the correlation at a lag: Matern-3/2 plus, for the part `roughness` (0 to 1), an Ornstein-Uhlenbeck process."""
    smooth = evaluate_matern(np.sqrt(3) * np.abs(lag_s) / time_scale_s, 3)
    return (1 - roughness) * smooth + roughness * evaluate_matern(np.abs(lag_s) / time_scale_s, 1)
