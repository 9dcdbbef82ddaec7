"""Estimates of missing samples, and their mean by precision."""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from scipy.ndimage import maximum_filter1d

from mocapfix.fill.cluster_fill import fill_from_clusters
from mocapfix.fill.gaussian_process_fill import fill_from_gaussian_process
from mocapfix.fill.spline_fill import fill_with_splines
from mocapfix.stats.runs import find_runs
from mocapfix.take import Take

# MERGED: mocapfix.fill.estimate
FILL_METHODS = (
    "its own path, by splines",
    "the markers that move with it",
    "the solved body",
    "all markers, as they went at other moments",
)
SPLINE_METHOD, CLUSTER_METHOD, BODY_METHOD, GAUSSIAN_PROCESS_METHOD = range(len(FILL_METHODS))
ESTIMATE_CORRELATION = 0.5  # correlation of the errors of two estimates of one sample


class MarkerEstimate(NamedTuple):
    """Places of missing samples (T, M, 3) in metres, their deviation per axis (T, M), NaN where there is none, and by which of
    WAYS (T, M) they were found."""

    position: np.ndarray
    sd: np.ndarray
    method: np.ndarray


def build_marker_estimate(position: np.ndarray, sd: np.ndarray, method: int) -> MarkerEstimate:
    """-> an estimate all of which was found by one way."""
    return MarkerEstimate(position, sd, np.full(sd.shape, method, np.int8))


def combine_estimates(estimates: Iterable[MarkerEstimate], correlation: float = ESTIMATE_CORRELATION) -> MarkerEstimate:
    """-> the mean of several estimates by their precision, by the way that counts most in it; NaN where none is.

    They err together, for all go by the same neighbours and edges, so the mean is less sure than independent ones would make
    it: `alike` is the correlation of their errors. Where they lie farther apart than they say, they say too little: the
    deviation grows by as much (Birge 1932, "The calculation of errors by the method of least squares").
    """
    place = precision = root = count = square = most = way = np.zeros(())
    for there, sure, by in estimates:
        if not count.shape:
            place, way = np.zeros(there.shape), np.zeros(sure.shape, np.int8)
            precision, root, count, square, most = (np.zeros(sure.shape) for _ in range(5))
        known = ~np.isnan(sure)
        weight = 1 / sure[known] ** 2
        place[known] += weight[:, None] * there[known]
        precision[known] += weight
        root[known] += 1 / sure[known]
        count[known] += 1
        square[known] += weight * (there[known] ** 2).sum(1)
        more = known & (np.nan_to_num(1 / sure) > most)
        most[more], way[more] = 1 / sure[more], by[more]
        del there  # before the next one is made
    precision[count == 0] = np.nan
    place /= precision[..., None]
    apart = square - precision * (place**2).sum(-1)
    birge = np.maximum(apart / np.maximum(3 * (count - 1), 1), 1)
    return MarkerEstimate(place, np.sqrt((correlation * root**2 + (1 - correlation) * precision) * birge) / precision, way)


# MERGED: mocapfix.fill.trajectories
# What the marker's own path, its cluster, the solved body and the whole marker set say of a missing sample, by precision.
MAX_SPLINE_GAP_S = 0.5  # seconds: longer gaps are no matter for splines
MAX_SPEED_RATIO = 3.0
SPEED_MARGIN_S = 0.25  # seconds
MIN_SPEED_LIMIT_M_S = 2.0  # metres a second: speeds of a take that hardly moves
GAUSSIAN_PROCESS_CORRELATION = (
    0.9  # likewise of the widest view and all others, for where it is asked, they guess from the same markers
)
SETTLED_SPLINE_SD_M = 0.001  # metres: a gap that a spline carries so surely is no matter for the others, and helps them


