"""Training of learned inverse kinematics on synthetic motion."""

import numpy as np
import pytest
import torch
import yaml

from mocapfix.io.shipped import find_shipped_folder
from mocapfix.io.yaml_files import read_yaml_model
from mocapfix.lab import learned_ik_training
from mocapfix.lab.frame_pairs import PairSampler, gather_sequences
from mocapfix.lab.settings import LearnedIkSettings
from mocapfix.solve.learned_ik import read_ik_network
from tests.lab.motion_files import draw_motion, write_bvh_motion

SMALL = {"hidden_widths": [16, 16], "steps": 6, "batch_poses": 32, "test_subjects": ["02"], "held_out_subjects": ["03"]}


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
        write_bvh_motion(folder / f"{name}.bvh", draw_motion(seed, spread=0.2))
    return folder


def build_settings(name="ik", **changes):
    settings = read_yaml_model(LearnedIkSettings, find_shipped_folder("priors") / f"{name}.yaml")
    return settings.model_copy(update=SMALL | {"hidden_widths": (16, 16)} | changes)


def test_command_writes_weights_and_a_card(motion, tmp_path, mocapfix):
    shipped = yaml.safe_load((find_shipped_folder("priors") / "ik.yaml").read_text(encoding="utf-8"))
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(shipped | SMALL), encoding="utf-8")
    options = ("--config", tmp_path / "mine.yaml", "--data", motion, "-o", tmp_path / "mine.safetensors")
    status, output, _ = mocapfix("train", "ik", *options)
    assert status == 0
    assert "joint error of held-out people" in output
    card = (tmp_path / "mine.md").read_text(encoding="utf-8")
    assert "| trained on | 01 (24), 14 (24) |" in card
    assert "| held out, for standard deviations and scores | 03 (24) |" in card
    assert "| never read, for the benchmarks | 02 |" in card
    assert "NSF EIA-0196217" in card
    assert not list(tmp_path.glob("*.checkpoint"))
    read_ik_network(tmp_path / "mine.safetensors")
    assert "With the joints of the left arm missing" in card
    assert mocapfix("train", "ik", *options)[0] == 1  # the weights exist


def test_interrupted_training_continues_to_the_same_network(tmp_path, motion, monkeypatch):
    monkeypatch.setattr(learned_ik_training, "STEPS_PER_CHECKPOINT", 2)
    settings = build_settings()
    sequences = gather_sequences([motion], lambda subject: subject in {"01", "14"}, lambda text: None)
    whole = learned_ik_training.fit_ik_model(settings, sequences, tmp_path / "whole.checkpoint", lambda text: None)

    def interrupt(text):
        if "step 4" in text:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        learned_ik_training.fit_ik_model(settings, sequences, tmp_path / "part.checkpoint", interrupt)
    resumed = learned_ik_training.fit_ik_model(settings, sequences, tmp_path / "part.checkpoint", lambda text: None)
    for name, values in whole.state_dict().items():
        torch.testing.assert_close(resumed.state_dict()[name], values)


def test_training_lowers_the_loss(tmp_path, motion):
    settings = build_settings(steps=60, learning_rate=3e-3, has_corruption=False)
    sequences = gather_sequences([motion], lambda subject: subject in {"01", "14"}, lambda text: None)
    losses = []
    for steps in (1, 60):
        model = learned_ik_training.fit_ik_model(
            settings.model_copy(update={"steps": steps}), sequences, tmp_path / f"{steps}.checkpoint", lambda text: None
        )
        batch = PairSampler(sequences, settings).draw_batch(1000)
        with torch.no_grad():
            loss = learned_ik_training.compute_ik_loss(
                model.predict(batch), learned_ik_training.build_true_tensors(batch), settings.loss_weights
            )
        losses.append(float(loss))
    assert losses[1] < losses[0]


def test_extracted_network_predicts_what_the_model_does(tmp_path, motion):
    settings = build_settings()
    sequences = gather_sequences([motion], lambda subject: subject in {"01", "14"}, lambda text: None)
    model = learned_ik_training.fit_ik_model(settings, sequences, tmp_path / "mine.checkpoint", lambda text: None)
    assert isinstance(model, learned_ik_training.ClosedFormModel)
    batch = PairSampler(sequences, settings).draw_batch(7)
    _, features = model._compute_inputs(batch)
    with torch.no_grad():
        expected = model.layers((torch.as_tensor(features) - model.input_mean) * model.input_scale)
    np.testing.assert_allclose(model.extract_network().evaluate(features), expected.numpy(), atol=2e-2)
