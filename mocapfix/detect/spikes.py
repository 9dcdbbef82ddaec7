"""Spikes: a few samples that lie off a marker's smooth path, after which the marker returns to it.

The path is the cheapest chain through the marker's samples. Each bend of the chain that is sharper than a body's costs up to
1, the maximum, so that a permanent jump (two swapped labels) remains affordable. Keeping an excursion costs three or four
bends; omitting its samples costs less. The cheapest chain is found exactly, by dynamic programming over the pairs of samples
kept last (Viterbi's algorithm; the cost of a bend is Blake and Zisserman's truncated quadratic). Hence neither a dense burst
of spikes nor a gap next to one misleads it, as they do local means and medians.

An omitted sample is a spike only if it lies far from a local fit to the kept samples.
"""

from typing import NamedTuple

import numpy as np

from mocapfix.faults import Fault
from mocapfix.kernels.viterbi import find_cheapest_chain
from mocapfix.stats.sequences import find_runs
from mocapfix.take import Take

# Measurement noise of the local fit, per axis.
FIT_NOISE_SD_M = 0.002
# Prior standard deviations of the local fit: position (m), velocity (m/s) and acceleration (m/s2).
FIT_PRIOR_SD = np.array([10.0, 10.0, 100.0])
# Jerk by which the path deviates from a parabola.
FIT_JERK_SD_M_PER_S3 = 5000.0
# Number of kept samples on either side to which a parabola is fitted.
FIT_SAMPLES_PER_SIDE = 3
# Smallest distance of a spike from the fit, in standard deviations of the fit.
MIN_SPIKE_DEVIATION_SD = 4.0


def detect_spikes(take: Take, min_distance_m: float, max_duration_s: float) -> list[Fault]:
    """Detect runs of samples more than `min_distance_m` off their path that last at most `max_duration_s`.

    Returns:
        The faults, ordered by marker and first frame. Their severity is the largest distance from the path in metres.
    """
    faults: list[Fault] = []
    visible = take.visible
    for m, label in enumerate(take.bare_labels):
        frames = np.flatnonzero(visible[:, m])
        path = _Path(frames, np.ascontiguousarray(take.markers[frames, m]), take.rate)
        distance_m = np.zeros(take.frame_count)
        distance_m[frames] = _measure_path_deviation(path, min_distance_m, max_duration_s)
        faults += [_build_spike_fault(label, m, first, distance_m[first : last + 1]) for first, last in find_runs(distance_m > 0)]
    return faults


class _Path(NamedTuple):
    """The visible samples of a marker: frame indices (N,), world positions (N, 3) in metres, frame rate in Hz."""

    frames: np.ndarray
    points: np.ndarray
    rate: float


def _build_spike_fault(label: str, marker: int, first: int, distance_m: np.ndarray) -> Fault:
    severity, frames = float(distance_m.max()), f"{len(distance_m)} frame{'s' if len(distance_m) > 1 else ''}"
    reason = f"{label} jumps {severity * 1e3:.0f} mm off its path for {frames} and returns."
    return Fault("spike", marker, first, first + len(distance_m) - 1, severity, reason)


def _measure_path_deviation(path: _Path, min_distance_m: float, max_duration_s: float) -> np.ndarray:
    """Measure the distance (N,) in metres of each spike sample from the marker's path; 0 for all other samples."""
    frames, points, rate = path
    deviation_m = np.zeros(len(frames))
    if len(frames) < 3:
        return deviation_m
    is_kept = find_cheapest_chain(frames, points, rate, max(1, round(max_duration_s * rate)))
    omitted = np.flatnonzero(~is_kept)
    if len(omitted):
        expected, sd_m = _fit_locally(frames[is_kept] / rate, points[is_kept], frames[omitted] / rate)
        distance_m = np.linalg.norm(points[omitted] - expected, axis=-1)
        is_spike = distance_m > np.maximum(min_distance_m, MIN_SPIKE_DEVIATION_SD * sd_m)
        deviation_m[omitted] = np.where(is_spike, distance_m, 0.0)
    return deviation_m


def _fit_locally(times_s: np.ndarray, points: np.ndarray, query_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit parabolas through the nearest samples.

    Bayesian least squares: a sample weighs less the farther away in time it is, since a path is close to a parabola only for a
    moment. Where the samples are far away or few, the standard deviation is large and nothing is a spike.

    Returns:
        The positions (N, 3) at the query times (N,), and their standard deviations (N,) per axis.
    """
    near = np.searchsorted(times_s, query_s)[:, None] + np.arange(-FIT_SAMPLES_PER_SIDE, FIT_SAMPLES_PER_SIDE)
    exists = (near >= 0) & (near < len(times_s))
    near = near.clip(0, len(times_s) - 1)
    lag = times_s[near] - query_s[:, None]
    weight = exists / (FIT_NOISE_SD_M**2 + (FIT_JERK_SD_M_PER_S3 * lag**3 / 6) ** 2)
    basis = np.stack([np.ones_like(lag), lag, lag**2 / 2], -1)
    origin = points[near[:, FIT_SAMPLES_PER_SIDE]][:, None]
    covariance = np.linalg.inv(np.einsum("nk,nka,nkb->nab", weight, basis, basis) + np.diag(FIT_PRIOR_SD**-2))
    moment = np.einsum("nk,nka,nkx->nax", weight, basis, points[near] - origin)
    return origin[:, 0] + np.einsum("na,nax->nx", covariance[:, 0], moment), np.sqrt(covariance[:, 0, 0])
