"""Estimates of missing samples from all methods, and their combination by precision."""

from collections.abc import Iterable, Iterator
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int8
from scipy.ndimage import maximum_filter1d

from mocapfix.fill.cluster_fill import fill_from_clusters
from mocapfix.fill.gaussian_process_fill import fill_from_gaussian_process
from mocapfix.fill.spline_fill import fill_with_splines
from mocapfix.stats.sequences import find_runs
from mocapfix.take import Take

ESTIMATE_CORRELATION = 0.5
"""Correlation of the errors of two estimates of one sample."""
GAUSSIAN_PROCESS_CORRELATION = 0.8
"""The same for the Gaussian process and the combination of the others: where it is used, they rely on the same markers."""
PREDICTED_SPREAD_DOF = 6.0
"""Degrees of freedom that the predicted standard deviations are worth beside the differences of the estimates."""
MIN_COMBINED_SD_M = 0.0003
"""Smallest standard deviation of a fill."""
MAX_SPLINE_GAP_S = 0.5
"""Duration of the longest gap that is filled by splines."""
SETTLED_SPLINE_SD_M = 0.001
"""Standard deviation of a spline below which its samples are used as known ones by the clusters."""
MAX_SPEED_RATIO = 3.0
"""Speed of an estimate, relative to the fastest visible motion, above which it is rejected."""
SPEED_PERCENTILE = 99.9
"""Percentile of the speeds of visible markers that counts as the fastest visible motion."""
MIN_SPEED_LIMIT_M_S = 2.0
"""Smallest value of this fastest speed, for takes with little motion."""
SPEED_MARGIN_S = 0.25
"""Time around an impossible speed in which estimates are rejected."""


class FillMethod(IntEnum):
    """How a sample was filled."""

    SPLINE = 0
    CLUSTER = 1
    BODY = 2
    GAUSSIAN_PROCESS = 3

    @property
    def description(self) -> str:
        """The source of the sample, as a phrase for reports."""
        return _FILL_METHOD_DESCRIPTIONS[self]


_FILL_METHOD_DESCRIPTIONS = {
    FillMethod.SPLINE: "a spline through its own trajectory",
    FillMethod.CLUSTER: "the markers that move with it",
    FillMethod.BODY: "the solved body",
    FillMethod.GAUSSIAN_PROCESS: "all markers, in frames with a similar body state",
}


class MarkerEstimate(NamedTuple):
    """Estimates of samples: positions in metres, standard deviations per axis, NaN for none, and FillMethods.

    They are those of a take (T, M), or those of its missing samples only (N,).
    """

    position: Float[np.ndarray, "*samples 3"]
    sd: Float[np.ndarray, "*samples"]
    method: Int8[np.ndarray, "*samples"]

    def select(self, is_missing: Bool[np.ndarray, "T M"]) -> "MarkerEstimate":
        """Return the estimates of the missing samples of a take."""
        return MarkerEstimate(*(values[is_missing] for values in self))

    def expand(self, is_missing: Bool[np.ndarray, "T M"]) -> "MarkerEstimate":
        """Return the estimates of a take from those of its missing samples."""
        position, sd = np.full((*is_missing.shape, 3), np.nan), np.full(is_missing.shape, np.nan)
        method = np.zeros(is_missing.shape, np.int8)
        position[is_missing], sd[is_missing], method[is_missing] = self
        return MarkerEstimate(position, sd, method)


def build_marker_estimate(
    position: Float[np.ndarray, "*samples 3"], sd: Float[np.ndarray, "*samples"], method: FillMethod
) -> MarkerEstimate:
    """Return an estimate from one method."""
    return MarkerEstimate(position, sd, np.full(sd.shape, method, np.int8))


