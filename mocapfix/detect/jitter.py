"""Noise and jitter: markers that are noisier than the others throughout, and bursts of noise of one marker.

The noise of a sample is its deviation from the cubic through its four neighbours. That removes almost all of a body's motion
and keeps the noise. The median over the take ignores spikes, bursts and gaps; the median over the shortest burst that counts
ignores single samples. Fast motion leaves a residual as well, which the markers of a segment share: only the noise that is not
proportional to that of the marker's neighbours is jitter.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import binary_closing, median_filter

from mocapfix.detect.round_memory import RoundMemory
from mocapfix.detect.shared_motion import compute_weighted_deviations, remove_shared_noise
from mocapfix.model.faults import Fault
from mocapfix.model.take import Take
from mocapfix.stats.marker_distances import estimate_distances
from mocapfix.stats.sequences import find_runs

# The neighbours of a sample through which the cubic goes.
NEIGHBOUR_OFFSETS = (-2, -1, 1, 2)
# The weights of the neighbours in the cubic's value at the sample, where none is missing.
NEIGHBOUR_WEIGHTS = (-1 / 6, 2 / 3, 2 / 3, -1 / 6)
# Samples whose times are this regular, relative to the time of a step, have no gap among them.
MAX_STEP_VARIATION = 0.01
# Number of samples from which a noise level is estimated: one outlier affects five of them.
MIN_NOISE_SAMPLES = 11
# Median norm of a vector of three independent standard normal numbers.
MEDIAN_NORM_SD = 1.538
# Smallest noise level of a noisy marker, relative to the median of the other markers and absolute.
MIN_NOISE_RATIO = 5.0
MIN_NOISE_M = 0.001
# Part of a body's motion that the cubic may leave. It matters at low frame rates only.
CUBIC_RESIDUAL_M_PER_S2 = 30.0


def detect_noise(take: Take, memory: RoundMemory | None = None) -> list[Fault]:
    """Detect the markers that are much noisier than the others.

    Returns:
        One fault for each marker, from its first to its last visible frame. Its severity is the noise level in metres.
    """
    levels_m = estimate_noise_levels(take, memory)
    faults: list[Fault] = []
    for m in np.flatnonzero(levels_m > MIN_NOISE_M):
        others = np.delete(levels_m, m)
        usual_m = float(np.nanmedian(others)) if np.isfinite(others).any() else np.inf
        if levels_m[m] > MIN_NOISE_RATIO * usual_m:
            first, *_, last = np.flatnonzero(take.visible[:, m])
            level = f"has noise of {levels_m[m] * 1e3:.1f} mm throughout; the other markers have {usual_m * 1e3:.1f} mm."
            reason = f"{take.bare_labels[m]} {level}"
            faults.append(Fault("noise", int(m), int(first), int(last), float(levels_m[m]), reason))
    return faults


def estimate_noise_levels(take: Take, memory: RoundMemory | None = None) -> Float[np.ndarray, " M"]:
    """Estimate the standard deviation per axis, in metres, of each marker's noise; NaN if the marker is hardly visible."""
    memory, visible = memory or RoundMemory(), take.visible
    markers = range(len(take.labels))
    usual_m = [memory.recall(("usual residual", m), visible[:, m], lambda m=m: _measure_usual_residual(take, m)) for m in markers]
    return np.array(usual_m) / MEDIAN_NORM_SD


def _measure_usual_residual(take: Take, marker: int) -> float:
    """Measure the median residual in metres of a marker's visible samples, NaN if there are too few."""
    frames = np.flatnonzero(take.visible[:, marker])
    if len(frames) < MIN_NOISE_SAMPLES:
        return np.nan
    return float(np.median(compute_cubic_residuals(frames / take.rate, take.markers[frames, marker])))


def compute_cubic_residuals(times_s: Float[np.ndarray, " N"], points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, " N"]:
    """Compute the distance in metres of each of at least 5 samples from the cubic through its neighbours.

    The cubic is evaluated with Lagrange weights at the samples' own times. The residual is scaled so that white noise keeps
    its standard deviation. The first and last two samples have their neighbours' residuals.
    """
    count = len(times_s) - 4
    lag = [times_s[2 + offset : 2 + offset + count] - times_s[2:-2] for offset in NEIGHBOUR_OFFSETS]
    steps = np.diff(times_s)
    if np.ptp(steps) < MAX_STEP_VARIATION * steps[0]:
        lag = [each[:1] for each in lag]  # the weights are the same for all samples
    weights = [np.prod([far / (far - near) for far in lag if far is not near], axis=0) for near in lag]
    residual = points[2:-2].copy()
    for weight, offset in zip(weights, NEIGHBOUR_OFFSETS, strict=True):
        residual -= weight[:, None] * points[2 + offset : 2 + offset + count]
    gain = np.sqrt(1 + sum(weight**2 for weight in weights))
    return np.pad(np.sqrt((residual**2).sum(1)) / gain, 2, mode="edge")


