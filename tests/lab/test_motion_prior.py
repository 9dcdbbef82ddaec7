"""Training of the motion prior on synthetic motion."""

import numpy as np
import pytest
import torch
import yaml

from mocapfix.errors import ReadError
from mocapfix.io.shipped import find_shipped_folder
from mocapfix.io.yaml_files import read_yaml_model
from mocapfix.lab import motion_training, settings
from mocapfix.solve.motion_prior import read_motion_prior
from tests.lab.motion_files import draw_motion, write_bvh_motion

SMALL = {"width": 16, "blocks": 1, "steps": 4, "batch_windows": 8}


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """Use one thread, which is faster than several for so little work."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def motion(tmp_path_factory):
    folder = tmp_path_factory.mktemp("motion")
    for seed, name in enumerate(("01_01", "02_01", "03_01", "14_01")):
        write_bvh_motion(folder / f"{name}.bvh", draw_motion(seed, frames=80, spread=0.2))
    return folder


def build_settings(**changes):
    shipped = read_yaml_model(settings.MotionSettings, find_shipped_folder("priors") / "motion.yaml")
    return shipped.model_copy(update=SMALL | changes)


def fit(motion, checkpoint, **changes):
    stretches = motion_training.gather_motion_stretches([motion], lambda subject: subject in ("01", "14"), lambda text: None)
    losses = []
    network = motion_training.fit_motion_network(build_settings(**changes), stretches, checkpoint, losses.append)
    return network, [float(text.split()[-1]) for text in losses]


def test_trained_prior_loads_and_has_a_card(motion, tmp_path, mocapfix):
    shipped = yaml.safe_load((find_shipped_folder("priors") / "motion.yaml").read_text(encoding="utf-8"))
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(shipped | SMALL), encoding="utf-8")
    options = ("--config", tmp_path / "mine.yaml", "--data", motion, "-o", tmp_path / "mine.safetensors")
    status, output, complaint = mocapfix("train", "motion", *options)
    assert status == 0, complaint
    assert "mm by interpolation" in output
    assert read_motion_prior(tmp_path / "mine.safetensors").block_count == 1
    card = (tmp_path / "mine.md").read_text(encoding="utf-8")
    assert "| trained on | 01 (80), 14 (80) |" in card
    assert "| held out, for standard deviations and scores | 03 (80) |" in card
    assert "NSF EIA-0196217" in card
    assert "| whole body, 0.2 to 0.4 s |" in card
    assert "retargeted_poses" not in card
    assert not (tmp_path / "mine.checkpoint").exists()
    assert mocapfix("train", "motion", *options)[0] == 1


def test_interrupted_training_ends_with_the_same_weights(motion, tmp_path, monkeypatch):
    whole, _ = fit(motion, tmp_path / "whole")
    monkeypatch.setattr(motion_training, "CHECKPOINT_STEPS", 2)

    def interrupt(text):
        raise KeyboardInterrupt

    stretches = motion_training.gather_motion_stretches([motion], lambda subject: subject in ("01", "14"), lambda text: None)
    with pytest.raises(KeyboardInterrupt):
        motion_training.fit_motion_network(build_settings(), stretches, tmp_path / "part", interrupt)
    resumed = motion_training.fit_motion_network(build_settings(), stretches, tmp_path / "part", lambda text: None)
    for name, values in whole.state_dict().items():
        torch.testing.assert_close(resumed.state_dict()[name], values, rtol=0, atol=0)


def test_training_lowers_the_loss(motion, tmp_path, monkeypatch):
    monkeypatch.setattr(motion_training, "CHECKPOINT_STEPS", 20)
    monkeypatch.setattr(motion_training, "RISE_STEPS", 5)
    monkeypatch.setattr(motion_training, "AVERAGED_STEPS", 10)
    _, losses = fit(motion, tmp_path / "mine", steps=60, batch_windows=16, learning_rate=5e-3)
    assert losses[-1] < 0.9 * losses[0]


def test_file_that_is_not_a_checkpoint_raises(motion, tmp_path):
    (tmp_path / "mine").write_text("weights", encoding="utf-8")
    with pytest.raises(ReadError, match="is not a training checkpoint"):
        fit(motion, tmp_path / "mine")


def test_scores_of_an_untrained_network_are_those_of_interpolation(motion, tmp_path):
    network, _ = fit(motion, tmp_path / "mine", steps=1)
    model = motion_training.extract_motion_weights(network)
    model.tensors["output.weight"][:] = 0
    model.tensors["output.bias"][:] = 0
    stretches = motion_training.gather_motion_stretches([motion], lambda subject: subject == "03", lambda text: None)
    scores = motion_training.compute_gap_scores(model, stretches, build_settings())
    np.testing.assert_allclose(scores.predicted_m, scores.interpolated_m, rtol=1e-4)
