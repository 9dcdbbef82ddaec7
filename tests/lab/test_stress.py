"""The stress test of extreme motion: its scores with known answers, and takes that are cleaned without losing a limb."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mocapfix.errors import ReadError
from mocapfix.lab import stress
from mocapfix.lab.uncertainty import clean_composed_take
from mocapfix.model.motion import FrameStatus
from mocapfix.synthetic import compose_take
from tests.lab.test_sound_takes import swing


@pytest.fixture(scope="module")
def truth():
    return compose_take(seed=1, seconds=2.0, rate=50.0)


def build_result(truth, joints, *, sample_sd=None, status=None, lost=None) -> Any:
    """Return what the score reads of a result."""
    return SimpleNamespace(
        report={"solve": {"lost_in_sight": lost or {}}},
        motion=replace(truth.motion, status=np.zeros(len(joints), int) if status is None else status),
        joint_position_world=joints,
        take=SimpleNamespace(sample_sd=sample_sd),
    )


def test_errors_changes_and_poor_frames_are_counted(truth):
    joints = truth.joint_positions + [0.003, 0.0, 0.004]
    sample_sd = np.full(truth.missing_mask.shape, np.nan)
    sample_sd[truth.missing_mask] = 0.01  # a filled gap is no changed sample
    seen = np.argwhere(~truth.missing_mask)
    for frame, marker in seen[:5]:
        sample_sd[frame, marker] = 0.01
    status = np.zeros(len(joints), int)
    status[3:6] = FrameStatus.POOR_FIT
    scores = stress.score_stress_take(
        truth, build_result(truth, joints, sample_sd=sample_sd, status=status, lost={"left arm": 2, "head": 1})
    )
    assert scores["joint_error_mm"] == pytest.approx(5.0)
    assert scores["limb_error_mm"] == pytest.approx(5.0)
    assert scores["changed_samples"] == 5
    assert scores["changed_share"] == pytest.approx(5 / len(seen))
    assert scores["poor_frames"] == 3
    assert scores["lost_frames"] == 3


def test_only_limbs_with_all_their_markers_seen_are_compared_by_their_largest_error(truth):
    skeleton = truth.subject.skeleton
    error_m = np.full((len(truth.joint_positions), len(skeleton.names)), 0.01)
    error_m[10, skeleton.find_joint("LeftHand")] = 0.5
    error_m[20, skeleton.find_joint("RightToeBase")] = 0.3
    error_m[30, skeleton.find_joint("LeftHandIndex1")] = 0.9  # no marker turns it
    whole = replace(truth, missing_mask=np.zeros_like(truth.missing_mask))
    assert stress.find_worst_limb(whole, error_m) == (0.5, "left arm", 10)
    missing = np.zeros_like(truth.missing_mask)
    missing[10, truth.labels.index("LFIN")] = True
    assert stress.find_worst_limb(replace(truth, missing_mask=missing), error_m) == (0.3, "right leg", 20)


def test_every_scored_joint_belongs_to_one_limb(truth):
    names = [name for joints in stress.LIMBS_WITH_JOINTS.values() for name in joints]
    assert len(names) == len(set(names))
    thumbs_and_stubs = {"LThumb", "RThumb", "LHipJoint", "RHipJoint"}
    assert set(truth.subject.skeleton.names) - set(names) == thumbs_and_stubs | set(stress.UNOBSERVED_JOINTS)
    carriers = {truth.subject.skeleton.names[j] for j in truth.subject.joints}
    assert carriers <= set(names)


def build_row(error_mm, *, kind="composed", ordinary=False, lost=0, limb_mm=20.0):
    row = {"kind": kind, "ordinary": ordinary, "joint_error_mm": error_mm, "lost_frames": lost, "limb_error_mm": limb_mm}
    return row | {"over_ordinary": error_mm / 10, "changed_share": 0.001, "poor_frames": 1}


def test_limits_hold_for_extreme_motion_only():
    totals = stress.summarise_stress([build_row(10, ordinary=True, lost=9, limb_mm=500), build_row(12), build_row(16)])
    assert totals["lost_frames"] == 0
    assert totals["over_ordinary"] == pytest.approx(1.4)
    assert totals["limb_error_mm"] == 20
    assert totals["within_limits"]
    assert not stress.summarise_stress([build_row(12, lost=1)])["within_limits"]
    assert not stress.summarise_stress([build_row(12, limb_mm=101)])["within_limits"]
    assert not stress.summarise_stress([build_row(15.1)])["within_limits"]


def test_a_recording_is_cut_about_its_fastest_frame():
    recording = swing(seconds=30.0)  # its root is faster and faster
    speeds = stress.compute_marker_speeds(recording, stress.build_full_marker_subject())
    fastest = int(speeds.argmax())
    assert fastest > 0.9 * len(speeds)
    part = stress.cut_around(recording, fastest)
    assert stress.get_duration_s(part) == stress.MAX_STRESS_RECORDING_S
    np.testing.assert_array_equal(part.motion.root_position[-1], recording.motion.root_position[-1])
    middle = stress.cut_around(recording, 450)
    np.testing.assert_array_equal(middle.motion.root_position[180], recording.motion.root_position[450])


def test_a_folder_without_motion_is_an_error_and_none_a_reason(tmp_path, monkeypatch):
    with pytest.raises(ReadError, match=r"test\.npz"):
        stress.measure_stress([tmp_path], motions=())
    clean = clean_perfectly_by_name({})
    monkeypatch.setattr(stress, "clean_composed_take", clean)
    monkeypatch.setattr(stress, "ORDINARY_SEEDS", range(1))
    names: list[str] = []
    results = stress.measure_stress((), ("punch",), (60.0,), names.append)
    assert [row["name"] for row in results["takes"]][-4:] == [
        "punch, 60 Hz",
        "punch, 60 Hz, slender",
        "punch, 120 Hz, slender",
        "punch, 120 Hz, gaps",
    ]
    assert len(names) == len(results["takes"]) == 2 * len(stress.ORDINARY_SEEDS) + 4
    assert "--data" in results["skipped"]
    assert results["ordinary_mm"] == {"composed": pytest.approx(5.0), "slender": pytest.approx(5.0)}
    assert results["all"]["over_ordinary"] == pytest.approx(1.0)
    assert results["all"]["within_limits"]


def clean_perfectly_by_name(lost):
    """Return a cleaning whose joints lie 5 mm from the truth."""
    return lambda truth: build_result(truth, truth.joint_positions + [0.003, 0.004, 0.0], lost=lost)


@pytest.mark.parametrize(
    ("motion", "seed", "rate", "is_slender"),
    [("punch", 0, 120.0, False), ("kick", 0, 60.0, False), ("arm circle", 3, 60.0, True)],
)
def test_no_limb_is_lost_in_a_strike(motion, seed, rate, is_slender):
    truth = stress.compose_extreme_take(motion, seed, rate, with_soft_tissue=is_slender, with_slender_limbs=is_slender)
    scores = stress.score_stress_take(truth, clean_composed_take(truth))
    assert scores["lost_in_sight"] == {}
    assert scores["limb_error_mm"] < 1e3 * stress.MAX_LIMB_ERROR_M
    assert scores["joint_error_mm"] < 25
    assert scores["poor_frames"] == 0
