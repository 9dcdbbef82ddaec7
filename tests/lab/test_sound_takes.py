"""Takes for the injection of faults: composed without damage, and performed at the rate of a capture system. Poses for the
benchmarks: their subjects, and the shipped poses.
"""

from functools import partial
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.errors import ReadError, SceneError
from mocapfix.io.shipped import find_shipped_folder
from mocapfix.io.yaml_files import read_yaml_model
from mocapfix.lab import settings, sound_takes
from mocapfix.lab.sound_takes import (
    SOUND_TAKE_DURATION_S,
    SOUND_TAKE_RATE_HZ,
    build_known_motion,
    choose_performances,
    iterate_sound_takes,
    perform_take,
    resample_performance,
)
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.solve import kinematics
from mocapfix.solve.pose_prior import remove_heading
from tests.lab.motion_files import draw_motion, write_bvh_motion

DATA = Path(__file__).resolve().parents[3] / "shared" / "data" / "cmu-motion"
JOINTS = len(load_cmu31_body().skeleton.names)


def swing(name="02_01", seconds=9.0, rate=30.0):
    """Return a performance that swings all joints about x and motion forward smoothly."""
    t = np.arange(round(seconds * rate)) / rate
    angles = np.zeros((len(t), JOINTS, 3))
    angles[..., 0] = 0.3 * np.sin(2 * t)[:, None]
    rotations = Rotation.from_rotvec(angles.reshape(-1, 3)).as_matrix().reshape(len(t), JOINTS, 3, 3)
    return sound_takes.PerformedMotion(build_known_motion(np.stack([0 * t, 0.9 + 0 * t, 0.5 * t**2], 1), rotations), rate, name)


def test_composed_take_has_no_faults():
    ((name, truth),) = iterate_sound_takes(None, 1)
    assert name == "seed 0"
    assert not truth.missing_mask.any()
    assert not truth.spike_mask.any()
    np.testing.assert_array_equal(truth.damaged_positions, truth.marker_positions)


def test_resampled_performance_is_smooth():
    motion = resample_performance(swing())
    t = np.arange(motion.frame_count) / SOUND_TAKE_RATE_HZ
    np.testing.assert_allclose(motion.root_position[:, 2], 0.5 * t**2, atol=1e-9)
    vectors = Rotation.from_matrix(motion.local_rotations[:, 3]).as_rotvec()
    np.testing.assert_allclose(vectors, np.outer(0.3 * np.sin(2 * t), [1, 0, 0]), atol=1e-3)


def test_long_performance_is_cut():
    assert (
        resample_performance(swing(seconds=SOUND_TAKE_DURATION_S + 5)).frame_count <= SOUND_TAKE_DURATION_S * SOUND_TAKE_RATE_HZ
    )


def test_performed_markers_have_skin_motion_and_noise():
    truth = perform_take(swing(), np.random.default_rng(0))
    joints, markers = kinematics.compute_joint_and_marker_positions(truth.subject, truth.motion)
    np.testing.assert_allclose(truth.joint_positions, joints)
    assert 0.003 < (truth.marker_positions - markers).std() < 0.006
    assert truth.rate == SOUND_TAKE_RATE_HZ


def test_a_person_can_have_its_own_bones():
    bones = 1.1 * load_cmu31_body().skeleton.offsets
    truth = perform_take(swing()._replace(bones=bones), np.random.default_rng(0), has_own_bones=True)
    np.testing.assert_array_equal(truth.subject.skeleton.offsets, bones)
    assert (perform_take(swing()._replace(bones=bones), np.random.default_rng(0)).subject.skeleton.offsets != bones).any()


def test_longest_recording_of_each_subject_comes_first():
    lengths = {"02_01": 9.0, "02_02": 12.0, "05_01": 8.5, "06_01": 3.0}
    chosen = choose_performances([swing(name, seconds) for name, seconds in lengths.items()], 9)
    assert [each.name for each in chosen] == ["02_02", "05_01", "02_01"]
    assert [each.name for each in choose_performances([swing(name, seconds) for name, seconds in lengths.items()], 1)] == [
        "02_02"
    ]


