"""Training the twist regressor on synthetic motion, whose arms twist when their elbows bend."""

import numpy as np
import pytest
import torch
import yaml
from scipy.spatial.transform import Rotation

from mocapfix.io.shipped import find_shipped_folder
from mocapfix.io.yaml_files import read_yaml_model
from mocapfix.lab import frame_pairs, settings, twist_training
from mocapfix.lab.frame_pairs import compute_twists
from mocapfix.model.skeleton import load_cmu31_skeleton
from mocapfix.solve.hybrik import compute_bone_vectors, read_twist_regressor
from tests.lab.motion_files import draw_motion, write_bvh_motion

BODY = load_cmu31_skeleton()
SMALL = {"hidden_widths": [16, 16], "epochs": 1, "batch_poses": 32}


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


@pytest.fixture
def command(motion, tmp_path, mocapfix):
    """Return a function that trains with changed settings: exit status, standard output, standard error."""

    def run(*more, **changes):
        shipped = yaml.safe_load((find_shipped_folder("priors") / "twist.yaml").read_text(encoding="utf-8"))
        (tmp_path / "mine.yaml").write_text(yaml.safe_dump(shipped | SMALL | changes), encoding="utf-8")
        options = ("--config", tmp_path / "mine.yaml", "--data", motion, "-o", tmp_path / "mine.safetensors")
        return mocapfix("train", "twist", *options, *more)

    return run


def build_settings(**changes):
    shipped = read_yaml_model(settings.TwistSettings, find_shipped_folder("priors") / "twist.yaml")
    return shipped.model_copy(update={"hidden_widths": (16, 16), "batch_poses": 32} | changes)


def test_trained_regressor_loads_and_has_a_card(command, tmp_path):
    status, output, _ = command()
    assert status == 0
    network = read_twist_regressor(tmp_path / "mine.safetensors")
    assert (network.sd_rad >= twist_training.MIN_TWIST_SD_RAD - 1e-6).all()
    card = (tmp_path / "mine.md").read_text(encoding="utf-8")
    assert "NSF EIA-0196217" in card
    assert "| trained on | 01 (24), 14 (24) |" in card
    assert "held out, for standard deviations and scores | 03 (24) |" in card
    assert "never read, for the benchmarks | 02, 05, 06, 16, 49, 85, basket-s010, tilling-mmk, ys2010-boxer |" in card
    table = card.split("## Scores")[1].split("\n\n")[2].splitlines()[2:]
    names = [BODY.names[j] for j in np.flatnonzero(frame_pairs.HAS_TWIST)]
    assert [row.split(" | ")[0] for row in table] == ["| " + name for name in names if name[0] != "R"] + ["| mean"]
    assert "mine.safetensors: " in output
    assert "mean twist error of held-out people" in output


def test_existing_weights_are_not_overwritten(command, tmp_path):
    (tmp_path / "mine.safetensors").write_text("weights", encoding="utf-8")
    status, _, complaint = command()
    assert status == 1
    assert "already exists" in complaint
    assert (tmp_path / "mine.safetensors").read_text(encoding="utf-8") == "weights"
    assert command("--overwrite")[0] == 0


def test_weights_of_another_format_are_refused_before_training(tmp_path, motion, mocapfix):
    config = find_shipped_folder("priors") / "twist.yaml"
    status, _, complaint = mocapfix("train", "twist", "--config", config, "--data", motion, "-o", tmp_path / "mine.pt")
    assert status == 1
    assert "mine.pt: weights are written as safetensors" in " ".join(complaint.split())


def draw_arm_poses(frames):
    """Return local rotations with a rng twist of the left upper arm, visible in the forearm of the bent elbow."""
    poses = np.tile(np.eye(3, dtype=np.float32), (frames, 31, 1, 1))
    arm, elbow = BODY.find_joint("LeftArm"), BODY.find_joint("LeftForeArm")
    poses[:, arm] = Rotation.from_euler("x", np.random.default_rng(0).uniform(-1, 1, frames)[:, None]).as_matrix()
    poses[:, elbow] = Rotation.from_euler("y", -1.2).as_matrix()
    return poses


def test_training_lowers_the_loss_and_finds_the_twist_of_an_arm():
    poses, losses = draw_arm_poses(300), []
    quick = build_settings(epochs=12, batch_poses=16, learning_rate=1e-2)
    network = twist_training.fit_twist_regressor(poses, np.ones(300), quick, lambda text: losses.append(float(text.split()[-1])))
    assert losses[-1] < 0.3 * losses[0]
    inputs, true = frame_pairs.build_examples(poses, BODY, None)
    assert np.degrees(twist_training.compute_angle_errors(network.evaluate(inputs), true).max(axis=1).mean()) < 12
    assert np.degrees(twist_training.compute_angle_errors(np.array([1.0, 0.0]), true).max(axis=1).mean()) > 25


def test_training_is_reproducible_by_seed():
    poses = draw_arm_poses(60)
    one, again, other = (
        twist_training.fit_twist_regressor(poses, np.ones(60), build_settings(epochs=1, seed=seed), lambda text: None)
        for seed in (3, 3, 4)
    )
    for layer, its in enumerate(one.weights):
        np.testing.assert_array_equal(its, again.weights[layer])
        assert (its != other.weights[layer]).any()


def test_examples_have_displaced_joints_and_true_twists():
    poses, rng = draw_arm_poses(200), np.random.default_rng(0)
    inputs, true = frame_pairs.build_epoch_examples(poses, rng)
    exact, twisted = frame_pairs.build_examples(poses, BODY, None)
    assert inputs.shape == exact.shape == (200, frame_pairs.INPUT_COUNT)
    assert inputs.dtype == true.dtype == np.float32
    np.testing.assert_allclose(true, twisted.reshape(200, -1), atol=2e-2)  # slightly different bone directions change the twist
    assert 0.02 < np.mean(inputs[:, : frame_pairs.INPUT_COUNT // 2].reshape(200, -1, 3).any(axis=2) == 0) < 0.3
    arm = int(frame_pairs.HAS_TWIST[: BODY.find_joint("LeftArm")].sum())
    np.testing.assert_allclose(
        twisted[:, arm], compute_twists(poses, compute_bone_vectors(BODY))[:, BODY.find_joint("LeftArm")], atol=1e-6
    )


def test_angle_errors_are_the_smaller_angle():
    one, other = (np.array([[np.cos(a), np.sin(a)]]) for a in (3.0, -3.0))
    np.testing.assert_allclose(twist_training.compute_angle_errors(5 * one, other), 2 * np.pi - 6.0)
    np.testing.assert_allclose(twist_training.compute_angle_errors(np.array([1.0, 0.0]), other), 3.0)
