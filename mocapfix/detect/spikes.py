"""Spikes: a few samples that lie off a marker's smooth path, after which the marker returns to it.

The path is the cheapest chain through the marker's samples. Each bend of the chain that is sharper than a body's costs up to
1, the maximum, so that a permanent jump (two swapped labels) remains affordable. Keeping an excursion costs three or four
bends; omitting its samples costs less. The cheapest chain is found exactly, by dynamic programming over the pairs of samples
kept last (Viterbi's algorithm; the cost of a bend is Blake and Zisserman's truncated quadratic). Hence neither a dense burst
of spikes nor a gap next to one misleads it, as they do local means and medians.

An omitted sample is a spike only if it lies far from a local fit to the kept samples, and if the marker's neighbours do not
deviate alike from their own fits to the same frames: a strike or a landing bends the paths of all markers of a segment.
"""

from typing import NamedTuple

import numpy as np

from mocapfix.detect.round_memory import RoundMemory
from mocapfix.detect.shared_motion import compute_weighted_deviations, find_rigid_deviations, find_shared_deviations
from mocapfix.kernels.viterbi import find_cheapest_chain
from mocapfix.model.faults import Fault
from mocapfix.model.take import Take
from mocapfix.stats.marker_distances import estimate_distances
from mocapfix.stats.sequences import find_runs

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
# Largest acceleration of a body part. A deviation that needs a larger one is no motion, even if several markers share it.
MAX_BODY_ACCELERATION_M_PER_S2 = 3000.0


def detect_spikes(take: Take, min_distance_m: float, max_duration_s: float, memory: RoundMemory | None = None) -> list[Fault]:
    """Detect runs of samples more than `min_distance_m` off their path that last at most `max_duration_s`.

    Returns:
        The faults, ordered by marker and first frame. Their severity is the largest distance from the path in metres.
    """
    faults: list[Fault] = []
    memory, partners = memory or RoundMemory(), None
    for m, label in enumerate(take.bare_labels):
        excursion = memory.recall(
            ("excursions", m, min_distance_m, max_duration_s),
            take.visible[:, m],
            lambda m=m: _find_excursions(_get_path(take, m), min_distance_m, max_duration_s),
        )
        if not len(excursion.frames):
            continue
        partners = estimate_distances(take.markers).partner if partners is None else partners
        is_spike = ~_find_shared_excursions(take, m, excursion, partners[m][partners[m] >= 0])
        distance_m = np.zeros(take.frame_count)
        distance_m[excursion.frames[is_spike]] = np.linalg.norm(excursion.deviation[is_spike], axis=-1)
        faults += [_build_spike_fault(label, m, first, distance_m[first : last + 1]) for first, last in find_runs(distance_m > 0)]
    return faults


class _Path(NamedTuple):
    """The visible samples of a marker: frame indices (N,), world positions (N, 3) in metres, frame rate in Hz."""

    frames: np.ndarray
    points: np.ndarray
    rate: float


def _get_path(take: Take, marker: int) -> _Path:
    frames = np.flatnonzero(take.visible[:, marker])
    return _Path(frames, np.ascontiguousarray(take.markers[frames, marker]), take.rate)


def _build_spike_fault(label: str, marker: int, first: int, distance_m: np.ndarray) -> Fault:
    severity, frames = float(distance_m.max()), f"{len(distance_m)} frame{'s' if len(distance_m) > 1 else ''}"
    reason = f"{label} jumps {severity * 1e3:.0f} mm off its path for {frames} and returns."
    return Fault("spike", marker, first, first + len(distance_m) - 1, severity, reason)


class _Excursions(NamedTuple):
    """The samples of a marker that lie far off its path.

    Attributes:
        frames: Frame indices (N,).
        deviation: Deviations (N, 3) in metres from the path.
        fitted_frames: Indices (N, S) of the frames to which the path is fitted locally.
        weight: Weights (N, S) of the positions there, with the sum 1: their weighted mean is the position on the path.
    """

    frames: np.ndarray
    deviation: np.ndarray
    fitted_frames: np.ndarray
    weight: np.ndarray


