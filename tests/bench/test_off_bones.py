"""What twists are worth: the order of their sources, and the errors by a known answer."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.bench import joint_noise, twists, unseen_poses
from mocapfix.bench.lost_limbs import build_known_motion

SUBJECT = joint_noise.build_cmu41_subject()
NAMES = SUBJECT.skeleton.names


@pytest.fixture(scope="module")
def said():
    return twists.measure_twist_sources(unseen_poses.load_unseen_poses()[::5], SUBJECT, lambda what: None)


def test_the_better_a_twist_is_known_the_nearer_come_the_markers(said):
    assert list(said) == ["random", "zero", "regressed", "noisy_markers", "markers"]
    far = [row["markers_mm"] for row in said.values()]
    assert far[0] > 3 * far[1]
    assert far[2] < 0.6 * far[1]
    assert far[3] < 0.8 * far[2]
    assert far[4] < 1


def test_twists_leave_joints_alone(said):
    for source in ("random", "zero", "regressed", "markers"):
        assert said[source]["joints_mm"] < 0.1


def test_random_twists_are_a_right_angle_off_and_zero_less(said):
    for joint in ("LeftArm", "RightLeg", "Neck"):
        assert 75 < said["random"]["twist_deg"][joint] < 105
        assert said["zero"]["twist_deg"][joint] < 45


def test_a_twisted_forearm_is_told_by_its_angle_and_the_markers_that_it_carries():
    true = build_known_motion(np.zeros((2, 3)), np.tile(np.eye(3), (2, len(NAMES), 1, 1)))
    arm, hand = NAMES.index("LeftForeArm"), NAMES.index("LeftHand")
    along = SUBJECT.skeleton.offsets[hand] / np.linalg.norm(SUBJECT.skeleton.offsets[hand])
    turned = true.local_rotations.copy()
    turned[1, arm] = Rotation.from_rotvec(0.6 * along).as_matrix()
    turned[1, hand] = turned[1, arm].T
    found = twists.compute_twist_source_errors(SUBJECT, build_known_motion(true.root_position, turned), true)
    assert found["joints_mm"] == pytest.approx(0, abs=1e-9)
    assert found["twist_deg"]["LeftForeArm"] == pytest.approx(np.degrees(0.6) / 2)
    assert found["twist_deg"]["LeftHand"] == found["twist_deg"]["LeftArm"] == pytest.approx(0, abs=1e-6)
    places = SUBJECT.marker_offsets[SUBJECT.joints == arm]
    off = np.linalg.norm(places - np.outer(places @ along, along), axis=1)
    moved = 2 * np.sin(0.3) * off.sum()
    assert found["markers_mm"] == pytest.approx(1e3 * moved / (2 * len(SUBJECT.joints)))
    assert "Hips" not in found["twist_deg"]
