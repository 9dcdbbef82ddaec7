"""Moments alike: courses with known answers, seen in part."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mocapfix.solve import alike

RATE = 60.0


def told(values, circumstances, seconds, asked, asked_at):
    return alike.expected(values, circumstances, seconds, np.zeros(len(values)), asked, asked_at)


def test_a_course_passes_through_what_is_known_of_it_and_is_sure_of_that():
    seconds = np.arange(60) / RATE
    course, like = np.sin(4 * seconds)[:, None], np.zeros((60, 1))
    mean, variance, _ = told(course, like, seconds, like, seconds)
    np.testing.assert_allclose(mean, course, atol=0.01)
    assert variance.max() < 3 * alike.NOISE


def test_across_a_short_gap_a_course_runs_on_smoothly():
    seconds = np.arange(60) / RATE
    course, like = np.sin(4 * seconds)[:, None], np.zeros((60, 1))
    gap = np.arange(25, 35)
    rest = np.setdiff1d(np.arange(60), gap)
    mean, _, _ = told(course[rest], like[rest], seconds[rest], like[gap], seconds[gap])
    np.testing.assert_allclose(mean, course[gap], atol=0.01)


def test_far_from_all_that_is_known_it_is_as_unsure_as_it_can_be_and_expects_the_mean():
    seconds = np.arange(60) / RATE
    mean, variance, _ = told(np.sin(seconds)[:, None], np.zeros((60, 1)), seconds, np.full((1, 1), 50.0), np.array([100.0]))
    np.testing.assert_allclose(mean, np.sin(seconds).mean(), atol=1e-6)
    np.testing.assert_allclose(variance, alike.TIME + alike.AGAIN + alike.TOGETHER * 50.0**2)


def test_what_goes_together_is_foretold_beyond_what_was_seen():
    rng = np.random.default_rng(0)
    like = rng.uniform(-1, 1, (200, 3))
    seconds, slope = 10.0 * np.arange(200), np.array([[0.3], [-0.5], [0.2]])
    mean, _, _ = told(like @ slope, like, seconds, np.array([[1.3, -1.3, 1.3]]), np.array([1e4]))
    np.testing.assert_allclose(mean, [[1.3]], rtol=0.15)


def test_what_comes_again_is_as_it_was():
    seconds = np.arange(0, 20, 1 / 10)
    like = np.stack([np.cos(seconds), np.sin(seconds)], 1)
    course = np.cos(3 * seconds)[:, None]  # no plane tells it
    gap = (seconds > 12) & (seconds < 14)
    mean, _, _ = told(course[~gap], like[~gap], seconds[~gap], like[gap], seconds[gap])
    np.testing.assert_allclose(mean, course[gap], atol=0.12)


def test_a_doubtful_moment_counts_for_less():
    seconds, like = np.arange(3) / RATE, np.zeros((3, 1))
    values, noise = np.array([[0.0], [1.0], [0.0]]), np.array([0.0, 100.0, 0.0])
    mean, _, _ = alike.expected(values, like, seconds, noise, like[1:2], seconds[1:2])
    assert abs(mean[0, 0]) < 0.05


def test_power_is_the_size_of_what_the_process_leaves_open():
    rng = np.random.default_rng(1)
    like, seconds = rng.normal(0, 0.3, (150, 4)), 10.0 * np.arange(150)
    among = alike.covariance(like, seconds, like, seconds) + alike.NOISE * np.eye(150)
    values = 0.2 * np.linalg.cholesky(among) @ rng.normal(size=(150, 30))
    power = told(values, like, seconds, like[:1], seconds[:1])[2]
    np.testing.assert_allclose(power.mean(), 0.04, rtol=0.05)


@given(st.integers(1, 30), st.integers(0, 2**32 - 1))
def test_covariance_is_symmetric_and_positive(count, seed):
    rng = np.random.default_rng(seed)
    like, seconds = rng.normal(size=(count, 3)), rng.uniform(0, 3, count)
    matrix = alike.covariance(like, seconds, like, seconds)
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-12)
    assert np.linalg.eigvalsh(matrix).min() > -1e-9


def test_circumstances_are_those_of_the_moving_body():
    t = np.arange(120) / RATE
    local = np.tile(np.eye(3), (120, 3, 1, 1))
    local[:, 0] = Rotation.from_euler("y", 0.5 * t[:, None]).as_matrix()
    local[:, 2] = Rotation.from_euler("x", 0.8 * t[:, None]).as_matrix()
    root = np.stack([0 * t, 0.9 + 0.1 * t, 0 * t], 1) + 0.7 * np.stack([np.cos(0.5 * t), 0 * t, -np.sin(0.5 * t)], 1)
    frames = np.arange(10, 110, 7)
    said = alike.circumstances(root, local, np.array([2]), frames, RATE)
    np.testing.assert_allclose(said[:, :9] * np.sqrt(2), local[frames, 2].reshape(-1, 9))
    np.testing.assert_allclose(said[:, 9:12] * alike.TURNING, np.tile([0.8, 0, 0], (15, 1)), atol=1e-9)
    np.testing.assert_allclose(said[:, 12:15] * alike.UPRIGHT, np.tile([0, 1, 0], (15, 1)), atol=1e-12)
    np.testing.assert_allclose(said[:, 15] * alike.HEIGHT, root[frames, 1])
    np.testing.assert_allclose(said[:, 16:19] * alike.SPEED, np.tile([0, 0.1, -0.35], (15, 1)), atol=1e-3)  # 0.7 m, 0.5 rad/s
    np.testing.assert_allclose(said[:, 19:] * alike.SPIN, np.tile([0, 0.5, 0], (15, 1)), atol=1e-9)


@pytest.mark.parametrize("frames", [1, 2])
def test_a_take_of_hardly_a_frame_has_circumstances_too(frames):
    local = np.tile(np.eye(3), (frames, 2, 1, 1))
    said = alike.circumstances(np.zeros((frames, 3)), local, np.array([1]), np.arange(frames), RATE)
    assert np.isfinite(said).all()
