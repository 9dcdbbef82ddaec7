"""The file of the network, and its evaluation."""

import numpy as np
import pytest
from safetensors.numpy import save_file

from mocapfix.errors import SceneError
from mocapfix.lab.cards import write_perceptron
from mocapfix.solve.learned_ik import IK_KIND, load_shipped_ik_network, read_ik_network
from tests.solve.ik_cases import build_network


def test_written_network_evaluates_to_the_same(tmp_path):
    network = build_network()
    write_perceptron(tmp_path / "mine.safetensors", network, IK_KIND)
    read = read_ik_network(tmp_path / "mine.safetensors")
    features = np.random.default_rng(0).normal(size=(4, len(network.input_mean))).astype(np.float32)
    np.testing.assert_allclose(read.evaluate(features), network.evaluate(features), atol=5e-3)


def test_evaluation_is_a_multilayer_perceptron():
    network = build_network()
    features = np.random.default_rng(0).normal(size=(4, len(network.input_mean))).astype(np.float32)
    expected = np.maximum(features @ network.weights[0], 0) @ network.weights[1]
    np.testing.assert_allclose(network.evaluate(features), expected, rtol=1e-5, atol=1e-6)


def test_shipped_network_is_small_and_fits():
    network = load_shipped_ik_network()
    assert sum(each.size for each in (*network.weights, *network.biases)) * 2 <= 2e6


def test_invalid_files_are_named(tmp_path):
    path = tmp_path / "other.safetensors"
    with pytest.raises(SceneError, match=r"other\.safetensors"):
        read_ik_network(path)
    save_file({"weights.0": np.zeros((2, 2), np.float32)}, path)
    with pytest.raises(SceneError, match="the header does not give the kind ik"):
        read_ik_network(path)
    network = build_network()
    narrow = type(network)(network.input_mean, network.input_scale, network.weights[:1], network.biases[:1])
    write_perceptron(path, narrow, IK_KIND)
    with pytest.raises(SceneError, match="96 outputs"):
        read_ik_network(path)
