"""Interpolated residuals against Gaussian process regression written out, and their limits."""

from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import lfilter

from mocapfix.stats.gaussian_process import (
    MIN_ROUGHNESS_STEPS,
    compute_residual_correlation,
    estimate_roughness,
    map_residual,
)
from mocapfix.stats.sequences import find_runs, sample_evenly

RATE = 100.0
TIME_SCALE_S = 0.3
MARGIN_S = 0.1
NOISE_SD = 1e-3
MIN_SD = 1e-3
seeds = st.integers(0, 2**32 - 1)


def build_gap_mask(frames, first, last):
    mask = np.zeros(frames, bool)
    mask[first : last + 1] = True
    return mask


def remove_gap(residual, is_gap):
    return np.where(is_gap[:, None], np.nan, residual)


def interpolate(residual, is_gap, rate=RATE, noise_sd=NOISE_SD):
    """Return the mean and variance of a residual in gaps, from up to six samples within the margin on either side."""
    known = ~np.isnan(residual[:, 0])
    power = max(float(np.median(residual[known] ** 2)) * 2.2 if known.any() else 0.0, MIN_SD**2)
    shown = np.flatnonzero(known)
    roughness = estimate_roughness(residual[shown], shown, rate, TIME_SCALE_S, noise_sd, power)
    offsets = sample_evenly(max(1, round(MARGIN_S * rate)), 6)
    mean, variance = np.zeros_like(residual), np.zeros(len(residual))
    for first, last in find_runs(is_gap):
        near, gap = np.r_[first - 1 - offsets, last + 1 + offsets], np.arange(first, last + 1)
        near = near[(near >= 0) & (near < len(residual))]
        near = near[known[near]]
        weights, variance[gap] = map_residual(
            near / rate,
            gap / rate,
            power=power,
            time_scale_s=TIME_SCALE_S,
            roughness=roughness,
            noise_variance=np.full(len(near), noise_sd**2),
        )
        mean[gap] = weights @ residual[near]
    return mean, variance


@given(seeds, st.integers(1, 60))
def test_interpolation_is_the_regression_on_samples_beside_the_gap(seed, length):
    t, phase = np.arange(100)[:, None] / RATE, np.random.default_rng(seed).uniform(0, 2 * np.pi, 3)
    residual, is_gap = 0.01 * np.sin(3 * t + phase), build_gap_mask(100, 20, 19 + length)  # smooth, so that the roughness is zero
    mean, variance = interpolate(remove_gap(residual, is_gap), is_gap)
    offsets = np.array([0, 1, 3, 5, 7, 9])  # of the ten samples within the margin
    near = np.r_[19 - offsets, 20 + length + offsets]
    power = max(2.2 * np.median(residual[~is_gap] ** 2), MIN_SD**2)

    def covariance(a, b):
        d = np.sqrt(3) * np.abs(np.subtract.outer(a, b)) / RATE / TIME_SCALE_S
        return power * (1 + d) * np.exp(-d)

    inside = np.arange(20, 20 + length)
    known = np.linalg.inv(covariance(near, near) + NOISE_SD**2 * np.eye(len(near)))
    to = covariance(inside, near)
    np.testing.assert_allclose(mean[inside], to @ known @ residual[near], atol=1e-9)
    np.testing.assert_allclose(variance[inside], power - np.diag(to @ known @ to.T), atol=1e-12)
    assert (mean[~is_gap] == 0).all()
    assert (variance[~is_gap] == 0).all()


def test_constant_residual_decays_in_a_long_gap():
    residual, is_gap = np.tile([0.01, -0.02, 0.0], (500, 1)), build_gap_mask(500, 100, 399)
    mean, variance = interpolate(remove_gap(residual, is_gap), is_gap)
    np.testing.assert_allclose(mean[[100, 399]], residual[[100, 399]], rtol=0.02)
    assert (np.abs(mean[250]) < 0.01 * np.abs(residual[250]) + 1e-9).all()
    inside = np.abs(mean[100:250, 0])
    assert (np.diff(inside) < 0).all()
    assert (np.diff(variance[101:250]) > 0).all()
    np.testing.assert_allclose(mean, mean[499::-1], atol=1e-12)  # symmetric
    power = np.median(residual**2) * 2.2
    assert variance[250] == pytest.approx(power, rel=0.01)
    assert variance[100] < 0.05 * power


