"""Carrying what was seen beside a gap across it.

What a marker does beyond its segment's motion (skin, and the solve's own error), or a joint beyond what was expected of it,
is a smooth random course about zero: a Gaussian process with Matern-3/2 covariance (Rasmussen & Williams 2006, Eq. 4.17),
part of it as rough as the residual shows itself to be (Matern-1/2).
Given the samples on both sides of a gap its mean goes on smoothly from them and fades towards zero in the middle of a long
gap, and its variance says how far it can be trusted.
"""

import numpy as np

from mocapfix.take import find_runs

MAX_SAMPLES_PER_SIDE = 6  # samples on either side
ROUGHNESS_LAG_S = 0.025  # seconds over which a course is rough, where it is


def interpolate_residual(
    residual: np.ndarray, is_gap: np.ndarray, rate: float, time_scale_s: float, margin_s: float, noise_sd: float, min_sd: float
) -> tuple[np.ndarray, np.ndarray, float]:
    """-> the course (T, 3) of a residual over the samples `wanted` (T,), its variance (T,) per axis, and what that would be
    far from any known sample.

    residual  (T, 3) in any unit, NaN where not known
    fade      seconds after which a residual has lost most of its memory
    reach     seconds on either side of a gap that are listened to
    noise     what a single sample cannot tell, in the residual's unit
    least     least size of the course, likewise
    """
    known = ~np.isnan(residual[:, 0])
    course, variance = np.zeros_like(residual), np.zeros(len(residual))
    # 2.2 times the median square is the mean square of a normal residual; outliers do not count
    power = max(float(np.median(residual[known] ** 2)) * 2.2 if known.any() else 0.0, min_sd**2)
    rough = estimate_roughness(residual, rate, time_scale_s, noise_sd, power)
    steps = max(1, round(margin_s * rate))
    pick = np.unique(np.linspace(0, steps - 1, min(MAX_SAMPLES_PER_SIDE, steps)).astype(int))
    for first, last in find_runs(is_gap):
        before, after = first - 1 - pick, last + 1 + pick
        near = np.r_[before[before >= 0], after[after < len(residual)]]
        near = near[known[near]]
        gap = np.arange(first, last + 1)
        if len(near) == 0:
            variance[gap] = power
            continue
        among = power * compute_residual_correlation(
            (near[:, None] - near[None]) / rate, time_scale_s, rough
        ) + noise_sd**2 * np.eye(len(near))
        between = power * compute_residual_correlation((gap[:, None] - near[None]) / rate, time_scale_s, rough)
        weight = np.linalg.solve(among, between.T).T
        course[gap] = weight @ residual[near]
        variance[gap] = np.maximum(power - (weight * between).sum(1), 0.0)
    return course, variance, power


def estimate_roughness(residual: np.ndarray, rate: float, time_scale_s: float, noise_sd: float, power: float) -> float:
    """-> the part of a residual's (T, 3) power that is rough: 0 for a smooth course, 1 for one that goes on in steps.

    From how far it gets in a moment, which a smooth course hardly does; robustly, as the power is.
    """
    step = max(1, round(ROUGHNESS_LAG_S * rate))
    change = residual[step:] - residual[:-step]
    change = change[~np.isnan(change[:, 0])]
    if len(change) < MAX_SAMPLES_PER_SIDE:
        return 0.0
    seconds = np.array(step / rate)
    smooth, rough = (float(compute_residual_correlation(seconds, time_scale_s, part)) for part in (0.0, 1.0))
    lost = (2.2 * float(np.median(change**2)) - 2 * noise_sd**2) / (2 * power)
    return float(np.clip((lost - (1 - smooth)) / (smooth - rough), 0.0, 1.0))


def compute_residual_correlation(lag_s: np.ndarray, time_scale_s: float, roughness: float) -> np.ndarray:
    """-> the correlation of the course at two moments so far apart, `rough` (0 to 1) of its power an Ornstein-Uhlenbeck
    process of the same fade, the rest Matern's.
    """
    return (1 - roughness) * compute_matern_32(lag_s, time_scale_s) + roughness * np.exp(-np.abs(lag_s) / time_scale_s)


def compute_matern_32(lag_s: np.ndarray, time_scale_s: float) -> np.ndarray:
    """-> the correlation of the course at two moments so far apart."""
    distance = np.sqrt(3) * np.abs(lag_s) / time_scale_s
    return (1 + distance) * np.exp(-distance)
