"""Estimates of missing samples from all methods, and their combination by precision.

Filling from the solved body: the marker's offset on its joint, plus the interpolated residual at the edges of the gap.
"""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from mocapfix.fill.cluster_fill import fill_from_clusters
from mocapfix.fill.fill_methods import (
    FillMethod,
    MarkerEstimate,
    build_marker_estimate,
    find_impossible_speeds,
    measure_fastest_speed,
)
from mocapfix.fill.marker_processes import fill_from_gaussian_process
from mocapfix.fill.spline_fill import fill_with_splines
from mocapfix.model.motion import Motion
from mocapfix.model.subject import Subject
from mocapfix.model.take import Take
from mocapfix.solve import kinematics
from mocapfix.stats.gaussian_process import interpolate_residual
from mocapfix.stats.sequences import find_runs

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
PARTIAL_BODY_SD_RATIO = 2.0
"""Ratio of errors to predicted standard deviations where a body has few markers, or a set that was learned from the take."""


def combine_with_partial_body(
    estimate: MarkerEstimate, body_estimate: MarkerEstimate, is_missing: Bool[np.ndarray, "T M"]
) -> MarkerEstimate:
    """Return the combination of the estimates without a body and those from a body that few markers determine.

    estimate       the estimate without a body, as `estimate_without_body` returns it
    body_estimate  the estimate from the solved body
    is_missing     samples that are estimated
    """
    widened = body_estimate._replace(sd=body_estimate.sd * PARTIAL_BODY_SD_RATIO)
    combined, ratio = combine_estimates([estimate.select(is_missing), widened.select(is_missing)])
    return combined._replace(sd=np.maximum(combined.sd * ratio, MIN_COMBINED_SD_M)).expand(is_missing)


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


BODY_RESIDUAL_FADE_S = 0.2
"""Time scale of the correlation of a marker's residual."""
BODY_RESIDUAL_REACH_S = 0.3
"""Time on either side of a gap that is used."""
BODY_SAMPLE_NOISE_M = 0.0005
"""Noise of a sample, caused by the cameras."""
MIN_BODY_RESIDUAL_M = 0.002
"""Smallest standard deviation of the residual."""
MIN_BODY_FILL_SD_M = 0.0005
"""Smallest standard deviation of a fill."""
MAX_EDGE_RESIDUAL_M = 0.05
"""Residual of a sample above which it may be unusable as the edge of a gap; it must also exceed MAX_EDGE_RESIDUAL_RATIO."""
MAX_EDGE_RESIDUAL_RATIO = 4.0
"""The same relative to the marker's median residual."""


def fill_from_body(
    markers: Float[np.ndarray, "T K 3"], is_wanted: Bool[np.ndarray, "T K"], subject: Subject, motion: Motion, rate: float
) -> tuple[Float[np.ndarray, "T K 3"], Float[np.ndarray, "T K"]]:
    """Return positions of the wanted samples in metres, and their standard deviations per axis; NaN elsewhere.

    In a gap the residual consists of the marker's motion relative to its joint and of the error of a pose that was solved without
    this marker. Both are known at the edges of the gap, and decay with the correlation of the residual.

    markers  in metres in the subject's order, NaN if not visible or an outlier
    """
    joint_positions, joint_rotations = kinematics.compute_world_poses(subject.skeleton, motion)
    filled, sd = np.full(markers.shape, np.nan), np.full(is_wanted.shape, np.nan)
    for k, joint in enumerate(subject.joints):
        wanted = is_wanted[:, k]
        if not wanted.any():
            continue
        rotation = joint_rotations[:, joint]
        predicted = joint_positions[:, joint] + rotation @ subject.marker_offsets[k]
        residual = np.einsum("tba,tb->ta", rotation, markers[:, k] - predicted)
        distance = np.linalg.norm(residual, axis=1)
        if (is_known := ~np.isnan(distance)).any():
            median = float(np.median(distance[is_known]))
            residual[distance > max(MAX_EDGE_RESIDUAL_M, MAX_EDGE_RESIDUAL_RATIO * median)] = np.nan
        interpolated, variance, power = interpolate_residual(
            residual,
            wanted,
            rate,
            time_scale_s=BODY_RESIDUAL_FADE_S,
            margin_s=BODY_RESIDUAL_REACH_S,
            noise_sd=BODY_SAMPLE_NOISE_M,
            min_sd=MIN_BODY_RESIDUAL_M,
        )
        filled[wanted, k] = predicted[wanted] + np.einsum("tab,tb->ta", rotation[wanted], interpolated[wanted])
        total_variance = variance[wanted] * (1 + motion.marker_sd[wanted, k] ** 2 / power)
        sd[wanted, k] = np.sqrt(np.maximum(total_variance, MIN_BODY_FILL_SD_M**2))
    return filled, sd
