import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.fill.fill_methods import FillMethod, GapEstimate
from mocapfix.fill.gap_estimates import choose_hidden_stretches
from mocapfix.fill.weighted_estimates import (
    build_expected_correlation,
    combine_gap_estimates,
    compute_error_covariances,
    compute_weights,
    shrink_covariances,
)

RATE = 100.0


def build_window(frames=2000):
    visible = np.ones(frames, bool)
    visible[500:520] = False
    return choose_hidden_stretches(visible, 500, 519, RATE)


def build_estimate(window, sd, *, expected_sd=0.01, method=FillMethod.SPLINE, seed=0, offset=0.0):
    error = np.random.default_rng(seed).normal(scale=sd, size=(*window.hidden_frames.shape, 3))
    return GapEstimate(method, np.full((window.length, 3), offset), error, np.full(len(window.points), expected_sd))


def test_estimate_with_small_hidden_errors_is_used():
    window = build_window()
    good = build_estimate(window, 0.001, method=FillMethod.CLUSTER)
    bad = build_estimate(window, 0.1, seed=1, offset=1.0)
    position, sd, method = combine_gap_estimates([bad, good], window, np.ones(len(window.starts)))
    assert np.abs(position).max() < 0.02
    assert (method == FillMethod.CLUSTER).all()
    assert 0.0007 < sd.mean() < 0.003


def test_without_hidden_stretches_the_expected_error_counts():
    visible = np.ones(50, bool)
    visible[2:48] = False
    window = choose_hidden_stretches(visible, 2, 47, RATE)
    unknown = np.full((*window.hidden_frames.shape, 3), np.nan)
    near = GapEstimate(FillMethod.SPLINE, np.zeros((46, 3)), unknown, np.full(len(window.points), 0.01))
    far = GapEstimate(FillMethod.CLUSTER, np.ones((46, 3)), unknown, np.full(len(window.points), 0.1))
    position, sd, _ = combine_gap_estimates([near, far], window, np.ones(len(window.starts)))
    assert np.abs(position).max() < 0.01
    np.testing.assert_allclose(sd, 0.01, rtol=0.01)


def test_dissimilar_stretches_do_not_count():
    window = build_window()
    count = len(window.starts)
    estimate = build_estimate(window, 0.001, expected_sd=0.05)
    similar, dissimilar = (combine_gap_estimates([estimate], window, np.full(count, each)).sd.mean() for each in (1.0, 1e-9))
    assert similar < 0.003
    np.testing.assert_allclose(dissimilar, 0.05, rtol=0.01)


@given(size=st.integers(1, 6), seed=st.integers(0, 999))
def test_weights_are_positive_and_no_worse_than_any_single_estimate(size, seed):
    root = np.random.default_rng(seed).normal(size=(size, size + 2))
    covariance = root @ root.T + 1e-6 * np.eye(size)
    weights, variance = compute_weights(covariance)
    assert (weights >= 0).all()
    np.testing.assert_allclose(weights.sum(), 1)
    assert variance <= np.diag(covariance).min() * (1 + 1e-9)


def test_best_estimate_is_kept_where_measured_correlations_contradict_each_other():
    sd = np.array([1.0, 2.0, 3.0])
    correlation = np.array([[1.0, 0.0, 0.8], [0.0, 1.0, 0.9], [0.8, 0.9, 1.0]])  # not positive definite
    weights, variance = compute_weights(correlation * sd[:, None] * sd)
    np.testing.assert_array_equal(weights, [1, 0, 0])
    assert variance == 1.0


def test_two_independent_estimates_are_weighted_by_precision():
    weights, variance = compute_weights(np.diag([1.0, 4.0]))
    np.testing.assert_allclose(weights, [0.8, 0.2])
    np.testing.assert_allclose(variance, 0.8)


@pytest.mark.parametrize("trust", [0.0, 0.5, 1.0])
def test_variances_are_shrunk_by_their_logarithms(trust):
    shrunk = shrink_covariances(np.array([[[1e-4]]]), np.array([[0.1]]), np.eye(1), np.array([trust]))
    np.testing.assert_allclose(np.sqrt(shrunk[0, 0, 0]), 0.01**trust * 0.1 ** (1 - trust), rtol=1e-3)


def test_covariances_are_those_of_the_errors():
    shared, own = np.random.default_rng(0).normal(size=(2, 4000, 3, 3))
    covariance = compute_error_covariances(np.stack([shared, shared + own]), np.ones(4000))
    np.testing.assert_allclose(covariance.mean(0), [[1, 1], [1, 2]], atol=0.05)
    unknown = compute_error_covariances(np.full((1, 4, 3, 3), np.nan), np.ones(4))
    assert np.isnan(unknown).all()


def test_estimates_in_the_same_axes_have_similar_errors():
    expected = build_expected_correlation([0, 0, 1, None, None])
    assert expected[0, 1] == expected[1, 0] > expected[0, 2]
    assert expected[3, 4] == expected[0, 2]
