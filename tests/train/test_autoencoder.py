"""Training small networks on few poses: repeatable, resumable, and the paper's loss."""

from pathlib import Path

import numpy as np
import pytest
import torch

from mocapfix.errors import ReadError
from mocapfix.pose_prior import mean_pose
from mocapfix.pose_prior.network import AutoencoderNetwork, NetworkArchitecture
from mocapfix.skeleton import load_cmu31_body
from mocapfix.train import autoencoder, settings
from mocapfix.train.autoencoder import build_rate_schedule, compute_weight_norm, train_network
from mocapfix.train.settings import AutoencoderSettings

NAMES = load_cmu31_body().skeleton.names
MIDDLE = mean_pose.load_mean_pose_prior("mean-pose", load_cmu31_body().skeleton).mean_rotations
PRIORS = Path(mean_pose.__file__).parents[2] / "priors"
SMALL = {"hidden": (16,), "code": 4, "epochs": 4, "batch": 32, "rate": 3e-3}


def small(name, **changes):
    """-> the shipped settings of a network, but small"""
    said = settings.read_prior_settings(PRIORS / f"{name}.yaml")
    assert isinstance(said, AutoencoderSettings)
    return said.model_copy(update=SMALL | changes)


@pytest.fixture(scope="module")
def poses():
    rng = np.random.default_rng(0)
    return rng.normal(size=(100, 2)) @ rng.normal(0, 0.2, (2, 93))


def run(poses, checkpoint, said, progress=lambda what: None):
    whose = np.arange(len(poses)) // 80
    _, network, _ = train_network(NAMES, MIDDLE, poses.reshape(-1, 31, 3), whose, said, checkpoint, progress)
    return torch.cat([w.flatten() for w in network.state_dict().values()])


@pytest.mark.parametrize("name", ["autoencoder", "mnn-ik"])
def test_interrupted_training_goes_on_to_the_same_weights(poses, tmp_path, name):
    whole = run(poses, tmp_path / "whole", small(name))

    def interrupt(what):
        if what.startswith("epoch 3"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(poses, tmp_path / "torn", small(name), interrupt)
    epochs = []
    assert torch.equal(run(poses, tmp_path / "torn", small(name), epochs.append), whole)
    assert [each.split(",")[0] for each in epochs] == ["epoch 3 of 4", "epoch 4 of 4"]


def test_another_seed_or_other_poses_begin_anew(poses, tmp_path):
    first = run(poses, tmp_path / "mine", small("autoencoder"))
    for said, shown in ((small("autoencoder", seed=1), poses), (small("autoencoder"), poses[::-1] * 0.9)):
        epochs = []
        assert not torch.equal(run(shown, tmp_path / "mine", said, epochs.append), first)
        assert len(epochs) == 4


def test_a_file_that_is_no_checkpoint_is_named(poses, tmp_path):
    (tmp_path / "mine").write_text("mine")
    with pytest.raises(ReadError, match="is no checkpoint"):
        run(poses, tmp_path / "mine", small("autoencoder"))


def test_training_lowers_the_loss(poses, tmp_path):
    told = []
    run(poses, tmp_path / "mine", small("mnn-ik", initial=None, epochs=15, rate=1e-2), told.append)
    losses = [float(each.split()[-1]) for each in told]
    assert losses[-1] < 0.5 * losses[0]


def test_weights_are_such_as_half_precision_holds(poses, tmp_path):
    weights = run(poses, tmp_path / "mine", small("autoencoder", epochs=1))
    assert torch.equal(weights, weights.half().float())


def test_the_papers_norm_is_of_weights_without_offsets():
    network = AutoencoderNetwork(2, 2, NetworkArchitecture("euler", "euler", (3,), 1, 0, "relu", skip_connection=False))
    with torch.no_grad():
        for w in network.parameters():
            w.fill_(2.0)
    assert float(compute_weight_norm(network).detach()) == pytest.approx(2 * np.sqrt(2 * (2 * 3 + 3 * 1)))


def test_the_papers_weights_start_as_small_as_the_settings_say():
    said = small("mnn-ik", hidden_widths=(200,))
    network, _ = autoencoder.initialise_network(
        93, MIDDLE, NetworkArchitecture("euler", "euler", (200,), 4, 0, "relu", skip_connection=False), said
    )
    first = next(network.encoder.parameters())
    assert float(first.detach().std()) == pytest.approx(0.01, rel=0.02)


def test_the_learning_rate_falls_as_the_settings_say():
    paper, cosine = build_rate_schedule(small("mnn-ik"), 10_000), build_rate_schedule(small("autoencoder"), 100)
    assert [paper(step) for step in (0, 1999, 2000, 4000)] == pytest.approx([1, 1, 0.98, 0.98**2])
    assert [cosine(step) for step in (0, 50, 100)] == pytest.approx([1, 0.5, 0])


def test_balance_shows_everybody_alike():
    whose = np.repeat([0, 1], [900, 100])
    for balance, expected in ((0.0, 0.1), (0.5, 0.25), (1.0, 0.5)):
        weights = torch.as_tensor(autoencoder.compute_sampling_weights(whose, balance))
        assert float(weights[900:].sum() / weights.sum()) == pytest.approx(expected)
        counts = np.zeros(1000)
        for seed in range(20):
            shown = autoencoder.sample_epoch(weights, torch.Generator().manual_seed(seed)).numpy()
            assert len(shown) == 1000
            np.add.at(counts, shown, 1)
        assert counts[900:].sum() / counts.sum() == pytest.approx(expected, abs=0.02)
        assert (counts[:900] == 20).all() == (balance == 0)


def test_the_part_of_poses_that_is_corrupted_is_the_one_asked_for(poses):
    vectors = torch.as_tensor(poses.reshape(-1, 31, 3), dtype=torch.float32).repeat(20, 1, 1)
    for part in (0.0, 0.3, 1.0):
        shown = autoencoder.corrupt_some_poses(vectors, part, autoencoder.build_limb_masks(), torch.Generator().manual_seed(0))
        assert float((shown != vectors).flatten(1).any(1).float().mean()) == pytest.approx(part, abs=0.04)
