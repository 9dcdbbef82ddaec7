"""What the marker's own path, its cluster, the solved body and the whole marker set say of a missing sample, by precision."""

from collections.abc import Iterable, Iterator

import numpy as np
from scipy.ndimage import maximum_filter1d

from mocapfix.fill.clusters import rigid
from mocapfix.fill.recalled import recalled
from mocapfix.fill.splines import splines
from mocapfix.take import Take, runs

LONGEST = 0.5  # seconds: longer gaps are no matter for splines
FASTER = 3.0
ABOUT = 0.25  # seconds
SLOW = 2.0  # metres a second: speeds of a take that hardly moves
ALIKE = 0.5  # correlation of the errors of two estimates of one sample
SAME = 0.9  # likewise of the widest view and all others, for where it is asked, they guess from the same markers
SURE = 0.001  # metres: a gap that a spline carries so surely is no matter for the others, and helps them

Estimate = tuple[
    np.ndarray, np.ndarray
]  # places (T, M, 3) of missing samples and their deviation (T, M), NaN where there is none


def trajectories(take: Take, believed: np.ndarray, body: Estimate | None = None) -> Estimate:
    """-> places (T, M, 3) in metres of what was missing or not believed, and their deviation (T, M), NaN where nothing tells.

    believed  (T, M) bool: samples to go by
    body      what the solved body says of the others, where one is solved
    """
    markers = np.where(believed[..., None], take.markers, np.nan)
    if believed.all():
        return np.full(markers.shape, np.nan), np.full(believed.shape, np.nan)
    near = weighed(estimates(markers, take.rate, body))
    place, sure = grounded(recalled(markers, *near, take.rate), markers, take.rate)
    return weighed([near, (place, sure * share_unseen(believed))], SAME)


def estimates(markers: np.ndarray, rate: float, body: Estimate | None) -> Iterator[Estimate]:
    """-> one way after the other: each is large."""
    path, sure = splines(markers, rate, LONGEST)
    whole = np.where((sure <= SURE)[..., None], path, markers)
    yield path, sure
    del path
    place, sure = grounded(rigid(whole, rate), markers, rate)
    yield place, sure * share_unseen(~np.isnan(markers[..., 0]))
    del place
    if body:
        yield body


def grounded(estimate: Estimate, markers: np.ndarray, rate: float) -> Estimate:
    """-> the estimate without the moments at which the marker would have to fly."""
    place, sure = estimate
    believed = ~np.isnan(markers[..., 0])
    fly = flying(np.where(believed[..., None], markers, place), believed, rate)
    return place, np.where(fly, np.nan, sure)


def share_unseen(believed: np.ndarray) -> np.ndarray:
    """-> (T, M) how many times less sure than it says a fill learnt from the take is: it was learnt where the marker was
    seen, and the longer a gap beside that, the more of it is unlike what was seen.
    """
    factor = np.ones(believed.shape)
    for m in range(believed.shape[1]):
        seen = max(believed[:, m].sum(), 1)
        for first, last in runs(~believed[:, m]):
            factor[first : last + 1, m] = 1 + 2 * (last - first + 1) / seen
    return factor


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


def weighed(estimates: Iterable[Estimate], alike: float = ALIKE) -> Estimate:
    """-> the mean place (T, M, 3) of several estimates by their precision, and its deviation (T, M); NaN where none is.

    They err together, for all go by the same neighbours and edges, so the mean is less sure than independent ones would make
    it: `alike` is the correlation of their errors. Where they lie farther apart than they say, they say too little: the
    deviation grows by as much (Birge 1932, "The calculation of errors by the method of least squares").
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
    return place, np.sqrt((alike * root**2 + (1 - alike) * precision) * birge) / precision
