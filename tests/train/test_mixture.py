import numpy as np
import pytest
from scipy.special import logsumexp, softmax
from sklearn.mixture import GaussianMixture

from mocapfix.errors import SceneError
from mocapfix.train import gaussian_models
from mocapfix.train.settings import MixtureSettings

NAMES, STILL = ("Hips", "Spine", "Head"), np.tile(np.eye(3), (3, 1, 1))
SETTINGS = MixtureSettings(
    model="mixture", title="", test_subjects=frozenset(), held_out_subjects=frozenset(), seed=0, variance_share=0.99, components=2, restarts=2, tolerance=1e-4,
    max_iterations=200,
)  # fmt: skip


def drawn(count=3000):
    """-> poses of two kinds, in three dimensions of nine and a little noise; of which kind each is"""
    rng = np.random.default_rng(0)
    axes = np.linalg.qr(rng.normal(size=(9, 9)))[0][:3]
    kind = rng.random(count) < 0.25
    rows = np.where(kind[:, None], [2.0, 0, 0], [-1.0, 0, 0]) + rng.normal(size=(count, 3)) * [0.2, 0.3, 0.4]
    return (rows @ axes + 0.001 * rng.normal(size=(count, 9))).reshape(-1, 3, 3), kind


def log_density(model, poses):
    return np.asarray(logsumexp(-model.costs(poses), axis=1)) - 0.5 * model.size * np.log(2 * np.pi)


def fit(poses, **changes):
    return gaussian_models.fit_mixture_model(NAMES, STILL, poses, SETTINGS.model_copy(update=changes), lambda what: None)


def test_two_kinds_of_poses_are_told_apart():
    poses, kind = drawn()
    model, _ = fit(poses)
    chosen = model.near(poses).component_index
    assert model.size == 3
    assert (chosen == chosen[0]).tolist() == (kind == kind[0]).tolist()
    np.testing.assert_allclose(sorted(model.weights), [kind.mean(), 1 - kind.mean()], atol=1e-3)


def test_the_density_is_scikit_learns():
    poses, _ = drawn()
    model, _ = fit(poses)
    theirs = GaussianMixture(2, weights_init=model.weights, means_init=model.centres)
    theirs.weights_, theirs.means_ = model.weights, model.centres
    theirs.precisions_cholesky_ = np.swapaxes(np.linalg.inv(model.spreads), 1, 2)
    np.testing.assert_allclose(log_density(model, poses), theirs.score_samples(model.project_poses(poses)), rtol=1e-9)


def test_expectation_maximisation_has_come_to_rest():
    poses, _ = drawn()
    model, _ = fit(poses, components=4)
    rows = model.project_poses(poses)
    shares = softmax(-model.costs(poses), axis=1)
    np.testing.assert_allclose(shares.mean(0), model.weights, atol=5e-3)
    np.testing.assert_allclose(shares.T @ rows / shares.sum(0)[:, None], model.centres, atol=1e-2)


def test_codes_within_a_component_are_normal():
    poses, _ = drawn()
    near = fit(poses)[0].near(poses)
    codes = near.encode(poses)
    for component in range(2):
        of = codes[near.component_index == component]
        np.testing.assert_allclose(of.mean(0), 0, atol=0.02)
        np.testing.assert_allclose(np.cov(of.T), np.eye(3), atol=0.02)


def test_the_reduced_space_is_the_least_that_keeps_the_variance():
    rows = np.random.default_rng(1).normal(size=(100_000, 3)) * [0.3, 2, 1]  # of the variance 80, 20 and 2 parts
    assert np.abs(gaussian_models.compute_principal_axes(rows, 0.7)).round(2).tolist() == [[0, 1, 0]]
    assert [len(gaussian_models.compute_principal_axes(rows, part)) for part in (0.9, 0.97, 0.99)] == [2, 2, 3]


def test_a_component_is_nowhere_narrower_than_the_floor():
    poses = np.repeat(drawn(40)[0], 30, axis=0)  # each pose held still for a second: as many points of no width
    model, _ = fit(poses, components=20)
    assert np.linalg.svd(model.spreads)[1].min() >= 0.999 * gaussian_models.MIN_NOISE_SD_RAD


def test_the_same_seed_makes_the_same_weights_and_more_fits_none_less_likely():
    poses, _ = drawn(1000)
    (first, told), (again, _) = fit(poses, components=6, restarts=3), fit(poses, components=6, restarts=3)
    for name in ("weights", "centres", "spreads"):
        assert np.array_equal(getattr(first, name), getattr(again, name))
    each = [log_density(fit(poses, components=6, restarts=1, seed=seed)[0], poses).mean() for seed in range(3)]
    assert len(set(np.round(each, 4))) > 1
    assert log_density(first, poses).mean() in each
    assert "has 3 axes" in told


def test_a_fit_that_does_not_come_to_rest_is_refused():
    with pytest.raises(SceneError, match=r"in 2 iterations; allow more \(most\)"):
        fit(drawn(400)[0], components=6, max_iterations=2, tolerance=1e-12)
