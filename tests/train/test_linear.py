import numpy as np

from mocapfix.train import gaussian_models

NAMES, STILL = ("Hips", "Spine", "Head"), np.tile(np.eye(3), (3, 1, 1))


def drawn(deviations, noise, count=20000):
    """-> poses that deviate so along three axes of their own and by `noise` along all; the axes"""
    rng = np.random.default_rng(0)
    axes = np.linalg.qr(rng.normal(size=(9, 9)))[0][:, :3]
    rows = rng.normal(size=(count, 3)) * deviations @ axes.T + noise * rng.normal(size=(count, 9))
    return (rows + np.arange(9) / 10).reshape(-1, 3, 3), axes


def test_the_spread_that_poses_were_drawn_with_is_found_again():
    poses, axes = drawn([0.6, 0.4, 0.3], 0.1)
    model = gaussian_models.fit_gaussian_model(NAMES, STILL, poses, 3)
    w = model.max_components.reshape(3, 9)
    np.testing.assert_allclose(model.mean.ravel(), np.arange(9) / 10, atol=0.02)
    np.testing.assert_allclose(model.noise, 0.1, rtol=0.02)
    np.testing.assert_allclose(np.linalg.norm(w, axis=1), [0.6, 0.4, 0.3], rtol=0.03)
    np.testing.assert_allclose(np.abs(w @ axes), np.diag([0.6, 0.4, 0.3]), atol=0.02)


def test_codes_of_the_poses_are_normal():
    poses, _ = drawn([0.6, 0.4, 0.3], 0.01)
    codes = gaussian_models.fit_gaussian_model(NAMES, STILL, poses, 3).encode(poses)
    np.testing.assert_allclose(codes.T @ codes / len(codes), np.eye(3), atol=0.02)


def test_all_components_are_those_above_the_noise_floor_and_make_the_covariance():
    poses, _ = drawn([0.6, 0.4, 0.3], 0.001)
    model = gaussian_models.fit_gaussian_model(NAMES, STILL, poses, None)
    assert model.size == 3
    assert model.noise == gaussian_models.MIN_NOISE_SD_RAD
    w = model.max_components.reshape(3, 9)
    np.testing.assert_allclose(
        w.T @ w + gaussian_models.MIN_NOISE_SD_RAD**2 * np.eye(9), np.cov(poses.reshape(-1, 9).T), atol=3e-4
    )


def test_no_more_components_than_stand_out_are_kept():
    poses, _ = drawn([0.6, 0.4, 0.3], 0.001)
    assert gaussian_models.fit_gaussian_model(NAMES, STILL, poses, 8).size == 3