def _find_excursions(path: _Path, min_distance_m: float, max_duration_s: float) -> _Excursions:
    """Find the samples that lie more than `min_distance_m` off the cheapest chain, for at most `max_duration_s`."""
    frames, points, rate = path
    is_kept = np.ones(len(frames), bool)
    if len(frames) >= 3:
        is_kept = find_cheapest_chain(frames, points, rate, max(1, round(max_duration_s * rate)))
    omitted = np.flatnonzero(~is_kept)
    fit = _fit_locally(frames[is_kept] / rate, frames[omitted] / rate)
    deviation = points[omitted] - np.einsum("ns,nsx->nx", fit.weight, points[is_kept][fit.samples])
    is_far = np.linalg.norm(deviation, axis=-1) > np.maximum(min_distance_m, MIN_SPIKE_DEVIATION_SD * fit.sd_m)
    return _Excursions(frames[omitted][is_far], deviation[is_far], frames[is_kept][fit.samples[is_far]], fit.weight[is_far])


def _find_shared_excursions(take: Take, marker: int, excursion: _Excursions, partners: np.ndarray) -> np.ndarray:
    """Find (N,) the excursions that the marker's partners share and that a body can make."""
    before = excursion.frames - excursion.fitted_frames[:, FIT_SAMPLES_PER_SIDE - 1]
    after = excursion.fitted_frames[:, FIT_SAMPLES_PER_SIDE] - excursion.frames
    max_distance_m = MAX_BODY_ACCELERATION_M_PER_S2 * np.abs(before * after) / take.rate**2 / 2
    is_possible = np.linalg.norm(excursion.deviation, axis=-1) < max_distance_m
    count, samples = len(excursion.frames), np.concatenate([excursion.frames[:, None], excursion.fitted_frames], axis=1)
    needed, rows = np.unique(samples, return_inverse=True)
    rows = rows.reshape(count, -1)
    neighbours = take.markers[needed[:, None], partners]
    deviation = compute_weighted_deviations(neighbours, rows[:, 0], rows[:, 1:], excursion.weight)
    moments = np.stack([excursion.frames - before, excursion.frames, excursion.frames + after], axis=1)
    fraction = np.where((before > 0) & (after > 0), before / np.maximum(before + after, 1), np.nan)
    is_rigid = find_rigid_deviations(take.markers[moments, marker], take.markers[moments[:, :, None], partners], fraction)
    return is_possible & (find_shared_deviations(excursion.deviation, deviation) | is_rigid)


class _LocalFit(NamedTuple):
    """Local fits at N times.

    Attributes:
        samples: Indices (N, S) of the nearest samples.
        weight: Weights (N, S) of these samples in the fitted position, with the sum 1.
        sd_m: Standard deviation (N,) in metres per axis of the fitted position.
    """

    samples: np.ndarray
    weight: np.ndarray
    sd_m: np.ndarray


def _fit_locally(times_s: np.ndarray, query_s: np.ndarray) -> _LocalFit:
    """Fit parabolas through the nearest samples.

    Bayesian least squares: a sample weighs less the farther away in time it is, since a path is close to a parabola only for a
    moment. Where the samples are far away or few, the standard deviation is large and nothing is a spike.
    """
    near = np.searchsorted(times_s, query_s)[:, None] + np.arange(-FIT_SAMPLES_PER_SIDE, FIT_SAMPLES_PER_SIDE)
    exists = (near >= 0) & (near < len(times_s))
    near = near.clip(0, len(times_s) - 1)
    lag = times_s[near] - query_s[:, None]
    precision = exists / (FIT_NOISE_SD_M**2 + (FIT_JERK_SD_M_PER_S3 * lag**3 / 6) ** 2)
    basis = np.stack([np.ones_like(lag), lag, lag**2 / 2], -1)
    covariance = np.linalg.inv(np.einsum("nk,nka,nkb->nab", precision, basis, basis) + np.diag(FIT_PRIOR_SD**-2))
    weight = np.einsum("na,nka,nk->nk", covariance[:, 0], basis, precision)
    # The prior's mean is the position of the first sample that follows.
    weight[:, FIT_SAMPLES_PER_SIDE] += 1 - weight.sum(1)
    return _LocalFit(near, weight, np.sqrt(covariance[:, 0, 0]))
