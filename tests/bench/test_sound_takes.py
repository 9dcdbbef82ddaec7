"""Takes for the injection of faults: composed without damage, and performed at the rate of a capture system."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.bench import sound_takes
from mocapfix.bench.common_task import build_known_motion
from mocapfix.bench.sound_takes import (
    SOUND_TAKE_DURATION_S,
    SOUND_TAKE_RATE_HZ,
    choose_performances,
    iterate_sound_takes,
    perform_take,
    resample_performance,
)
from mocapfix.errors import ReadError, SceneError
from mocapfix.skeleton import load_cmu31_body
from mocapfix.solve import kinematics

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
