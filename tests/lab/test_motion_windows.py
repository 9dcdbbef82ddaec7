"""Training windows of the motion prior."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.errors import ReadError
from mocapfix.lab import motion_training
from mocapfix.solve.motion_prior import INNER_TOKENS, TOKEN_COUNT
from tests.lab.motion_files import draw_motion, write_bvh_motion


@pytest.fixture(scope="module")
def stretches(tmp_path_factory):
    folder = tmp_path_factory.mktemp("motion")
    for seed, name in enumerate(("01_01", "02_01", "14_01")):
        write_bvh_motion(folder / f"{name}.bvh", draw_motion(seed, frames=80, spread=0.2))
    return motion_training.gather_motion_stretches([folder], lambda subject: subject != "02", lambda text: None)


def test_only_wanted_subjects_are_gathered(stretches, tmp_path):
    assert stretches.count_frames() == {"01": 80, "14": 80}
    assert sum(stretches.count_source_frames().values()) == 160
    np.testing.assert_allclose(np.linalg.norm(stretches.quaternions, axis=-1), 1, atol=1e-5)
    write_bvh_motion(tmp_path / "01_01.bvh", draw_motion(0))
    with pytest.raises(ReadError, match="no motion of the required subjects"):
        motion_training.gather_motion_stretches([tmp_path], lambda subject: False, lambda text: None)


def test_joints_are_missing_inside_the_gap_and_known_before(stretches):
    weights = motion_training.compute_stretch_weights(stretches, 0.5)
    assert weights.sum() == pytest.approx(1)
    windows = motion_training.draw_training_windows(stretches, weights, 40, np.random.default_rng(0))
    assert windows.quaternions.shape[:2] == (40, TOKEN_COUNT)
    assert windows.is_known.any(axis=1).all()
    is_missing = ~windows.is_known[:, INNER_TOKENS]
    assert is_missing.any(axis=2).all()
    assert is_missing[windows.is_body_gap].all()
    assert 0.1 < windows.is_body_gap.mean() < 0.8
    assert not (windows.is_known & ~windows.is_inside[..., None]).any()


def test_sampling_at_whole_frames_returns_them(stretches):
    frames = np.array([[0.0, 5.0, 79.0]])
    quaternions, position = motion_training.sample_stretches(stretches, np.array([1]), frames)
    index = stretches.starts[1] + np.array([0, 5, 79])
    np.testing.assert_allclose(np.abs((quaternions[0] * stretches.quaternions[index]).sum(-1)), 1, atol=1e-5)
    np.testing.assert_allclose(position[0], stretches.position[index], atol=1e-5)


def test_motion_at_another_rate_is_resampled(tmp_path):
    slow = draw_motion(0, frames=41, spread=0.05)
    write_bvh_motion(tmp_path / "01_01.bvh", slow, rate=20.0)
    resampled = motion_training.gather_motion_stretches([tmp_path], lambda subject: True, lambda text: None)
    assert resampled.count_frames() == {"01": 61}  # 2 s
    joints = motion_training.build_motion_tree().joints
    expected = Rotation.from_matrix(slow[:, joints].reshape(-1, 3, 3)).as_quat().reshape(41, -1, 4)
    np.testing.assert_allclose(np.abs((resampled.quaternions[::3] * expected[::2]).sum(-1)), 1, atol=1e-4)


def test_mirroring_twice_changes_nothing(stretches):
    mirrored = motion_training.mirror_quaternions(stretches.quaternions)
    assert np.abs(mirrored - stretches.quaternions).max() > 0.01
    np.testing.assert_array_equal(motion_training.mirror_quaternions(mirrored), stretches.quaternions)


def test_varied_windows_are_slower_or_faster_and_turned_by_the_same_rotation_throughout(stretches):
    weights = motion_training.compute_stretch_weights(stretches, 0.5)

    def draw(*variation):
        return motion_training.draw_training_windows(stretches, weights, 40, np.random.default_rng(0), *variation)

    plain, turned, paced = draw(), draw(0.0, 0.1), draw(0.25)
    moved = turned.quaternions.reshape(-1, 4), plain.quaternions.reshape(-1, 4)
    turn = (Rotation.from_quat(moved[1]).inv() * Rotation.from_quat(moved[0])).as_rotvec().reshape(*plain.is_known.shape, 3)
    np.testing.assert_allclose(turn, np.broadcast_to(turn[:, :1], turn.shape), atol=1e-5)
    assert np.abs(turn[:, :, 0]).max() < 1e-5  # the root has its own directions
    assert turn[:, 0, 1:].std() == pytest.approx(0.1, rel=0.1)
    frames = paced.gap_s * motion_training.MOTION_RATE_HZ
    assert np.abs(frames - np.round(frames)).max() > 0.1  # those of recorded speed last for whole frames
    np.testing.assert_allclose(plain.gap_s * motion_training.MOTION_RATE_HZ % 1, 0, atol=1e-9)
