import numpy as np

from mocapfix.lab import pose_prior_training

NAMES, IDENTITY = ("Hips", "Spine", "Head"), np.tile(np.eye(3), (3, 1, 1))


def draw_poses(sds, noise, count=20000):
    """Return poses with these standard deviations along three axes and with `noise` along all axes; and the three axes."""
    rng = np.random.default_rng(0)
    axes = np.linalg.qr(rng.normal(size=(9, 9)))[0][:, :3]
    rows = rng.normal(size=(count, 3)) * sds @ axes.T + noise * rng.normal(size=(count, 9))
    return (rows + np.arange(9) / 10).reshape(-1, 3, 3), axes


def test_fitted_components_are_those_of_the_distribution():
    poses, axes = draw_poses([0.6, 0.4, 0.3], 0.1)
    model = pose_prior_training.fit_gaussian_model(NAMES, IDENTITY, poses, np.ones(len(poses)), 3)
    w = model.components.reshape(3, 9)
    np.testing.assert_allclose(model.mean_vectors.ravel(), np.arange(9) / 10, atol=0.02)
    np.testing.assert_allclose(model.noise_sd_rad, 0.1, rtol=0.02)
    np.testing.assert_allclose(np.linalg.norm(w, axis=1), [0.6, 0.4, 0.3], rtol=0.03)
    np.testing.assert_allclose(np.abs(w @ axes), np.diag([0.6, 0.4, 0.3]), atol=0.02)


def test_codes_have_unit_covariance():
    poses, _ = draw_poses([0.6, 0.4, 0.3], 0.01)
    codes = pose_prior_training.fit_gaussian_model(NAMES, IDENTITY, poses, np.ones(len(poses)), 3).encode(poses)
    np.testing.assert_allclose(codes.T @ codes / len(codes), np.eye(3), atol=0.02)


def test_all_components_above_the_noise_floor_give_the_covariance():
    poses, _ = draw_poses([0.6, 0.4, 0.3], 0.001)
    model = pose_prior_training.fit_gaussian_model(NAMES, IDENTITY, poses, np.ones(len(poses)), None)
    assert model.code_size == 3
    assert model.noise_sd_rad == pose_prior_training.MIN_NOISE_SD_RAD
    w = model.components.reshape(3, 9)
    np.testing.assert_allclose(
        w.T @ w + pose_prior_training.MIN_NOISE_SD_RAD**2 * np.eye(9), np.cov(poses.reshape(-1, 9).T), atol=3e-4
    )


def test_components_below_the_noise_are_dropped():
    poses, _ = draw_poses([0.6, 0.4, 0.3], 0.001)
    assert pose_prior_training.fit_gaussian_model(NAMES, IDENTITY, poses, np.ones(len(poses)), 8).code_size == 3


def test_weighted_poses_give_the_model_of_repeated_poses():
    rng = np.random.default_rng(3)
    poses, counts = rng.normal(0, 0.3, (300, len(NAMES), 3)), rng.integers(1, 4, 300)
    weighted = pose_prior_training.fit_gaussian_model(NAMES, IDENTITY, poses, counts.astype(float), None)
    repeated = np.repeat(poses, counts, axis=0)
    expected = pose_prior_training.fit_gaussian_model(NAMES, IDENTITY, repeated, np.ones(len(repeated)), None)
    np.testing.assert_allclose(weighted.decode(np.zeros((1, 9)))[0], expected.decode(np.zeros((1, 9)))[0], atol=1e-9)
    assert weighted.code_size == expected.code_size


def test_mixture_is_fitted_to_poses_drawn_by_their_weights():
    poses = np.repeat([0.0, 1.0], [900, 100])[:, None, None] * np.ones((1, 3, 3))
    assert pose_prior_training.draw_poses(poses, np.ones(1000), 0) is poses
    drawn = pose_prior_training.draw_poses(poses, np.repeat([1.0, 9.0], [900, 100]), 0)
    assert len(drawn) == 1000
    assert drawn.mean() == np.mean(drawn > 0.5)
    assert 0.45 < drawn.mean() < 0.55
