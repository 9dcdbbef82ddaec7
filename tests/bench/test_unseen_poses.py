"""Poses for the benchmarks: their subjects, and the shipped poses."""

from pathlib import Path

import numpy as np
import pytest

from mocapfix.bench import unseen_poses
from mocapfix.errors import ReadError
from mocapfix.files.shipped import find_shipped_folder
from mocapfix.pose_prior.model import remove_heading
from mocapfix.train import settings
from tests.train.motion_files import draw_motion, write_bvh

MOTION = Path(__file__).resolve().parents[3] / "shared" / "data" / "cmu-motion"


@pytest.fixture
def motion(tmp_path):
    for name in ("01_01", "02_01", "05_03"):
        write_bvh(tmp_path / f"{name}.bvh", draw_motion(int(name[:2])))
    return tmp_path


def remove_headings(rotations):
    rotations = rotations.copy()
    rotations[:, 0] = remove_heading(rotations[:, 0])
    return rotations


def test_subjects_are_test_subjects_of_all_shipped_priors():
    for path in find_shipped_folder("priors").glob("*.safetensors"):
        training_settings = (settings.read_twist_settings if path.stem == "twist" else settings.read_prior_settings)(
            path.with_suffix(".yaml")
        )
        assert training_settings.test_subjects == unseen_poses.UNSEEN_SUBJECTS
        assert not training_settings.held_out_subjects & unseen_poses.UNSEEN_SUBJECTS


def test_poses_are_evenly_spaced_without_heading(motion):
    found = unseen_poses.sample_subject_poses(motion, 1000)
    expected = remove_headings(np.concatenate([draw_motion(2), draw_motion(5)]))
    np.testing.assert_allclose(found, expected, atol=1e-6)
    np.testing.assert_allclose(unseen_poses.sample_subject_poses(motion, 3), expected[[0, 23, 47]], atol=1e-6)


def test_interleaved_poses_are_the_test_frames_of_mnn_ik(motion):
    expected = np.concatenate([draw_motion(seed)[np.isin(np.arange(24) % 5, (1, 3))] for seed in (1, 2, 5)])
    np.testing.assert_allclose(unseen_poses.sample_interleaved_poses(motion, 1000), remove_headings(expected), atol=1e-6)


def test_folder_without_test_subjects_raises(motion):
    for name in ("02_01", "05_03"):
        (motion / f"{name}.bvh").unlink()
    with pytest.raises(ReadError, match="holds no motion of the test subjects 02, 05"):
        unseen_poses.sample_subject_poses(motion, 10)


def test_written_poses_are_read_back(tmp_path, monkeypatch):
    poses = draw_motion(7)
    unseen_poses.write_unseen_poses(tmp_path / "poses.npz", poses)
    monkeypatch.setattr(unseen_poses, "find_shipped_folder", lambda _: tmp_path)
    monkeypatch.setattr(unseen_poses, "UNSEEN_POSES_FILE", "poses.npz")
    np.testing.assert_allclose(unseen_poses.load_unseen_poses(), poses, atol=2e-4)


def test_shipped_poses_are_upright_and_distinct():
    poses = unseen_poses.load_unseen_poses()
    assert poses.shape == (1000, 31, 3, 3)
    np.testing.assert_allclose(poses @ np.swapaxes(poses, 2, 3), np.broadcast_to(np.eye(3), poses.shape), atol=1e-9)
    np.testing.assert_allclose(remove_heading(poses[:, 0]), poses[:, 0], atol=2e-3)
    assert len(np.unique(poses.round(3), axis=0)) > 990


@pytest.mark.skipif(not MOTION.is_dir(), reason="needs the CMU motion")
def test_shipped_poses_are_those_of_the_motion(tmp_path):
    for name in ("test.npz", "skeletons.json"):
        (tmp_path / name).symlink_to(MOTION / name)
    np.testing.assert_allclose(unseen_poses.sample_subject_poses(tmp_path, 1000), unseen_poses.load_unseen_poses(), atol=2e-4)
