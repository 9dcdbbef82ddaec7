"""Training what regresses twists: on made-up motion, whose arms twist as their elbows bend."""

import numpy as np
import pytest
import torch
import yaml
from scipy.spatial.transform import Rotation

from mocapfix.errors import WriteError
from mocapfix.files.shipped import find_shipped_folder
from mocapfix.initialise.twist_regressor import compute_bone_vectors, compute_twists, read_twist_regressor
from mocapfix.skeleton import load_cmu31_skeleton
from mocapfix.train import settings, twist_examples
from mocapfix.train import twist as training
from tests.train.people import walked, write_bvh

BODY = load_cmu31_skeleton()
SMALL = {"hidden": [16, 16], "epochs": 1, "batch": 32}


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """So little work is done sooner by one thread than by several that wait for one another."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def motion(tmp_path_factory):
    where = tmp_path_factory.mktemp("motion")
    for seed, name in enumerate(("01_01", "02_01", "03_01", "14_01")):
        write_bvh(where / f"{name}.bvh", walked(seed, spread=0.2))
    return where


@pytest.fixture
def command(motion, tmp_path, mocapfix):
    """-> train by settings that are those shipped but for some: exit status, standard output, standard error"""

    def run(*more, **changes):
        said = yaml.safe_load((find_shipped_folder("priors") / "twist.yaml").read_text(encoding="utf-8"))
        (tmp_path / "mine.yaml").write_text(yaml.safe_dump(said | SMALL | changes))
        options = ("--config", tmp_path / "mine.yaml", "--data", motion, "-o", tmp_path / "mine.safetensors")
        return mocapfix("train", "twist", *options, *more)

    return run


def said(**changes):
    shipped = settings.read_twist_settings(find_shipped_folder("priors") / "twist.yaml")
    return shipped.model_copy(update={"hidden": (16, 16), "batch": 32} | changes)


def test_a_network_is_trained_loaded_and_told_of(command, tmp_path):
    status, told, _ = command()
    assert status == 0
    network = read_twist_regressor(tmp_path / "mine.safetensors")
    assert (network.sd_rad >= training.MIN_TWIST_SD_RAD - 1e-6).all()
    card = (tmp_path / "mine.md").read_text(encoding="utf-8")
    assert "NSF EIA-0196217" in card
    assert "| learned from | 01 (24), 14 (24) |" in card
    assert "kept from it, for sigma and the scores | 03 (24) |" in card
    assert "never read, for the benchmarks | 02, 05, 06, 16, 49, 85 |" in card
    table = card.split("## Scores")[1].split("\n\n")[2].splitlines()[2:]
    names = [BODY.names[j] for j in np.flatnonzero(twist_examples.HAS_TWIST)]
    assert [row.split(" | ")[0] for row in table] == ["| " + name for name in names if name[0] != "R"] + ["| mean"]
    assert "mine.safetensors: " in told
    assert "degrees off the twists of people that were kept from it" in told


def test_weights_that_are_there_are_not_replaced_unasked(command, tmp_path):
    (tmp_path / "mine.safetensors").write_text("dear")
    status, _, complaint = command()
    assert status == 1
    assert "is there already" in complaint
    assert (tmp_path / "mine.safetensors").read_text() == "dear"
    assert command("--overwrite")[0] == 0


def test_weights_of_another_form_are_refused_before_any_work(tmp_path, motion):
    with pytest.raises(WriteError, match=r"mine\.pt: .*ends in \.safetensors"):
        training.train_twist_regressor(said(), motion, tmp_path / "mine.pt", lambda what: None)


def of_arms(frames):
    """-> local rotations whose left upper arm is twisted at will, its elbow bent: the forearm shows it"""
    poses = np.tile(np.eye(3, dtype=np.float32), (frames, 31, 1, 1))
    arm, elbow = BODY.index("LeftArm"), BODY.index("LeftForeArm")
    poses[:, arm] = Rotation.from_euler("x", np.random.default_rng(0).uniform(-1, 1, frames)[:, None]).as_matrix()
    poses[:, elbow] = Rotation.from_euler("y", -1.2).as_matrix()
    return poses


def test_training_lowers_the_loss_and_finds_the_twist_of_an_arm():
    poses, losses = of_arms(300), []
    quick = said(epochs=12, batch_poses=16, rate=1e-2)
    network = training.fit_twist_regressor(poses, np.ones(300), quick, lambda what: losses.append(float(what.split()[-1])))
    assert losses[-1] < 0.3 * losses[0]
    inputs, true = twist_examples.build_examples(poses, BODY, None)
    assert np.degrees(training.compute_angle_errors(network.said(inputs), true).max(axis=1).mean()) < 12
    assert np.degrees(training.compute_angle_errors(np.array([1.0, 0.0]), true).max(axis=1).mean()) > 25


def test_the_same_seed_gives_the_same_network_and_another_another():
    poses = of_arms(60)
    one, again, other = (
        training.fit_twist_regressor(poses, np.ones(60), said(epochs=1, seed=seed), lambda what: None) for seed in (3, 3, 4)
    )
    for layer, its in enumerate(one.weights):
        np.testing.assert_array_equal(its, again.weights[layer])
        assert (its != other.weights[layer]).any()


def test_examples_are_of_other_bodies_displaced_and_lost_but_their_twists_are_true():
    poses, random = of_arms(200), np.random.default_rng(0)
    inputs, true = twist_examples.build_epoch_examples(poses, random)
    exact, twisted = twist_examples.build_examples(poses, BODY, None)
    assert inputs.shape == exact.shape == (200, twist_examples.INPUT_COUNT)
    assert inputs.dtype == true.dtype == np.float32
    np.testing.assert_allclose(true, twisted.reshape(200, -1), atol=2e-2)  # bones that lean a little are twisted otherwise
    assert 0.02 < np.mean(inputs[:, : twist_examples.INPUT_COUNT // 2].reshape(200, -1, 3).any(axis=2) == 0) < 0.3
    arm = int(twist_examples.HAS_TWIST[: BODY.index("LeftArm")].sum())
    np.testing.assert_allclose(
        twisted[:, arm], compute_twists(poses, compute_bone_vectors(BODY))[:, BODY.index("LeftArm")], atol=1e-6
    )


def test_angles_are_apart_by_the_shorter_way():
    one, other = (np.array([[np.cos(a), np.sin(a)]]) for a in (3.0, -3.0))
    np.testing.assert_allclose(training.compute_angle_errors(5 * one, other), 2 * np.pi - 6.0)
    np.testing.assert_allclose(training.compute_angle_errors(np.array([1.0, 0.0]), other), 3.0)
