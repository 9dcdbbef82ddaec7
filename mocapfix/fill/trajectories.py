"""What the marker's own path, its cluster, the solved body and the whole marker set say of a missing sample, by precision."""

from collections.abc import Iterator

import numpy as np
from scipy.ndimage import maximum_filter1d

from mocapfix.fill.clusters import rigid
from mocapfix.fill.estimate import CLUSTER, PATH, RECALLED, Estimate, one_way, weighed
from mocapfix.fill.recalled import recalled
from mocapfix.fill.splines import splines
from mocapfix.take import Take, runs

LONGEST = 0.5  # seconds: longer gaps are no matter for splines
FASTER = 3.0
ABOUT = 0.25  # seconds
SLOW = 2.0  # metres a second: speeds of a take that hardly moves
SAME = 0.9  # likewise of the widest view and all others, for where it is asked, they guess from the same markers
SURE = 0.001  # metres: a gap that a spline carries so surely is no matter for the others, and helps them


def trajectories(take: Take, believed: np.ndarray, body: Estimate | None = None) -> Estimate:
    """-> the surest estimate there is of what was missing or not believed.

    believed  (T, M) bool: samples to go by
    body      what the solved body says of the others, where one is solved
    """
    markers = np.where(believed[..., None], take.markers, np.nan)
    if believed.all():
        return one_way(np.full(markers.shape, np.nan), np.full(believed.shape, np.nan), PATH)
    near = weighed(estimates(markers, take.rate, body))
    place, sure = grounded(recalled(markers, near.place, near.deviation, take.rate), markers, take.rate)
    return weighed([near, one_way(place, sure * share_unseen(believed), RECALLED)], SAME)


def estimates(markers: np.ndarray, rate: float, body: Estimate | None) -> Iterator[Estimate]:
    """-> one way after the other: each is large."""
    path, sure = splines(markers, rate, LONGEST)
    whole = np.where((sure <= SURE)[..., None], path, markers)
    yield one_way(path, sure, PATH)
    del path
    place, sure = grounded(rigid(whole, rate), markers, rate)
    yield one_way(place, sure * share_unseen(~np.isnan(markers[..., 0])), CLUSTER)
    del place
    if body:
        yield body


def grounded(estimate: tuple[np.ndarray, np.ndarray], markers: np.ndarray, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """-> the places and deviation of an estimate without the moments at which the marker would have to fly."""
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