def test_gap_at_the_end_uses_one_side():
    residual, is_gap = np.full((100, 3), 0.01), build_gap_mask(100, 70, 99)
    mean, variance = interpolate(remove_gap(residual, is_gap), is_gap)
    assert (np.diff(mean[70:, 0]) < 0).all()
    assert (np.diff(variance[70:]) > 0).all()
    mirrored, _ = interpolate(remove_gap(residual, is_gap)[::-1], is_gap[::-1])
    np.testing.assert_allclose(mirrored, mean[::-1], atol=1e-12)


@pytest.mark.parametrize("known", [0, 20])
def test_without_samples_beside_the_gap_mean_is_zero_and_variance_full(known):
    residual, is_gap = np.full((100, 3), np.nan), build_gap_mask(100, 50, 60)
    residual[:known] = 0.004
    mean, variance = interpolate(residual, is_gap)
    assert (mean == 0).all()
    np.testing.assert_allclose(variance[is_gap], max(2.2 * 0.004**2 if known else 0, MIN_SD**2))


def test_samples_outside_the_margin_and_unknown_samples_are_ignored():
    residual, is_gap = np.full((100, 3), 0.01), build_gap_mask(100, 50, 60)
    residual[45] = np.nan
    expected, _ = interpolate(remove_gap(residual, is_gap), is_gap)
    changed = remove_gap(residual, is_gap)
    changed[:40], changed[71:] = 0.0101, 0.0099  # beyond 0.1 s; hardly a change of the median
    np.testing.assert_allclose(interpolate(changed, is_gap)[0], expected, atol=1e-6)
    assert np.isfinite(expected).all()


def test_gaps_are_interpolated_independently():
    rng = np.random.default_rng(0)
    residual = rng.normal(0, 0.01, (300, 3))
    one, two = build_gap_mask(300, 50, 80), build_gap_mask(300, 200, 205)
    both = remove_gap(residual, one | two)
    mean, variance = interpolate(both, one | two)
    for one_gap in (one, two):
        single_mean, single_variance = interpolate(both, one_gap)
        np.testing.assert_allclose(mean[one_gap], single_mean[one_gap], atol=1e-12)
        np.testing.assert_allclose(variance[one_gap], single_variance[one_gap], atol=1e-15)


def test_distant_outlier_does_not_change_the_variance():
    residual, is_gap = np.full((100, 3), 0.001), build_gap_mask(100, 50, 60)
    _, reference = interpolate(remove_gap(residual, is_gap), is_gap)
    residual[3] = 5.0
    _, with_outlier = interpolate(remove_gap(residual, is_gap), is_gap)
    np.testing.assert_allclose(with_outlier, reference)


def test_interpolation_does_not_depend_on_the_frame_rate():
    t = np.arange(0, 4, 1 / 240)
    residual = np.stack([0.01 * np.sin(t), 0.01 * np.cos(t), 0 * t], 1)
    is_gap = (t >= 1.5) & (t < 2.5)
    fine, fine_variance = interpolate(remove_gap(residual, is_gap), is_gap, rate=240.0)
    coarse, coarse_variance = interpolate(remove_gap(residual, is_gap)[::4], is_gap[::4], rate=60.0)
    np.testing.assert_allclose(fine[::4], coarse, atol=1.5e-3)
    middle = np.flatnonzero(is_gap[::4])[30]
    assert fine_variance[4 * middle] == pytest.approx(coarse_variance[middle], rel=0.1)


def simulate_random_walk(seed, frames, rate, time_scale_s=TIME_SCALE_S, size=0.004):
    """Return an Ornstein-Uhlenbeck process (T, 3)."""
    decay = np.exp(-1 / (time_scale_s * rate))
    steps = np.random.default_rng(seed).normal(0, size * np.sqrt(1 - decay**2), (frames, 3))
    return np.asarray(lfilter([1], [1, -decay], steps, axis=0))


