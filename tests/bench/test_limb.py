"""The benchmark of lost limbs: gaps at known places, ways with known answers."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.bench import lost_limbs as limb
from mocapfix.bench import lost_limbs as limb_ways
from mocapfix.errors import ReadError
from mocapfix.pose_prior import io
from mocapfix.skeleton import load_cmu31_body
from mocapfix.solve import kinematics

SKELETON = load_cmu31_body().skeleton
ARM = np.array([SKELETON.find_joint(name) for name in ("LeftArm", "LeftForeArm", "LeftHand")])
RATE = 30.0


def turning(frames, joint=None, speed=0.7):
    """-> a motion in which one joint turns evenly"""
    rotations = np.tile(np.eye(3), (frames, len(SKELETON.names), 1, 1))
    if joint is not None:
        rotations[:, joint] = Rotation.from_euler("x", speed * np.arange(frames)[:, None] / RATE).as_matrix()
    return limb.build_known_motion(np.tile([0.0, 0.9, 0.0], (frames, 1)), rotations)


def ways(found, model=None):
    return dict(limb_ways.fill_limb_gap(found, ARM, 20, 39, RATE, model))


def test_a_joint_that_turns_evenly_is_put_back_exactly():
    truth = turning(60, ARM[0])
    spoiled = turning(60, ARM[0])
    spoiled.local_rotations[20:40, ARM[0]] = np.eye(3)
    for way, found in ways(spoiled).items():
        np.testing.assert_allclose(found.local_rotations, truth.local_rotations, atol=1e-9, err_msg=way)


def test_a_model_is_right_at_both_edges_when_it_is_corrected_there():
    found = turning(60, ARM[0], speed=0.4)
    by_way = ways(found, io.load_pose_model("gaussian", SKELETON))
    alone, corrected = by_way["model, each frame alone"], by_way["model, corrected at both edges"]

    def off(motion, frame):
        turn = motion.rotations[frame, ARM[0]].T @ found.local_rotations[frame, ARM[0]]
        return Rotation.from_matrix(turn).magnitude()

    for frame in (20, 39):
        assert off(corrected, frame) < 0.1 * off(alone, frame)


def test_gaps_lie_where_enough_is_seen_on_either_side_and_begin_everywhere():
    performances = [limb.PerformedMotion(turning(frames), RATE, "walk") for frames in (40, 20, 60)]
    gaps = limb.draw_limb_gaps(performances, 0.5, 2000, np.random.default_rng(0))
    around = round(limb.MIN_CONTEXT_S * RATE)
    for gap in gaps:
        assert gap.first >= around
        assert gap.last - gap.first == 14
        assert gap.last <= gap.performance.motion.frame_count - around
    begins = {(gap.performance.motion.frame_count, gap.first) for gap in gaps}
    assert begins == {(40, first) for first in (12,)} | {(60, first) for first in range(12, 33)}
    assert {gap.side for gap in gaps} == {"Left", "Right"}


@pytest.mark.parametrize("name", ["arm", "leg"])
def test_only_what_the_limb_carries_is_struck(name):
    subject = limb.build_full_marker_subject()
    gap = limb.LimbGap(limb.PerformedMotion(turning(40), RATE, "walk"), "Right", 12, 26)
    seen = limb.remove_limb_markers(gap, name, subject).visible
    assert seen[:12].all()
    assert seen[27:].all()
    struck = {label for label, there in zip(subject.labels, seen[20], strict=True) if not there}
    assert struck == {
        "arm": {"RUPA", "RELB", "RFRM", "RWRA", "RWRB", "RFIN", "RightForeArm", "RightHand", "RightFingerBase", "RightHandIndex1",
                "RThumb"},
        "leg": {"RTHI", "RKNE", "RSHN", "RANK", "RHEE", "RTOE", "RMT5", "RightLeg", "RightFoot", "RightToeBase"},
    }[name]  # fmt: skip


def test_a_marker_on_every_joint_lies_there():
    motion = turning(2, ARM[0], speed=20.0)
    joints, markers = kinematics.compute_joint_and_marker_positions(limb.build_full_marker_subject(), motion)
    np.testing.assert_allclose(markers[:, -len(SKELETON.names) :], joints, atol=1e-12)


def test_errors_are_those_of_the_lost_joints_in_the_gap():
    truth, found = turning(40), turning(40)
    gap = limb.LimbGap(limb.PerformedMotion(truth, RATE, "walk"), "Left", 10, 19)
    assert limb.compute_limb_error(gap, "arm", found) == 0
    found.root_position[:10] += 5.0  # not in the gap
    assert limb.compute_limb_error(gap, "arm", found) == 0
    found.root_position[10:20, 0] += 0.02
    assert limb.compute_limb_error(gap, "arm", found) == pytest.approx(0.02)


def test_a_shard_of_people_is_measured_by_limb_seconds_and_way(tmp_path):
    time = np.arange(150) / RATE
    euler = np.zeros((150, 31, 3), np.int16)
    for name, phase in (("LeftArm", 0), ("RightArm", 0), ("LeftUpLeg", 2), ("RightUpLeg", 2)):
        euler[:, SKELETON.find_joint(name), 2] = 32767 / 180 * 20 * np.sin(3 * time + phase)
    root = np.tile([0.0, 17.0, 0.0], (150, 1)).astype(np.float32)
    np.savez(tmp_path / "test.npz", euler=euler, root=root, trial=np.array(["02_01"]), start=np.array([0]))
    (tmp_path / "skeletons.json").write_text(json.dumps({"joints": SKELETON.names}))
    told = []
    said = limb.measure_lost_limbs(tmp_path, None, gap_count=1, progress=told.append)
    assert set(said) == {"arm", "leg", "ways"}
    assert set(said["ways"]) == {"slerp", "cubic"}
    for table in (said, *said["ways"].values()):
        for name in ("arm", "leg"):
            assert set(table[name]) == {"0.5", "1", "2"}
            assert all(0 < mm < 400 for mm in table[name].values())
    assert said["leg"]["0.5"] < said["ways"]["slerp"]["leg"]["0.5"]
    assert told[0] == "arm lost for 0.5 s, 1 of 1"
    with pytest.raises(ReadError, match="is no shard of motion"):
        limb.measure_lost_limbs(tmp_path / "elsewhere", None, gap_count=1)
