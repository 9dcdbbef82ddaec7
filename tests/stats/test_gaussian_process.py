"""Gaussian process regression on signals with known answers."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.stats.gaussian_process import StateCovariance, fit_gaussian_process

RATE = 60.0
COVARIANCE = StateCovariance(
    time_scale_s=0.3, similarity_rate=0.6, time_power=0.06, recurrence_power=1.6, linear_power=0.8, noise_power=1.5e-4
)


def fit(values, states, times_s):
    return fit_gaussian_process(values, states, times_s, np.zeros(len(values)), COVARIANCE)


def predict(values, states, times_s, new_states, new_times_s):
    return fit(values, states, times_s).predict(new_states, new_times_s)


def test_prediction_interpolates_training_values():
    times_s = np.arange(60) / RATE
    signal, state = np.sin(4 * times_s)[:, None], np.zeros((60, 1))
    mean, variance = predict(signal, state, times_s, state, times_s)
    np.testing.assert_allclose(mean, signal, atol=0.01)
    assert variance.max() < 3 * COVARIANCE.noise_power


def test_prediction_is_smooth_across_a_short_gap():
    times_s = np.arange(60) / RATE
    signal, state = np.sin(4 * times_s)[:, None], np.zeros((60, 1))
    gap = np.arange(25, 35)
    rest = np.setdiff1d(np.arange(60), gap)
    mean, _ = predict(signal[rest], state[rest], times_s[rest], state[gap], times_s[gap])
    np.testing.assert_allclose(mean, signal[gap], atol=0.01)


def test_far_prediction_is_the_mean_with_prior_variance():
    times_s = np.arange(60) / RATE
    mean, variance = predict(np.sin(times_s)[:, None], np.zeros((60, 1)), times_s, np.full((1, 1), 50.0), np.array([100.0]))
    np.testing.assert_allclose(mean, np.sin(times_s).mean(), atol=1e-6)
    np.testing.assert_allclose(variance, COVARIANCE.time_power + COVARIANCE.recurrence_power + COVARIANCE.linear_power * 50.0**2)


def test_linear_part_extrapolates():
    rng = np.random.default_rng(0)
    state = rng.uniform(-1, 1, (200, 3))
    times_s, slope = 10.0 * np.arange(200), np.array([[0.3], [-0.5], [0.2]])
    mean, _ = predict(state @ slope, state, times_s, np.array([[1.3, -1.3, 1.3]]), np.array([1e4]))
    np.testing.assert_allclose(mean, [[1.3]], rtol=0.15)


def test_recurring_motion_is_predicted():
    times_s = np.arange(0, 20, 1 / 10)
    state = np.stack([np.cos(times_s), np.sin(times_s)], 1)
    signal = np.cos(3 * times_s)[:, None]  # no linear function of the state
    gap = (times_s > 12) & (times_s < 14)
    mean, _ = predict(signal[~gap], state[~gap], times_s[~gap], state[gap], times_s[gap])
    np.testing.assert_allclose(mean, signal[gap], atol=0.12)


def test_noisy_frame_has_less_weight():
    times_s, state = np.arange(3) / RATE, np.zeros((3, 1))
    values, noise = np.array([[0.0], [1.0], [0.0]]), np.array([0.0, 100.0, 0.0])
    mean, _ = fit_gaussian_process(values, state, times_s, noise, COVARIANCE).predict(state[1:2], times_s[1:2])
    assert abs(mean[0, 0]) < 0.05


def test_signal_power_is_estimated():
    rng = np.random.default_rng(1)
    state, times_s = rng.normal(0, 0.3, (150, 4)), 10.0 * np.arange(150)
    covariance = COVARIANCE.compute_covariance(state, times_s, state, times_s) + COVARIANCE.noise_power * np.eye(150)
    values = 0.2 * np.linalg.cholesky(covariance) @ rng.normal(size=(150, 30))
    np.testing.assert_allclose(fit(values, state, times_s).signal_power.mean(), 0.04, rtol=0.05)


@given(st.integers(1, 30), st.integers(0, 2**32 - 1))
def test_covariance_is_symmetric_and_positive(count, seed):
    rng = np.random.default_rng(seed)
    state, times_s = rng.normal(size=(count, 3)), rng.uniform(0, 3, count)
    matrix = COVARIANCE.compute_covariance(state, times_s, state, times_s)
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-12)
    assert np.linalg.eigvalsh(matrix).min() > -1e-9


def test_cross_validation_equals_refitting_without_the_stretch():
    rng = np.random.default_rng(2)
    times_s, state, values = np.arange(30) / 10, rng.normal(size=(30, 2)), rng.normal(size=(30, 3))
    known = fit(values, state, times_s)
    ratios = []
    for first in (0, 10, 20):  # three stretches of a second
        held_out = np.arange(first, first + 10)
        rest = np.setdiff1d(np.arange(30), held_out)
        covariance = COVARIANCE.compute_covariance(
            state[rest] - known.state_mean, times_s[rest], state[rest] - known.state_mean, times_s[rest]
        )
        cross = COVARIANCE.compute_covariance(
            state[held_out] - known.state_mean, times_s[held_out], state[rest] - known.state_mean, times_s[rest]
        )
        prior = np.diag(
            COVARIANCE.compute_covariance(
                state[held_out] - known.state_mean, times_s[held_out], state[held_out] - known.state_mean, times_s[held_out]
            )
        )
        gain = cross @ np.linalg.inv(covariance + COVARIANCE.noise_power * np.eye(20))
        error = values[held_out] - known.value_mean - gain @ (values[rest] - known.value_mean)
        ratios.append((error**2 / (prior + COVARIANCE.noise_power - (gain * cross).sum(1))[:, None]).mean(0))
    np.testing.assert_allclose(known.measure_gap_errors(1.0)[0], np.mean(ratios, 0), rtol=1e-6)


def test_cross_validation_error_of_the_models_own_draws():
    rng = np.random.default_rng(3)
    state, times_s = rng.normal(0, 0.3, (200, 4)), np.arange(200) / 20
    covariance = COVARIANCE.compute_covariance(state, times_s, state, times_s) + COVARIANCE.noise_power * np.eye(200)
    values = 0.2 * np.linalg.cholesky(covariance) @ rng.normal(size=(200, 50))
    np.testing.assert_allclose(fit(values, state, times_s).measure_gap_errors(0.5)[0].mean(), 0.04, rtol=0.1)


def test_cross_validation_needs_two_stretches():
    times_s = np.arange(20) / 20
    assert np.isnan(fit(np.sin(times_s)[:, None], np.zeros((20, 1)), times_s).measure_gap_errors(5.0)[0]).all()
