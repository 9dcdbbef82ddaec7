"""Courses with known answers, seen in part."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.stats import gaussian_process
from mocapfix.stats.gaussian_process import StateCovariance, fit_gaussian_process

RATE = 60.0
LIKENESS = StateCovariance(
    time_scale_s=0.3, similarity_rate=0.6, time_power=0.06, recurrence_power=1.6, linear_power=0.8, noise_power=1.5e-4
)


def process(values, circumstances, seconds):
    return fit_gaussian_process(values, circumstances, seconds, np.zeros(len(values)), LIKENESS)


def told(values, circumstances, seconds, asked, asked_at):
    return process(values, circumstances, seconds).predict(asked, asked_at)


def test_prediction_interpolates_training_values():
    seconds = np.arange(60) / RATE
    course, like = np.sin(4 * seconds)[:, None], np.zeros((60, 1))
    mean, variance = told(course, like, seconds, like, seconds)
    np.testing.assert_allclose(mean, course, atol=0.01)
    assert variance.max() < 3 * LIKENESS.noise_power


def test_prediction_is_smooth_across_a_short_gap():
    seconds = np.arange(60) / RATE
    course, like = np.sin(4 * seconds)[:, None], np.zeros((60, 1))
    gap = np.arange(25, 35)
    rest = np.setdiff1d(np.arange(60), gap)
    mean, _ = told(course[rest], like[rest], seconds[rest], like[gap], seconds[gap])
    np.testing.assert_allclose(mean, course[gap], atol=0.01)


def test_far_prediction_is_the_mean_with_prior_variance():
    seconds = np.arange(60) / RATE
    mean, variance = told(np.sin(seconds)[:, None], np.zeros((60, 1)), seconds, np.full((1, 1), 50.0), np.array([100.0]))
    np.testing.assert_allclose(mean, np.sin(seconds).mean(), atol=1e-6)
    np.testing.assert_allclose(variance, LIKENESS.time_power + LIKENESS.recurrence_power + LIKENESS.linear_power * 50.0**2)


def test_linear_part_extrapolates():
    rng = np.random.default_rng(0)
    like = rng.uniform(-1, 1, (200, 3))
    seconds, slope = 10.0 * np.arange(200), np.array([[0.3], [-0.5], [0.2]])
    mean, _ = told(like @ slope, like, seconds, np.array([[1.3, -1.3, 1.3]]), np.array([1e4]))
    np.testing.assert_allclose(mean, [[1.3]], rtol=0.15)


def test_recurring_motion_is_predicted():
    seconds = np.arange(0, 20, 1 / 10)
    like = np.stack([np.cos(seconds), np.sin(seconds)], 1)
    course = np.cos(3 * seconds)[:, None]  # no plane tells it
    gap = (seconds > 12) & (seconds < 14)
    mean, _ = told(course[~gap], like[~gap], seconds[~gap], like[gap], seconds[gap])
    np.testing.assert_allclose(mean, course[gap], atol=0.12)


def test_noisy_frame_has_less_weight():
    seconds, like = np.arange(3) / RATE, np.zeros((3, 1))
    values, noise = np.array([[0.0], [1.0], [0.0]]), np.array([0.0, 100.0, 0.0])
    mean, _ = fit_gaussian_process(values, like, seconds, noise, LIKENESS).predict(like[1:2], seconds[1:2])
    assert abs(mean[0, 0]) < 0.05


def test_signal_power_is_estimated():
    rng = np.random.default_rng(1)
    like, seconds = rng.normal(0, 0.3, (150, 4)), 10.0 * np.arange(150)
    among = LIKENESS.compute_covariance(like, seconds, like, seconds) + LIKENESS.noise_power * np.eye(150)
    values = 0.2 * np.linalg.cholesky(among) @ rng.normal(size=(150, 30))
    np.testing.assert_allclose(process(values, like, seconds).signal_power.mean(), 0.04, rtol=0.05)


@given(st.integers(1, 30), st.integers(0, 2**32 - 1))
def test_covariance_is_symmetric_and_positive(count, seed):
    rng = np.random.default_rng(seed)
    like, seconds = rng.normal(size=(count, 3)), rng.uniform(0, 3, count)
    matrix = LIKENESS.compute_covariance(like, seconds, like, seconds)
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-12)
    assert np.linalg.eigvalsh(matrix).min() > -1e-9


def test_cross_validation_equals_refitting_without_the_stretch():
    rng = np.random.default_rng(2)
    seconds, like, values = np.arange(30) / 10, rng.normal(size=(30, 2)), rng.normal(size=(30, 3))
    known = process(values, like, seconds)
    ratios = []
    for first in (0, 10, 20):  # three stretches of a second
        out = np.arange(first, first + 10)
        rest = np.setdiff1d(np.arange(30), out)
        among = LIKENESS.compute_covariance(
            like[rest] - known.state_mean, seconds[rest], like[rest] - known.state_mean, seconds[rest]
        )
        between = LIKENESS.compute_covariance(
            like[out] - known.state_mean, seconds[out], like[rest] - known.state_mean, seconds[rest]
        )
        own = np.diag(
            LIKENESS.compute_covariance(like[out] - known.state_mean, seconds[out], like[out] - known.state_mean, seconds[out])
        )
        gain = between @ np.linalg.inv(among + LIKENESS.noise_power * np.eye(20))
        missed = values[out] - known.value_mean - gain @ (values[rest] - known.value_mean)
        ratios.append((missed**2 / (own + LIKENESS.noise_power - (gain * between).sum(1))[:, None]).mean(0))
    np.testing.assert_allclose(known.cross_validate_gaps(1.0), np.mean(ratios, 0), rtol=1e-6)


def test_cross_validation_error_of_the_models_own_draws():
    rng = np.random.default_rng(3)
    like, seconds = rng.normal(0, 0.3, (200, 4)), np.arange(200) / 20
    among = LIKENESS.compute_covariance(like, seconds, like, seconds) + LIKENESS.noise_power * np.eye(200)
    values = 0.2 * np.linalg.cholesky(among) @ rng.normal(size=(200, 50))
    np.testing.assert_allclose(process(values, like, seconds).cross_validate_gaps(0.5).mean(), 0.04, rtol=0.1)


def test_cross_validation_needs_two_stretches():
    seconds = np.arange(20) / 20
    assert np.isnan(process(np.sin(seconds)[:, None], np.zeros((20, 1)), seconds).cross_validate_gaps(5.0)).all()


def test_columns_with_the_same_gap_are_grouped():
    gone = np.zeros((20, 5), bool)
    gone[3:7, [1, 2]] = gone[4:7, 3] = gone[15:, 2] = True
    assert {gap: list(lost) for gap, lost in gaussian_process.group_gaps(gone).items()} == {
        (3, 6): [1, 2],
        (4, 6): [3],
        (15, 19): [2],
    }


@given(st.integers(0, 3000), st.integers(1, 400), st.sampled_from([30.0, 120.0]))
def test_training_frames_cover_both_edges_and_the_whole_take(first, length, rate):
    known = np.ones(3000, bool)
    known[first : first + length] = False
    chosen = gaussian_process.select_training_frames(known, first, first + length - 1, rate)
    assert len(chosen) <= gaussian_process.MAX_TRAINING_FRAMES
    assert (np.diff(chosen) > 0).all()
    assert known[chosen].all()
    for edge in (first - 1, first + length):
        assert not 0 <= edge < 3000 or edge in chosen
    if first > 500:
        assert chosen[0] == 0
    if first + length < 2500:
        assert chosen[-1] == 2999
