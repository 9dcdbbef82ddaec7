"""Comparison of starts: marker losses, wrong frames, and starts that are wrong everywhere."""

import json
from dataclasses import replace

import numpy as np
import pytest

from mocapfix.errors import ReadError
from mocapfix.lab import initialisation, sound_takes
from mocapfix.lab.initialisation import (
    InitialisationTake,
    SolveEnd,
    find_observed_joints,
    find_wrong_frames,
    has_distant_joint,
)
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.model.take import Take
from mocapfix.synthetic import SyntheticTake, compose_take
from tests.conftest import build_c3d

NAMES = load_cmu31_body().skeleton.names
KEYS = {
    "frames", "wrong", "wrong_from_start", "wrong_first_solve", "unconverged", "iterations", "iterations_first_solve",
    "start_markers_mm",
    "start_joints_mm", "start_seconds", "seconds", "wrong_in",
}  # fmt: skip


@pytest.fixture(scope="module")
def truth() -> SyntheticTake:
    return compose_take(seed=5, seconds=1.5)


@pytest.fixture(scope="module")
def case(truth):
    """Return a take with the true body."""
    return InitialisationTake(
        "walk", Take(truth.marker_positions, truth.labels, truth.rate), truth.subject, truth.joint_positions, truth.motion
    )


def start_sound(case):
    return initialisation.start_from_markers(case, "registration")


def start_far_away(case):
    """Return a start 10 km above, where no marker has any weight."""
    start = start_sound(case)
    return replace(start, root_position=start.root_position + [0.0, 1e4, 0.0])


def start_upside_down(case):
    start = start_sound(case)
    rotations = start.local_rotations.copy()
    rotations[:, 0] = np.diag([1.0, -1.0, -1.0]) @ rotations[:, 0]
    return replace(start, local_rotations=rotations)


@pytest.fixture(scope="module")
def results(case):
    ways = {"sound": start_sound, "upside down": start_upside_down, "far": start_far_away}
    return initialisation.compare_starts([case], ways, repeats=1)


def test_wrong_frames_of_the_first_and_the_full_solve_are_counted(case, results):
    assert set(results) == {"truth", "sound", "upside down", "far"}
    for row in results.values():
        assert set(row) == KEYS
        assert row["frames"] == case.take.frame_count
        assert 0 < row["start_seconds"] < row["seconds"]
        assert row["wrong_from_start"] == row["wrong"]  # no frame is wrong from the truth
    assert (results["sound"]["wrong"], results["sound"]["wrong_first_solve"], results["sound"]["wrong_in"]) == (0, 0, {})
    far, upside_down = results["far"], results["upside down"]
    assert far["wrong_first_solve"] == case.take.frame_count  # no marker has a weight there
    assert (far["wrong"], far["wrong_in"]) == (0, {})  # the full solve starts frames again that lost their markers
    assert 0 < upside_down["wrong"] < upside_down["wrong_first_solve"]
    assert upside_down["wrong_in"] == {"walk": upside_down["wrong"]}
    json.dumps(results, allow_nan=False)


def test_frames_wrong_from_the_truth_do_not_count_against_a_start(case):
    joints = case.true_joint_positions.copy()
    joints[5:8] += [0.0, 0.5, 0.0]  # not where the markers are
    results = initialisation.compare_starts([case._replace(true_joint_positions=joints)], {"sound": start_sound}, repeats=1)
    assert {name: (row["wrong"], row["wrong_from_start"]) for name, row in results.items()} == {"truth": (3, 0), "sound": (3, 0)}


def test_start_errors_and_iterations_are_measured(results):
    near, rotations, far = results["sound"], results["upside down"], results["far"]
    assert results["truth"]["start_joints_mm"] < 1e-6
    assert 1.0 < near["start_joints_mm"] < 50.0
    assert 500.0 < rotations["start_joints_mm"] < 2000.0
    assert rotations["iterations_first_solve"] > near["iterations_first_solve"] + 2
    assert 0 < rotations["wrong"] < rotations["frames"]  # the solve recovers in some frames
    for name in ("start_joints_mm", "start_markers_mm"):
        assert far[name] == pytest.approx(1e7, rel=1e-3)


def test_wrong_frames_concern_observed_joints_only(truth, case):
    joints, hand = truth.joint_positions.copy(), NAMES.index("LeftHandIndex1")
    joints[3, hand] += [0.0, 0.101, 0.0]
    joints[4, hand] += [0.0, 0.099, 0.0]
    end = SolveEnd(joints, np.zeros(len(joints)), np.zeros(len(joints), int))
    assert np.flatnonzero(find_wrong_frames(case, {"": end})[""]).tolist() == [3]
    markers = case.take.markers.copy()
    markers[3, [label.startswith(("LFRM", "LWR", "LFIN")) for label in case.take.labels]] = np.nan
    unseen = case._replace(take=case.take.replace_markers(markers))
    assert not find_observed_joints(unseen)[3, hand]
    assert find_observed_joints(unseen)[3, NAMES.index("LeftFoot")]
    assert not find_wrong_frames(unseen, {"": end})[""].any()


