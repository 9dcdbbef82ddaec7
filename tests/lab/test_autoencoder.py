"""Training small networks on few poses: reproducible, resumable, and with the loss of MNN-IK."""

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from mocapfix.errors import ReadError
from mocapfix.lab import autoencoder_training, settings
from mocapfix.lab.autoencoder_training import build_rate_schedule, compute_weight_norm, train_network
from mocapfix.lab.networks import AutoencoderNetwork, compute_rotation_tensor, copy_weights
from mocapfix.lab.settings import AutoencoderSettings
from mocapfix.lab.training_poses import compute_sampling_weights
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.solve import mean_pose
from mocapfix.solve.trained_priors import DECODER, ENCODER, Layers, NetworkArchitecture

REFERENCE = mean_pose.load_mean_pose_prior("mean-pose", load_cmu31_body().skeleton).mean_rotations
PRIORS = Path(mean_pose.__file__).parents[2] / "priors"
SMALL = {"hidden_widths": (16,), "code_size": 4, "epochs": 4, "batch_poses": 32, "learning_rate": 3e-3}


def build_settings(name, **changes):
    """Return the shipped settings of a network with a small architecture."""
    shipped = settings.read_prior_settings(PRIORS / f"{name}.yaml")
    assert isinstance(shipped, AutoencoderSettings)
    return shipped.model_copy(update=SMALL | changes)


@pytest.fixture(scope="module")
def poses():
    rng = np.random.default_rng(0)
    return rng.normal(size=(100, 2)) @ rng.normal(0, 0.2, (2, 93))