def detect_jitter(
    take: Take,
    is_usable: Bool[np.ndarray, "T M"],
    min_amplitude_m: float,
    min_ratio: float,
    min_duration_s: float,
    memory: RoundMemory | None = None,
) -> list[Fault]:
    """Detect the bursts in which a marker is much noisier than in the rest of the take.

    Args:
        take: The measured samples.
        is_usable: The samples without spikes.
        min_amplitude_m: Smallest noise in a burst, in metres.
        min_ratio: Smallest noise in a burst, in multiples of the marker's median over the take.
        min_duration_s: Duration of the shortest burst.
        memory: What earlier rounds on the same positions found.

    Returns:
        The faults, ordered by marker and first frame. Their severity is the noise in metres.
    """
    limits = _BurstLimits(min_amplitude_m + CUBIC_RESIDUAL_M_PER_S2 / take.rate**2, min_ratio, min_duration_s * take.rate)
    faults: list[Fault] = []
    memory, partners = memory or RoundMemory(), None
    for m, label in enumerate(take.bare_labels):
        samples = is_usable[:, m]
        noise = memory.recall(
            ("bursts", m, limits), samples, lambda m=m, samples=samples: _measure_noise(take, m, samples, limits)
        )
        memory.recall(("usual residual", m), samples, lambda noise=noise: noise.usual_m)  # for `estimate_noise_levels`
        for burst in noise.bursts:
            partners = estimate_distances(take.markers).partner if partners is None else partners
            if _is_shared_burst(take, is_usable, [m, *partners[m][partners[m] >= 0]], burst, noise.threshold_m):
                continue
            duration_s = (burst.last - burst.first + 1) / take.rate
            reason = (
                f"{label} has jitter of {burst.amplitude_m * 1e3:.0f} mm for {duration_s:.2f} s; "
                f"its usual noise is {noise.usual_m * 1e3:.1f} mm."
            )
            faults.append(Fault("jitter", m, burst.first, burst.last, burst.amplitude_m, reason))
    return faults


class _BurstLimits(NamedTuple):
    """The smallest noise of a burst, in metres and relative to the marker's median, and its least number of frames."""

    min_amplitude_m: float
    min_ratio: float
    min_frames: float


class _Burst(NamedTuple):
    """A burst of jitter over the frames first..last, inclusive, with its amplitude in metres."""

    first: int
    last: int
    amplitude_m: float


class _MarkerNoise(NamedTuple):
    """The median noise of a marker, the smallest noise of a burst of it, both in metres, and the bursts."""

    usual_m: float
    threshold_m: float
    bursts: tuple[_Burst, ...]


def _measure_noise(take: Take, marker: int, is_usable: np.ndarray, limits: _BurstLimits) -> _MarkerNoise:
    """Measure the noise of a marker in the frames `is_usable` (T,)."""
    frames = np.flatnonzero(is_usable)
    if len(frames) < MIN_NOISE_SAMPLES:
        return _MarkerNoise(np.nan, np.nan, ())
    residual_m = compute_cubic_residuals(frames / take.rate, take.markers[frames, marker])
    usual_m = float(np.median(residual_m))
    threshold_m = max(limits.min_amplitude_m, limits.min_ratio * usual_m)
    return _MarkerNoise(usual_m, threshold_m, tuple(_find_bursts(frames, residual_m, threshold_m, limits.min_frames)))


def _find_bursts(frames: np.ndarray, residual_m: np.ndarray, min_residual_m: float, min_frames: float) -> Iterator[_Burst]:
    """Find the bursts among samples at `frames` (N,). A gap of `min_frames` or longer ends a burst."""
    window = max(MIN_NOISE_SAMPLES, round(min_frames)) | 1
    for stretch in np.split(np.arange(len(frames)), np.flatnonzero(np.diff(frames) > min_frames) + 1):
        is_noisy = _is_median_above(residual_m[stretch], window, min_residual_m)
        if not is_noisy.any():
            continue
        median_m = median_filter(residual_m[stretch], window, mode="nearest")
        is_burst = is_noisy | binary_closing(is_noisy, np.ones(window))  # a short pause does not end a burst
        for a, b in find_runs(is_burst):
            first, last = int(frames[stretch[a]]), int(frames[stretch[b]])
            if len(stretch) >= MIN_NOISE_SAMPLES and last - first + 1 >= min_frames:
                yield _Burst(first, last, float(median_m[a : b + 1].max()))


def _is_shared_burst(
    take: Take, is_usable: np.ndarray, markers_compared: list[int], burst: _Burst, min_residual_m: float
) -> bool:
    """Return whether a marker's noise in a burst is that of its neighbours.

    Args:
        take: The measured samples.
        is_usable: The samples (T, M) without spikes.
        markers_compared: Indices of the marker and its neighbours.
        burst: The burst.
        min_residual_m: Smallest noise of a burst.
    """
    reach = max(NEIGHBOUR_OFFSETS)
    start, stop = max(burst.first - reach, 0), min(burst.last + reach + 1, take.frame_count)
    usable = is_usable[start:stop, markers_compared, None]
    markers = np.where(usable, take.markers[start:stop, markers_compared], np.nan)
    frames = np.arange(reach, len(markers) - reach)
    around = frames[:, None] + np.array(NEIGHBOUR_OFFSETS)
    residual = compute_weighted_deviations(markers, frames, around, np.tile(NEIGHBOUR_WEIGHTS, (len(frames), 1)))
    residual = residual[~np.isnan(residual[:, 0, 0])]
    if len(residual) < MIN_NOISE_SAMPLES:
        return False
    unexplained_m = np.linalg.norm(remove_shared_noise(residual[:, 0], residual[:, 1:]), axis=-1)
    return bool(np.median(unexplained_m) / np.sqrt(1 + np.square(NEIGHBOUR_WEIGHTS).sum()) < min_residual_m)


def _is_median_above(values: np.ndarray, window: int, threshold: float) -> np.ndarray:
    """Return (N,) whether the median over an odd window around each sample exceeds a threshold, without computing it.

    The first and the last value continue beyond the ends, as those of `median_filter` with the mode "nearest".
    """
    is_above = np.pad(values > threshold, window // 2, mode="edge")
    count = np.r_[0, np.cumsum(is_above)]
    return count[window:] - count[:-window] > window // 2
