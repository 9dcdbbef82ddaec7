"""Smoothing of joints over time: less noise, and standard deviations that hold."""

import numpy as np

from mocapfix.solve.learned_ik import smooth_positions
from tests.solve.ik_cases import draw_poses, place

RATE_HZ = 30.0


def draw_noisy(sd, frames=200):
    true = place(draw_poses(0, frames))[0]
    return true, true + sd * np.random.default_rng(0).normal(size=true.shape), np.full(true.shape[:2], sd)


def test_noise_is_reduced_to_the_predicted_deviation():
    true, noisy, sd = draw_noisy(0.02)
    smoothed, smoothed_sd = smooth_positions(noisy, sd, RATE_HZ)
    error = np.sqrt(((smoothed - true) ** 2).mean())
    assert error < 0.6 * 0.02
    assert error < 1.3 * np.sqrt((smoothed_sd**2).mean())


def test_exact_positions_stay():
    true, _, _ = draw_noisy(0.02)
    smoothed, _ = smooth_positions(true, np.full(true.shape[:2], 1e-4), RATE_HZ)
    np.testing.assert_allclose(smoothed, true, atol=1e-3)


def test_short_gaps_are_filled_and_long_ones_are_not():
    true, noisy, sd = draw_noisy(0.002)
    noisy[50:52, 20] = np.nan
    noisy[100:160, 20] = np.nan
    smoothed, smoothed_sd = smooth_positions(noisy, sd, RATE_HZ)
    np.testing.assert_allclose(smoothed[50:52, 20], true[50:52, 20], atol=0.02)
    assert np.isnan(smoothed[125:135, 20]).all()
    assert smoothed_sd[130, 20] > smoothed_sd[51, 20]
    assert not np.isnan(smoothed[:, 19]).any()
