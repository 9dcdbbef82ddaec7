"""The takes that faults are put into: composed without damage, and performed at the rate of a stage."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.bench import limb, sound_takes
from mocapfix.bench.sound_takes import RATE, SECONDS, acted, faster, of_everybody, sound
from mocapfix.errors import ReadError, SceneError
from mocapfix.kernels import kinematics
from mocapfix.skeleton import cmu31

DATA = Path(__file__).resolve().parents[3] / "shared" / "data" / "cmu-motion"
JOINTS = len(cmu31().skeleton.names)


def swinging(name="02_01", seconds=9.0, rate=30.0):
    """-> a performance that swings all joints about x and walks on, both smoothly"""
    t = np.arange(round(seconds * rate)) / rate
    angles = np.zeros((len(t), JOINTS, 3))
    angles[..., 0] = 0.3 * np.sin(2 * t)[:, None]
    rotations = Rotation.from_rotvec(angles.reshape(-1, 3)).as_matrix().reshape(len(t), JOINTS, 3, 3)
    return limb.Performance(limb.motion(np.stack([0 * t, 0.9 + 0 * t, 0.5 * t**2], 1), rotations), rate, name)


def test_a_composed_take_is_sound():
    ((name, truth),) = sound(None, 1)
    assert name == "seed 0"
    assert not truth.struck.any()
    assert not truth.moved.any()
    np.testing.assert_array_equal(truth.damaged, truth.markers)


def test_a_performance_goes_on_between_its_frames_as_it_would():
    moves = faster(swinging())
    t = np.arange(moves.frames) / RATE
    np.testing.assert_allclose(moves.root[:, 2], 0.5 * t**2, atol=1e-9)
    turned = Rotation.from_matrix(moves.rotations[:, 3]).as_rotvec()
    np.testing.assert_allclose(turned, np.outer(0.3 * np.sin(2 * t), [1, 0, 0]), atol=1e-3)


def test_a_long_performance_is_cut():
    assert faster(swinging(seconds=SECONDS + 5)).frames <= SECONDS * RATE


def test_an_actors_markers_are_where_the_body_has_them_but_for_skin_and_noise():
    truth = acted(swinging(), np.random.default_rng(0))
    joints, markers = kinematics.placed(truth.subject, truth.motion)
    np.testing.assert_allclose(truth.joints, joints)
    assert 0.003 < (truth.markers - markers).std() < 0.006
    assert truth.rate == RATE


def test_everybodys_longest_comes_first_and_what_is_short_not_at_all():
    lengths = {"02_01": 9.0, "02_02": 12.0, "05_01": 8.5, "06_01": 3.0}
    chosen = of_everybody([swinging(name, seconds) for name, seconds in lengths.items()], 9)
    assert [each.name for each in chosen] == ["02_02", "05_01", "02_01"]
    assert [each.name for each in of_everybody([swinging(name, seconds) for name, seconds in lengths.items()], 1)] == ["02_02"]


def test_no_takes_and_no_motion_are_told(tmp_path, monkeypatch):
    with pytest.raises(SceneError, match="at least one take"):
        next(sound(None, 0))
    with pytest.raises(ReadError, match=r"test\.npz"):
        next(sound(tmp_path, 1))
    monkeypatch.setattr(sound_takes, "performed", lambda path: iter([swinging(seconds=2.0)]))
    with pytest.raises(ReadError, match="8 s or longer"):
        next(sound(tmp_path, 1))


@pytest.mark.skipif(not DATA.exists(), reason="CMU motion is not part of the repository")
def test_the_recordings_of_the_test_people_are_performed():
    ((name, truth),) = sound(DATA, 1)
    assert name.startswith("02_")
    assert truth.markers.shape[1:] == (41, 3)
    assert np.isfinite(truth.markers).all()