@pytest.mark.parametrize("rate", [60.0, 120.0, 480.0])
def test_roughness_of_random_walk_and_of_smooth_motion(rate):
    rng, t = np.random.default_rng(4), np.arange(0, 60, 1 / rate)[:, None]
    frames, rough = np.arange(len(t)), simulate_random_walk(4, len(t), rate)
    assert estimate_roughness(rough, frames, rate, TIME_SCALE_S, 0.0, 0.004**2) == pytest.approx(1.0, abs=0.15)
    smooth = 0.004 * np.sin(3 * t + np.arange(3.0))
    noisy = smooth + rng.normal(0, NOISE_SD, smooth.shape)
    assert estimate_roughness(noisy, frames, rate, TIME_SCALE_S, NOISE_SD, 0.004**2 / 2) < 0.05
    assert 0.3 < estimate_roughness((rough + smooth) / np.sqrt(2), frames, rate, TIME_SCALE_S, 0.0, 0.75 * 0.004**2) < 0.9
    few = MIN_ROUGHNESS_STEPS // 2
    assert estimate_roughness(rough[:few], frames[:few], rate, TIME_SCALE_S, NOISE_SD, 1e-6) == 0  # too few samples
    apart = frames[:: 10 * round(rate)]
    assert estimate_roughness(rough[apart], apart, rate, TIME_SCALE_S, 0.0, 1e-6) == 0  # none is a short time after another


def test_correlation_mixes_smooth_and_rough_parts():
    seconds = np.linspace(-1, 1, 21)
    distance = np.sqrt(3) * np.abs(seconds) / TIME_SCALE_S
    np.testing.assert_allclose(compute_residual_correlation(seconds, TIME_SCALE_S, 0.0), (1 + distance) * np.exp(-distance))
    np.testing.assert_allclose(compute_residual_correlation(seconds, TIME_SCALE_S, 1.0), np.exp(-np.abs(seconds) / TIME_SCALE_S))
    assert (compute_residual_correlation(seconds, TIME_SCALE_S, 0.4)[[10]] == 1.0).all()


@pytest.mark.parametrize("length", [3, 10, 30])
def test_variance_of_rough_residual_equals_its_error(length):
    rough = simulate_random_walk(5, 20000, RATE)
    is_gap = (np.arange(len(rough)) % 200 >= 100) & (np.arange(len(rough)) % 200 < 100 + length)
    mean, variance = interpolate(remove_gap(rough, is_gap), is_gap, noise_sd=0.0)
    error = ((mean - rough)[is_gap] ** 2).mean()
    assert 0.6 < variance[is_gap].mean() / error < 1.6
    assert (variance <= 2.2 * np.median(rough[~is_gap] ** 2)).all()


def test_a_smooth_excess_adds_to_the_variance_and_continues_the_samples():
    known, wanted = np.array([-0.01]), np.array([0.0, 5.0])
    build = partial(map_residual, known, wanted, power=1.0, time_scale_s=TIME_SCALE_S, roughness=1.0, noise_variance=np.zeros(1))
    _, alone = build()
    weights, variance = build(known_excess=np.array([9.0]), wanted_excess=np.array([9.0, 4.0]))
    np.testing.assert_allclose(variance[1], 1.0 + 4.0, rtol=1e-6)
    assert alone[0] < variance[0] < 0.2
    assert weights[0, 0] > 0.99
    assert abs(weights[1, 0]) < 1e-3


def test_correlation_is_symmetric_and_decreases_from_one():
    seconds = np.linspace(0, 3, 50)
    correlation = compute_residual_correlation(seconds, TIME_SCALE_S, 0.0)
    assert correlation[0] == 1.0
    assert (np.diff(correlation) < 0).all()
    assert correlation[-1] < 1e-6
    np.testing.assert_array_equal(compute_residual_correlation(-seconds, TIME_SCALE_S, 0.0), correlation)
    assert compute_residual_correlation(np.array([TIME_SCALE_S]), TIME_SCALE_S, 0.0)[0] == pytest.approx(
        (1 + np.sqrt(3)) * np.exp(-np.sqrt(3))
    )
