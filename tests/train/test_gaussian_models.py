import numpy as np

from mocapfix.train import gaussian_models

NAMES, IDENTITY = ("Hips", "Spine", "Head"), np.tile(np.eye(3), (3, 1, 1))


def draw_poses(sds, noise, count=20000):
    """Return poses with these standard deviations along three axes and with `noise` along all axes; and the three axes."""
    rng = np.random.default_rng(0)
    axes = np.linalg.qr(rng.normal(size=(9, 9)))[0][:, :3]
    rows = rng.normal(size=(count, 3)) * sds @ axes.T + noise * rng.normal(size=(count, 9))
    return (rows + np.arange(9) / 10).reshape(-1, 3, 3), axes


def test_fitted_components_are_those_of_the_distribution():
    poses, axes = draw_poses([0.6, 0.4, 0.3], 0.1)
    model = gaussian_models.fit_gaussian_model(NAMES, IDENTITY, poses, np.ones(len(poses)), 3)
    w = model.components.reshape(3, 9)
    np.testing.assert_allclose(model.mean_vectors.ravel(), np.arange(9) / 10, atol=0.02)
    np.testing.assert_allclose(model.noise_sd_rad, 0.1, rtol=0.02)
    np.testing.assert_allclose(np.linalg.norm(w, axis=1), [0.6, 0.4, 0.3], rtol=0.03)
    np.testing.assert_allclose(np.abs(w @ axes), np.diag([0.6, 0.4, 0.3]), atol=0.02)


def test_codes_have_unit_covariance():
    poses, _ = draw_poses([0.6, 0.4, 0.3], 0.01)
    codes = gaussian_models.fit_gaussian_model(NAMES, IDENTITY, poses, np.ones(len(poses)), 3).encode(poses)
    np.testing.assert_allclose(codes.T @ codes / len(codes), np.eye(3), atol=0.02)


def test_all_components_above_the_noise_floor_give_the_covariance():
    poses, _ = draw_poses([0.6, 0.4, 0.3], 0.001)
    model = gaussian_models.fit_gaussian_model(NAMES, IDENTITY, poses, np.ones(len(poses)), None)
    assert model.code_size == 3
    assert model.noise_sd_rad == gaussian_models.MIN_NOISE_SD_RAD
    w = model.components.reshape(3, 9)
    np.testing.assert_allclose(
        w.T @ w + gaussian_models.MIN_NOISE_SD_RAD**2 * np.eye(9), np.cov(poses.reshape(-1, 9).T), atol=3e-4
    )


def test_components_below_the_noise_are_dropped():
    poses, _ = draw_poses([0.6, 0.4, 0.3], 0.001)
    assert gaussian_models.fit_gaussian_model(NAMES, IDENTITY, poses, np.ones(len(poses)), 8).code_size == 3