def estimate_missing_samples(
    take: Take, is_inlier: Bool[np.ndarray, "T M"], body_estimate: MarkerEstimate | None = None
) -> MarkerEstimate:
    """Return the most precise estimate of all samples that are missing or no inliers.

    is_inlier      samples that are used
    body_estimate  the estimate from the solved body, if there is one
    """
    markers = np.where(is_inlier[..., None], take.markers, np.nan)
    if is_inlier.all():
        nothing = np.full(is_inlier.shape, np.nan)
        return build_marker_estimate(np.full(markers.shape, np.nan), nothing, FillMethod.SPLINE)
    context = _FillContext(markers, take.rate, np.isnan(markers[..., 0]), measure_fastest_speed(markers, take.rate))
    combined, ratio = combine_estimates(iterate_estimates(context, body_estimate))
    others = combined.expand(context.is_missing)
    filled = fill_from_gaussian_process(markers, others.position, others.sd, take.rate)
    del others
    process = _select_plausible(filled, is_inlier, context, FillMethod.GAUSSIAN_PROCESS)
    del filled
    estimate, process_ratio = combine_estimates([combined, process], GAUSSIAN_PROCESS_CORRELATION)
    estimate = estimate._replace(sd=np.maximum(estimate.sd * ratio * process_ratio, MIN_COMBINED_SD_M))
    return estimate.expand(context.is_missing)


class _FillContext(NamedTuple):
    """What the estimates have in common.

    markers          (T, M, 3) m, NaN if not visible or an outlier
    rate             frame rate in Hz
    is_missing       (T, M) the samples that are NaN
    fastest_speed    of the visible motion, in m/s; None if nothing is visible in two frames in a row
    """

    markers: np.ndarray
    rate: float
    is_missing: np.ndarray
    fastest_speed: float | None


def iterate_estimates(context: _FillContext, body_estimate: MarkerEstimate | None) -> Iterator[MarkerEstimate]:
    """Yield the estimates of the missing samples from splines, clusters and the body."""
    markers, rate = context.markers, context.rate
    position, sd = fill_with_splines(markers, rate, MAX_SPLINE_GAP_S)
    spline = build_marker_estimate(position, sd, FillMethod.SPLINE).select(context.is_missing)
    del position, sd
    with_splines = markers.copy()
    with_splines[context.is_missing] = np.where((spline.sd <= SETTLED_SPLINE_SD_M)[:, None], spline.position, np.nan)
    yield spline
    yield _select_plausible(fill_from_clusters(with_splines, rate), ~context.is_missing, context, FillMethod.CLUSTER)
    if body_estimate:
        yield body_estimate.select(context.is_missing)


def _select_plausible(
    filled: tuple[Float[np.ndarray, "T M 3"], Float[np.ndarray, "T M"]],
    is_learned: Bool[np.ndarray, "T M"],
    context: _FillContext,
    method: FillMethod,
) -> MarkerEstimate:
    """Return the estimates of the missing samples from a method that has learned from others, none near impossible speeds."""
    is_missing, path = context.is_missing, context.markers.copy()
    position, sd = (values[is_missing] for values in filled)
    path[is_missing] = position
    is_impossible = find_impossible_speeds(path, ~is_missing, context.rate, context.fastest_speed)[is_missing]
    sd = np.where(is_impossible, np.nan, sd) * compute_gap_inflation(is_learned)[is_missing]
    return build_marker_estimate(position, sd, method)


