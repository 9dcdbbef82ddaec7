import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.keypoints.film_solver import (
    build_camera,
    build_camera_rotation,
    fit_camera_scale,
    solve_camera_scale,
    subtract_weighted_mean,
)


def test_level_camera_image_axes():
    camera = build_camera(build_camera_rotation(0.0), 100.0, np.array([640.0, 360.0]))
    np.testing.assert_allclose(camera.project(np.array([[0.5, 1.0, -3.0]])), [[690.0, 260.0]])


@given(st.floats(-1.5, 1.5))
def test_camera_axes_are_right_handed(pitch_rad):
    rotation = build_camera_rotation(pitch_rad)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)


def test_camera_facing_down_images_nearer_points_below():
    camera = build_camera(build_camera_rotation(np.pi / 2), 10.0, np.zeros(2))
    np.testing.assert_allclose(camera.project(np.array([[0.0, 5.0, 0.0], [0.0, 0.0, 1.0]])), [[0, 0], [0, 10]], atol=1e-12)


@given(st.integers(0, 2**32 - 1), st.floats(5, 500))
def test_scale_does_not_depend_on_the_frames_offsets(seed, scale):
    rng = np.random.default_rng(seed)
    flat, weight = rng.normal(size=(4, 9, 2)), rng.uniform(0, 1, (4, 9))
    pixels = scale * flat + rng.normal(0, 300, (4, 1, 2))
    pixels[weight < 0.2], weight[weight < 0.2] = 1e6, 0.0  # samples without weight are ignored
    assert fit_camera_scale(flat, pixels, weight) == pytest.approx(scale)


def test_scale_is_the_least_squares_solution():
    rng = np.random.default_rng(0)
    flat, pixels, weight = rng.normal(size=(3, 7, 2)), rng.normal(size=(3, 7, 2)), rng.uniform(0, 1, (3, 7))

    def squares(scale):
        return (weight[..., None] * subtract_weighted_mean(pixels - scale * flat, weight) ** 2).sum()

    best = fit_camera_scale(flat, pixels, weight)
    assert squares(best) < min(squares(best * 1.001), squares(best * 0.999))


def test_coincident_points_give_no_scale():
    assert np.isnan(fit_camera_scale(np.ones((1, 5, 2)), np.zeros((1, 5, 2)), np.ones((1, 5))))


@pytest.mark.parametrize("echo", [0.0, 0.5, 0.9])
@pytest.mark.parametrize("start", [60.0, 170.0, 200.0, 420.0])
def test_slowly_converging_scale_is_found(echo, start):
    evaluated = []

    def estimate(scale):
        evaluated.append(scale)
        return 200 * (scale / 200) ** echo

    assert solve_camera_scale(estimate, start) == pytest.approx(200, rel=0.03)
    assert len(evaluated) <= 12


def test_noisy_scale_estimates_do_not_diverge():
    rng = np.random.default_rng(0)
    found = [solve_camera_scale(lambda s: 200 * (s / 200) ** 0.9 * np.exp(rng.normal(0, 5e-4)), 185.0) for _ in range(50)]
    assert np.abs(np.log(np.array(found) / 200)).max() < 0.1
