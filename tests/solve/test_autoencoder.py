from dataclasses import replace

import numpy as np
import pytest
import torch

from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.solve import mean_pose
from mocapfix.solve.autoencoder import AutoencoderModel
from mocapfix.solve.pose_features import FEATURE_TYPES
from mocapfix.solve.prior_network import NetworkArchitecture, build_network, copy_weights

SKELETON = load_cmu31_body().skeleton
REFERENCE = mean_pose.load_mean_pose_prior("mean-pose", SKELETON).mean_rotations


def draw_model(inputs, activation, outputs=None, skip_connection=False, seed=0, code_size=3, direction_count=0):
    """Return an untrained model whose decoded poses are close to the reference pose."""
    torch.manual_seed(seed)
    architecture = NetworkArchitecture(inputs, outputs or inputs, (8,), code_size, direction_count, activation, skip_connection)
    features = FEATURE_TYPES[architecture.output_features](torch.as_tensor(REFERENCE, dtype=torch.float32))
    network = build_network(architecture, REFERENCE)
    with torch.no_grad():
        weight, bias = [each for each in network.decoder.parameters() if len(each) == features.feature_count][:2]
        bias.copy_(features.compute_features(torch.zeros(31, 3)))
        weight.mul_(0.3)
    rng = np.random.default_rng(seed)
    code_mean, code_cholesky = rng.normal(size=code_size), np.tril(rng.uniform(0.5, 1.5, (code_size, code_size)))
    directions = rng.normal(0, 0.2, (direction_count, 31, 3))
    residual_sd_rad = np.full(31, 0.1)
    return AutoencoderModel(
        SKELETON.names, REFERENCE, residual_sd_rad, architecture, copy_weights(network), code_mean, code_cholesky, directions
    )


@pytest.mark.parametrize(
    ("inputs", "activation", "outputs", "skip_connection", "direction_count"),
    [
        ("continuous", "silu", "continuous", False, 0),
        ("euler", "relu", "euler", False, 0),
        ("continuous", "silu", "vectors", True, 2),
    ],
)
def test_linearisation_predicts_the_change_of_the_decoded_pose(inputs, activation, outputs, skip_connection, direction_count):
    model = draw_model(inputs, activation, outputs, skip_connection, direction_count=direction_count)
    codes = np.random.default_rng(1).normal(size=(5, 3 + direction_count))
    decoded, jacobian = model.linearise(codes)
    assert jacobian.shape == (5, 31, 3, 3 + direction_count)
    np.testing.assert_allclose(decoded, model.decode(codes), atol=1e-6)
    for p, step in enumerate(1e-3 * np.eye(3 + direction_count)):
        numeric = (model.decode(codes + step) - model.decode(codes - step)) / 2e-3
        np.testing.assert_allclose(jacobian[..., p], numeric, atol=2e-3)
    assert np.abs(jacobian).max() > 0.02


@pytest.mark.parametrize(("activation", "skip_connection"), [("silu", True), ("relu", False)])
def test_decoder_equals_the_torch_network(activation, skip_connection):
    model = draw_model("continuous", activation, "vectors", skip_connection)
    codes = torch.as_tensor(np.random.default_rng(5).normal(size=(6, 3)), dtype=torch.float32)
    directions = np.random.default_rng(6).normal(size=(2, 3))
    features, slopes = model.decoder.linearise(codes.numpy(), directions)
    np.testing.assert_allclose(features, model.network.decoder(codes).detach().numpy(), atol=1e-6)
    jacobian = torch.func.vmap(torch.func.jacrev(model.network.decoder))(codes).detach().numpy()
    np.testing.assert_allclose(slopes, np.einsum("nba,pa->npb", jacobian, directions), atol=1e-5)


def test_only_the_network_code_is_nonlinear():
    model, codes = draw_model("continuous", "silu", direction_count=2), np.random.default_rng(2).normal(size=(4, 5))
    _, jacobian = model.linearise(codes)
    assert model.nonlinear_code_size == 3
    np.testing.assert_array_equal(jacobian[..., 3:], np.repeat(jacobian[:1, ..., 3:], 4, axis=0))
    assert (np.ptp(jacobian[..., :3], axis=0).max(axis=(0, 1)) > 1e-3).all()


def test_code_is_the_network_code_normalised_by_its_covariance():
    model, vectors = draw_model("continuous", "silu"), np.random.default_rng(2).normal(0, 0.3, (6, 31, 3))
    vectors[:, 0, 1] = 0
    with torch.no_grad():
        network_code = model.network.encoder(
            model.input_features.compute_features(torch.as_tensor(vectors, dtype=torch.float32))
        ).numpy()
    np.testing.assert_allclose(model.code_mean + model.encode(vectors) @ model.code_cholesky.T, network_code, atol=1e-5)


def test_further_code_dimensions_are_amplitudes_of_residual_directions():
    model, rng = draw_model("continuous", "silu", "vectors", direction_count=2), np.random.default_rng(4)
    model = replace(model, residual_sd_rad=np.full(31, 1e-4))
    vectors = rng.normal(0, 0.3, (6, 31, 3))
    amplitudes = rng.normal(size=(6, 2))
    network_code = model.encode(vectors)[:, :3]
    decoded = model.decode(np.c_[network_code, amplitudes])
    again = model.encode(decoded)
    exact = np.linalg.lstsq(
        model.residual_directions.reshape(2, -1).T,
        (decoded - model.decode(np.c_[again[:, :3], np.zeros((6, 2))])).reshape(6, -1).T,
        rcond=None,
    )[0].T
    np.testing.assert_allclose(again[:, 3:], exact, atol=1e-5)


def test_batched_encoding_equals_encoding_one_pose():
    model, vectors = draw_model("continuous", "silu"), np.random.default_rng(3).normal(0, 0.3, (700, 31, 3))
    np.testing.assert_allclose(model.encode(vectors)[600:601], model.encode(vectors[600:601]), atol=1e-5)


def test_mnn_ik_network_has_four_layers_each_way():
    network = build_network(
        NetworkArchitecture("euler", "euler", (1024, 1024, 1024), 35, 0, "relu", skip_connection=False), REFERENCE
    )
    widths = [tuple(w.shape) for name, w in network.named_parameters() if name.endswith("weight")]
    assert widths == [(1024, 93), (1024, 1024), (1024, 1024), (35, 1024), (1024, 35), (1024, 1024), (1024, 1024), (93, 1024)]
    assert isinstance(network.encoder[-1], torch.nn.Linear)
    assert isinstance(network.decoder[-1], torch.nn.Linear)
