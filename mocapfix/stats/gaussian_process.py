"""Gaussian process regression over a take's frames, and the interpolation of a residual across a gap.

The covariance of two frames depends on their distance in time, as motion is smooth (Matern-5/2), and on the similarity of the
body's states. The latter has two parts: a linear one, for what always moves together, as both arms do, and a stationary one
(Matern-3/2), for motion that recurs (Rasmussen and Williams 2006, Eqs. 2.25, 2.26, 4.16, 4.17). So the prediction is a cubic
curve across a short gap, a regression on the take's own motion across a long one, and a weighted combination between.

What a marker's segment does not explain of its motion is a smooth random process about zero (Matern-3/2), of which a part is
rough (Matern-1/2). Given the samples on both sides of a gap, its mean continues them and decays towards zero in the middle of a
long gap.
"""

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from mocapfix.kernels import gap_estimates

MIN_VALUE_VARIANCE = 1e-12  # of the values, in their unit squared; a smaller variance is taken as this


def evaluate_matern(scaled_distance: Float[np.ndarray, "*shape"], order: Literal[1, 3, 5]) -> Float[np.ndarray, "*shape"]:
    """Return the Matern correlation of smoothness order / 2 at distances times sqrt(order) over the length scale.

    Rasmussen and Williams 2006, Eqs. 4.16 and 4.17; of order 1 it is that of an Ornstein-Uhlenbeck process.
    """
    decay = np.exp(-scaled_distance)
    if order == 1:
        return decay
    if order == 3:
        return (1 + scaled_distance) * decay
    return (1 + scaled_distance + scaled_distance**2 / 3) * decay


def compute_matern_52(lag_s: Float[np.ndarray, "*shape"], time_scale_s: float) -> Float[np.ndarray, "*shape"]:
    """Return the Matern-5/2 correlation of a smooth process at two moments `lag_s` seconds apart."""
    return evaluate_matern(np.sqrt(5) / time_scale_s * np.abs(lag_s), 5)


class StateCovariance(NamedTuple):
    """The covariance of a signal at two frames, by their times and body states. Powers are relative to the signal's."""

    time_scale_s: float  # of the part that depends on time
    similarity_rate: float  # inverse length scale of the stationary part, per unit of state
    time_power: float  # of the part that depends on time
    recurrence_power: float  # of the stationary part
    linear_power: float  # of the linear part, per unit of state squared
    noise_power: float  # of a single frame's own value

    def compute_covariance(
        self,
        states_a: Float[np.ndarray, "A F"],
        times_a_s: Float[np.ndarray, " A"],
        states_b: Float[np.ndarray, "B F"],
        times_b_s: Float[np.ndarray, " B"],
    ) -> Float[np.ndarray, "A B"]:
        """Return the covariances of frames in states (A, F) and (B, F), at times (A,) and (B,)."""
        products = states_a @ states_b.T
        squares = (states_a**2).sum(1)[:, None] + (states_b**2).sum(1) - 2 * products
        distance = np.sqrt(np.maximum(squares, 0.0))
        by_time = compute_matern_52(times_a_s[:, None] - times_b_s, self.time_scale_s)
        by_state = evaluate_matern(np.sqrt(3) * self.similarity_rate * distance, 3)
        return self.time_power * by_time + self.recurrence_power * by_state + self.linear_power * products


