"""Twists from different sources."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.lab import hybrik_tables, sound_takes
from mocapfix.lab.sound_takes import build_known_motion
from mocapfix.model.skeleton import load_cmu31_skeleton

JOINT_NAMES = load_cmu31_skeleton().names
SUBJECT = hybrik_tables.build_cmu41_subject()


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
