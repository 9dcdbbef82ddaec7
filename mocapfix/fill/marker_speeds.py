"""The speed of markers: how much it varies, and from which speed on an estimate is impossible."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import maximum_filter1d

MAX_SPEED_RATIO = 3.0
"""Speed of an estimate, relative to the fastest visible motion, above which it is rejected."""
SPEED_PERCENTILE = 99.9
"""Percentile of the speeds of visible markers that counts as the fastest visible motion."""
SPEED_MARGIN_S = 0.25
"""Time around an impossible speed in which estimates are rejected."""
VELOCITY_LAG_S = 0.1
"""Time over which the variation of velocities is measured."""
MIN_SPEED_LIMIT_M_S = 2.0
"""Smallest value of this fastest speed, for takes with little motion."""


class SpeedLimit(NamedTuple):
    """The largest speed of an estimate in m/s."""

    speed_m_s: float

    def is_exceeded(self, path: Float[np.ndarray, "n 3"], rate: float) -> bool:
        """Return whether a path in metres is faster anywhere.

        A cluster of few visible or collinear markers can flip between two frames, which no standard deviation shows.
        """
        speed = np.linalg.norm(np.diff(path, axis=0), axis=-1) * rate
        return bool((np.nan_to_num(speed) > self.speed_m_s).any())


def measure_speed_limit(markers: Float[np.ndarray, "T M 3"], rate: float) -> SpeedLimit:
    """Return the limit for a take; infinite if no marker is visible in two frames in a row.

    markers  in metres, NaN if not visible or an outlier
    rate     frame rate in Hz
    """
    fastest = measure_fastest_speed(markers, rate)
    return SpeedLimit(np.inf if fastest is None else MAX_SPEED_RATIO * max(fastest, MIN_SPEED_LIMIT_M_S))


def measure_velocity_variation(markers: Float[np.ndarray, "T M 3"], rate: float) -> Float[np.ndarray, " M"]:
    """Return the standard deviation of each marker's velocity in m/s; near that of all for markers that show little of it.

    Velocities are those over VELOCITY_LAG_S, in which noise is small.
    """
    lag = min(max(1, round(VELOCITY_LAG_S * rate)), max(1, len(markers) - 1))
    step = markers[lag:] - markers[:-lag]
    count = (~np.isnan(step[..., 0])).sum(0)
    square = np.zeros(markers.shape[1])
    for m in np.flatnonzero(count):
        square[m] = np.nanvar(step[:, m], axis=0).sum()
    typical = square[count > 0].mean() if (count > 0).any() else 0.0
    typical_share = np.exp(-count / lag)
    return np.sqrt(typical_share * typical + (1 - typical_share) * square) * rate / lag


def measure_fastest_speed(markers: Float[np.ndarray, "T M 3"], rate: float) -> float | None:
    """Return the speed in m/s of the fastest visible motion; None if no marker is visible in two frames in a row.

    markers  in metres, NaN if not visible or an outlier
    rate     frame rate in Hz
    """
    speeds = [np.linalg.norm(np.diff(markers[:, m], axis=0), axis=-1) for m in range(markers.shape[1])]
    visible = np.concatenate([speed[~np.isnan(speed)] for speed in speeds]) * rate if speeds else np.zeros(0)
    return float(np.percentile(visible, SPEED_PERCENTILE)) if len(visible) else None


def find_impossible_speeds(
    path: Float[np.ndarray, "T M 3"], is_inlier: Bool[np.ndarray, "T M"], rate: float, fastest_speed: float | None
) -> Bool[np.ndarray, "T M"]:
    """Find samples of gaps near a time at which the marker would be MAX_SPEED_RATIO times as fast as any visible one.

    A cluster of few visible or collinear markers can flip between two frames, which no standard deviation shows.

    path           positions in metres with the gaps filled
    is_inlier      the samples that are visible
    rate           frame rate in Hz
    fastest_speed  of the visible motion in m/s; None if there is none, and no speed is impossible
    """
    is_impossible = np.zeros_like(is_inlier)
    if fastest_speed is None:
        return is_impossible
    frames, markers = np.nonzero(~(is_inlier[1:] & is_inlier[:-1]))  # of the steps into, within and out of gaps
    speed = np.nan_to_num(np.linalg.norm(path[frames + 1, markers] - path[frames, markers], axis=-1)) * rate
    is_fast = speed > MAX_SPEED_RATIO * max(fastest_speed, MIN_SPEED_LIMIT_M_S)
    if not is_fast.any():
        return is_impossible
    is_impossible[frames[is_fast], markers[is_fast]] = is_impossible[frames[is_fast] + 1, markers[is_fast]] = True
    return maximum_filter1d(is_impossible, 2 * round(SPEED_MARGIN_S * rate) + 1, axis=0) & ~is_inlier
