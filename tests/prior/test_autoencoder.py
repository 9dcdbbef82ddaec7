from dataclasses import replace

import numpy as np
import pytest
import torch

from mocapfix.pose_prior import mean_pose
from mocapfix.pose_prior.autoencoder import AutoencoderModel
from mocapfix.pose_prior.network import NetworkArchitecture, build_network
from mocapfix.pose_prior.pose_features import FEATURE_TYPES
from mocapfix.skeleton import load_cmu31_body

SKELETON = load_cmu31_body().skeleton
MIDDLE = mean_pose.load_mean_pose_prior("mean-pose", SKELETON).mean_rotations


def drawn(kind, activation, gives=None, straight=False, seed=0, code=3, astray=0):
    """-> an untrained model whose poses stay near the middle"""
    torch.manual_seed(seed)
    shape = NetworkArchitecture(kind, gives or kind, (8,), code, astray, activation, straight)
    given = FEATURE_TYPES[shape.output_features](torch.as_tensor(MIDDLE, dtype=torch.float32))
    network = build_network(shape, MIDDLE)
    with torch.no_grad():
        weight, offset = [each for each in network.decoder.parameters() if len(each) == given.size][:2]
        offset.copy_(given.compute_features(torch.zeros(31, 3)))
        weight.mul_(0.3)
    rng = np.random.default_rng(seed)
    mean, spread = rng.normal(size=code), np.tril(rng.uniform(0.5, 1.5, (code, code)))
    return AutoencoderModel(
        SKELETON.names, MIDDLE, np.full(31, 0.1), shape, network, mean, spread, rng.normal(0, 0.2, (astray, 31, 3))
    )


@pytest.mark.parametrize(
    ("kind", "activation", "gives", "straight", "astray"),
    [
        ("continuous", "silu", "continuous", False, 0),
        ("euler", "relu", "euler", False, 0),
        ("continuous", "silu", "vectors", True, 2),
    ],
)
def test_linearising_says_how_decoding_changes(kind, activation, gives, straight, astray):
    model, codes = drawn(kind, activation, gives, straight, astray=astray), np.random.default_rng(1).normal(size=(5, 3 + astray))
    decoded, slopes = model.linearise(codes)
    assert slopes.shape == (5, 31, 3, 3 + astray)
    np.testing.assert_allclose(decoded, model.decode(codes), atol=1e-6)
    for p, step in enumerate(1e-3 * np.eye(3 + astray)):
        numeric = (model.decode(codes + step) - model.decode(codes - step)) / 2e-3
        np.testing.assert_allclose(slopes[..., p], numeric, atol=2e-3)
    assert np.abs(slopes).max() > 0.02


def test_only_the_networks_own_numbers_are_bent():
    model, codes = drawn("continuous", "silu", astray=2), np.random.default_rng(2).normal(size=(4, 5))
    _, slopes = model.linearise(codes)
    assert model.nonlinear_code_size == 3
    np.testing.assert_array_equal(slopes[..., 3:], np.repeat(slopes[:1, ..., 3:], 4, axis=0))
    assert (np.ptp(slopes[..., :3], axis=0).max(axis=(0, 1)) > 1e-3).all()


def test_the_code_is_the_networks_own_in_units_of_its_spread():
    model, vectors = drawn("continuous", "silu"), np.random.default_rng(2).normal(0, 0.3, (6, 31, 3))
    vectors[:, 0, 1] = 0
    with torch.no_grad():
        own = model.network.encoder(model.input_features.compute_features(torch.as_tensor(vectors, dtype=torch.float32))).numpy()
    np.testing.assert_allclose(model.code_mean + model.encode(vectors) @ model.code_cholesky.T, own, atol=1e-5)


def test_what_a_network_misses_is_coded_by_the_directions_in_which_poses_stray():
    model, rng = drawn("continuous", "silu", "vectors", astray=2), np.random.default_rng(4)
    model = replace(model, residual_sd_rad=np.full(31, 1e-4))
    vectors = rng.normal(0, 0.3, (6, 31, 3))
    others = rng.normal(size=(6, 2))
    own = model.encode(vectors)[:, :3]
    decoded = model.decode(np.c_[own, others])
    again = model.encode(decoded)
    exact = np.linalg.lstsq(
        model.residual_directions.reshape(2, -1).T,
        (decoded - model.decode(np.c_[again[:, :3], np.zeros((6, 2))])).reshape(6, -1).T,
        rcond=None,
    )[0].T
    np.testing.assert_allclose(again[:, 3:], exact, atol=1e-5)


def test_many_poses_are_coded_as_each_alone():
    model, vectors = drawn("continuous", "silu"), np.random.default_rng(3).normal(0, 0.3, (700, 31, 3))
    np.testing.assert_allclose(model.encode(vectors)[600:601], model.encode(vectors[600:601]), atol=1e-5)


def test_the_papers_network_has_four_layers_each_way():
    network = build_network(
        NetworkArchitecture("euler", "euler", (1024, 1024, 1024), 35, 0, "relu", skip_connection=False), MIDDLE
    )
    widths = [tuple(w.shape) for name, w in network.named_parameters() if name.endswith("weight")]
    assert widths == [(1024, 93), (1024, 1024), (1024, 1024), (35, 1024), (1024, 35), (1024, 1024), (1024, 1024), (93, 1024)]
    assert isinstance(network.encoder[-1], torch.nn.Linear)
    assert isinstance(network.decoder[-1], torch.nn.Linear)
