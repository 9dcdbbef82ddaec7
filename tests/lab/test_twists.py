"""Twists from different sources, and the distribution of bone twists with its figure."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.errors import ReadError
from mocapfix.lab import hands, hybrik_tables, sound_takes
from mocapfix.lab.common_task import build_known_motion
from mocapfix.model.skeleton import load_cmu31_skeleton
from tests.lab.motion_files import write_bvh_motion

JOINT_NAMES = load_cmu31_skeleton().names
SUBJECT = hybrik_tables.build_cmu41_subject()


@pytest.fixture
def motion(tmp_path):
    """Return a folder of a motion whose left arm twists from 0 to 60 degrees and whose thigh swings."""
    rotations = np.tile(np.eye(3), (102, 31, 1, 1))  # the first frame is the T-pose, as in CMU's
    angles = np.append(0, np.linspace(0, 60, 101) + 1e-4)[:, None]  # only the T-pose has angles of whole degrees
    rotations[:, JOINT_NAMES.index("LeftArm")] = Rotation.from_euler("x", angles, degrees=True).as_matrix()
    bone = load_cmu31_skeleton().offsets[JOINT_NAMES.index("RightLeg")]
    across = np.cross(bone, [0, 0, 1]) / np.linalg.norm(np.cross(bone, [0, 0, 1]))
    rotations[:, JOINT_NAMES.index("RightUpLeg")] = Rotation.from_rotvec(np.radians(angles) * across).as_matrix()
    write_bvh_motion(tmp_path / "01_01.bvh", rotations)
    return tmp_path


def test_percentiles_are_of_twists_in_degrees(motion):
    percentiles = hybrik_tables.compute_twist_distribution(motion)
    assert len(percentiles) == 23
    np.testing.assert_allclose(percentiles.pop("LeftArm"), [0.6, 15, 30, 45, 59.4], atol=1e-3)
    np.testing.assert_allclose(list(percentiles.values()), 0, atol=1e-3)


def test_frames_beyond_a_jump_are_skipped(motion):
    rotations = np.tile(np.eye(3), (30, 31, 1, 1))
    rotations[20:, JOINT_NAMES.index("RightHand")] = Rotation.from_euler("x", 170, degrees=True).as_matrix()
    (motion / "01_01.bvh").unlink()
    write_bvh_motion(motion / "01_02.bvh", rotations)
    np.testing.assert_allclose(hybrik_tables.compute_twist_distribution(motion)["RightHand"], 0, atol=1e-3)


def test_folder_without_motion_raises(tmp_path):
    with pytest.raises(ReadError, match="holds no motion"):
        hybrik_tables.compute_twist_distribution(tmp_path)


def test_figure_is_drawn(motion, tmp_path):
    hands.draw_twists(tmp_path / "twists.png", hybrik_tables.compute_twist_distribution(motion))
    assert (tmp_path / "twists.png").read_bytes().startswith(b"\x89PNG\r\n")


def test_sides_share_a_row():
    sides = {name: hands.split_side(name) for name in ("LHipJoint", "RightLeg", "LeftLeg", "LowerBack", "RThumb")}
    assert sides == {
        "LHipJoint": ("left", "HipJoint"),
        "RightLeg": ("right", "Leg"),
        "LeftLeg": ("left", "Leg"),
        "LowerBack": ("middle", "LowerBack"),
        "RThumb": ("right", "Thumb"),
    }


@pytest.fixture(scope="module")
def results():
    return hybrik_tables.measure_twist_sources(sound_takes.load_unseen_poses()[::5], SUBJECT, lambda text: None)


def test_better_twists_reduce_marker_errors(results):
    assert list(results) == ["random", "zero", "regressed", "noisy_markers", "markers"]
    far = [row["markers_mm"] for row in results.values()]
    assert far[0] > 3 * far[1]
    assert far[2] < 0.6 * far[1]
    assert far[3] < 0.8 * far[2]
    assert far[4] < 1


def test_twists_do_not_change_joint_errors(results):
    for source in ("random", "zero", "regressed", "markers"):
        assert results[source]["joints_mm"] < 0.1


def test_random_twists_have_a_mean_error_of_a_right_angle(results):
    for joint in ("LeftArm", "RightLeg", "Neck"):
        assert 75 < results["random"]["twist_deg"][joint] < 105
        assert results["zero"]["twist_deg"][joint] < 45


def test_twisted_forearm_has_its_angle_and_marker_errors():
    true = build_known_motion(np.zeros((2, 3)), np.tile(np.eye(3), (2, len(JOINT_NAMES), 1, 1)))
    arm, hand = JOINT_NAMES.index("LeftForeArm"), JOINT_NAMES.index("LeftHand")
    direction = SUBJECT.skeleton.offsets[hand] / np.linalg.norm(SUBJECT.skeleton.offsets[hand])
    rotations = true.local_rotations.copy()
    rotations[1, arm] = Rotation.from_rotvec(0.6 * direction).as_matrix()
    rotations[1, hand] = rotations[1, arm].T
    errors = hybrik_tables.compute_twist_source_errors(SUBJECT, build_known_motion(true.root_position, rotations), true)
    assert errors["joints_mm"] == pytest.approx(0, abs=1e-9)
    assert errors["twist_deg"]["LeftForeArm"] == pytest.approx(np.degrees(0.6) / 2)
    assert errors["twist_deg"]["LeftHand"] == errors["twist_deg"]["LeftArm"] == pytest.approx(0, abs=1e-6)
    places = SUBJECT.marker_offsets[SUBJECT.joints == arm]
    off = np.linalg.norm(places - np.outer(places @ direction, direction), axis=1)
    moved = 2 * np.sin(0.3) * off.sum()
    assert errors["markers_mm"] == pytest.approx(1e3 * moved / (2 * len(SUBJECT.joints)))
    assert "Hips" not in errors["twist_deg"]
