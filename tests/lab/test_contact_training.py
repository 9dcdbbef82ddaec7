"""Training of contacts of hidden feet: the examples of a take, the fit, the scores, and the command."""

import json

import numpy as np
import pytest
import torch
import yaml

from mocapfix.contacts import find_contacts
from mocapfix.contacts.find_contacts import FEATURE_COUNT, find_shown_standing
from mocapfix.io.shipped import find_shipped_folder
from mocapfix.io.yaml_files import read_yaml_model
from mocapfix.lab import contact_training
from mocapfix.lab.contact_training import (
    COPY_WEIGHT,
    ContactExamples,
    compute_contact_loss,
    compute_contact_scores,
    fit_contact_network,
    generate_examples,
)
from mocapfix.lab.settings import ContactSettings
from mocapfix.lab.sound_takes import remove_damage
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.solve.learned_ik import Perceptron, read_perceptron
from mocapfix.synthetic import compose_take
from tests.lab.test_shard_recordings import write_shard

CONFIG = find_shipped_folder("priors") / "contacts.yaml"


@pytest.fixture(scope="module")
def sound():
    return remove_damage(compose_take(seed=0, seconds=6.0))


@pytest.fixture(scope="module")
def examples(sound):
    return list(generate_examples(sound, np.random.default_rng(0)))


def test_examples_are_of_hidden_frames_and_tell_what_is_true(examples):
    solved = [each for each in examples if each.weight.max() == 1]
    assert len(solved) == 2
    assert {each.weight.max() for each in examples} == {1.0, COPY_WEIGHT}
    for each in examples:
        assert each.features.shape == (len(each.weight), FEATURE_COUNT)
        assert (each.weight > 0).any(axis=1).all()
    # the composed walk stands on each foot for more than half of the time
    assert 0.4 < np.concatenate([each.is_standing[each.weight > 0] for each in solved]).mean() < 1


def test_examples_are_of_the_motion_in_which_contacts_are_found(sound, monkeypatch):
    judged: list[tuple[np.ndarray, np.ndarray]] = []

    def judge(position, sd, rate):
        judged.append((position, sd))
        return find_shown_standing(position, sd, rate)

    monkeypatch.setattr(find_contacts, "find_shown_standing", judge)
    monkeypatch.setattr(contact_training, "find_shown_standing", judge)
    list(generate_examples(sound, np.random.default_rng(0)))
    found, learned = judged[:2]  # the first is of the pipeline, the second of the training
    for one, other in zip(found, learned, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-9)


def build_line(seed: int, count: int = 4000) -> ContactExamples:
    """Return examples whose first feature decides on both joints, at different values."""
    features = np.random.default_rng(seed).normal(size=(count, 3)).astype(np.float32)
    return ContactExamples(features, features[:, :1] > [0.0, 0.5], np.ones((count, 2)))


def test_a_network_learns_what_decides():
    settings = read_yaml_model(ContactSettings, CONFIG).model_copy(update={"epochs": 3, "batch_poses": 32})
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    network = fit_contact_network([build_line(0)], settings, lambda _: None)
    torch.set_num_threads(threads)
    precision, recall, f1 = compute_contact_scores(network, [build_line(1)])[5, :3]
    assert min(precision, recall, f1) > 0.95


def test_frames_without_weight_do_not_count():
    predicted, true = torch.tensor([[0.0, 9.0], [0.0, 9.0]]), torch.tensor([[1.0, 0.0], [0.0, 0.0]])
    loss = compute_contact_loss(predicted, true, torch.tensor([[1.0, 0.0], [1.0, 0.0]]))
    assert float(loss) == pytest.approx(np.log(2))


def test_scores_count_frames_of_full_weight():
    zeros, ones = np.zeros(2, np.float32), np.ones((1, 2), np.float32)
    network = Perceptron(zeros[:1], ones[0, :1], (ones,), (zeros,))
    features = np.array([[3.0], [3.0], [-3.0], [-3.0]], np.float32)
    true, weight = np.array([[1, 1], [0, 1], [0, 1], [1, 1]], bool), np.array([[1, 0.3], [1, 0.3], [1, 0.3], [1, 0.3]])
    scores = compute_contact_scores(network, [ContactExamples(features, true, weight)])
    np.testing.assert_allclose(scores[5], [0.5, 0.5, 0.5, 0.0, 0.0])
    np.testing.assert_allclose(scores[0], [0.5, 1.0, 2 / 3, 0.5, 0.5])
    np.testing.assert_allclose(scores[9], [0.5, 0.5, 0.5, 0.5, 0.5])


def test_the_command_trains_on_people_with_their_own_bones(tmp_path, mocapfix, monkeypatch):
    path, _ = write_shard(tmp_path)
    bones = load_cmu31_body().skeleton.offsets / 0.056444
    names, people = load_cmu31_body().skeleton.names, {each: {"offsets": bones.tolist()} for each in ("01", "14")}
    (path.parent / "skeletons.json").write_text(json.dumps({"joints": names, "skeletons": people}), encoding="utf-8")
    monkeypatch.setattr(contact_training, "MIN_PIECE_S", 0.2)
    seen = []

    def generate(sound, rng):
        seen.append((sound.subject.skeleton.offsets, len(sound.marker_positions)))
        yield build_line(len(seen))

    monkeypatch.setattr(contact_training, "generate_examples", generate)
    shipped = yaml.safe_load(CONFIG.read_text(encoding="utf-8"))
    changes = {"held_out_subjects": ["14"], "piece_share": 1.0, "epochs": 1}
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(shipped | changes), encoding="utf-8")
    status, output, _ = mocapfix(
        "train", "contacts", "--config", tmp_path / "mine.yaml", "--data", tmp_path, "-o", tmp_path / "mine.safetensors"
    )
    assert status == 0
    assert "contacts of held-out people: precision" in output
    assert len(seen) == 2
    for offsets, _ in seen:
        np.testing.assert_allclose(offsets, load_cmu31_body().skeleton.offsets, atol=1e-9)
    assert read_perceptron(tmp_path / "mine.safetensors", "contacts", 3, 2)
    card = (tmp_path / "mine.md").read_text(encoding="utf-8")
    assert "| trained on | 01 (10) |" in card
    assert "| 0.9 | " in card


def test_hidden_frames_of_examples_are_those_of_the_detection(sound):
    sd = np.full((len(sound.marker_positions), 4), 0.003)
    sd[100:200, 0] = 0.03
    is_known = find_shown_standing(sound.joint_positions[:, [3, 4, 8, 9]], sd, sound.rate)[1]
    assert not is_known[100:200, :2].any()  # where the ankle is unknown, so is where the toes are
    assert is_known[:, 2:].all()