def train_weights(poses, checkpoint, training_settings, progress=lambda text: None):
    weights = compute_sampling_weights(np.arange(len(poses)) // 80, training_settings.subject_balance)
    vectors = poses.reshape(-1, 31, 3)
    network = train_network(REFERENCE, vectors, weights, training_settings, checkpoint, progress).network
    return torch.cat([w.flatten() for w in network.state_dict().values()])


@pytest.mark.parametrize("name", ["autoencoder", "mnn-ik"])
def test_interrupted_training_resumes_to_the_same_weights(poses, tmp_path, name):
    whole = train_weights(poses, tmp_path / "whole", build_settings(name))

    def interrupt(text):
        if text.startswith("epoch 3"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_weights(poses, tmp_path / "interrupted", build_settings(name), interrupt)
    epochs = []
    assert torch.equal(train_weights(poses, tmp_path / "interrupted", build_settings(name), epochs.append), whole)
    assert [each.split(",")[0] for each in epochs] == ["epoch 3 of 4", "epoch 4 of 4"]


def test_other_seed_or_poses_start_again(poses, tmp_path):
    first = train_weights(poses, tmp_path / "mine", build_settings("autoencoder"))
    for changed, shown in ((build_settings("autoencoder", seed=1), poses), (build_settings("autoencoder"), poses[::-1] * 0.9)):
        epochs = []
        assert not torch.equal(train_weights(shown, tmp_path / "mine", changed, epochs.append), first)
        assert len(epochs) == 4


def test_invalid_checkpoint_raises(poses, tmp_path):
    (tmp_path / "mine").write_text("mine", encoding="utf-8")
    with pytest.raises(ReadError, match="is not a training checkpoint"):
        train_weights(poses, tmp_path / "mine", build_settings("autoencoder"))


def test_training_lowers_the_loss(poses, tmp_path):
    messages = []
    train_weights(
        poses, tmp_path / "mine", build_settings("mnn-ik", initial_weight_sd=None, epochs=15, learning_rate=1e-2), messages.append
    )
    losses = [float(each.split()[-1]) for each in messages]
    assert losses[-1] < 0.5 * losses[0]


def test_weights_are_exact_in_half_precision(poses, tmp_path):
    weights = train_weights(poses, tmp_path / "mine", build_settings("autoencoder", epochs=1))
    assert torch.equal(weights, weights.half().float())


def test_weight_norm_excludes_biases():
    network = AutoencoderNetwork(NetworkArchitecture("euler", "euler", (3,), 1, 0, "relu", skip_connection=False), 1)
    with torch.no_grad():
        for w in network.parameters():
            w.fill_(2.0)
    assert float(compute_weight_norm(network).detach()) == pytest.approx(2 * np.sqrt(2 * (3 * 3 + 3 * 1)))


def test_initial_weights_have_the_set_standard_deviation():
    training_settings = build_settings("mnn-ik", hidden_widths=(200,))
    network, _ = autoencoder_training.initialise_network(
        31, NetworkArchitecture("euler", "euler", (200,), 4, 0, "relu", skip_connection=False), training_settings
    )
    first = next(network.encoder.parameters())
    assert float(first.detach().std()) == pytest.approx(0.01, rel=0.02)


def test_learning_rate_follows_the_schedule():
    paper, cosine = build_rate_schedule(build_settings("mnn-ik"), 10_000), build_rate_schedule(build_settings("autoencoder"), 100)
    assert [paper(step) for step in (0, 1999, 2000, 4000)] == pytest.approx([1, 1, 0.98, 0.98**2])
    assert [cosine(step) for step in (0, 50, 100)] == pytest.approx([1, 0.5, 0])


def test_subject_balance_sets_the_sampling_frequency():
    subject_index = np.repeat([0, 1], [900, 100])
    for balance, expected in ((0.0, 0.1), (0.5, 0.25), (1.0, 0.5)):
        weights = torch.as_tensor(compute_sampling_weights(subject_index, balance))
        assert float(weights[900:].sum() / weights.sum()) == pytest.approx(expected)
        counts = np.zeros(1000)
        for seed in range(20):
            shown = autoencoder_training.sample_epoch(weights, torch.Generator().manual_seed(seed)).numpy()
            assert len(shown) == 1000
            np.add.at(counts, shown, 1)
        assert counts[900:].sum() / counts.sum() == pytest.approx(expected, abs=0.02)
        assert (counts[:900] == 20).all() == (balance == 0)


def test_corrupted_share_of_poses_is_corrupted(poses):
    vectors = torch.as_tensor(poses.reshape(-1, 31, 3), dtype=torch.float32).repeat(20, 1, 1)
    for share in (0.0, 0.3, 1.0):
        shown = autoencoder_training.corrupt_some_poses(
            vectors, share, autoencoder_training.build_limb_masks(), torch.Generator().manual_seed(0)
        )
        assert float((shown != vectors).flatten(1).any(1).float().mean()) == pytest.approx(share, abs=0.04)


@pytest.mark.parametrize(("activation", "has_skip"), [("silu", True), ("relu", False)])
def test_numpy_evaluates_the_network_as_torch_does(activation, has_skip):
    architecture = NetworkArchitecture("continuous", "vectors", (8,), 3, 0, activation, has_skip)
    torch.manual_seed(0)
    network, rng = AutoencoderNetwork(architecture, 31), np.random.default_rng(5)
    for part, layers, size in ((ENCODER, network.encoder, 183), (DECODER, network.decoder, 3)):
        rows = torch.as_tensor(rng.normal(size=(6, size)), dtype=torch.float32)
        directions = rng.normal(size=(2, size))
        outputs, slopes = Layers(architecture, copy_weights(network), part).linearise(rows.numpy(), directions)
        np.testing.assert_allclose(outputs, layers(rows).detach().numpy(), atol=1e-6)
        jacobian = torch.func.vmap(torch.func.jacrev(layers))(rows).detach().numpy()
        np.testing.assert_allclose(slopes, np.einsum("nba,pa->npb", jacobian, directions), atol=1e-5)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 1.0, 3.1])
def test_rotations_of_tensors_agree_with_scipy(angle):
    vectors = np.array([[0.6, 0.0, -0.8], [0, 1, 0]]) * angle
    expected = Rotation.from_rotvec(vectors).as_matrix()
    np.testing.assert_allclose(compute_rotation_tensor(torch.as_tensor(vectors)).numpy(), expected, atol=1e-12)