def test_pose_of_least_cost_replaces_an_unknown_truth(truth, case):
    """Frame 0: equal. 1: the other is distant and costs more. 2: the first one is. 3: distant at equal cost."""
    unknown, frames = case._replace(true_joint_positions=None), len(truth.joint_positions)
    aside, none = truth.joint_positions.copy(), np.zeros(frames, int)
    aside[1:4] += [0.5, 0.0, 0.0]
    costs = np.zeros((2, frames))
    costs[1, 1], costs[0, 2], costs[1, 3] = 5.0, 5.0, 0.5 * initialisation.MAX_EQUAL_COST_DIFFERENCE
    found = find_wrong_frames(
        unknown, {"one": SolveEnd(truth.joint_positions, costs[0], none), "other": SolveEnd(aside, costs[1], none)}
    )
    assert np.flatnonzero(found["one"]).tolist() == [2]
    assert np.flatnonzero(found["other"]).tolist() == [1]


def test_distant_joint_threshold_is_a_tenth_of_a_metre():
    joints, messages = np.zeros((1, 2, 3)), np.array([[True, False]])
    assert not has_distant_joint(joints, joints + [0.09, 0.0, 0.0], messages).any()
    assert has_distant_joint(joints, joints + [0.11, 0.0, 0.0], messages).all()
    assert not has_distant_joint(joints, joints + [0.11, 0.0, 0.0], ~messages & False).any()


def test_marker_losses_have_their_distribution(case):
    losses = {name: lost(case, np.random.default_rng(1)) for name, lost in initialisation.MARKER_LOSSES.items()}
    on, half = case.subject.joints, round(initialisation.GROUP_LOSS_DURATION_S * case.take.rate)
    assert initialisation.SINGLE_GAP_SHARE <= losses["gaps"].mean() < 0.2
    for name in ("a segment lost", "the pelvis lost"):
        carriers = {tuple(np.unique(on[lost])) for lost in losses[name] if lost.any()}
        assert all(len(each) == 1 for each in carriers)
        for (j,) in carriers:
            frames = losses[name][:, on == j]
            assert (frames.all(axis=1) == frames.any(axis=1)).all()
        assert half <= losses[name].any(axis=1).sum() <= 2 * half
    assert {int(j) for j in on[losses["the pelvis lost"].any(axis=0)]} == {0}
    assert 0.3 < losses["half lost"][round(0.5 * case.take.rate)].mean() < 0.7
    (damaged,) = initialisation.damage_takes([case], lambda *_: losses["gaps"])
    np.testing.assert_array_equal(damaged.take.visible, case.take.visible & ~losses["gaps"])


def test_performing_subject_is_calibrated_close_to_the_truth(truth):
    performance = sound_takes.PerformedMotion(
        truth.motion.select_frames(np.arange(0, truth.motion.frame_count, 8)), truth.rate / 8, "01_01"
    )
    (found,) = initialisation.perform_subject_recordings([performance], np.random.default_rng(0))
    assert found.name == "01_01"
    assert found.true_joint_positions is not None
    assert found.true_joint_positions.shape == (performance.motion.frame_count, len(NAMES), 3)
    assert found.take.visible.all()
    assert found.subject.frame_count > 0
    length_ratio = np.linalg.norm(found.subject.skeleton.offsets, axis=1) / np.linalg.norm(
        initialisation.draw_subject(np.random.default_rng(0), asymmetric=True).skeleton.offsets, axis=1
    ).clip(1e-9)
    assert length_ratio[NAMES.index("LeftFoot")] == pytest.approx(1.0, abs=0.1)


def test_captures_are_read_without_truth(truth, tmp_path):
    (tmp_path / "walk.c3d").write_bytes(build_c3d(truth.marker_positions[:40], truth.labels))
    (tmp_path / "stick.c3d").write_bytes(build_c3d(truth.marker_positions[:, :3], ("A", "B", "C")))
    (found,) = initialisation.read_captures(tmp_path)
    assert (found.name, found.true_joint_positions, found.true_motion) == ("walk", None, None)
    results = initialisation.compare_starts([found], {"one": start_sound}, repeats=1)
    assert set(results) == {"one"}
    results = results["one"]
    assert (results["start_joints_mm"], results["wrong"]) == (None, 0)
    with pytest.raises(ReadError, match="holds no capture"):
        list(initialisation.read_captures(tmp_path / "elsewhere"))


def test_every_start_is_measured_on_every_set(monkeypatch, case):
    monkeypatch.setattr(
        initialisation, "compose_initialisation_takes", lambda seeds: [case._replace(name=f"seed {seed}") for seed in seeds]
    )
    messages = []
    results = initialisation.measure_initialisation(("registration", "hybrik-x"), seeds=[7], repeats=1, progress=messages.append)
    assert set(results) == {"composed"}
    assert set(results["composed"]) == {"truth", "registration", "hybrik-x"}
    assert messages == ["composed: seed 7"]


def test_ghosts_are_one_at_a_time_for_a_while(case):
    (other,) = initialisation.add_ghosts([case])
    is_ghost = (other.take.markers != case.take.markers).any(axis=2)
    assert is_ghost.sum(axis=1).max() == 1
    assert 0.2 < is_ghost.any(axis=1).mean() < 0.8
    shift = other.take.markers[is_ghost] - case.take.markers[is_ghost]
    assert len(np.unique(shift.round(9), axis=0)) <= 2  # at most two ghosts in one and a half seconds
