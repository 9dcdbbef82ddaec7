"""Smooth paths against their definition, solved densely."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.stats.sequences import minimise_acceleration, smooth_path

RATE = 100.0
seeds = st.integers(0, 2**32 - 1)


def solve_densely(path, variance, power, rate):
    """Return the argmin over x of sum |x_t - path_t|^2 / variance_t + sum of (x''_t)^2 / (rate power_t), by rows of A x = b."""
    second = np.diff(np.eye(len(path)), 2, axis=0) * rate**2 / np.sqrt(rate * power[1:-1])[:, None]
    rows = np.vstack([np.diag(variance**-0.5), second])
    targets = np.vstack([path / np.sqrt(variance)[:, None], np.zeros((len(second), path.shape[1]))])
    return np.linalg.lstsq(rows, targets, rcond=None)[0]


@given(seeds, st.integers(3, 40), st.floats(-2, 3), st.sampled_from([30.0, 120.0]))
def test_smooth_path_is_the_least_squares_solution(seed, frames, power, rate):
    rng = np.random.default_rng(seed)
    path, variance = rng.normal(size=(frames, 2)), 10.0 ** rng.uniform(-5, -1, frames)
    powers = 10.0 ** (power + rng.uniform(-0.5, 0.5, frames))
    estimated = smooth_path(path, variance, powers, rate)
    np.testing.assert_allclose(estimated, solve_densely(path, variance, powers, rate), atol=1e-6)


@pytest.mark.parametrize("frames", [1, 2, 3, 4, 5, 100])
def test_straight_line_is_a_fixed_point(frames):
    line = np.arange(frames)[:, None] * [[0.1, -2.0]] + [[3.0, 0.5]]
    np.testing.assert_allclose(smooth_path(line, np.full(frames, 1e-4), np.ones(frames), RATE), line, atol=1e-8)


def test_gap_between_straight_ends_is_linear():
    line = np.linspace(0, 1, 60)[:, None] * [[1.0, 2.0]]
    variance, damaged = np.full(60, 1e-4), line.copy()
    variance[20:40], damaged[20:40] = 1e8, 100.0
    np.testing.assert_allclose(smooth_path(damaged, variance, np.ones(60), RATE), line, atol=1e-4)


def test_certain_frames_are_kept_and_stiff_paths_are_lines():
    rng = np.random.default_rng(0)
    path, certain = rng.normal(size=(50, 1)), np.full(50, 1e-12)
    np.testing.assert_allclose(smooth_path(path, certain, np.ones(50), RATE), path, atol=1e-4)
    stiff = smooth_path(path, np.full(50, 1.0), np.full(50, 1e-5), RATE)
    t = np.arange(50)
    np.testing.assert_allclose(stiff[:, 0], np.polyval(np.polyfit(t, path[:, 0], 1), t), atol=1e-3)


@pytest.mark.parametrize("rate", [0.01, 1.0, 10_000.0, 1e6])
@pytest.mark.parametrize("known_frames", [0, 1, 2, 100])
@pytest.mark.parametrize("power", [1e-3, 1e6])
def test_any_rate_gives_a_path(rate, known_frames, power):
    variance = np.full(200, 1e4)
    variance[:known_frames] = 4e-4
    path = np.random.default_rng(0).normal(size=(200, 4))
    smooth = smooth_path(path, variance, np.full(200, power), rate)
    assert np.isfinite(smooth).all()
    assert np.abs(smooth[:known_frames]).max(initial=0) < 10


@given(seeds, st.integers(0, 12), st.integers(1, 3))
def test_path_of_coupled_coordinates_solves_the_dense_equations(seed, frames, size):
    rng = np.random.default_rng(seed)
    roots, pull = rng.normal(size=(frames, size, size)), rng.normal(size=(frames, size, 2))
    curvature = roots @ roots.swapaxes(1, 2) + np.eye(size)
    speed, stiffness = rng.uniform(0, 9, (max(frames - 1, 0), size)), rng.uniform(0, 9, max(frames - 2, 0))
    matrix = np.zeros((frames, size, frames, size))
    matrix[np.arange(frames), :, np.arange(frames)] = curvature
    for weight, order in ((speed, 1), (np.tile(stiffness[:, None], size), 2)):
        difference = np.diff(np.eye(frames), order, axis=0)
        matrix += np.einsum("da,dm,db,mn->ambn", difference, weight, difference, np.eye(size))
    expected = np.linalg.solve(matrix.reshape(frames * size, -1), pull.reshape(-1, 2)) if frames else pull
    found = minimise_acceleration(curvature, pull, stiffness, speed)
    np.testing.assert_allclose(found, expected.reshape(pull.shape), atol=1e-9)