class GaussianProcess(NamedTuple):
    """C signals conditioned on their values in N training frames."""

    covariance: StateCovariance
    state_mean: Float[np.ndarray, " F"]
    training_states: Float[np.ndarray, "N F"]  # relative to their mean
    training_times_s: Float[np.ndarray, " N"]
    value_mean: Float[np.ndarray, " C"]
    precision: Float[np.ndarray, "N N"]  # inverse of the values' covariance
    weights: Float[np.ndarray, "N C"]  # precision times the values relative to their mean
    signal_power: Float[np.ndarray, " C"]  # estimated from the values

    def predict(
        self, states: Float[np.ndarray, "A F"], times_s: Float[np.ndarray, " A"]
    ) -> tuple[Float[np.ndarray, "A C"], Float[np.ndarray, " A"]]:
        """Return the expectation in states (A, F) at times (A,), and its variance (A,) relative to the signal power."""
        model, states = self.covariance, states - self.state_mean
        cross = model.compute_covariance(states, times_s, self.training_states, self.training_times_s)
        prior = model.time_power + model.recurrence_power + model.linear_power * (states**2).sum(1)
        variance = prior - np.einsum("an,an->a", cross @ self.precision, cross)
        return self.value_mean + cross @ self.weights, np.maximum(variance, model.noise_power)

    def predict_held_out(self, indices: Int[np.ndarray, " H"]) -> tuple[Float[np.ndarray, "H C"], Float[np.ndarray, " H"]]:
        """Return the errors of predicting some training frames from the others, and the variances relative to the signal power.

        No second factorisation is needed (see `measure_gap_errors`).
        """
        covariance = np.linalg.inv(self.precision[np.ix_(indices, indices)])
        return -covariance @ self.weights[indices], np.diag(covariance)

    def measure_gap_errors(
        self, gap_s: float, count: int | None = None
    ) -> tuple[Float[np.ndarray, " C"], Float[np.ndarray, " C"]]:
        """Return (C,) the mean square errors in stretches of `gap_s` seconds of all or the first `count` training frames, each
        predicted from all others: over the predicted variance, and themselves. NaN if there are fewer than two stretches.

        No second factorisation is needed: with K the covariance, a stretch's error is the inverse of its block of K^-1 times
        its weights (Rasmussen and Williams 2006, Eq. 5.12, for more than one value). Stretches of the same number of frames are
        computed together.
        """
        stretch = ((self.training_times_s[:count] - self.training_times_s[0]) // gap_s).astype(int)
        order = np.argsort(stretch, kind="stable")
        _, starts, sizes = np.unique(stretch[order], return_index=True, return_counts=True)
        is_judged = 2 * sizes <= len(stretch)
        squares = np.empty((2, len(sizes), len(self.value_mean)))
        for size in np.unique(sizes[is_judged]):
            same = np.flatnonzero(sizes == size)
            held_out = order[starts[same][:, None] + np.arange(size)]
            covariance = np.linalg.inv(self.precision[held_out[:, :, None], held_out[:, None]])
            error = covariance @ self.weights[held_out]
            squares[0, same] = (error**2 / np.diagonal(covariance, axis1=1, axis2=2)[..., None]).mean(1)
            squares[1, same] = (error**2).mean(1)
        if is_judged.sum() < 2:
            return np.full(len(self.value_mean), np.nan), np.full(len(self.value_mean), np.nan)
        return squares[0, is_judged].mean(0), squares[1, is_judged].mean(0)


def fit_gaussian_process(
    values: Float[np.ndarray, "N C"],
    states: Float[np.ndarray, "N F"],
    times_s: Float[np.ndarray, " N"],
    noise_variance: Float[np.ndarray, " N"],
    covariance: StateCovariance,
) -> GaussianProcess:
    """Return the process of C signals, given their `values` in N frames.

    Args:
        states: Each in units of a difference that counts as one.
        noise_variance: Of the values beside the covariance's own noise, in their unit squared.
    """
    state_mean, value_mean = states.mean(0), values.mean(0)
    states, values = states - state_mean, values - value_mean
    scale = max(float((values**2).mean()), MIN_VALUE_VARIANCE)
    noise = np.diag(covariance.noise_power + noise_variance / scale)
    precision = np.linalg.inv(covariance.compute_covariance(states, times_s, states, times_s) + noise)
    weights = precision @ values
    return GaussianProcess(covariance, state_mean, states, times_s, value_mean, precision, weights, (values * weights).mean(0))


MIN_ROUGHNESS_STEPS = 6  # changes over this lag that show the roughness
ROUGHNESS_LAG_S = 0.025  # lag at which a residual's change shows its roughness
MEDIAN_DEVIATIONS_PER_SD = 1.4826  # standard deviation of a normal variable over its median absolute deviation
CHI2_MEDIAN_3_DOF = 2.366  # median of the chi-squared distribution with three degrees of freedom
NORMAL_MEDIAN_FACTOR = 2.2  # mean square over median square of a normal residual; the median ignores outliers


def map_residual(
    known_s: Float[np.ndarray, " N"],
    wanted_s: Float[np.ndarray, " P"],
    *,
    power: float,
    time_scale_s: float,
    roughness: float,
    noise_variance: Float[np.ndarray, " N"],
    known_excess: Float[np.ndarray, " N"] | float = 0.0,
    wanted_excess: Float[np.ndarray, " P"] | float = 0.0,
) -> tuple[Float[np.ndarray, "P N"], Float[np.ndarray, " P"]]:
    """Return the linear map from known samples of a residual to its expectation at wanted times, and its variance there.

    Args:
        known_s, wanted_s: Times in seconds of the known samples, and those at which it is wanted.
        power: Variance per axis of the process, in the residual's unit squared.
        time_scale_s: Of its correlation.
        roughness: Its rough part, as `estimate_roughness` returns it.
        noise_variance: Of each sample.
        known_excess, wanted_excess: Variance at these times of a further, smooth process.
    """
    excess = np.zeros(len(known_s)) + known_excess, np.zeros(len(wanted_s)) + wanted_excess
    weights, variance = np.empty((len(wanted_s), len(known_s))), np.empty(len(wanted_s))
    gap_estimates.map_residual(known_s, wanted_s, power, time_scale_s, roughness, noise_variance, *excess, weights, variance)
    return weights, variance


def estimate_roughness(
    known: Float[np.ndarray, "N 3"],
    frames: Int[np.ndarray, " N"],
    rate: float,
    time_scale_s: float,
    noise_sd: float,
    power: float,
) -> float:
    """Return the rough part of a residual's power: 0 for a smooth process, 1 for one that moves in independent steps.

    Estimated from the median square of its change over a short lag, which is small for a smooth process. The frames ascend.
    """
    step = max(1, round(ROUGHNESS_LAG_S * rate))
    row = np.full(frames.max(initial=0) + step + 1, -1)
    row[frames] = np.arange(len(frames))
    later = row[frames + step]
    earlier = np.flatnonzero(later >= 0)
    change = known.take(later[earlier], axis=0) - known.take(earlier, axis=0)
    if len(change) < MIN_ROUGHNESS_STEPS:
        return 0.0
    smooth, rough = (float(compute_residual_correlation(np.array([step / rate]), time_scale_s, part)[0]) for part in (0.0, 1.0))
    decorrelation = (NORMAL_MEDIAN_FACTOR * float(np.median(change**2)) - 2 * noise_sd**2) / (2 * power)
    return float(np.clip((decorrelation - (1 - smooth)) / (smooth - rough), 0.0, 1.0))


def compute_residual_correlation(
    lag_s: Float[np.ndarray, "*shape"], time_scale_s: float, roughness: float
) -> Float[np.ndarray, "*shape"]:
    """Return the correlation at a lag: Matern-3/2 plus, for the part `roughness` (0 to 1), an Ornstein-Uhlenbeck process."""
    smooth = evaluate_matern(np.sqrt(3) * np.abs(lag_s) / time_scale_s, 3)
    return (1 - roughness) * smooth + roughness * evaluate_matern(np.abs(lag_s) / time_scale_s, 1)