def combine_estimates(
    estimates: Iterable[MarkerEstimate], correlation: float = ESTIMATE_CORRELATION
) -> tuple[MarkerEstimate, Float[np.ndarray, "*samples"]]:
    """Return the mean of several estimates weighted by precision, with the method of the largest weight; NaN without any.

    The estimates rely on the same neighbours and edges, so their errors are correlated, and the variance of the mean is larger
    than for independent estimates. Where the estimates differ by more than their standard deviations allow, the standard
    deviation is increased accordingly (Birge 1932, "The calculation of errors by the method of least squares").

    An estimate weighs no more for agreeing with another. But where estimates agree, their mean is more certain than this standard
    deviation says. The second result is the ratio of the two: it weights the predicted standard deviations and the differences of
    the estimates by their degrees of freedom.
    """
    mean = precision = inverse_sd = count = square = largest = method = np.zeros(())
    for position, sd, each_method in estimates:
        if not count.shape:
            mean, method = np.zeros(position.shape), np.zeros(sd.shape, np.int8)
            precision, inverse_sd, count, square, largest = (np.zeros(sd.shape) for _ in range(5))
        is_known = ~np.isnan(sd)
        weight = 1 / sd[is_known] ** 2
        mean[is_known] += weight[:, None] * position[is_known]
        precision[is_known] += weight
        inverse_sd[is_known] += 1 / sd[is_known]
        count[is_known] += 1
        square[is_known] += weight * (position[is_known] ** 2).sum(1)
        is_larger = is_known & (np.nan_to_num(1 / sd) > largest)
        largest[is_larger], method[is_larger] = 1 / sd[is_larger], each_method[is_larger]
    precision[count == 0] = np.nan
    mean /= precision[..., None]
    spread = square - precision * (mean**2).sum(-1)
    birge = np.maximum(spread / np.maximum(3 * (count - 1), 1), 1)
    variance = (correlation * inverse_sd**2 + (1 - correlation) * precision) * birge
    degrees_of_freedom = 3 * np.maximum(count - 1, 0)
    expected_spread = 1 - ESTIMATE_CORRELATION
    expected = PREDICTED_SPREAD_DOF + np.maximum(spread, 0) / expected_spread
    ratio = np.sqrt(expected / (PREDICTED_SPREAD_DOF + degrees_of_freedom) / birge)
    return MarkerEstimate(mean, np.sqrt(variance) / precision, method), ratio


def compute_gap_inflation(is_inlier: Bool[np.ndarray, "T M"]) -> Float[np.ndarray, "T M"]:
    """Return the factor by which the standard deviation of a learned estimate is underestimated.

    Such an estimate is learned from the frames in which the marker is visible. The longer a gap is relative to these, the more of
    it differs from what was learned.
    """
    factor = np.ones(is_inlier.shape)
    for m in range(is_inlier.shape[1]):
        visible_count = max(is_inlier[:, m].sum(), 1)
        for first, last in find_runs(~is_inlier[:, m]):
            factor[first : last + 1, m] = 1 + 2 * (last - first + 1) / visible_count
    return factor


def measure_fastest_speed(markers: Float[np.ndarray, "T M 3"], rate: float) -> float | None:
    """Return the speed in m/s of the fastest visible motion; None if no marker is visible in two frames in a row.

    markers  in metres, NaN if not visible or an outlier
    rate     frame rate in Hz
    """
    speeds = [np.linalg.norm(np.diff(markers[:, m], axis=0), axis=-1) for m in range(markers.shape[1])]
    visible = np.concatenate([speed[~np.isnan(speed)] for speed in speeds]) * rate
    return float(np.percentile(visible, SPEED_PERCENTILE)) if len(visible) else None


def find_impossible_speeds(
    path: Float[np.ndarray, "T M 3"], is_inlier: Bool[np.ndarray, "T M"], rate: float, fastest_speed: float | None
) -> Bool[np.ndarray, "T M"]:
    """Find samples of gaps near a time at which the marker would be MAX_SPEED_RATIO times as fast as any visible one.

    A cluster of few visible or collinear markers can flip between two frames, which no standard deviation shows.

    path           positions in metres with the gaps filled
    is_inlier      the samples that are visible
    rate           frame rate in Hz
    fastest_speed  of the visible motion in m/s; None if there is none, and no speed is impossible
    """
    is_impossible = np.zeros_like(is_inlier)
    if fastest_speed is None:
        return is_impossible
    frames, markers = np.nonzero(~(is_inlier[1:] & is_inlier[:-1]))  # of the steps into, within and out of gaps
    speed = np.nan_to_num(np.linalg.norm(path[frames + 1, markers] - path[frames, markers], axis=-1)) * rate
    is_fast = speed > MAX_SPEED_RATIO * max(fastest_speed, MIN_SPEED_LIMIT_M_S)
    if not is_fast.any():
        return is_impossible
    is_impossible[frames[is_fast], markers[is_fast]] = is_impossible[frames[is_fast] + 1, markers[is_fast]] = True
    return maximum_filter1d(is_impossible, 2 * round(SPEED_MARGIN_S * rate) + 1, axis=0) & ~is_inlier
