"""The whole training by its command, on a few seconds of made-up motion."""

import numpy as np
import pytest
import yaml

from mocapfix.cli import app
from mocapfix.errors import WriteError
from mocapfix.files.shipped import find_shipped_folder
from mocapfix.pose_prior import io
from mocapfix.pose_prior.gaussian import GaussianModel
from mocapfix.skeleton import load_cmu31_body
from mocapfix.train import pose_prior as training
from mocapfix.train import settings
from tests.train.people import walked, write_bvh

SKELETON = load_cmu31_body().skeleton
SMALL = {"hidden": [8], "code": 3, "epochs": 2, "batch": 16}


@pytest.fixture(scope="module")
def motion(tmp_path_factory):
    where = tmp_path_factory.mktemp("motion")
    for seed, name in enumerate(("01_01", "01_02", "02_01", "03_01", "14_01")):
        write_bvh(where / f"{name}.bvh", walked(seed))
    return where


def train(name, motion, where, *more, **changes):
    """-> the exit status of the command, with settings that are those shipped as NAME but for some"""
    said = yaml.safe_load((find_shipped_folder("priors") / f"{name}.yaml").read_text(encoding="utf-8"))
    (where / "mine.yaml").write_text(yaml.safe_dump(said | changes))
    with pytest.raises(SystemExit) as left:
        app.run_command_line(
            [
                "train",
                "prior",
                "--config",
                str(where / "mine.yaml"),
                "--data",
                str(motion),
                "-o",
                str(where / "mine.safetensors"),
                *more,
            ]
        )
    return left.value.code_size


@pytest.mark.parametrize(
    ("name", "changes", "size"),
    [
        ("pca", {"components": 4}, 4),
        ("gaussian", {}, 11),
        ("mixture", {"components": 3}, 11),
        ("autoencoder", SMALL | {"astray": 2}, 5),
        ("mnn-ik", SMALL | {"initial": None}, 3),
    ],
)
def test_a_prior_is_trained_loaded_and_told_of(tmp_path, motion, capsys, name, changes, size):
    assert train(name, motion, tmp_path, **changes) == 0
    model = io.load_pose_model(str(tmp_path / "mine.safetensors"), SKELETON)
    assert model.size == size
    card = (tmp_path / "mine.md").read_text(encoding="utf-8")
    assert "NSF EIA-0196217" in card
    assert "| learned from | 01 (48), 14 (24) |" in card
    assert "kept from it, for sigma and the scores | 03 (24) |" in card
    assert "72 frames" in card
    assert not list(tmp_path.glob("*.checkpoint"))
    assert "mine.safetensors: gives poses back to" in capsys.readouterr().out


def test_mnn_iks_split_learns_from_everybody_and_the_card_says_so(tmp_path, motion):
    assert train("pca", motion, tmp_path, "--interleaved", components=4) == 0
    card = (tmp_path / "mine.md").read_text(encoding="utf-8")
    assert "| learned from | 01 (28), 02 (14), 03 (14), 14 (14) |" in card
    assert "70 frames" in card
    assert "two frames of every five, between those learned from" in card
    assert "never read" not in card
    assert "| frames it has not seen |" in card
    model = io.load_pose_model(str(tmp_path / "mine.safetensors"), SKELETON)
    poses = training.gather_training_poses(
        motion, model.reference_rotations, frozenset(), frozenset(), lambda what: None, is_interleaved=True
    )
    np.testing.assert_allclose(model.sigma, training.compute_residual_sd(model, poses.seen), rtol=1e-5)
    assert not np.allclose(model.sigma, training.compute_residual_sd(model, poses.unseen), rtol=1e-5)


def test_weights_that_are_there_are_not_replaced_unasked(tmp_path, motion, capsys):
    assert train("pca", motion, tmp_path, components=4) == 0
    before = (tmp_path / "mine.safetensors").read_bytes()
    assert train("pca", motion, tmp_path, components=2) == 1
    assert "is there already" in capsys.readouterr().err
    assert (tmp_path / "mine.safetensors").read_bytes() == before
    assert train("pca", motion, tmp_path, "--overwrite", components=2) == 0


def test_weights_of_another_form_are_refused_before_any_work(tmp_path, motion):
    said = settings.read_prior_settings(find_shipped_folder("priors") / "pca.yaml")
    with pytest.raises(WriteError, match=r"mine\.pt: .*ends in \.safetensors"):
        training.train_pose_prior(said, motion, tmp_path / "mine.pt", lambda what: None)


def test_a_networks_codes_of_what_it_learned_are_half_of_normal(tmp_path, motion):
    train("autoencoder", motion, tmp_path, **SMALL)
    model = io.load_pose_model(str(tmp_path / "mine.safetensors"), SKELETON)
    poses = training.gather_training_poses(
        motion, model.reference_rotations, frozenset(["02"]), frozenset(["03"]), lambda what: None
    )
    codes = model.encode(poses.seen)[:, :3]
    np.testing.assert_allclose(codes.mean(0), 0, atol=1e-3)
    np.testing.assert_allclose(np.cov(codes.T), np.eye(3) / training.SD_INFLATION**2, atol=1e-3)


def test_sigma_is_what_unseen_people_stray_and_never_less_than_the_floor():
    rng = np.random.default_rng(0)
    model = GaussianModel(
        SKELETON.names, np.tile(np.eye(3), (31, 1, 1)), np.ones(31), np.zeros((31, 3)), np.zeros((1, 31, 3)), 0.1
    )
    unseen = np.zeros((5000, 31, 3))
    unseen[:, 7] = rng.normal(0, 0.2, (5000, 3))
    sigma = training.compute_residual_sd(model, unseen)
    assert sigma[7] == pytest.approx(0.2 * training.SD_INFLATION, rel=0.03)
    np.testing.assert_allclose(np.delete(sigma, 7), training.MIN_RESIDUAL_SD_RAD)
