"""Starts compared: what is lost of a take, what counts as wrong, and a start that is wrong everywhere."""

import json
from dataclasses import replace

import numpy as np
import pytest

from mocapfix import synthetic
from mocapfix.bench import initialisation, initialisation_outcomes, initialisation_takes, lost_limbs
from mocapfix.bench.initialisation_outcomes import (
    SolveEnd,
    build_start_motion,
    find_observed_joints,
    find_wrong_frames,
    has_distant_joint,
)
from mocapfix.bench.initialisation_takes import InitialisationTake
from mocapfix.errors import ReadError
from mocapfix.skeleton import load_cmu31_body
from mocapfix.synthetic import SyntheticTake
from mocapfix.take import Take
from tests.conftest import as_c3d

NAMES = load_cmu31_body().skeleton.names
KEYS = {
    "frames", "wrong", "astray", "wrong_alone", "unconverged", "iterations", "iterations_alone", "start_markers_mm",
    "start_joints_mm", "start_seconds", "seconds", "wrong_in",
}  # fmt: skip


@pytest.fixture(scope="module")
def truth() -> SyntheticTake:
    return synthetic.compose_take(seed=5, seconds=1.5)


@pytest.fixture(scope="module")
def case(truth):
    """-> a take whose body is the true one"""
    return InitialisationTake("walk", Take(truth.markers, truth.labels, truth.rate), truth.subject, truth.joints, truth.motion)


def sound(case):
    return initialisation.start_from_markers(case, "registration")


def on_the_moon(case):
    """-> a start 10 km up: from there no marker is heard"""
    start = sound(case)
    return replace(start, root_position=start.root_position + [0.0, 1e4, 0.0])


def upside_down(case):
    start = sound(case)
    turned = start.local_rotations.copy()
    turned[:, 0] = np.diag([1.0, -1.0, -1.0]) @ turned[:, 0]
    return replace(start, local_rotations=turned)


@pytest.fixture(scope="module")
def said(case):
    ways = {"sound": sound, "upside down": upside_down, "moon": on_the_moon}
    return initialisation.compare_starts([case], ways, repeats=1)


def test_a_start_that_leads_nowhere_is_counted_in_every_frame(case, said):
    assert set(said) == {"truth", "sound", "upside down", "moon"}
    for row in said.values():
        assert set(row) == KEYS
        assert row["frames"] == case.worn.frame_count
        assert 0 < row["start_seconds"] < row["seconds"]
        assert row["astray"] == row["wrong"]  # from the truth all ends right
    assert (said["sound"]["wrong"], said["sound"]["wrong_alone"], said["sound"]["wrong_in"]) == (0, 0, {})
    assert said["moon"]["wrong"] == said["moon"]["wrong_alone"] == case.worn.frame_count
    assert said["moon"]["wrong_in"] == {"walk": case.worn.frame_count}
    json.dumps(said, allow_nan=False)


def test_what_ends_wrong_from_the_truth_too_is_no_starts_fault(case):
    joints = case.joints.copy()
    joints[5:8] += [0.0, 0.5, 0.0]  # elsewhere than the markers say
    said = initialisation.compare_starts([case._replace(joints=joints)], {"sound": sound}, repeats=1)
    assert {name: (row["wrong"], row["astray"]) for name, row in said.items()} == {"truth": (3, 0), "sound": (3, 0)}


def test_where_a_start_lies_and_what_it_costs_is_told(said):
    near, turned, moon = said["sound"], said["upside down"], said["moon"]
    assert said["truth"]["start_joints_mm"] < 1e-6
    assert 1.0 < near["start_joints_mm"] < 50.0
    assert 500.0 < turned["start_joints_mm"] < 2000.0
    assert turned["iterations_alone"] > near["iterations_alone"] + 2
    assert 0 < turned["wrong"] < turned["frames"]  # the solve turns him back, but not from everywhere
    for name in ("start_joints_mm", "start_markers_mm"):
        assert moon[name] == pytest.approx(1e7, rel=1e-3)


def test_a_start_goes_on_from_where_the_frame_before_ended(truth):
    root, local = truth.motion.root_position, truth.motion.rotations
    start = replace(truth.motion, root_position=root.copy(), rotations=local + 1.0)
    start.root_position[2:4] = np.nan
    found = build_start_motion(start, root, local)
    np.testing.assert_array_equal(found.root_position[:6], root[[0, 1, 1, 2, 4, 5]])
    np.testing.assert_array_equal(found.local_rotations[2:4], local[1:3])
    np.testing.assert_array_equal(found.local_rotations[4:], start.rotations[4:])


def test_the_truth_says_what_is_wrong_but_only_of_joints_that_markers_tell_of(truth, case):
    joints, hand = truth.joints.copy(), NAMES.index("LeftHandIndex1")
    joints[3, hand] += [0.0, 0.101, 0.0]
    joints[4, hand] += [0.0, 0.099, 0.0]
    end = SolveEnd(joints, np.zeros(len(joints)), np.zeros(len(joints), int))
    assert np.flatnonzero(find_wrong_frames(case, {"": end})[""]).tolist() == [3]
    markers = case.worn.markers.copy()
    markers[3, [label.startswith(("LFRM", "LWR", "LFIN")) for label in case.worn.labels]] = np.nan
    unseen = case._replace(worn=case.worn.replace_markers(markers))
    assert not find_observed_joints(unseen)[3, hand]
    assert find_observed_joints(unseen)[3, NAMES.index("LeftFoot")]
    assert not find_wrong_frames(unseen, {"": end})[""].any()


