"""Noise: how much each marker trembles all along, and the markers that tremble far more than the take's others.

The measure is what a cubic through a sample's four neighbours leaves of it, which is next to nothing of a body's motion and
all of a tremble; its median over the take is blind to spikes, bursts and gaps.
"""

import numpy as np

from mocapfix.faults import Fault
from mocapfix.take import Take

SIDES = (-2, -1, 1, 2)  # the four neighbours of a sample
FEWEST = 11  # samples of which a level is told at least, for a single one that is off spoils five
MEDIAN = 1.538  # of the length of a vector whose three numbers have standard deviation 1
RATIO = 5.0  # times the level of the take's other markers: how noisy one is at least
SMALLEST = 0.001  # metres, likewise


def found(take: Take) -> list[Fault]:
    """-> the markers that are much noisier than the take's others, from the first to the last frame in which each is seen."""
    levels, faults = level(take), []
    for m in np.flatnonzero(levels > SMALLEST):
        others = np.delete(levels, m)
        usual = float(np.nanmedian(others)) if np.isfinite(others).any() else np.inf
        if levels[m] > RATIO * usual:
            first, *_, last = np.flatnonzero(take.seen[:, m])
            off = f"trembles by {levels[m] * 1e3:.1f} mm all along; the take's other markers do by {usual * 1e3:.1f} mm."
            reason = f"{take.bare_labels[m]} {off}"
            faults.append(Fault("noise", int(m), int(first), int(last), float(levels[m]), reason))
    return faults


def level(take: Take) -> np.ndarray:
    """-> (M,) metres: the standard deviation per axis by which each marker trembles; NaN where it is hardly seen."""
    levels = np.full(len(take.labels), np.nan)
    for m in range(len(levels)):
        frames = np.flatnonzero(take.seen[:, m])
        if len(frames) >= FEWEST:
            levels[m] = np.median(tremble(frames / take.rate, take.markers[frames, m])) / MEDIAN
    return levels


def tremble(times: np.ndarray, points: np.ndarray) -> np.ndarray:
    """-> (N,) metres: how far each of N >= 5 samples (N, 3) lies from the cubic through its neighbours.

    Lagrange's weights at the samples' own `times` (N,), scaled so that white noise keeps its standard deviation.
    """
    middle = np.arange(2, len(times) - 2)
    lag = [times[middle + side] - times[middle] for side in SIDES]
    weights = [np.prod([far / (far - near) for far in lag if far is not near], axis=0) for near in lag]
    cubic = sum(weight[:, None] * points[middle + side] for weight, side in zip(weights, SIDES, strict=True))
    gain = np.sqrt(1 + sum(weight**2 for weight in weights))
    return np.pad(np.linalg.norm(points[middle] - cubic, axis=-1) / gain, 2, mode="edge")
