"""Poses for the benchmarks: whose they are, and that what ships is what a folder of motion gives."""

from pathlib import Path

import numpy as np
import pytest
from tests.train.people import walked, write_bvh

from mocapfix.bench import unseen_poses
from mocapfix.errors import ReadError
from mocapfix.files.shipped import find_shipped_folder
from mocapfix.pose_prior.model import remove_heading
from mocapfix.train import settings

MOTION = Path(__file__).resolve().parents[3] / "shared" / "data" / "cmu-motion"


@pytest.fixture
def motion(tmp_path):
    for name in ("01_01", "02_01", "05_03"):
        write_bvh(tmp_path / f"{name}.bvh", walked(int(name[:2])))
    return tmp_path


def upright(rotations):
    rotations = rotations.copy()
    rotations[:, 0] = remove_heading(rotations[:, 0])
    return rotations


def test_the_subjects_are_those_that_no_shipped_prior_learns_from():
    for path in find_shipped_folder("priors").glob("*.safetensors"):
        said = (settings.read_twist_settings if path.stem == "twist" else settings.read_prior_settings)(path.with_suffix(".yaml"))
        assert said.test_subjects == unseen_poses.UNSEEN_SUBJECTS
        assert not said.held_out_subjects & unseen_poses.UNSEEN_SUBJECTS


def test_poses_are_of_those_subjects_alone_spread_evenly_and_without_heading(motion):
    found = unseen_poses.sample_subject_poses(motion, 1000)
    expected = upright(np.concatenate([walked(2), walked(5)]))
    np.testing.assert_allclose(found, expected, atol=1e-6)
    np.testing.assert_allclose(unseen_poses.sample_subject_poses(motion, 3), expected[[0, 23, 47]], atol=1e-6)


def test_between_are_the_frames_that_mnn_iks_split_does_not_learn_from(motion):
    expected = np.concatenate([walked(who)[np.isin(np.arange(24) % 5, (1, 3))] for who in (1, 2, 5)])
    np.testing.assert_allclose(unseen_poses.sample_interleaved_poses(motion, 1000), upright(expected), atol=1e-6)


def test_a_folder_without_those_subjects_is_named(motion):
    for name in ("02_01", "05_03"):
        (motion / f"{name}.bvh").unlink()
    with pytest.raises(ReadError, match="holds no motion of the subjects 02, 05"):
        unseen_poses.sample_subject_poses(motion, 10)


def test_what_is_packed_comes_back(tmp_path, monkeypatch):
    poses = walked(7)
    unseen_poses.write_unseen_poses(tmp_path / "poses.npz", poses)
    monkeypatch.setattr(unseen_poses, "folder", lambda _: tmp_path)
    monkeypatch.setattr(unseen_poses, "SHIPPED", "poses.npz")
    np.testing.assert_allclose(unseen_poses.load_unseen_poses(), poses, atol=2e-4)


def test_a_thousand_poses_ship_upright_and_unlike_one_another():
    poses = unseen_poses.load_unseen_poses()
    assert poses.shape == (1000, 31, 3, 3)
    np.testing.assert_allclose(poses @ np.swapaxes(poses, 2, 3), np.broadcast_to(np.eye(3), poses.shape), atol=1e-9)
    np.testing.assert_allclose(remove_heading(poses[:, 0]), poses[:, 0], atol=2e-3)
    assert len(np.unique(poses.round(3), axis=0)) > 990


@pytest.mark.skipif(not MOTION.is_dir(), reason="the CMU motion is not here")
def test_what_ships_is_what_the_motion_of_those_subjects_gives(tmp_path):
    for name in ("test.npz", "skeletons.json"):
        (tmp_path / name).symlink_to(MOTION / name)
    np.testing.assert_allclose(unseen_poses.sample_subject_poses(tmp_path, 1000), unseen_poses.load_unseen_poses(), atol=2e-4)