def test_where_nobody_knows_the_truth_the_pose_that_costs_least_stands_for_it(truth, case):
    """Frame 0: alike. 1: the other is far off, and costs more. 2: the one is. 3: far off, but as good."""
    unknown, frames = case._replace(joints=None), len(truth.joints)
    aside, none = truth.joints.copy(), np.zeros(frames, int)
    aside[1:4] += [0.5, 0.0, 0.0]
    costs = np.zeros((2, frames))
    costs[1, 1], costs[0, 2], costs[1, 3] = 5.0, 5.0, 0.5 * initialisation_outcomes.MAX_EQUAL_COST_DIFFERENCE
    found = find_wrong_frames(unknown, {"one": SolveEnd(truth.joints, costs[0], none), "other": SolveEnd(aside, costs[1], none)})
    assert np.flatnonzero(found["one"]).tolist() == [2]
    assert np.flatnonzero(found["other"]).tolist() == [1]


def test_far_is_a_tenth_of_a_metre():
    joints, told = np.zeros((1, 2, 3)), np.array([[True, False]])
    assert not has_distant_joint(joints, joints + [0.09, 0.0, 0.0], told).any()
    assert has_distant_joint(joints, joints + [0.11, 0.0, 0.0], told).all()
    assert not has_distant_joint(joints, joints + [0.11, 0.0, 0.0], ~told & False).any()


def test_what_is_lost_is_lost_as_it_is_said(case):
    gone = {name: lost(case, np.random.default_rng(1)) for name, lost in initialisation_takes.MARKER_LOSSES.items()}
    on, half = case.subject.joints, round(initialisation_takes.GROUP_LOSS_DURATION_S * case.worn.rate)
    assert initialisation_takes.SINGLE_GAP_SHARE <= gone["gaps"].mean() < 0.2
    for name in ("a segment lost", "the pelvis lost"):
        carriers = {tuple(np.unique(on[lost])) for lost in gone[name] if lost.any()}
        assert all(len(each) == 1 for each in carriers)
        for (j,) in carriers:
            frames = gone[name][:, on == j]
            assert (frames.all(axis=1) == frames.any(axis=1)).all()
        assert half <= gone[name].any(axis=1).sum() <= 2 * half
    assert {int(j) for j in on[gone["the pelvis lost"].any(axis=0)]} == {0}
    assert 0.3 < gone["half lost"][round(0.5 * case.worn.rate)].mean() < 0.7
    (damaged,) = initialisation_takes.damage_takes([case], lambda *_: gone["gaps"])
    np.testing.assert_array_equal(damaged.take.visible, case.worn.visible & ~gone["gaps"])


def test_a_person_who_performs_is_calibrated_and_close_to_who_was_drawn(truth):
    performance = lost_limbs.PerformedMotion(truth.motion.at(np.arange(0, truth.motion.frame_count, 8)), truth.rate / 8, "01_01")
    (found,) = initialisation_takes.perform_subject_recordings([performance], np.random.default_rng(0))
    assert found.name == "01_01"
    assert found.true_joint_positions is not None
    assert found.true_joint_positions.shape == (performance.motion.frame_count, len(NAMES), 3)
    assert found.take.visible.all()
    assert found.subject.frame_count > 0
    alike = np.linalg.norm(found.subject.skeleton.offsets, axis=1) / np.linalg.norm(
        initialisation_takes.draw_subject(np.random.default_rng(0), asymmetric=True).skeleton.offsets, axis=1
    ).clip(1e-9)
    assert alike[NAMES.index("LeftFoot")] == pytest.approx(1.0, abs=0.1)


def test_captures_are_read_from_a_folder_and_their_truth_is_not_known(truth, tmp_path):
    (tmp_path / "walk.c3d").write_bytes(as_c3d(truth.markers[:40], truth.labels))
    (tmp_path / "stick.c3d").write_bytes(as_c3d(truth.markers[:, :3], ("A", "B", "C")))
    (found,) = initialisation_takes.read_captures(tmp_path)
    assert (found.name, found.true_joint_positions, found.true_motion) == ("walk", None, None)
    said = initialisation.compare_starts([found], {"one": sound}, repeats=1)
    assert set(said) == {"one"}
    said = said["one"]
    assert (said["start_joints_mm"], said["wrong"]) == (None, 0)
    with pytest.raises(ReadError, match="holds no capture"):
        list(initialisation_takes.read_captures(tmp_path / "elsewhere"))


def test_every_way_is_measured_on_every_set(monkeypatch, case):
    monkeypatch.setattr(initialisation_takes, "composed", lambda seeds: [case._replace(name=f"seed {seed}") for seed in seeds])
    told = []
    said = initialisation.measure_initialisation(("registration", "previous"), seeds=[7], repeats=1, progress=told.append)
    assert set(said) == {"composed"}
    assert set(said["composed"]) == {"truth", "registration", "previous"}
    assert told == ["composed: seed 7"]
    assert said["composed"]["previous"]["iterations_alone"] < said["composed"]["registration"]["iterations_alone"] - 1


def test_a_label_that_jumps_to_a_ghost_does_so_one_at_a_time_and_for_a_while(case):
    (other,) = initialisation_takes.add_ghosts([case])
    jumped = (other.take.markers != case.worn.markers).any(axis=2)
    assert jumped.sum(axis=1).max() == 1
    assert 0.2 < jumped.any(axis=1).mean() < 0.8
    shift = other.take.markers[jumped] - case.worn.markers[jumped]
    assert len(np.unique(shift.round(9), axis=0)) <= 2  # in one and a half seconds it jumps once or twice, and stays there
