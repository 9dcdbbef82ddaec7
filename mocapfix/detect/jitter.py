"""Jitter: a burst in which a marker trembles far more than it does in the rest of the take.

The measure is what a cubic through a sample's four neighbours leaves of it, which is next to nothing of a body's
motion and all of a tremble; its median over the shortest burst that counts is blind to single samples. Where the
marker trembles a few times more than its own median over the take, that is a burst.
"""

from collections.abc import Iterator

import numpy as np
from scipy.ndimage import binary_closing, median_filter

from mocapfix.faults import Fault
from mocapfix.take import Take, runs

SIDES = (-2, -1, 1, 2)  # the four neighbours of a sample
FEWEST = 11  # samples in the median at least, for a single one that is off spoils five
SWAY = 30.0  # m/s2: what the cubic may leave of a body's motion; it tells at low frame rates only


def found(take: Take, usable: np.ndarray, smallest: float, ratio: float, shortest: float) -> list[Fault]:
    """-> the bursts among the `usable` (T, M) samples that are free of spikes.

    In a burst the marker trembles by at least `smallest` metres and `ratio` times its own median, for `shortest` seconds.
    """
    faults = []
    for m, label in enumerate(take.bare_labels):
        frames = np.flatnonzero(usable[:, m])
        if len(frames) < FEWEST:
            continue
        tremble = _tremble(frames / take.rate, take.markers[frames, m])
        own = float(np.median(tremble))
        threshold = max(smallest + SWAY / take.rate**2, ratio * own)
        for first, last, size in _bursts(frames, tremble, threshold, shortest * take.rate):
            seconds = (last - first + 1) / take.rate
            reason = f"{label} trembles by {size * 1e3:.0f} mm for {seconds:.2f} s; its usual tremble is {own * 1e3:.1f} mm."
            faults.append(Fault("jitter", m, first, last, size, reason))
    return faults


def _bursts(frames: np.ndarray, tremble: np.ndarray, threshold: float, shortest: float) -> Iterator[tuple[int, int, float]]:
    """-> the first and last frame and the size in metres of each burst; a gap of the `shortest` (frames) or longer ends one."""
    window = max(FEWEST, round(shortest)) | 1
    for stretch in np.split(np.arange(len(frames)), np.flatnonzero(np.diff(frames) > shortest) + 1):
        usual = median_filter(tremble[stretch], window, mode="nearest")
        trembles = usual > threshold
        for a, b in runs(trembles | binary_closing(trembles, np.ones(window))):  # a moment's rest does not end a burst
            first, last = int(frames[stretch[a]]), int(frames[stretch[b]])
            if len(stretch) >= FEWEST and last - first + 1 >= shortest:
                yield first, last, float(usual[a : b + 1].max())


def _tremble(times: np.ndarray, points: np.ndarray) -> np.ndarray:
    """-> (N,) metres: how far each of N >= 5 samples (N, 3) lies from the cubic through its neighbours.

    Lagrange's weights at the samples' own `times` (N,), scaled so that white noise keeps its standard deviation.
    """
    middle = np.arange(2, len(times) - 2)
    lag = [times[middle + side] - times[middle] for side in SIDES]
    weights = [np.prod([far / (far - near) for far in lag if far is not near], axis=0) for near in lag]
    cubic = sum(weight[:, None] * points[middle + side] for weight, side in zip(weights, SIDES, strict=True))
    gain = np.sqrt(1 + sum(weight**2 for weight in weights))
    return np.pad(np.linalg.norm(points[middle] - cubic, axis=-1) / gain, 2, mode="edge")
