"""Spikes: a few samples that lie off a marker's smooth path, after which the marker comes back.

The path is the cheapest chain through the marker's samples. A chain pays for each bend that is sharper than a body's, but
never more than 1, because a marker may change its place for good (where two labels are swapped). It also pays for each run
of samples that it omits, less than the three or four bends of an excursion. The cheapest chain is found exactly, by dynamic
programming over the pairs of samples kept last (Viterbi's algorithm; the cost of a bend is Blake and Zisserman's truncated
quadratic). Hence neither a dense burst of spikes nor a gap next to one misleads it, as they do local means and medians.

An omitted sample is a spike only if it lies far from a local fit to the kept samples.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from mocapfix.faults import Fault
from mocapfix.stats.runs import find_runs
from mocapfix.take import Take

# Sharpest bend of a marker on a body: acceleration in a blow or a heel strike, and the part that noise and skin add in any time.
BEND_TOLERANCE_M_PER_S2 = 200.0
BEND_TOLERANCE_M = 0.010
# Cost of omitting one sample, and the additional cost of the longest run that may be omitted.
OMITTED_SAMPLE_COST = 1.5
OMITTED_RUN_LENGTH_COST = 1.5
# Cost of omitting one sample next to a gap or at the ends of the take, where it causes only one bend.
OMITTED_EDGE_SAMPLE_COST = 0.75
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
    reason = f"{label} jumps {severity * 1e3:.0f} mm off its path for {frames} and comes back."
    return Fault("spike", marker, first, first + len(distance_m) - 1, severity, reason)


def _measure_path_deviation(path: _Path, min_distance_m: float, max_duration_s: float) -> np.ndarray:
    """Measure the distance (N,) in metres of each spike sample from the marker's path; 0 for all other samples."""
    frames, points, rate = path
    deviation_m = np.zeros(len(frames))
    if len(frames) < 3:
        return deviation_m
    is_kept = _find_cheapest_chain(frames, points, rate, max(1, round(max_duration_s * rate)))
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


@njit(cache=True)
def _compute_bend(frames, points, rate, a, b, c):
    """Compute how sharply, 0..1, the path bends at sample b between a and c; 1 for the tolerance or more."""
    before, after = (frames[b] - frames[a]) / rate, (frames[c] - frames[b]) / rate
    share, square = before / (before + after), 0.0
    for x in range(3):
        square += (points[a, x] + share * (points[c, x] - points[a, x]) - points[b, x]) ** 2
    return min(1.0, square / (BEND_TOLERANCE_M + BEND_TOLERANCE_M_PER_S2 * before * after / 2) ** 2)


@njit(cache=True)
def _find_cheapest_chain(frames, points, rate, max_omitted):
    """Return the mask (N,) of the samples on the cheapest chain that omits at most `max_omitted` samples in a row.

    cost[i, g] is the cost of the cheapest chain that ends in samples i - g - 1 and i; predecessor[i, g] is its g before.
    """
    count, steps = len(frames), max_omitted + 1
    cost, predecessor = np.full((count, steps), np.inf), np.full((count, steps), -1)
    price = np.array([0.0] + [OMITTED_SAMPLE_COST + OMITTED_RUN_LENGTH_COST * n / max_omitted for n in range(max_omitted)])
    edge_price = price.copy()
    edge_price[1] = OMITTED_EDGE_SAMPLE_COST
    for i in range(1, count):
        for g in range(min(steps, i)):
            j = i - g - 1
            step_price = edge_price[g] if frames[i] - frames[j] > i - j else price[g]
            if j < steps:
                cost[i, g] = edge_price[j] + step_price
            for h in range(min(steps, j)):
                total = cost[j, h] + step_price + _compute_bend(frames, points, rate, j - h - 1, j, i)
                if total < cost[i, g]:
                    cost[i, g], predecessor[i, g] = total, h
    best, i, g = np.inf, count - 1, 0
    for end in range(max(1, count - steps), count):
        for step in range(steps):
            total = cost[end, step] + edge_price[count - 1 - end]
            if total < best:
                best, i, g = total, end, step
    return _trace_chain(predecessor, i, g)


@njit(cache=True)
def _trace_chain(predecessor, i, g):
    """Return the mask (N,) of the samples on the chain that ends in i - g - 1 and i."""
    is_kept = np.zeros(len(predecessor), np.bool_)
    is_kept[i] = True
    while g >= 0:
        i, g = i - g - 1, predecessor[i, g]
        is_kept[i] = True
    return is_kept
