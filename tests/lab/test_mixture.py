import numpy as np
import pytest
from scipy.special import logsumexp, softmax
from sklearn.mixture import GaussianMixture

from mocapfix.errors import SceneError
from mocapfix.lab import pose_prior_training
from mocapfix.lab.settings import MixtureSettings

NAMES, IDENTITY = ("Hips", "Spine", "Head"), np.tile(np.eye(3), (3, 1, 1))
SETTINGS = MixtureSettings(
    model="mixture",
    title="",
    test_subjects=frozenset(),
    held_out_subjects=frozenset(),
    subject_balance=0,
    retargeted_weight=1,
    seed=0,
    variance_share=0.99,
    components=2,
    restarts=2,
    tolerance=1e-4,
    max_iterations=200,
)


def draw_poses(count=3000):
    """Return poses of two clusters, in three of nine dimensions with little noise; and the cluster of each."""
    rng = np.random.default_rng(0)
    axes = np.linalg.qr(rng.normal(size=(9, 9)))[0][:3]
    cluster = rng.random(count) < 0.25
    rows = np.where(cluster[:, None], [2.0, 0, 0], [-1.0, 0, 0]) + rng.normal(size=(count, 3)) * [0.2, 0.3, 0.4]
    return (rows @ axes + 0.001 * rng.normal(size=(count, 9))).reshape(-1, 3, 3), cluster


def log_density(model, poses):
    return np.asarray(logsumexp(-model.compute_component_costs(poses), axis=1)) - 0.5 * model.code_size * np.log(2 * np.pi)


def fit(poses, **changes):
    return pose_prior_training.fit_mixture_model(
        NAMES, IDENTITY, poses, np.ones(len(poses)), SETTINGS.model_copy(update=changes), lambda text: None
    )


def test_two_clusters_are_separated():
    poses, cluster = draw_poses()
    model, _ = fit(poses)
    chosen = model.select_components(poses).component_index
    assert model.code_size == 3
    assert (chosen == chosen[0]).tolist() == (cluster == cluster[0]).tolist()
    np.testing.assert_allclose(sorted(model.component_weights), [cluster.mean(), 1 - cluster.mean()], atol=1e-3)


def test_density_agrees_with_scikit_learn():
    poses, _ = draw_poses()
    model, _ = fit(poses)
    reference = GaussianMixture(2, weights_init=model.component_weights, means_init=model.component_means)
    reference.weights_, reference.means_ = model.component_weights, model.component_means
    reference.precisions_cholesky_ = np.swapaxes(np.linalg.inv(model.component_cholesky), 1, 2)
    np.testing.assert_allclose(log_density(model, poses), reference.score_samples(model.project_poses(poses)), rtol=1e-9)


def test_em_has_converged():
    poses, _ = draw_poses()
    model, _ = fit(poses, components=4)
    rows = model.project_poses(poses)
    shares = softmax(-model.compute_component_costs(poses), axis=1)
    np.testing.assert_allclose(shares.mean(0), model.component_weights, atol=5e-3)
    np.testing.assert_allclose(shares.T @ rows / shares.sum(0)[:, None], model.component_means, atol=1e-2)


def test_codes_of_a_component_have_unit_covariance():
    poses, _ = draw_poses()
    selected = fit(poses)[0].select_components(poses)
    codes = selected.encode(poses)
    for component in range(2):
        component_codes = codes[selected.component_index == component]
        np.testing.assert_allclose(component_codes.mean(0), 0, atol=0.02)
        np.testing.assert_allclose(np.cov(component_codes.T), np.eye(3), atol=0.02)


def test_fewest_principal_axes_keep_the_variance():
    rows = np.random.default_rng(1).normal(size=(100_000, 3)) * [0.3, 2, 1]  # variances in the ratio 80 : 20 : 2
    assert np.abs(pose_prior_training.compute_principal_axes(rows, 0.7)).round(2).tolist() == [[0, 1, 0]]
    assert [len(pose_prior_training.compute_principal_axes(rows, part)) for part in (0.9, 0.97, 0.99)] == [2, 2, 3]


def test_components_are_not_narrower_than_the_noise_floor():
    poses = np.repeat(draw_poses(40)[0], 30, axis=0)  # each pose is repeated for a second, so it has no variance
    model, _ = fit(poses, components=20)
    assert np.linalg.svd(model.component_cholesky)[1].min() >= 0.999 * pose_prior_training.MIN_NOISE_SD_RAD


def test_fits_are_reproducible_and_the_best_restart_is_used():
    poses, _ = draw_poses(1000)
    (first, summary), (again, _) = fit(poses, components=6, restarts=3), fit(poses, components=6, restarts=3)
    for name in ("component_weights", "component_means", "component_cholesky"):
        assert np.array_equal(getattr(first, name), getattr(again, name))
    each = [log_density(fit(poses, components=6, restarts=1, seed=seed)[0], poses).mean() for seed in range(3)]
    assert len(set(np.round(each, 4))) > 1
    assert log_density(first, poses).mean() in each
    assert "onto 3 principal axes" in summary
    assert f"of {len(poses):,} drawn poses" in summary


def test_fit_that_does_not_converge_raises():
    with pytest.raises(SceneError, match=r"did not converge in 2 iterations; raise max_iterations"):
        fit(draw_poses(400)[0], components=6, max_iterations=2, tolerance=1e-12)