def test_missing_takes_or_motion_raise(tmp_path, monkeypatch):
    with pytest.raises(SceneError, match="number of takes must be at least 1"):
        next(iterate_sound_takes(None, 0))
    with pytest.raises(ReadError, match=r"test\.npz"):
        next(iterate_sound_takes(tmp_path, 1))
    monkeypatch.setattr(sound_takes, "read_performed_motions", lambda path: iter([swing(seconds=2.0)]))
    with pytest.raises(ReadError, match="8 s or longer"):
        next(iterate_sound_takes(tmp_path, 1))


@pytest.mark.skipif(not DATA.exists(), reason="CMU motion is not part of the repository")
def test_recordings_of_test_subjects_are_performed():
    ((name, truth),) = iterate_sound_takes(DATA, 1)
    assert name.startswith("02_")
    assert truth.marker_positions.shape[1:] == (41, 3)
    assert np.isfinite(truth.marker_positions).all()


MOTION = Path(__file__).resolve().parents[3] / "shared" / "data" / "cmu-motion"


@pytest.fixture
def motion(tmp_path):
    for name in ("01_01", "02_01", "05_03"):
        write_bvh_motion(tmp_path / f"{name}.bvh", draw_motion(int(name[:2])))
    return tmp_path


def remove_headings(rotations):
    rotations = rotations.copy()
    rotations[:, 0] = remove_heading(rotations[:, 0])
    return rotations


def test_subjects_are_test_subjects_of_all_shipped_priors():
    for path in find_shipped_folder("priors").glob("*.safetensors"):
        readers = {
            "twist": partial(read_yaml_model, settings.TwistSettings),
            "motion": partial(read_yaml_model, settings.MotionSettings),
            "ik": partial(read_yaml_model, settings.LearnedIkSettings),
            "contacts": partial(read_yaml_model, settings.ContactSettings),
        }
        training_settings = readers.get(path.stem, settings.read_prior_settings)(path.with_suffix(".yaml"))
        assert training_settings.test_subjects == sound_takes.UNSEEN_SUBJECTS
        assert not training_settings.held_out_subjects & sound_takes.UNSEEN_SUBJECTS


def test_poses_are_evenly_spaced_without_heading(motion):
    found = sound_takes.sample_subject_poses(motion, 1000)
    expected = remove_headings(np.concatenate([draw_motion(2), draw_motion(5)]))
    np.testing.assert_allclose(found, expected, atol=1e-6)
    np.testing.assert_allclose(sound_takes.sample_subject_poses(motion, 3), expected[[0, 23, 47]], atol=1e-6)


def test_folder_without_test_subjects_raises(motion):
    for name in ("02_01", "05_03"):
        (motion / f"{name}.bvh").unlink()
    with pytest.raises(ReadError, match="holds no motion of the test subjects 02, 05"):
        sound_takes.sample_subject_poses(motion, 10)


def write_unseen_poses(target, poses) -> None:
    """Write poses as `load_unseen_poses` reads them: ZYX Euler angles as integers."""
    angles = Rotation.from_matrix(poses.reshape(-1, 3, 3)).as_euler("ZYX").reshape(*poses.shape[:2], 3)
    np.savez_compressed(target, euler=np.round(angles * (sound_takes.HALF_TURN_STEPS / np.pi)).astype(np.int16))


def test_written_poses_are_read_back(tmp_path, monkeypatch):
    poses = draw_motion(7)
    write_unseen_poses(tmp_path / "poses.npz", poses)
    monkeypatch.setattr(sound_takes, "find_bench_file", lambda _: tmp_path / "poses.npz")
    np.testing.assert_allclose(sound_takes.load_unseen_poses(), poses, atol=2e-4)


def test_shipped_poses_are_upright_and_distinct():
    poses = sound_takes.load_unseen_poses()
    assert poses.shape == (1000, 31, 3, 3)
    np.testing.assert_allclose(poses @ np.swapaxes(poses, 2, 3), np.broadcast_to(np.eye(3), poses.shape), atol=1e-9)
    np.testing.assert_allclose(remove_heading(poses[:, 0]), poses[:, 0], atol=2e-3)
    assert len(np.unique(poses.round(3), axis=0)) > 990


@pytest.mark.skipif(not MOTION.is_dir(), reason="needs the CMU motion")
def test_shipped_poses_are_those_of_the_motion(tmp_path):
    for name in ("test.npz", "skeletons.json"):
        (tmp_path / name).symlink_to(MOTION / name)
    np.testing.assert_allclose(sound_takes.sample_subject_poses(tmp_path, 1000), sound_takes.load_unseen_poses(), atol=2e-4)
