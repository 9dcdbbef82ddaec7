"""The combination of several estimates: of samples by their precisions, of a gap by the errors in hidden stretches.

Errors of estimates are correlated, and the weights with the smallest expected error follow from their covariance (Bates & Granger
1969, "The combination of forecasts"). Few stretches show little of it: variances and correlations are then shrunk to the expected
ones, variances by their logarithms, since errors of one method in different gaps differ by factors.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int8

from mocapfix.fill.fill_methods import FillMethod, GapEstimate, GapWindow, MarkerEstimate
from mocapfix.fill.spline_fill import MIN_FILL_SD_M

EXPECTED_WEIGHT = 2.0  # number of independent hidden stretches that the expected covariance is worth
FIRST_STRETCH_DISCOUNT = 0.5  # number of stretches that are subtracted: a single one shows little
EXPECTED_CORRELATION = 0.45  # expected correlation of the errors of two estimates of one sample
SAME_AXES_CORRELATION = 0.75  # the same where both were made in the same axes
COVARIANCE_RIDGE = 1e-3  # relative increase of the variances, so that equal estimates share their weight


ESTIMATE_CORRELATION = 0.5  # correlation of the errors of two estimates of one sample
PREDICTED_SPREAD_DOF = 6.0
"""Degrees of freedom that the predicted standard deviations are worth beside the differences of the estimates."""


class CombinedEstimate(NamedTuple):
    """The combined estimates of a marker in one gap: positions, standard deviations per axis, and the main methods."""

    position: Float[np.ndarray, "n 3"]
    sd: Float[np.ndarray, " n"]
    method: Int8[np.ndarray, " n"]


def combine_gap_estimates(
    estimates: Sequence[GapEstimate], window: GapWindow, similarity: Float[np.ndarray, " K"]
) -> CombinedEstimate:
    """Return the combination of estimates with the smallest expected error at each point of the gap.

    similarity  of each hidden stretch to the gap, 0 to 1
    """
    error = np.stack([e.error for e in estimates])
    covariance = compute_error_covariances(error, similarity)
    expected_sd = np.stack([e.expected_sd for e in estimates], axis=1)
    known_share = (~np.isnan(error[..., 0])).mean(2) @ similarity / max(len(similarity), 1)
    count = np.maximum(window.count_independent_stretches() * known_share - FIRST_STRETCH_DISCOUNT, 0.0)
    count *= window.hidden_length / window.length
    correlation = build_expected_correlation([e.axes_number for e in estimates])
    shrunk = shrink_covariances(covariance, expected_sd, correlation, count / (count + EXPECTED_WEIGHT))
    weights, variance = (np.array(values) for values in zip(*(compute_weights(each) for each in shrunk), strict=True))
    frames = np.arange(window.length)
    by_frame = np.stack([np.interp(frames, window.points, column) for column in weights.T])
    position = np.einsum("en,ena->na", by_frame, np.stack([e.position for e in estimates]))
    sd = np.interp(frames, window.points, np.sqrt(variance))
    methods = np.array([e.method for e in estimates])
    by_method = np.stack([by_frame[methods == method].sum(0) for method in FillMethod])
    return CombinedEstimate(position, sd, np.array(list(FillMethod), np.int8)[by_method.argmax(0)])


def build_expected_correlation(axes_numbers: Sequence[int | None]) -> Float[np.ndarray, "E E"]:
    """Return the expected correlations of the errors of estimates in axes with these numbers."""
    is_same = np.array([[a is not None and a == b for b in axes_numbers] for a in axes_numbers])
    return np.where(is_same, SAME_AXES_CORRELATION, EXPECTED_CORRELATION)


def compute_error_covariances(
    error: Float[np.ndarray, "E K S 3"], similarity: Float[np.ndarray, " K"]
) -> Float[np.ndarray, "S E E"]:
    """Return the second moments (m2 per axis) of the errors of E estimates at the points of a gap; NaN where unknown.

    Stretches are weighted by their similarity to the gap. Neighbouring points and the mirrored point are averaged.
    """
    estimates, _, points, _ = error.shape
    is_known = ~np.isnan(error[..., 0])
    moment, count = np.zeros((2, points, estimates, estimates))
    for s in range(points):
        known = is_known[:, :, s] * np.sqrt(similarity)
        flat = (np.nan_to_num(error[:, :, s]) * np.sqrt(similarity)[:, None]).reshape(estimates, -1)
        moment[s], count[s] = flat @ flat.T / 3, known @ known.T
    moment, count = moment + moment[::-1], count + count[::-1]
    if points > 2:
        moment[1:-1], count[1:-1] = (x[1:-1] + 0.5 * (x[:-2] + x[2:]) for x in (moment, count))
    return np.divide(moment, count, out=np.full(moment.shape, np.nan), where=count > 0)


def shrink_covariances(
    covariance: Float[np.ndarray, "S E E"],
    expected_sd: Float[np.ndarray, "S E"],
    expected_correlation: Float[np.ndarray, "E E"],
    trust: Float[np.ndarray, " E"],
) -> Float[np.ndarray, "S E E"]:
    """Return covariances between the measured ones, with a weight for each estimate (0 to 1), and the expected ones."""
    variance = np.einsum("see->se", covariance)
    is_known = ~np.isnan(variance)
    measured_sd = np.sqrt(np.where(is_known, variance, 1.0))
    log_sd = [np.log(np.maximum(sd, MIN_FILL_SD_M)) for sd in (measured_sd, expected_sd)]
    sd = np.exp(np.where(is_known, trust * log_sd[0] + (1 - trust) * log_sd[1], log_sd[1]))
    scale = np.maximum(measured_sd, MIN_FILL_SD_M / 10)
    correlation = np.clip(covariance / scale[:, :, None] / scale[:, None], -1, 1)
    correlation = np.where(np.isnan(correlation), expected_correlation, correlation)
    shared_trust = np.sqrt(trust[:, None] * trust)
    correlation = shared_trust * correlation + (1 - shared_trust) * expected_correlation
    diagonal = np.arange(sd.shape[1])
    correlation[:, diagonal, diagonal] = 1 + COVARIANCE_RIDGE
    return correlation * sd[:, :, None] * sd[:, None]


def compute_weights(covariance: Float[np.ndarray, "E E"]) -> tuple[Float[np.ndarray, " E"], float]:
    """Return weights that are not negative, sum to one and give a small expected error, and the variance of that error.

    Estimates with negative weights are left out in turn. This can leave out a good one, and a covariance from few stretches
    need not be positive definite. So where the best estimate alone is expected to have the smaller error, it has all the weight.
    """
    active = np.arange(len(covariance))
    while True:
        solved = np.linalg.solve(covariance[np.ix_(active, active)], np.ones(len(active)))
        if (solved > 0).all():
            break
        kept = active[solved > 0]
        active = kept if len(kept) else active[[np.argmin(np.diag(covariance)[active])]]
    weights = np.zeros(len(covariance))
    weights[active] = solved / solved.sum()
    variance, best = float(weights @ covariance @ weights), int(np.argmin(np.diag(covariance)))
    if variance <= covariance[best, best]:
        return weights, variance
    return np.eye(len(covariance))[best], float(covariance[best, best])


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