def estimate_missing_samples(take: Take, is_inlier: np.ndarray, body_estimate: MarkerEstimate | None = None) -> MarkerEstimate:
    """-> the surest estimate there is of what was missing or not believed.

    believed  (T, M) bool: samples to go by
    body      what the solved body says of the others, where one is solved
    """
    markers = np.where(is_inlier[..., None], take.markers, np.nan)
    if is_inlier.all():
        return build_marker_estimate(np.full(markers.shape, np.nan), np.full(is_inlier.shape, np.nan), SPLINE_METHOD)
    near = combine_estimates(iterate_estimates(markers, take.rate, body_estimate))
    place, sure = reject_fast_estimates(
        fill_from_gaussian_process(markers, near.position, near.sd, take.rate), markers, take.rate
    )
    return combine_estimates(
        [near, build_marker_estimate(place, sure * compute_gap_inflation(is_inlier), GAUSSIAN_PROCESS_METHOD)],
        GAUSSIAN_PROCESS_CORRELATION,
    )


def iterate_estimates(markers: np.ndarray, rate: float, body_estimate: MarkerEstimate | None) -> Iterator[MarkerEstimate]:
    """-> one way after the other: each is large."""
    path, sure = fill_with_splines(markers, rate, MAX_SPLINE_GAP_S)
    whole = np.where((sure <= SETTLED_SPLINE_SD_M)[..., None], path, markers)
    yield build_marker_estimate(path, sure, SPLINE_METHOD)
    del path
    place, sure = reject_fast_estimates(fill_from_clusters(whole, rate), markers, rate)
    yield build_marker_estimate(place, sure * compute_gap_inflation(~np.isnan(markers[..., 0])), CLUSTER_METHOD)
    del place
    if body_estimate:
        yield body_estimate


def reject_fast_estimates(
    estimate: tuple[np.ndarray, np.ndarray], markers: np.ndarray, rate: float
) -> tuple[np.ndarray, np.ndarray]:
    """-> the places and deviation of an estimate without the moments at which the marker would have to fly."""
    place, sure = estimate
    believed = ~np.isnan(markers[..., 0])
    fly = find_impossible_speeds(np.where(believed[..., None], markers, place), believed, rate)
    return place, np.where(fly, np.nan, sure)


def compute_gap_inflation(is_inlier: np.ndarray) -> np.ndarray:
    """-> (T, M) how many times less sure than it says a fill learnt from the take is: it was learnt where the marker was
    seen, and the longer a gap beside that, the more of it is unlike what was seen.
    """
    factor = np.ones(is_inlier.shape)
    for m in range(is_inlier.shape[1]):
        seen = max(is_inlier[:, m].sum(), 1)
        for first, last in find_runs(~is_inlier[:, m]):
            factor[first : last + 1, m] = 1 + 2 * (last - first + 1) / seen
    return factor


def find_impossible_speeds(path: np.ndarray, is_inlier: np.ndarray, rate: float) -> np.ndarray:
    """-> (T, M) bool: samples of gaps within ABOUT of a moment at which the marker would have to fly, FASTER times as fast
    as any marker is seen to move.

    Few markers seen, or in a line, turn the body they are laid on over between two frames: no deviation tells of that.

    path (T, M, 3) metres, believed (T, M) bool, rate in Hz
    """
    steps = [np.linalg.norm(np.diff(path[:, m], axis=0), axis=-1) for m in range(path.shape[1])]
    speed = np.nan_to_num(np.stack(steps, axis=1)) * rate
    both = is_inlier[1:] & is_inlier[:-1]
    if not both.any():
        return np.zeros_like(is_inlier)
    fast = speed > MAX_SPEED_RATIO * max(float(np.percentile(speed[both], 99.9)), MIN_SPEED_LIMIT_M_S)
    fast &= ~both
    at = np.zeros_like(is_inlier)
    at[1:] |= fast
    at[:-1] |= fast
    return maximum_filter1d(at, 2 * round(SPEED_MARGIN_S * rate) + 1, axis=0) & ~is_inlier
