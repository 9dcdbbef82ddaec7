"""Noise: how much each marker trembles all along, and the markers that tremble far more than the take's others.

The measure is what a cubic through a sample's four neighbours leaves of it, which is next to nothing of a body's motion and
all of a tremble; its median over the take is blind to spikes, bursts and gaps.
"""

from collections.abc import Iterator

import numpy as np
from scipy.ndimage import binary_closing, median_filter

from mocapfix.faults import Fault
from mocapfix.stats.runs import find_runs
from mocapfix.take import Take

# MERGED: mocapfix.detect.noise
NEIGHBOUR_OFFSETS = (-2, -1, 1, 2)  # the four neighbours of a sample
MIN_NOISE_SAMPLES = 11  # samples of which a level is told at least, for a single one that is off spoils five
MEDIAN_NORM_SD = 1.538  # of the length of a vector whose three numbers have standard deviation 1
MIN_NOISE_RATIO = 5.0  # times the level of the take's other markers: how noisy one is at least
MIN_NOISE_M = 0.001  # metres, likewise


def detect_noise(take: Take) -> list[Fault]:
    """-> the markers that are much noisier than the take's others, from the first to the last frame in which each is seen."""
    levels, faults = estimate_noise_levels(take), []
    for m in np.flatnonzero(levels > MIN_NOISE_M):
        others = np.delete(levels, m)
        usual = float(np.nanmedian(others)) if np.isfinite(others).any() else np.inf
        if levels[m] > MIN_NOISE_RATIO * usual:
            first, *_, last = np.flatnonzero(take.visible[:, m])
            off = f"trembles by {levels[m] * 1e3:.1f} mm all along; the take's other markers do by {usual * 1e3:.1f} mm."
            reason = f"{take.bare_labels[m]} {off}"
            faults.append(Fault("noise", int(m), int(first), int(last), float(levels[m]), reason))
    return faults


def estimate_noise_levels(take: Take) -> np.ndarray:
    """-> (M,) metres: the standard deviation per axis by which each marker trembles; NaN where it is hardly seen."""
    levels = np.full(len(take.labels), np.nan)
    for m in range(len(levels)):
        frames = np.flatnonzero(take.visible[:, m])
        if len(frames) >= MIN_NOISE_SAMPLES:
            levels[m] = np.median(compute_cubic_residuals(frames / take.rate, take.markers[frames, m])) / MEDIAN_NORM_SD
    return levels


def compute_cubic_residuals(times: np.ndarray, points: np.ndarray) -> np.ndarray:
    """-> (N,) metres: how far each of N >= 5 samples (N, 3) lies from the cubic through its neighbours.

    Lagrange's weights at the samples' own `times` (N,), scaled so that white noise keeps its standard deviation.
    """
    middle = np.arange(2, len(times) - 2)
    lag = [times[middle + side] - times[middle] for side in NEIGHBOUR_OFFSETS]
    weights = [np.prod([far / (far - near) for far in lag if far is not near], axis=0) for near in lag]
    cubic = sum(weight[:, None] * points[middle + side] for weight, side in zip(weights, NEIGHBOUR_OFFSETS, strict=True))
    gain = np.sqrt(1 + sum(weight**2 for weight in weights))
    return np.pad(np.linalg.norm(points[middle] - cubic, axis=-1) / gain, 2, mode="edge")


# MERGED: mocapfix.detect.jitter
# Jitter: a burst in which a marker trembles far more than it does in the rest of the take.
#
# The measure is that of noise, what a cubic through a sample's neighbours leaves of it; its median over the shortest burst
# that counts is blind to single samples. Where the marker trembles a few times more than its own median over the take, that is
# a burst.
CUBIC_RESIDUAL_M_PER_S2 = 30.0  # m/s2: what the cubic may leave of a body's motion; it tells at low frame rates only


def detect_jitter(
    take: Take, is_usable: np.ndarray, min_amplitude_m: float, min_ratio: float, min_duration_s: float
) -> list[Fault]:
    """-> the bursts among the `usable` (T, M) samples that are free of spikes.

    In a burst the marker trembles by at least `smallest` metres and `ratio` times its own median, for `shortest` seconds.
    """
    faults = []
    for m, label in enumerate(take.bare_labels):
        frames = np.flatnonzero(is_usable[:, m])
        if len(frames) < MIN_NOISE_SAMPLES:
            continue
        trembles = compute_cubic_residuals(frames / take.rate, take.markers[frames, m])
        own = float(np.median(trembles))
        threshold = max(min_amplitude_m + CUBIC_RESIDUAL_M_PER_S2 / take.rate**2, min_ratio * own)
        for first, last, size in _find_bursts(frames, trembles, threshold, min_duration_s * take.rate):
            seconds = (last - first + 1) / take.rate
            reason = f"{label} trembles by {size * 1e3:.0f} mm for {seconds:.2f} s; its usual tremble is {own * 1e3:.1f} mm."
            faults.append(Fault("jitter", m, first, last, size, reason))
    return faults


def _find_bursts(
    frames: np.ndarray, residual_m: np.ndarray, min_residual_m: float, min_frames: float
) -> Iterator[tuple[int, int, float]]:
    """-> the first and last frame and the size in metres of each burst; a gap of the `shortest` (frames) or longer ends one."""
    window = max(MIN_NOISE_SAMPLES, round(min_frames)) | 1
    for stretch in np.split(np.arange(len(frames)), np.flatnonzero(np.diff(frames) > min_frames) + 1):
        usual = median_filter(residual_m[stretch], window, mode="nearest")
        trembles = usual > min_residual_m
        for a, b in find_runs(trembles | binary_closing(trembles, np.ones(window))):  # a moment's rest does not end a burst
            first, last = int(frames[stretch[a]]), int(frames[stretch[b]])
            if len(stretch) >= MIN_NOISE_SAMPLES and last - first + 1 >= min_frames:
                yield first, last, float(usual[a : b + 1].max())
