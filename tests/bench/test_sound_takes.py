"""The takes that faults are put into: composed without damage, and performed at the rate of a stage."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.bench import lost_limbs, sound_takes
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


def swinging(name="02_01", seconds=9.0, rate=30.0):
    """-> a performance that swings all joints about x and walks on, both smoothly"""
    t = np.arange(round(seconds * rate)) / rate
    angles = np.zeros((len(t), JOINTS, 3))
    angles[..., 0] = 0.3 * np.sin(2 * t)[:, None]
    rotations = Rotation.from_rotvec(angles.reshape(-1, 3)).as_matrix().reshape(len(t), JOINTS, 3, 3)
    return lost_limbs.PerformedMotion(
        lost_limbs.build_known_motion(np.stack([0 * t, 0.9 + 0 * t, 0.5 * t**2], 1), rotations), rate, name
    )


def test_a_composed_take_is_sound():
    ((name, truth),) = iterate_sound_takes(None, 1)
    assert name == "seed 0"
    assert not truth.missing_mask.any()
    assert not truth.spike_mask.any()
    np.testing.assert_array_equal(truth.damaged_positions, truth.marker_positions)


def test_a_performance_goes_on_between_its_frames_as_it_would():
    moves = resample_performance(swinging())
    t = np.arange(moves.frame_count) / SOUND_TAKE_RATE_HZ
    np.testing.assert_allclose(moves.root_position[:, 2], 0.5 * t**2, atol=1e-9)
    turned = Rotation.from_matrix(moves.local_rotations[:, 3]).as_rotvec()
    np.testing.assert_allclose(turned, np.outer(0.3 * np.sin(2 * t), [1, 0, 0]), atol=1e-3)


def test_a_long_performance_is_cut():
    assert (
        resample_performance(swinging(seconds=SOUND_TAKE_DURATION_S + 5)).frame_count
        <= SOUND_TAKE_DURATION_S * SOUND_TAKE_RATE_HZ
    )


def test_an_actors_markers_are_where_the_body_has_them_but_for_skin_and_noise():
    truth = perform_take(swinging(), np.random.default_rng(0))
    joints, markers = kinematics.compute_joint_and_marker_positions(truth.subject, truth.motion)
    np.testing.assert_allclose(truth.joint_positions, joints)
    assert 0.003 < (truth.marker_positions - markers).std() < 0.006
    assert truth.rate == SOUND_TAKE_RATE_HZ


def test_everybodys_longest_comes_first_and_what_is_short_not_at_all():
    lengths = {"02_01": 9.0, "02_02": 12.0, "05_01": 8.5, "06_01": 3.0}
    chosen = choose_performances([swinging(name, seconds) for name, seconds in lengths.items()], 9)
    assert [each.name for each in chosen] == ["02_02", "05_01", "02_01"]
    assert [each.name for each in choose_performances([swinging(name, seconds) for name, seconds in lengths.items()], 1)] == [
        "02_02"
    ]


def test_no_takes_and_no_motion_are_told(tmp_path, monkeypatch):
    with pytest.raises(SceneError, match="at least one take"):
        next(iterate_sound_takes(None, 0))
    with pytest.raises(ReadError, match=r"test\.npz"):
        next(iterate_sound_takes(tmp_path, 1))
    monkeypatch.setattr(sound_takes, "performed", lambda path: iter([swinging(seconds=2.0)]))
    with pytest.raises(ReadError, match="8 s or longer"):
        next(iterate_sound_takes(tmp_path, 1))


@pytest.mark.skipif(not DATA.exists(), reason="CMU motion is not part of the repository")
def test_the_recordings_of_the_test_people_are_performed():
    ((name, truth),) = iterate_sound_takes(DATA, 1)
    assert name.startswith("02_")
    assert truth.marker_positions.shape[1:] == (41, 3)
    assert np.isfinite(truth.marker_positions).all()
