"""Training a pose prior by its command, on a few seconds of synthetic motion."""

from collections import Counter

import numpy as np
import pytest
import yaml

from mocapfix.cli import app
from mocapfix.io.shipped import find_shipped_folder
from mocapfix.lab import pose_prior_training
from mocapfix.lab.training_poses import TrainingPoses
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.solve import trained_priors
from mocapfix.solve.pose_prior import GaussianModel
from tests.lab.motion_files import draw_motion, write_bvh_motion

SKELETON = load_cmu31_body().skeleton
SMALL = {"hidden_widths": [8], "code_size": 3, "epochs": 2, "batch_poses": 16}


@pytest.fixture(scope="module")
def motion(tmp_path_factory):
    folder = tmp_path_factory.mktemp("motion")
    for seed, name in enumerate(("01_01", "01_02", "02_01", "03_01", "14_01")):
        write_bvh_motion(folder / f"{name}.bvh", draw_motion(seed))
    return folder


def train(name, motion, folder, *more, **changes):
    """Run the command with changed settings of a shipped prior and return its exit status."""
    shipped = yaml.safe_load((find_shipped_folder("priors") / f"{name}.yaml").read_text(encoding="utf-8"))
    (folder / "mine.yaml").write_text(yaml.safe_dump(shipped | changes), encoding="utf-8")
    with pytest.raises(SystemExit) as exited:
        app.run_command_line(
            [
                "train",
                "prior",
                "--config",
                str(folder / "mine.yaml"),
                "--data",
                str(motion),
                "-o",
                str(folder / "mine.safetensors"),
                *more,
            ]
        )
    return exited.value.code


@pytest.mark.parametrize(
    ("name", "changes", "size"),
    [
        ("pca", {"components": 4}, 4),
        ("gaussian", {}, 11),
        ("mixture", {"components": 3}, 11),
        ("autoencoder", SMALL | {"residual_directions": 2}, 5),
        ("mnn-ik", SMALL | {"initial_weight_sd": None}, 3),
    ],
)
def test_trained_prior_loads_and_has_a_card(tmp_path, motion, capsys, name, changes, size):
    assert train(name, motion, tmp_path, **changes) == 0
    model = trained_priors.load_pose_model(str(tmp_path / "mine.safetensors"), SKELETON)
    assert model.code_size == size
    card = (tmp_path / "mine.md").read_text(encoding="utf-8")
    assert "NSF EIA-0196217" in card
    assert "| trained on | 01 (48), 14 (24) |" in card
    assert "held out, for standard deviations and scores | 03 (24) |" in card
    assert "72 frames" in card
    assert not list(tmp_path.glob("*.checkpoint"))
    assert "mine.safetensors: reconstructs training poses to" in capsys.readouterr().out


def test_existing_weights_are_not_overwritten(tmp_path, motion, capsys):
    assert train("pca", motion, tmp_path, components=4) == 0
    before = (tmp_path / "mine.safetensors").read_bytes()
    assert train("pca", motion, tmp_path, components=2) == 1
    assert "already exists" in capsys.readouterr().err
    assert (tmp_path / "mine.safetensors").read_bytes() == before
    assert train("pca", motion, tmp_path, "--overwrite", components=2) == 0


def test_codes_of_training_poses_are_scaled_by_the_inflation(tmp_path, motion):
    train("autoencoder", motion, tmp_path, **SMALL)
    model = trained_priors.load_pose_model(str(tmp_path / "mine.safetensors"), SKELETON)
    poses = pose_prior_training.gather_training_poses(
        [motion], model.reference_rotations, frozenset(["02"]), frozenset(["03"]), lambda text: None
    )
    codes = model.encode(poses.training_vectors)[:, :3]
    np.testing.assert_allclose(codes.mean(0), 0, atol=1e-3)
    np.testing.assert_allclose(np.cov(codes.T), np.eye(3) / pose_prior_training.SD_INFLATION**2, atol=1e-3)


def test_residual_sd_is_measured_on_held_out_poses_with_a_lower_bound():
    rng = np.random.default_rng(0)
    model = GaussianModel(
        SKELETON.names, np.tile(np.eye(3), (31, 1, 1)), np.ones(31), np.zeros((31, 3)), np.zeros((1, 31, 3)), 0.1
    )
    held_out = np.zeros((5000, 31, 3))
    held_out[:, 7] = rng.normal(0, 0.2, (5000, 3))
    residual_sd = pose_prior_training.compute_residual_sd(model, held_out)
    assert residual_sd[7] == pytest.approx(0.2 * pose_prior_training.SD_INFLATION, rel=0.03)
    np.testing.assert_allclose(np.delete(residual_sd, 7), pose_prior_training.MIN_RESIDUAL_SD_RAD)


def test_residual_sd_is_measured_on_poses_that_are_not_retargeted():
    held_out = np.arange(4.0)[:, None, None] * np.ones((4, 31, 3))
    index = np.array([0, 1, 0, 1])
    for is_retargeted, expected in (([False, True], [0.0, 2.0]), ([True, True], [0.0, 1.0, 2.0, 3.0])):
        poses = TrainingPoses(held_out, held_out, index, index, np.array(is_retargeted), Counter(), 0)
        np.testing.assert_array_equal(pose_prior_training.select_measured_poses(poses)[:, 0, 0], expected)
