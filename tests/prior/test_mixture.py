import numpy as np
import pytest
from scipy.stats import multivariate_normal

from mocapfix.pose_prior import io
from mocapfix.pose_prior.mixture import MixtureModel
from mocapfix.skeleton import load_cmu31_body

RNG = np.random.default_rng(0)
NAMES = load_cmu31_body().skeleton.names
WEIGHTS, CENTRES = np.array([0.7, 0.3]), np.array([[-2.0, 0, 0], [2.0, 1, 0]])
SPREADS = np.array([np.diag([0.5, 0.4, 0.3]), [[0.3, 0, 0], [0.2, 0.5, 0], [-0.1, 0.3, 0.2]]])


@pytest.fixture(scope="module")
def mixture():
    axes = np.linalg.qr(RNG.normal(size=(93, 3)))[0].T.reshape(3, 31, 3)
    middle, mean = np.tile(np.eye(3), (31, 1, 1)), RNG.normal(0, 0.1, (31, 3))
    return MixtureModel(NAMES, middle, np.full(31, 0.1), mean, axes, WEIGHTS, CENTRES, SPREADS, np.zeros(1, int))


def poses(mixture, rows):
    return mixture.mean + np.tensordot(rows, mixture.principal_axes, 1)


def test_costs_are_those_of_weighed_gaussians(mixture):
    rows = RNG.normal(0, 2, (6, 3))
    parts = [w * multivariate_normal(c, s @ s.T).pdf(rows) for w, c, s in zip(WEIGHTS, CENTRES, SPREADS, strict=True)]
    constant = 1.5 * np.log(2 * np.pi)
    np.testing.assert_allclose(mixture.compute_component_costs(poses(mixture, rows)), -np.log(parts).T - constant, rtol=1e-9)


def test_each_pose_is_of_the_component_in_which_it_costs_least(mixture):
    assert mixture.select_components(
        poses(mixture, np.array([[-2, 0.3, 0], [2.2, 1, 0.1], [-1.5, 0, 0]]))
    ).component_index.tolist() == [0, 1, 0]


def test_between_two_alike_components_the_weight_decides(mixture):
    alike = MixtureModel(**vars(mixture) | {"spreads": SPREADS[[0, 0]]})
    assert alike.select_components(poses(alike, CENTRES.mean(0, keepdims=True))).component_index.tolist() == [0]


def test_no_code_is_the_components_centre_and_a_code_lies_in_its_spread(mixture):
    near = mixture.select_components(poses(mixture, CENTRES))
    np.testing.assert_allclose(near.decode(np.zeros((2, 3))), poses(mixture, CENTRES), atol=1e-12)
    away = near.project_poses(near.decode(np.tile([0, 1.0, 0], (2, 1)))) - CENTRES
    np.testing.assert_allclose(away, SPREADS[:, :, 1], atol=1e-12)


def test_encoding_undoes_decoding(mixture):
    codes = RNG.normal(size=(5, 3))
    for near in (mixture, mixture.select_components(poses(mixture, CENTRES[[0, 1, 1, 0, 1]]))):
        np.testing.assert_allclose(near.encode(near.decode(codes)), codes, atol=1e-12)


def test_what_lies_across_the_reduced_space_makes_no_difference(mixture):
    pose = poses(mixture, CENTRES[:1])
    across = RNG.normal(size=(1, 31, 3))
    across -= np.tensordot(np.tensordot(across, mixture.principal_axes, ([1, 2], [1, 2])), mixture.principal_axes, 1)
    np.testing.assert_allclose(mixture.encode(pose + across), mixture.encode(pose), atol=1e-12)


def test_linearising_says_how_decoding_changes(mixture):
    near = mixture.select_components(poses(mixture, CENTRES[[0, 1, 1]]))
    codes, step = RNG.normal(size=(3, 3)), RNG.normal(size=(3, 3))
    decoded, slopes = near.linearise(codes)
    assert slopes.shape == (3, 31, 3, 3)
    np.testing.assert_allclose(decoded, near.decode(codes), atol=1e-12)
    np.testing.assert_allclose(decoded + np.einsum("njap,np->nja", slopes, step), near.decode(codes + step), atol=1e-12)


def test_it_comes_back_from_a_file(mixture, tmp_path):
    io.save_pose_model(tmp_path / "mine.safetensors", mixture)
    loaded = io.load_pose_model(str(tmp_path / "mine.safetensors"), load_cmu31_body().skeleton)
    assert isinstance(loaded, MixtureModel)
    at = poses(mixture, RNG.normal(size=(5, 3)))
    np.testing.assert_allclose(loaded.compute_component_costs(at), mixture.compute_component_costs(at), rtol=1e-4)
    np.testing.assert_allclose(loaded.select_components(at).encode(at), mixture.select_components(at).encode(at), atol=1e-4)
