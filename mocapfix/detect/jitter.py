"""Jitter: a burst in which a marker trembles far more than it does in the rest of the take.

The measure is what a cubic through a sample's four neighbours leaves of it, which is next to nothing of a body's
motion and all of a tremble; its median over the shortest burst that counts is blind to single samples. Where the
marker trembles a few times more than its own median over the take, that is a burst.
"""

import numpy as np
from scipy.ndimage import binary_closing, median_filter

from mocapfix.faults import Fault
from mocapfix.take import Take, runs

SIDES = (-2, -1, 1, 2)  # the four neighbours of a sample
FEWEST = 11  # samples in the median at least: a single sample that is off touches five
SWAY = 30.0  # m/s2: what the cubic may leave of a body's motion, which is felt at low frame rates only


def found(take: Take, usable: np.ndarray, smallest: float, ratio: float, shortest: float) -> list[Fault]:
    """-> the bursts among the `usable` (T, M) samples that are free of spikes.

    In a burst the marker trembles by at least `smallest` metres and `ratio` times its own median, for `shortest` seconds.
    """
    faults = []
    for m, label in enumerate(take.bare_labels):
        frames = np.flatnonzero(usable[:, m])
        tremble = _tremble(frames / take.rate, take.markers[frames, m])
        own = float(np.median(tremble)) if len(frames) else 0.0
        window = max(FEWEST, round(shortest * take.rate)) | 1
        for stretch in np.split(np.arange(len(frames)), np.flatnonzero(np.diff(frames) > shortest * take.rate) + 1):
            if len(stretch) < FEWEST:
                continue
            usual = median_filter(tremble[stretch], window, mode="nearest")
            trembles = usual > max(smallest + SWAY / take.rate**2, ratio * own)
            for a, b in runs(trembles | binary_closing(trembles, np.ones(window))):
                first, last = int(frames[stretch[a]]), int(frames[stretch[b]])
                if last - first + 1 >= shortest * take.rate:
                    faults.append(_burst(label, m, first, last, float(usual[a : b + 1].max()), own, take.rate))
    return faults


def _burst(label: str, marker: int, first: int, last: int, size: float, own: float, rate: float) -> Fault:
    seconds = (last - first + 1) / rate
    reason = f"{label} trembles by {size * 1e3:.0f} mm for {seconds:.2f} s; in the rest of the take it is {own * 1e3:.1f} mm."
    return Fault("jitter", marker, first, last, size, reason)


def _tremble(times: np.ndarray, points: np.ndarray) -> np.ndarray:
    """-> (N,) metres: the distance of each sample (N, 3) from a cubic through its neighbours, as large as the noise on it.

    Lagrange's weights at the samples' own `times` (N,), scaled so that white noise keeps its standard deviation.
    """
    count = len(times)
    if count < 5:
        return np.zeros(count)
    middle = np.arange(2, count - 2)
    lag = [times[middle + side] - times[middle] for side in SIDES]
    weights = [np.prod([far / (far - near) for far in lag if far is not near], axis=0) for near in lag]
    cubic = sum(weight[:, None] * points[middle + side] for weight, side in zip(weights, SIDES, strict=True))
    gain = np.sqrt(1 + sum(weight**2 for weight in weights))
    return np.pad(np.linalg.norm(points[middle] - cubic, axis=-1) / gain, 2, mode="edge")
