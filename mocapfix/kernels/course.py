"""Carrying what was seen beside a gap across it.

What a marker does beyond its segment's motion (skin, and the solve's own error), or a joint beyond what was expected of it,
is a smooth random course about zero: a Gaussian process with Matern-3/2 covariance (Rasmussen & Williams 2006, Eq. 4.17).
Given the samples on both sides of a gap its mean goes on smoothly from them and fades towards zero in the middle of a long
gap, and its variance says how far it can be trusted.
"""

import numpy as np

from mocapfix.take import runs

LISTENED = 6  # samples on either side
MOMENT = 0.025  # seconds over which a course is rough, where it is


def across(
    residual: np.ndarray, wanted: np.ndarray, rate: float, fade: float, reach: float, noise: float, least: float
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
    power = max(float(np.median(residual[known] ** 2)) * 2.2 if known.any() else 0.0, least**2)
    restless = roughness(residual, rate, fade, noise, power)
    steps = max(1, round(reach * rate))
    pick = np.unique(np.linspace(0, steps - 1, min(LISTENED, steps)).astype(int))
    for first, last in runs(wanted):
        before, after = first - 1 - pick, last + 1 + pick
        near = np.r_[before[before >= 0], after[after < len(residual)]]
        near = near[known[near]]
        gap = np.arange(first, last + 1)
        if len(near) == 0:
            variance[gap] = power
            continue
        among = power * matern((near[:, None] - near[None]) / rate, fade) + noise**2 * np.eye(len(near))
        between = power * matern((gap[:, None] - near[None]) / rate, fade)
        weight = np.linalg.solve(among, between.T).T
        course[gap] = weight @ residual[near]
        left = np.maximum(power - (weight * between).sum(1), 0.0)
        variance[gap] = np.minimum(left + restless * bridge(first, last, len(residual)) / rate, power)
    return course, variance, power


def roughness(residual: np.ndarray, rate: float, fade: float, noise: float, power: float) -> float:
    """-> by how much more than foretold a residual (T, 3) changes in a moment, squared, per second: skin may slide in steps."""
    step = max(1, round(MOMENT * rate))
    change = residual[step:] - residual[:-step]
    change = change[~np.isnan(change[:, 0])]
    if len(change) < LISTENED:
        return 0.0
    foretold = 2 * power * (1 - matern(np.array(step / rate), fade)) + 2 * noise**2
    return max(float(2.2 * np.median(change**2) - foretold), 0.0) * rate / step


def bridge(first: int, last: int, frames: int) -> np.ndarray:
    """-> (G,) the variance, in that of one frame's step, of a random walk over first..last that is known on both sides."""
    gap = np.arange(first, last + 1)
    before = gap - first + 1.0 if first > 0 else np.full(len(gap), np.inf)
    after = last + 1.0 - gap if last < frames - 1 else np.full(len(gap), np.inf)
    return 1 / (1 / before + 1 / after)


def matern(seconds: np.ndarray, fade: float) -> np.ndarray:
    """-> the correlation of the course at two moments so far apart."""
    distance = np.sqrt(3) * np.abs(seconds) / fade
    return (1 + distance) * np.exp(-distance)
