"""Which frames to calibrate from: well seen and unlike each other."""

import numpy as np

CANDIDATES = 600  # frames looked at, evenly over the take: solving them all takes a fraction of a second
CHOSEN = 150


def candidates(markers: np.ndarray) -> np.ndarray:
    """-> indices of up to CANDIDATES frames, evenly over the take, of those that show the most markers.

    markers (T, K, 3), NaN where not believed. Well seen is within a tenth of the markers that the best frames show.
    """
    count = (~np.isnan(markers[..., 0])).sum(1)
    enough = np.flatnonzero(count >= 0.9 * np.percentile(count, 90))
    return enough[np.unique(np.linspace(0, len(enough) - 1, min(len(enough), CANDIDATES)).astype(int))]


def varied(rotations: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """-> indices of up to CHOSEN of the poses `rotations` (N, J, 3, 3): half the most unlike, half at random.

    The unlike ones by farthest-point selection in the chordal distance over the joints below the root.
    """
    flat = rotations[:, 1:].reshape(len(rotations), -1)
    if len(flat) <= CHOSEN:
        return np.arange(len(flat))
    chosen = [int(np.linalg.norm(flat - flat.mean(0), axis=1).argmin())]
    nearest = np.full(len(flat), np.inf)
    while len(chosen) < CHOSEN // 2:
        nearest = np.minimum(nearest, np.linalg.norm(flat - flat[chosen[-1]], axis=1))
        nearest[chosen[-1]] = -1.0  # not again, though no other be any farther
        chosen.append(int(nearest.argmax()))
    rest = np.setdiff1d(np.arange(len(flat)), chosen)
    return np.sort(np.r_[chosen, rng.choice(rest, CHOSEN - len(chosen), replace=False)])
