"""Jitter: a burst in which a marker trembles far more than it does in the rest of the take.

The measure is that of noise, what a cubic through a sample's neighbours leaves of it; its median over the shortest burst
that counts is blind to single samples. Where the marker trembles a few times more than its own median over the take, that is
a burst.
"""

from collections.abc import Iterator

import numpy as np
from scipy.ndimage import binary_closing, median_filter

from mocapfix.detect.noise import FEWEST, tremble
from mocapfix.faults import Fault
from mocapfix.take import Take, runs

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
        trembles = tremble(frames / take.rate, take.markers[frames, m])
        own = float(np.median(trembles))
        threshold = max(smallest + SWAY / take.rate**2, ratio * own)
        for first, last, size in _bursts(frames, trembles, threshold, shortest * take.rate):
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
