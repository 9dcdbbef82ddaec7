"""Spikes: a few samples that lie off a marker's own smooth path, and the marker comes back.

The path is the cheapest chain through the marker's samples. A chain pays for each bend sharper than a body's, but never
more than 1, for a marker may change its place once and for all (where two labels are swapped); and it pays for each run
of samples it leaves out, less than the three or four bends of an excursion. The cheapest chain is found exactly, by dynamic
programming over the pairs of samples kept last (Viterbi's algorithm; the bends are Blake and Zisserman's truncated
quadratic), so neither a dense burst of spikes nor a gap beside one misleads it as they do local means and medians. What
it left out is a spike only where that lies far from a local fit to what it kept.
"""

import numpy as np
from numba import njit

from mocapfix.faults import Fault
from mocapfix.stats.runs import find_runs
from mocapfix.take import Take

BEND_TOLERANCE_M_PER_S2 = 200.0  # m/s2: what a marker on a body does in a blow or a heel strike
BEND_TOLERANCE_M = 0.010  # metres: how sharp a bend noise and skin make in whatever little time
OMITTED_SAMPLE_COST, OMITTED_RUN_LENGTH_COST = 1.5, 1.5  # of leaving out one sample, and besides for the longest run there may be
OMITTED_EDGE_SAMPLE_COST = 0.75  # of leaving out one sample beside a gap or at the take's ends, where it makes only one bend
FIT_NOISE_SD_M = 0.002  # metres per axis
FIT_PRIOR_SD = np.array([10.0, 10.0, 100.0])  # metres, m/s, m/s2: standard deviations before any sample is seen
FIT_JERK_SD_M_PER_S3 = 5000.0  # m/s3: how soon a parabola stops being true
FIT_SAMPLES_PER_SIDE = 3  # kept samples used on either side
MIN_SPIKE_DEVIATION_SD = 4.0  # standard deviations


def detect_spikes(take: Take, min_distance_m: float, max_duration_s: float) -> list[Fault]:
    """-> every spike: samples at least `smallest` metres off their path, `longest` seconds in a row at most."""
    faults, seen = [], take.visible
    for m, label in enumerate(take.bare_labels):
        frames = np.flatnonzero(seen[:, m])
        off = _measure_path_deviation(
            frames, np.ascontiguousarray(take.markers[frames, m]), take.rate, min_distance_m, max_duration_s
        )
        distance = np.zeros(take.frame_count)
        distance[frames] = off
        faults += [
            _build_spike_fault(label, m, first, last, distance[first : last + 1]) for first, last in find_runs(distance > 0)
        ]
    return faults


def _build_spike_fault(label: str, marker: int, first: int, last: int, distance_m: np.ndarray) -> Fault:
    severity, frames = float(distance_m.max()), f"{len(distance_m)} frame{'s' if len(distance_m) > 1 else ''}"
    reason = f"{label} jumps {severity * 1e3:.0f} mm off its path for {frames} and comes back."
    return Fault("spike", marker, first, last, severity, reason)


def _measure_path_deviation(
    frames: np.ndarray, points: np.ndarray, rate: float, min_distance_m: float, max_duration_s: float
) -> np.ndarray:
    """-> (N,) metres: how far each sample (N, 3) at `frames` (N,) lies off the marker's path; 0 for a sample that does not."""
    off = np.zeros(len(frames))
    if len(frames) < 3:
        return off
    kept = _find_cheapest_chain(frames, points, rate, max(1, round(max_duration_s * rate)))
    left_out = np.flatnonzero(~kept)
    if len(left_out):
        expected, deviation = _fit_locally(frames[kept] / rate, points[kept], frames[left_out] / rate)
        distance = np.linalg.norm(points[left_out] - expected, axis=-1)
        off[left_out] = np.where(distance > np.maximum(min_distance_m, MIN_SPIKE_DEVIATION_SD * deviation), distance, 0.0)
    return off


def _fit_locally(times: np.ndarray, points: np.ndarray, when: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """-> positions (N, 3) and their standard deviation (N,) per axis at `when` (N,): parabolas through the nearest samples.

    Bayesian least squares: a sample weighs less the farther away in time it is, for a path is a parabola only for a
    moment. Where samples are far or few the deviation is large, and nothing is called a spike.
    """
    near = np.searchsorted(times, when)[:, None] + np.arange(-FIT_SAMPLES_PER_SIDE, FIT_SAMPLES_PER_SIDE)
    there = (near >= 0) & (near < len(times))
    near = near.clip(0, len(times) - 1)
    lag = times[near] - when[:, None]
    weight = there / (FIT_NOISE_SD_M**2 + (FIT_JERK_SD_M_PER_S3 * lag**3 / 6) ** 2)
    basis = np.stack([np.ones_like(lag), lag, lag**2 / 2], -1)
    origin = points[near[:, FIT_SAMPLES_PER_SIDE]][:, None]
    covariance = np.linalg.inv(np.einsum("nk,nka,nkb->nab", weight, basis, basis) + np.diag(FIT_PRIOR_SD**-2))
    moment = np.einsum("nk,nka,nkx->nax", weight, basis, points[near] - origin)
    return origin[:, 0] + np.einsum("na,nax->nx", covariance[:, 0], moment), np.sqrt(covariance[:, 0, 0])


@njit(cache=True)
def _compute_bend(frames, points, rate, a, b, c):
    """-> 0..1: how sharply the path bends at sample b between a and c, 1 being as sharp as counts."""
    before, after = (frames[b] - frames[a]) / rate, (frames[c] - frames[b]) / rate
    share, square = before / (before + after), 0.0
    for x in range(3):
        square += (points[a, x] + share * (points[c, x] - points[a, x]) - points[b, x]) ** 2
    return min(1.0, square / (BEND_TOLERANCE_M + BEND_TOLERANCE_M_PER_S2 * before * after / 2) ** 2)


@njit(cache=True)
def _find_cheapest_chain(frames, points, rate, max_omitted):
    """-> (N,) bool: the samples on the cheapest chain that leaves out at most `longest` samples in a row.

    cost[i, g] is that of the cheapest chain that ends in samples i - g - 1 and i; came[i, g] is the g before.
    """
    count, steps = len(frames), max_omitted + 1
    cost, came = np.full((count, steps), np.inf), np.full((count, steps), -1)
    price = np.array([0.0] + [OMITTED_SAMPLE_COST + OMITTED_RUN_LENGTH_COST * n / max_omitted for n in range(max_omitted)])
    edge = price.copy()
    edge[1] = OMITTED_EDGE_SAMPLE_COST
    for i in range(1, count):
        for g in range(min(steps, i)):
            j = i - g - 1
            leap = edge[g] if frames[i] - frames[j] > i - j else price[g]
            if j < steps:
                cost[i, g] = edge[j] + leap
            for h in range(min(steps, j)):
                total = cost[j, h] + leap + _compute_bend(frames, points, rate, j - h - 1, j, i)
                if total < cost[i, g]:
                    cost[i, g], came[i, g] = total, h
    best, i, g = np.inf, count - 1, 0
    for end in range(max(1, count - steps), count):
        for step in range(steps):
            total = cost[end, step] + edge[count - 1 - end]
            if total < best:
                best, i, g = total, end, step
    return _trace_chain(came, i, g)


@njit(cache=True)
def _trace_chain(predecessor, i, g):
    """-> (N,) bool: the samples on the chain that ends in i - g - 1 and i."""
    kept = np.zeros(len(predecessor), np.bool_)
    kept[i] = True
    while g >= 0:
        i, g = i - g - 1, predecessor[i, g]
        kept[i] = True
    return kept
