import numpy as np
import pytest
from scipy.stats import multivariate_normal

from mocapfix.lab.cards import write_pose_model
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.solve import trained_priors
from mocapfix.solve.pose_prior import MixtureModel

RNG = np.random.default_rng(0)
NAMES = load_cmu31_body().skeleton.names
WEIGHTS, MEANS = np.array([0.7, 0.3]), np.array([[-2.0, 0, 0], [2.0, 1, 0]])
CHOLESKY = np.array([np.diag([0.5, 0.4, 0.3]), [[0.3, 0, 0], [0.2, 0.5, 0], [-0.1, 0.3, 0.2]]])


@pytest.fixture(scope="module")
def mixture():
    axes = np.linalg.qr(RNG.normal(size=(93, 3)))[0].T.reshape(3, 31, 3)
    reference, mean = np.tile(np.eye(3), (31, 1, 1)), RNG.normal(0, 0.1, (31, 3))
    return MixtureModel(NAMES, reference, np.full(31, 0.1), mean, axes, WEIGHTS, MEANS, CHOLESKY, np.zeros(1, int))


def build_poses(mixture, rows):
    return mixture.mean_vectors + np.tensordot(rows, mixture.principal_axes, 1)


def test_component_costs_are_negative_log_densities(mixture):
    rows = RNG.normal(0, 2, (6, 3))
    parts = [w * multivariate_normal(c, s @ s.T).pdf(rows) for w, c, s in zip(WEIGHTS, MEANS, CHOLESKY, strict=True)]
    constant = 1.5 * np.log(2 * np.pi)
    np.testing.assert_allclose(
        mixture.compute_component_costs(build_poses(mixture, rows)), -np.log(parts).T - constant, rtol=1e-9
    )


def test_component_of_least_cost_is_selected(mixture):
    assert mixture.select_components(
        build_poses(mixture, np.array([[-2, 0.3, 0], [2.2, 1, 0.1], [-1.5, 0, 0]]))
    ).component_index.tolist() == [0, 1, 0]


def test_weight_decides_between_equal_components(mixture):
    equal = MixtureModel(**vars(mixture) | {"component_cholesky": CHOLESKY[[0, 0]]})
    assert equal.select_components(build_poses(equal, MEANS.mean(0, keepdims=True))).component_index.tolist() == [0]


def test_decoding_adds_the_scaled_code_to_the_component_mean(mixture):
    selected = mixture.select_components(build_poses(mixture, MEANS))
    np.testing.assert_allclose(selected.decode(np.zeros((2, 3))), build_poses(mixture, MEANS), atol=1e-12)
    deviation = selected.project_poses(selected.decode(np.tile([0, 1.0, 0], (2, 1)))) - MEANS
    np.testing.assert_allclose(deviation, CHOLESKY[:, :, 1], atol=1e-12)


def test_encoding_inverts_decoding(mixture):
    codes = RNG.normal(size=(5, 3))
    for selected in (mixture, mixture.select_components(build_poses(mixture, MEANS[[0, 1, 1, 0, 1]]))):
        np.testing.assert_allclose(selected.encode(selected.decode(codes)), codes, atol=1e-12)


def test_deviation_perpendicular_to_the_principal_axes_is_ignored(mixture):
    pose = build_poses(mixture, MEANS[:1])
    residual = RNG.normal(size=(1, 31, 3))
    residual -= np.tensordot(np.tensordot(residual, mixture.principal_axes, ([1, 2], [1, 2])), mixture.principal_axes, 1)
    np.testing.assert_allclose(mixture.encode(pose + residual), mixture.encode(pose), atol=1e-12)


def test_linearisation_predicts_the_change_of_the_decoded_pose(mixture):
    selected = mixture.select_components(build_poses(mixture, MEANS[[0, 1, 1]]))
    codes, step = RNG.normal(size=(3, 3)), RNG.normal(size=(3, 3))
    decoded, jacobian = selected.linearise(codes)
    assert jacobian.shape == (3, 31, 3, 3)
    np.testing.assert_allclose(decoded, selected.decode(codes), atol=1e-12)
    np.testing.assert_allclose(decoded + np.einsum("njap,np->nja", jacobian, step), selected.decode(codes + step), atol=1e-12)


def test_saved_mixture_is_restored(mixture, tmp_path):
    write_pose_model(tmp_path / "mine.safetensors", mixture)
    loaded = trained_priors.load_pose_model(str(tmp_path / "mine.safetensors"), load_cmu31_body().skeleton)
    assert isinstance(loaded, MixtureModel)
    at = build_poses(mixture, RNG.normal(size=(5, 3)))
    np.testing.assert_allclose(loaded.compute_component_costs(at), mixture.compute_component_costs(at), rtol=1e-4)
    np.testing.assert_allclose(loaded.select_components(at).encode(at), mixture.select_components(at).encode(at), atol=1e-4)
