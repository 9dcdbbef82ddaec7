"""The course across a gap against Gaussian process regression written out, and what it must do at the limits."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import lfilter

from mocapfix.stats.residual_process import (
    MAX_SAMPLES_PER_SIDE,
    compute_residual_correlation,
    estimate_roughness,
    interpolate_residual,
)

RATE, FADE, REACH, NOISE, LEAST = 100.0, 0.3, 0.1, 1e-3, 1e-3
seeds = st.integers(0, 2**32 - 1)


def gap(frames, first, last):
    mask = np.zeros(frames, bool)
    mask[first : last + 1] = True
    return mask


def torn(residual, wanted):
    return np.where(wanted[:, None], np.nan, residual)


def crossed(residual, wanted, rate=RATE, fade=FADE, reach=REACH, noise=NOISE, least=LEAST):
    return interpolate_residual(
        residual, wanted, rate, time_scale_s=fade, margin_s=reach, noise_sd=noise, min_sd=least
    )[:2]


@given(seeds, st.integers(1, 60))
def test_interpolation_is_the_regression_on_samples_beside_the_gap(seed, length):
    t, phase = np.arange(100)[:, None] / RATE, np.random.default_rng(seed).uniform(0, 2 * np.pi, 3)
    residual, wanted = 0.01 * np.sin(3 * t + phase), gap(100, 20, 19 + length)  # smooth: nothing is added for roughness
    course, variance = crossed(torn(residual, wanted), wanted)
    away = np.array([0, 1, 3, 5, 7, 9])  # of the ten samples within the reach
    near = np.r_[19 - away, 20 + length + away]
    power = max(2.2 * np.median(residual[~wanted] ** 2), LEAST**2)

    def covariance(a, b):
        d = np.sqrt(3) * np.abs(np.subtract.outer(a, b)) / RATE / FADE
        return power * (1 + d) * np.exp(-d)

    inside = np.arange(20, 20 + length)
    known = np.linalg.inv(covariance(near, near) + NOISE**2 * np.eye(len(near)))
    to = covariance(inside, near)
    np.testing.assert_allclose(course[inside], to @ known @ residual[near], atol=1e-9)
    np.testing.assert_allclose(variance[inside], power - np.diag(to @ known @ to.T), atol=1e-12)
    assert (course[~wanted] == 0).all()
    assert (variance[~wanted] == 0).all()


def test_constant_residual_decays_in_a_long_gap():
    residual, wanted = np.tile([0.01, -0.02, 0.0], (500, 1)), gap(500, 100, 399)
    course, variance = crossed(torn(residual, wanted), wanted)
    np.testing.assert_allclose(course[[100, 399]], residual[[100, 399]], rtol=0.02)
    assert (np.abs(course[250]) < 0.01 * np.abs(residual[250]) + 1e-9).all()
    inside = np.abs(course[100:250, 0])
    assert (np.diff(inside) < 0).all()
    assert (np.diff(variance[101:250]) > 0).all()
    np.testing.assert_allclose(course, course[499::-1], atol=1e-12)  # both sides alike
    power = np.median(residual**2) * 2.2
    assert variance[250] == pytest.approx(power, rel=0.01)
    assert variance[100] < 0.05 * power


def test_gap_at_the_end_uses_one_side():
    residual, wanted = np.full((100, 3), 0.01), gap(100, 70, 99)
    course, variance = crossed(torn(residual, wanted), wanted)
    assert (np.diff(course[70:, 0]) < 0).all()
    assert (np.diff(variance[70:]) > 0).all()
    mirrored, _ = crossed(torn(residual, wanted)[::-1], wanted[::-1])
    np.testing.assert_allclose(mirrored, course[::-1], atol=1e-12)


@pytest.mark.parametrize("known", [0, 20])
def test_without_samples_beside_the_gap_mean_is_zero_and_variance_full(known):
    residual, wanted = np.full((100, 3), np.nan), gap(100, 50, 60)
    residual[:known] = 0.004
    course, variance = crossed(residual, wanted)
    assert (course == 0).all()
    np.testing.assert_allclose(variance[wanted], max(2.2 * 0.004**2 if known else 0, LEAST**2))


def test_samples_outside_the_margin_and_unknown_samples_are_ignored():
    residual, wanted = np.full((100, 3), 0.01), gap(100, 50, 60)
    residual[45] = np.nan
    told, _ = crossed(torn(residual, wanted), wanted)
    strange = torn(residual, wanted)
    strange[:40], strange[71:] = 0.0101, 0.0099  # beyond 0.1 s; hardly a change of the median
    np.testing.assert_allclose(crossed(strange, wanted)[0], told, atol=1e-6)
    assert np.isfinite(told).all()


def test_gaps_are_interpolated_independently():
    rng = np.random.default_rng(0)
    residual = rng.normal(0, 0.01, (300, 3))
    one, two = gap(300, 50, 80), gap(300, 200, 205)
    both = torn(residual, one | two)
    course, variance = crossed(both, one | two)
    for alone in (one, two):
        there, unsure = crossed(both, alone)
        np.testing.assert_allclose(course[alone], there[alone], atol=1e-12)
        np.testing.assert_allclose(variance[alone], unsure[alone], atol=1e-15)


def test_distant_outlier_does_not_change_the_variance():
    residual, wanted = np.full((100, 3), 0.001), gap(100, 50, 60)
    _, calm = crossed(torn(residual, wanted), wanted)
    residual[3] = 5.0
    _, struck = crossed(torn(residual, wanted), wanted)
    np.testing.assert_allclose(struck, calm)


def test_interpolation_does_not_depend_on_the_frame_rate():
    t = np.arange(0, 4, 1 / 240)
    residual = np.stack([0.01 * np.sin(t), 0.01 * np.cos(t), 0 * t], 1)
    wanted = (t >= 1.5) & (t < 2.5)
    fine, fine_variance = crossed(torn(residual, wanted), wanted, rate=240.0)
    coarse, coarse_variance = crossed(torn(residual, wanted)[::4], wanted[::4], rate=60.0)
    np.testing.assert_allclose(fine[::4], coarse, atol=1.5e-3)
    middle = np.flatnonzero(wanted[::4])[30]
    assert fine_variance[4 * middle] == pytest.approx(coarse_variance[middle], rel=0.1)


def sliding(seed, frames, rate, fade=FADE, size=0.004):
    """-> (T, 3) skin that slides in steps: an Ornstein-Uhlenbeck process"""
    keep = np.exp(-1 / (fade * rate))
    steps = np.random.default_rng(seed).normal(0, size * np.sqrt(1 - keep**2), (frames, 3))
    return np.asarray(lfilter([1], [1, -keep], steps, axis=0))


@pytest.mark.parametrize("rate", [60.0, 120.0, 480.0])
def test_roughness_of_random_walk_and_of_smooth_motion(rate):
    rng, t = np.random.default_rng(4), np.arange(0, 60, 1 / rate)[:, None]
    rough = sliding(4, len(t), rate)
    assert estimate_roughness(rough, rate, FADE, 0.0, 0.004**2) == pytest.approx(1.0, abs=0.15)
    smooth = 0.004 * np.sin(3 * t + np.arange(3.0))
    assert estimate_roughness(smooth + rng.normal(0, NOISE, smooth.shape), rate, FADE, NOISE, 0.004**2 / 2) < 0.05
    assert 0.3 < estimate_roughness((rough + smooth) / np.sqrt(2), rate, FADE, 0.0, 0.75 * 0.004**2) < 0.9
    assert estimate_roughness(rough[: MAX_SAMPLES_PER_SIDE // 2], rate, FADE, NOISE, 1e-6) == 0  # too few to tell


def test_correlation_mixes_smooth_and_rough_parts():
    seconds = np.linspace(-1, 1, 21)
    distance = np.sqrt(3) * np.abs(seconds) / FADE
    np.testing.assert_allclose(compute_residual_correlation(seconds, FADE, 0.0), (1 + distance) * np.exp(-distance))
    np.testing.assert_allclose(compute_residual_correlation(seconds, FADE, 1.0), np.exp(-np.abs(seconds) / FADE))
    assert (compute_residual_correlation(seconds, FADE, 0.4)[[10]] == 1.0).all()


@pytest.mark.parametrize("length", [3, 10, 30])
def test_variance_of_rough_residual_equals_its_error(length):
    rough = sliding(5, 20000, RATE)
    wanted = (np.arange(len(rough)) % 200 >= 100) & (np.arange(len(rough)) % 200 < 100 + length)
    course, variance, power = interpolate_residual(
        torn(rough, wanted), wanted, RATE, time_scale_s=FADE, margin_s=REACH, noise_sd=0.0, min_sd=LEAST
    )
    strayed = ((course - rough)[wanted] ** 2).mean()
    assert 0.6 < variance[wanted].mean() / strayed < 1.6
    assert (variance <= power).all()


def test_correlation_is_symmetric_and_decreases_from_one():
    seconds = np.linspace(0, 3, 50)
    correlation = compute_residual_correlation(seconds, FADE, 0.0)
    assert correlation[0] == 1.0
    assert (np.diff(correlation) < 0).all()
    assert correlation[-1] < 1e-6
    np.testing.assert_array_equal(compute_residual_correlation(-seconds, FADE, 0.0), correlation)
    assert compute_residual_correlation(np.array([FADE]), FADE, 0.0)[0] == pytest.approx((1 + np.sqrt(3)) * np.exp(-np.sqrt(3)))
