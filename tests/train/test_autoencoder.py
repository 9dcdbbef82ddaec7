"""Training small networks on few poses: repeatable, resumable, and the paper's loss."""

from pathlib import Path

import numpy as np
import pytest
import torch

from mocapfix import prior
from mocapfix.errors import ReadError
from mocapfix.prior.autoencoder import Network, Shape
from mocapfix.skeleton import cmu31
from mocapfix.train import autoencoder, settings
from mocapfix.train.autoencoder import falling, norm
from mocapfix.train.autoencoder import train as trained
from mocapfix.train.settings import AutoencoderSettings

NAMES = cmu31().skeleton.names
MIDDLE = prior.load("mean-pose", cmu31().skeleton).rotations
PRIORS = Path(prior.__file__).parents[2] / "priors"
SMALL = {"hidden": (16,), "code": 4, "epochs": 4, "batch": 32, "rate": 3e-3}


def small(name, **changes):
    """-> the shipped settings of a network, but small"""
    said = settings.read(PRIORS / f"{name}.yaml")
    assert isinstance(said, AutoencoderSettings)
    return said.model_copy(update=SMALL | changes)


@pytest.fixture(scope="module")
def poses():
    rng = np.random.default_rng(0)
    return rng.normal(size=(100, 2)) @ rng.normal(0, 0.2, (2, 93))


def run(poses, checkpoint, said, progress=lambda what: None):
    _, network = trained(NAMES, MIDDLE, poses.reshape(-1, 31, 3), said, checkpoint, progress)
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
    network = Network(2, Shape("euler", (3,), 1, "relu"))
    with torch.no_grad():
        for w in network.parameters():
            w.fill_(2.0)
    assert float(norm(network).detach()) == pytest.approx(2 * np.sqrt(2 * (2 * 3 + 3 * 1)))


def test_the_papers_weights_start_with_its_variance():
    said = small("mnn-ik", hidden=(200,))
    features = autoencoder.KINDS["euler"](torch.as_tensor(MIDDLE, dtype=torch.float32))
    network = autoencoder.initial(features, Shape("euler", (200,), 4, "relu"), said)
    first = next(network.encoder.parameters())
    assert float(first.detach().std()) == pytest.approx(0.1, rel=0.02)


def test_the_learning_rate_falls_as_the_settings_say():
    paper, cosine = falling(small("mnn-ik"), 10_000), falling(small("autoencoder"), 100)
    assert [paper(step) for step in (0, 1999, 2000, 4000)] == pytest.approx([1, 1, 0.98, 0.98**2])
    assert [cosine(step) for step in (0, 50, 100)] == pytest.approx([1, 0.5, 0])


def test_slight_joints_weigh_less_and_in_the_papers_loss_all_alike():
    for name, thumb in (("autoencoder", autoencoder.SLIGHT), ("mnn-ik", 1.0)):
        said = small(name)
        features = autoencoder.KINDS[said.features](torch.as_tensor(MIDDLE, dtype=torch.float32))
        weights = autoencoder.loss_weights(NAMES, features, said)
        assert len(weights) == features.size
        per = features.size // 31 if name == "mnn-ik" else 6
        assert float(weights[(NAMES.index("LThumb") - (name != "mnn-ik")) * per]) == pytest.approx(thumb)
        assert float(weights[(NAMES.index("LeftArm") - (name != "mnn-ik")) * per]) == 1.0
        assert float(weights[-1]) == 1.0
