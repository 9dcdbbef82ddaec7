"""Filling a take without a skeleton: what clusters, the whole marker set and the marker's own path say, by precision."""

from collections.abc import Iterable, Iterator

import numpy as np
from scipy.ndimage import maximum_filter1d

from mocapfix.fill.clusters import rigid
from mocapfix.fill.splines import splines
from mocapfix.kernels.gaussian import gaussian
from mocapfix.take import Take

LIMIT = 0.120  # metres per axis
LONGEST = 0.5  # seconds
FASTER = 3.0
ABOUT = 0.25  # seconds
SLOW = 2.0  # metres a second: speeds of a take that hardly moves
ALIKE = 0.3  # correlation of the errors of two estimates of one sample
SURE = 0.001  # metres: a gap that a spline carries so surely is no matter for the others, and helps them


def trajectories(
    take: Take, believed: np.ndarray, limit: float = LIMIT, longest: float = LONGEST
) -> tuple[np.ndarray, np.ndarray]:
    """-> markers (T, M, 3) in metres with what was missing or not believed filled, and those samples' deviation (T, M).

    A sample that none places, that is less sure than the limit, or near which the marker would have to fly, is NaN.

    believed  (T, M) bool: samples that are kept bit for bit
    limit     metres: largest standard deviation per axis of a sample that is filled
    longest   seconds: longer gaps are no matter for splines
    """
    markers = np.where(believed[..., None], take.markers, np.nan)
    if believed.all():
        return markers, np.full(believed.shape, np.nan)
    place, deviation = weighed(estimates(markers, take.rate, longest))
    place[believed] = markers[believed]
    deviation[flying(place, believed, take.rate)] = np.nan
    fill = ~believed & (deviation <= limit)
    markers[fill] = place[fill]
    return markers, np.where(fill, deviation, np.nan)


def estimates(markers: np.ndarray, rate: float, longest: float) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """-> places (T, M, 3) of missing samples and their deviation (T, M), one way after the other: three are large."""
    path, sure = splines(markers, rate, longest)
    whole = np.where((sure <= SURE)[..., None], path, markers)
    yield path, sure
    del path
    yield gaussian(whole, rate)
    yield rigid(whole, rate)


def flying(path: np.ndarray, believed: np.ndarray, rate: float) -> np.ndarray:
    """-> (T, M) bool: samples of gaps within ABOUT of a moment at which the marker would have to fly, FASTER times as fast
    as any marker is seen to move.

    Few markers seen, or in a line, turn the body they are laid on over between two frames: no deviation tells of that.

    path (T, M, 3) metres, believed (T, M) bool, rate in Hz
    """
    steps = [np.linalg.norm(np.diff(path[:, m], axis=0), axis=-1) for m in range(path.shape[1])]
    speed = np.nan_to_num(np.stack(steps, axis=1)) * rate
    both = believed[1:] & believed[:-1]
    if not both.any():
        return np.zeros_like(believed)
    fast = speed > FASTER * max(float(np.percentile(speed[both], 99.9)), SLOW)
    fast &= ~both
    at = np.zeros_like(believed)
    at[1:] |= fast
    at[:-1] |= fast
    return maximum_filter1d(at, 2 * round(ABOUT * rate) + 1, axis=0) & ~believed


def weighed(estimates: Iterable[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """-> the mean place (T, M, 3) of several estimates by their precision, and its deviation (T, M); NaN where none is.

    They err together, for all go by the same neighbours and edges, so the mean is less sure than independent ones would make
    it. Where they lie farther apart than they say, they say too little: the deviation grows by as much (Birge 1932, "The
    calculation of errors by the method of least squares").
    """
    place = precision = root = count = square = np.zeros(())
    for there, sure in estimates:
        if not count.shape:
            place = np.zeros(there.shape)
            precision, root, count, square = (np.zeros(sure.shape) for _ in range(4))
        known = ~np.isnan(sure)
        weight = 1 / sure[known] ** 2
        place[known] += weight[:, None] * there[known]
        precision[known] += weight
        root[known] += 1 / sure[known]
        count[known] += 1
        square[known] += weight * (there[known] ** 2).sum(1)
        del there  # before the next one is made
    precision[count == 0] = np.nan
    place /= precision[..., None]
    apart = square - precision * (place**2).sum(-1)
    birge = np.maximum(apart / np.maximum(3 * (count - 1), 1), 1)
    return place, np.sqrt((ALIKE * root**2 + (1 - ALIKE) * precision) * birge) / precision
