"""The benchmark of lost limbs: gaps at known frames, methods with known results."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.errors import ReadError
from mocapfix.lab import lost_limbs
from mocapfix.lab.sound_takes import PerformedMotion, build_known_motion
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.solve import kinematics

SKELETON = load_cmu31_body().skeleton
RATE_HZ = 30.0


def rotate_evenly(frames, joint=None, speed=0.7):
    """Return a motion in which one joint rotates at constant speed."""
    rotations = np.tile(np.eye(3), (frames, len(SKELETON.names), 1, 1))
    if joint is not None:
        rotations[:, joint] = Rotation.from_euler("x", speed * np.arange(frames)[:, None] / RATE_HZ).as_matrix()
    return build_known_motion(np.tile([0.0, 0.9, 0.0], (frames, 1)), rotations)


def test_gaps_have_context_and_uniform_starts():
    performances = [PerformedMotion(rotate_evenly(frames), RATE_HZ, "walk") for frames in (40, 20, 60)]
    gaps = lost_limbs.draw_limb_gaps(performances, 0.5, 2000, np.random.default_rng(0))
    around = round(lost_limbs.MIN_CONTEXT_S * RATE_HZ)
    for gap in gaps:
        assert gap.first >= around
        assert gap.last - gap.first == 14
        assert gap.last <= gap.performance.motion.frame_count - around
    begins = {(gap.performance.motion.frame_count, gap.first) for gap in gaps}
    assert begins == {(40, first) for first in (12,)} | {(60, first) for first in range(12, 33)}
    assert {gap.side for gap in gaps} == {"Left", "Right"}


@pytest.mark.parametrize("name", ["arm", "leg"])
def test_only_markers_of_the_limb_are_missing(name):
    subject = lost_limbs.build_full_marker_subject()
    gap = lost_limbs.LimbGap(PerformedMotion(rotate_evenly(40), RATE_HZ, "walk"), "Right", 12, 26)
    visible = lost_limbs.remove_limb_markers(gap, name, subject).visible
    assert visible[:12].all()
    assert visible[27:].all()
    missing = {label for label, there in zip(subject.labels, visible[20], strict=True) if not there}
    assert missing == {
        "arm": {"RUPA", "RELB", "RFRM", "RWRA", "RWRB", "RFIN", "RightForeArm", "RightHand", "RightFingerBase", "RightHandIndex1",
                "RThumb"},
        "leg": {"RTHI", "RKNE", "RSHN", "RANK", "RHEE", "RTOE", "RMT5", "RightLeg", "RightFoot", "RightToeBase"},
    }[name]  # fmt: skip


def test_every_joint_has_a_marker():
    motion = rotate_evenly(2, SKELETON.find_joint("LeftArm"), speed=20.0)
    joints, markers = kinematics.compute_joint_and_marker_positions(lost_limbs.build_full_marker_subject(), motion)
    np.testing.assert_allclose(markers[:, -len(SKELETON.names) :], joints, atol=1e-12)


def test_errors_are_of_the_lost_joints_in_the_gap():
    truth, found = rotate_evenly(40), rotate_evenly(40)
    gap = lost_limbs.LimbGap(PerformedMotion(truth, RATE_HZ, "walk"), "Left", 10, 19)
    assert lost_limbs.compute_limb_error(gap, "arm", found) == 0
    found.root_position[:10] += 5.0  # not in the gap
    assert lost_limbs.compute_limb_error(gap, "arm", found) == 0
    found.root_position[10:20, 0] += 0.02
    assert lost_limbs.compute_limb_error(gap, "arm", found) == pytest.approx(0.02)


def test_shard_is_measured_by_limb_duration_and_method(tmp_path):
    time = np.arange(150) / RATE_HZ
    euler = np.zeros((150, 31, 3), np.int16)
    for name, phase in (("LeftArm", 0), ("RightArm", 0), ("LeftUpLeg", 2), ("RightUpLeg", 2)):
        euler[:, SKELETON.find_joint(name), 2] = 32767 / 180 * 20 * np.sin(3 * time + phase)
    root = np.tile([0.0, 17.0, 0.0], (150, 1)).astype(np.float32)
    np.savez(tmp_path / "test.npz", euler=euler, root=root, trial=np.array(["02_01"]), start=np.array([0]))
    (tmp_path / "skeletons.json").write_text(json.dumps({"joints": SKELETON.names}), encoding="utf-8")
    messages = []
    results = lost_limbs.measure_lost_limbs(tmp_path, None, gap_count=1, progress=messages.append)
    assert set(results) == {"arm", "leg", "ways"}
    assert not results["ways"]  # there is no model
    for name in ("arm", "leg"):
        assert set(results[name]) == {"0.5", "1", "2"}
        assert all(0 < mm < 400 for mm in results[name].values())
    assert messages[0] == "arm lost for 0.5 s, 1 of 1"
    with pytest.raises(ReadError, match="is not a shard of motion"):
        lost_limbs.measure_lost_limbs(tmp_path / "elsewhere", None, gap_count=1)
