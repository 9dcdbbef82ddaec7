from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.solve import mean_pose
from mocapfix.solve.trained_priors import (
    FEATURE_COUNTS,
    AutoencoderModel,
    NetworkArchitecture,
    compute_feature_vectors,
    compute_pose_features,
)

SKELETON = load_cmu31_body().skeleton
REFERENCE = mean_pose.load_mean_pose_prior("mean-pose", SKELETON).mean_rotations


def draw_model(inputs, activation, outputs=None, skip_connection=False, seed=0, code_size=3, direction_count=0):
    """Return an untrained model whose decoded poses are close to the reference pose."""
    rng, outputs = np.random.default_rng(seed), outputs or ("vectors" if inputs == "continuous" else inputs)
    architecture = NetworkArchitecture(inputs, outputs, (8,), code_size, direction_count, activation, skip_connection)
    weights = {
        name: (rng.uniform(-1, 1, shape) / np.sqrt(shape[-1])).astype(np.float32)
        for name, shape in architecture.list_weight_shapes(31).items()
    }
    last = "decoder.0.layers.2" if skip_connection else "decoder.2"
    weights[f"{last}.weight"] *= 0.3
    weights[f"{last}.bias"] = compute_pose_features(outputs, np.zeros((1, 31, 3)), REFERENCE)[0].astype(np.float32)
    code_mean, code_cholesky = rng.normal(size=code_size), np.tril(rng.uniform(0.5, 1.5, (code_size, code_size)))
    directions = rng.normal(0, 0.2, (direction_count, 31, 3))
    residual_sd_rad = np.full(31, 0.1)
    return AutoencoderModel(
        SKELETON.names, REFERENCE, residual_sd_rad, architecture, weights, code_mean, code_cholesky, directions
    )


@pytest.mark.parametrize(
    ("inputs", "activation", "outputs", "skip_connection", "direction_count"),
    [
        ("continuous", "silu", "vectors", False, 0),
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


def test_only_the_network_code_is_nonlinear():
    model, codes = draw_model("continuous", "silu", direction_count=2), np.random.default_rng(2).normal(size=(4, 5))
    _, jacobian = model.linearise(codes)
    assert model.nonlinear_code_size == 3
    np.testing.assert_array_equal(jacobian[..., 3:], np.repeat(jacobian[:1, ..., 3:], 4, axis=0))
    assert (np.ptp(jacobian[..., :3], axis=0).max(axis=(0, 1)) > 1e-3).all()


def test_code_is_the_network_code_normalised_by_its_covariance():
    model, vectors = draw_model("continuous", "silu"), np.random.default_rng(2).normal(0, 0.3, (6, 31, 3))
    vectors[:, 0, 1] = 0
    network_code = model.encoder.evaluate(compute_pose_features("continuous", vectors, REFERENCE))
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
    architecture = NetworkArchitecture("euler", "euler", (1024, 1024, 1024), 35, 0, "relu", skip_connection=False)
    widths = [shape for name, shape in architecture.list_weight_shapes(31).items() if name.endswith("weight")]
    assert widths == [(1024, 93), (1024, 1024), (1024, 1024), (35, 1024), (1024, 35), (1024, 1024), (1024, 1024), (93, 1024)]


def draw_vectors(seed, spread=0.5):
    vectors = np.random.default_rng(seed).normal(0, spread, (4, 31, 3))
    vectors[:, 0, 1] = 0
    return vectors


@pytest.mark.parametrize("kind", ["euler", "vectors"])
def test_features_determine_the_pose(kind):
    vectors = draw_vectors(0)
    features = compute_pose_features(kind, vectors, REFERENCE)
    np.testing.assert_allclose(compute_feature_vectors(kind, features, REFERENCE), vectors, atol=1e-9)


def test_features_are_angles_or_columns_of_rotations_and_the_up_vector():
    vectors = draw_vectors(1)
    rotations = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(4, 31, 3, 3) @ REFERENCE
    angles = compute_pose_features("euler", vectors, REFERENCE).reshape(-1, 3)
    np.testing.assert_allclose(angles, Rotation.from_matrix(rotations.reshape(-1, 3, 3)).as_euler("ZYX"), atol=1e-9)
    features = compute_pose_features("continuous", vectors, REFERENCE)
    assert features.shape == (4, FEATURE_COUNTS["continuous"](31))
    np.testing.assert_allclose(features[:, 6:9], rotations[:, 2, :, 0], atol=1e-9)
    np.testing.assert_allclose(features[:, 9:12], rotations[:, 2, :, 1], atol=1e-9)
    np.testing.assert_allclose(features[:, -3:], np.swapaxes(rotations[:, 0], 1, 2) @ [0, 1, 0], atol=1e-9)
