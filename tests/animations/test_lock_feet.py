"""Feet of an animation held where they stand: only legs and the root change, only on request, and each change is on record."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from mocapfix import pipeline
from mocapfix.animations.clean import AnimationResult
from mocapfix.animations.lock_feet import MAX_ROOT_DISPLACEMENT_M, find_root_displacement
from mocapfix.contacts.find_contacts import find_contacts
from mocapfix.io import bvh
from mocapfix.io.bvh import write_bvh
from mocapfix.io.contact_files import read_contacts, write_contacts
from mocapfix.model.animation import Animation
from mocapfix.model.motion import Motion
from mocapfix.options import CleanOptions
from mocapfix.solve.kinematics import LegPath, compute_world_poses, reach_ankle
from mocapfix.synthetic import compose_take

LEGS = {f"{side}{bone}" for side in ("Left", "Right") for bone in ("UpLeg", "Leg", "Foot")}
SLIDE_M = 0.03


@pytest.fixture(scope="module")
def path(tmp_path_factory) -> Path:
    """Return an animation of 6 s of walking whose whole body drifts sideways, so that standing feet slide by about 30 mm/s."""
    truth, path = compose_take(seed=3, seconds=6.0), tmp_path_factory.mktemp("slide") / "slide.bvh"
    drift = np.zeros((720, 3))
    drift[:, 0] = SLIDE_M * np.arange(720) / 120.0
    fields = vars(truth.motion) | {"root_position": truth.motion.root_position + drift}
    write_bvh(path, truth.subject.skeleton, Motion(**fields), truth.rate)
    return path


@pytest.fixture(scope="module")
def locked(path) -> AnimationResult:
    result = pipeline.clean(path, feet="lock")
    assert isinstance(result, AnimationResult)
    return result


def measure_drift_mm(animation, contacts) -> float:
    """Return the largest horizontal distance of a joint from its mean place in any contact of at least 0.2 s."""
    positions, drifts = animation.compute_world_poses()[0], []
    for joint in ("LeftFoot", "LeftToeBase", "RightFoot", "RightToeBase"):
        path = positions[:, animation.names.index(joint)][:, [0, 2]] * 1e3
        for first, last in contacts.list_intervals(joint):
            inner = path[first + 3 : last - 2]
            if len(inner) >= 24:
                drifts.append(np.linalg.norm(inner - inner.mean(0), axis=1).max())
    return max(drifts)


def find_changed_joints(result: AnimationResult) -> set[str]:
    before, after = result.input_animation, result.animation
    is_changed = (before.values != after.values).any(0)
    return {name for name, columns in zip(before.names, before.joint_columns, strict=True) if is_changed[columns].any()}


def test_feet_stand_still(locked):
    before, after = (measure_drift_mm(each, locked.contacts) for each in (locked.input_animation, locked.animation))
    assert before > 8
    assert after < 0.3 * before


def test_legs_and_the_root_change_and_carry_the_rest_along(locked):
    assert find_changed_joints(locked) == LEGS | {"Hips"}
    (before, rotations), (after, rotations_after) = (
        each.compute_world_poses() for each in (locked.input_animation, locked.animation)
    )
    others = [n for n, name in enumerate(locked.animation.names) if not re.search("Leg|Foot|Toe", name)]
    moved = after[:, others] - before[:, others]
    np.testing.assert_allclose(moved, np.broadcast_to(moved[:, :1], moved.shape), atol=1e-9)
    np.testing.assert_array_equal(rotations[:, others], rotations_after[:, others])
    assert 0.001 < np.linalg.norm(moved, axis=-1).max() < 0.02


def test_every_changed_value_is_on_record(locked):
    is_recorded = np.zeros(720, bool)
    for change in locked.changes[:-1]:
        assert change.kind == "foot slide"
        assert change.markers in (("LeftUpLeg", "LeftLeg", "LeftFoot"), ("RightUpLeg", "RightLeg", "RightFoot"))
        assert "slides by up to" in change.why
    assert (locked.changes[-1].kind, locked.changes[-1].markers) == ("root shift", ("Hips position",))
    assert "so that the legs reach" in locked.changes[-1].why
    for change in locked.changes:
        is_recorded[change.first - 1 : change.last] = True
    is_changed = (locked.input_animation.values != locked.animation.values).any(1)
    assert not (is_changed & ~is_recorded).any()
    assert sum(change.samples for change in locked.changes) == locked.report["fill"]["replaced"] > 0
    feet = locked.report["contacts"]["feet"]
    assert feet["mode"] == "lock"
    assert 5 < feet["largest_displacement_mm"] < 60


def test_written_file_has_the_locked_feet_and_keeps_other_numbers(path, locked, tmp_path):
    outputs = locked.write(tmp_path)
    written = bvh.read_bvh(outputs["bvh"])
    np.testing.assert_allclose(written.compute_world_poses()[0], locked.animation.compute_world_poses()[0], atol=1e-4)
    before, after = (each.read_text(encoding="utf-8").split("\n") for each in (path, outputs["bvh"]))
    head = next(n for n, line in enumerate(before) if line.startswith("Frame Time")) + 1
    assert before[:head] == after[:head]
    columns = {c for name in (*LEGS, "Hips") for c in written.joint_columns[written.names.index(name)].tolist()}
    for old, new in zip(before[head:], after[head:], strict=True):
        differing = {c for c, (a, b) in enumerate(zip(old.split(), new.split(), strict=True)) if a != b}
        assert differing <= columns
    page = outputs["report.html"].read_text(encoding="utf-8")
    assert "foot slide: LeftUpLeg, LeftLeg, LeftFoot" in page
    assert "sliding feet" in page


def test_angles_stay_continuous(locked):
    before, after = (np.abs(np.diff(each.values, axis=0)).max() for each in (locked.input_animation, locked.animation))
    assert after < max(1.5 * before, before + 3)


@pytest.mark.parametrize("decision", ["reject", "keep"])
def test_declined_change_leaves_that_contact_as_it_was(path, locked, tmp_path, decision):
    outputs = locked.write(tmp_path / "first")
    review = yaml.safe_load(outputs["changes.yaml"].read_text(encoding="utf-8"))
    declined = review["changes"][2]
    declined["decision"] = decision
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(review), encoding="utf-8")
    again = pipeline.clean(path, feet="lock", review_files=(tmp_path / "mine.yaml",))
    assert isinstance(again, AnimationResult)
    side = declined["markers"][0].removesuffix("UpLeg").lower()
    assert again.contacts is not None
    middle, foot = (declined["first"] + declined["last"]) // 2 - 1, again.animation.names.index(f"{side.capitalize()}ToeBase")
    first, last = next(
        each for each in again.contacts.list_intervals(f"{side.capitalize()}ToeBase") if each[0] <= middle <= each[1]
    )
    moved_m = np.linalg.norm(
        again.animation.compute_world_poses()[0][:, foot] - again.input_animation.compute_world_poses()[0][:, foot], axis=1
    )
    assert moved_m[first : last + 1].max() < 0.001
    assert moved_m.max() > 0.005
    assert [change.decision for change in again.changes if change.id == declined["id"]] == [decision]
    others = [change.id for change in again.changes if change.decision == "accept"]
    assert len(others) >= len(locked.changes) - 2


@pytest.mark.parametrize(
    ("options", "joints"),
    [
        ({"keep": ("LeftLeg",)}, {name for name in LEGS if name.startswith("Right")}),
        ({"frames": (100, 250)}, LEGS | {"Hips"}),
        ({"keep": ("Hips",)}, LEGS),
        ({"feet": "soft"}, set()),
    ],
)
def test_options_limit_what_changes(path, options, joints):
    result = pipeline.clean(path, CleanOptions().change(**{"feet": "lock", **options}))
    assert isinstance(result, AnimationResult)
    assert find_changed_joints(result) == joints
    if "frames" in options:
        frames = np.flatnonzero((result.input_animation.values != result.animation.values).any(1)) + 1
        assert frames.min() >= 100
        assert frames.max() <= 250


def test_knees_that_are_hinges_are_named_and_left_unchanged(path, tmp_path):
    animation = bvh.read_bvh(path)
    knee = animation.names.index("LeftLeg")
    lines = path.read_text(encoding="utf-8").split("\n")
    n = next(n for n, line in enumerate(lines) if line.strip() == "JOINT LeftLeg")
    channels = next(k for k in range(n, n + 6) if "CHANNELS" in lines[k])
    axis = lines[channels].split()[-1]
    lines[channels] = re.sub(r"CHANNELS.*", f"CHANNELS 1 {axis}", lines[channels])
    head = next(k for k, line in enumerate(lines) if line.startswith("Frame Time")) + 1
    dropped = animation.joint_columns[knee][:-1].tolist()
    for k in range(head, head + animation.frame_count):
        lines[k] = " ".join(word for c, word in enumerate(lines[k].split()) if c not in dropped)
    (tmp_path / "hinge.bvh").write_text("\n".join(lines), encoding="utf-8")
    result = pipeline.clean(tmp_path / "hinge.bvh", feet="lock")
    assert isinstance(result, AnimationResult)
    assert find_changed_joints(result) <= {name for name in LEGS if name.startswith("Right")}
    notes = [note for note in result.subject_report["notes"] if "left foot is not held" in note]
    assert notes == ["The left foot is not held: in hinge.bvh its thigh, shin or foot turns about fewer than three axes."]


STRETCH = 1.12


def scale_path(motion: Motion, factor: float) -> Motion:
    """Return a motion whose horizontal path is longer by a factor."""
    scale = np.array([factor, 1.0, factor])
    return replace(motion, root_position=motion.root_position[0] + (motion.root_position - motion.root_position[0]) * scale)


@pytest.fixture(scope="module")
def stretched(tmp_path_factory) -> tuple[Path, Path, Animation]:
    """Return the files of a walk whose path is 12 % too long, and of its true contacts, and the walk with the right path."""
    truth, folder = compose_take(seed=3, seconds=4.0), tmp_path_factory.mktemp("stretch")
    write_bvh(folder / "walk.bvh", truth.subject.skeleton, scale_path(truth.motion, STRETCH), truth.rate)
    write_bvh(folder / "true.bvh", truth.subject.skeleton, truth.motion, truth.rate)
    joints = compute_world_poses(truth.subject.skeleton, truth.motion)[0]
    contacts = find_contacts(truth.subject.skeleton, truth.motion, joints, truth.rate)
    write_contacts(folder / "true.contacts.json", contacts, truth.rate)
    return folder / "walk.bvh", folder / "true.contacts.json", bvh.read_bvh(folder / "true.bvh")


def measure_slide_mm_s(animation: Animation, true: Animation) -> float:
    """Return the mean horizontal speed of ankles and toes where those of the walk with the right path are slower than 0.1 m/s."""
    speeds = []
    for joint in ("LeftFoot", "LeftToeBase", "RightFoot", "RightToeBase"):
        own, still = (
            np.gradient(each.compute_world_poses()[0][:, each.names.index(joint)], 1 / 120, axis=0) for each in (animation, true)
        )
        speeds.append(np.linalg.norm(own[:, [0, 2]], axis=1)[np.linalg.norm(still, axis=1) < 0.1] * 1e3)
    return float(np.concatenate(speeds).mean())


def measure_acceleration(animation: Animation, joint: str) -> float:
    path = animation.compute_world_poses()[0][:, animation.names.index(joint)]
    return float(np.linalg.norm(np.diff(path, 2, axis=0), axis=1).max() * 120**2)


@pytest.mark.parametrize("are_given", [False, True])
def test_feet_of_a_stretched_walk_stand_still_and_no_knee_pops(stretched, are_given):
    path, contacts_path, true = stretched
    result = pipeline.clean(path, feet="lock", contacts_file=contacts_path if are_given else None)
    assert isinstance(result, AnimationResult)
    before, after = result.input_animation, result.animation
    assert measure_slide_mm_s(before, true) > 60
    assert measure_slide_mm_s(after, true) < 15
    for joint in ("LeftLeg", "RightLeg", "Hips"):
        assert measure_acceleration(after, joint) < 1.3 * max(measure_acceleration(before, joint), 20)
    moved_m = np.linalg.norm(after.compute_world_poses()[0] - before.compute_world_poses()[0], axis=-1)
    assert moved_m.max() < 0.12  # the path stays as long as it is
    heights = [each.compute_world_poses()[0][:, each.names.index("LeftToeBase"), 1] for each in (before, after)]
    np.testing.assert_allclose(heights[0], heights[1], atol=0.004)
    assert any("the root by up to" in note and "at most 100 mm" in note for note in result.subject_report["notes"])


def test_contacts_of_a_stretched_walk_are_those_of_the_walk(stretched):
    path, contacts_path, true = stretched
    found = pipeline.clean(path).contacts
    assert found is not None
    expected = read_contacts(contacts_path, true.frame_count)
    for joint in ("LeftToeBase", "RightToeBase"):
        assert (found.is_contact[:, found.joints.index(joint)] == expected[joint]).mean() > 0.93
    assert any(event.kind == "foot strike" for event in found.events)


def test_only_feet_in_given_contacts_are_held(path, tmp_path):
    (tmp_path / "mine.json").write_text('{"LeftFoot": [[100, 180]], "LeftToeBase": [[100, 200]]}', encoding="utf-8")
    result = pipeline.clean(path, feet="lock", contacts_file=tmp_path / "mine.json")
    assert isinstance(result, AnimationResult)
    assert result.contacts is not None
    assert result.contacts.list_intervals("LeftFoot") == [(100, 180)]
    assert result.contacts.list_intervals("RightFoot") == []
    before, after = (each.compute_world_poses()[0] for each in (result.input_animation, result.animation))
    toes = [result.animation.names.index(f"{side}ToeBase") for side in ("Left", "Right")]
    moved_m = np.linalg.norm(after - before, axis=-1)[:, toes].max(0)
    assert moved_m[0] > 0.005
    assert moved_m[1] < 0.003


def test_the_root_stays_if_its_change_is_declined(path, locked, tmp_path):
    review = yaml.safe_load(locked.write(tmp_path)["changes.yaml"].read_text(encoding="utf-8"))
    review["changes"][-1]["decision"] = "reject"
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(review), encoding="utf-8")
    again = pipeline.clean(path, feet="lock", review_files=(tmp_path / "mine.yaml",))
    assert isinstance(again, AnimationResult)
    assert find_changed_joints(again) == LEGS
    assert measure_drift_mm(again.animation, again.contacts) < 0.5 * measure_drift_mm(again.input_animation, again.contacts)


def build_leg(knee_forward_m: float, frames: int = 60) -> LegPath:
    """Return a leg of 0.4 m and 0.4 m that stands, whose knee is forward of the line from hip to ankle."""
    half = np.sqrt(0.16 - knee_forward_m**2)
    places = [[0, 2 * half, 0], [0, half, knee_forward_m], [0, 0, 0], [0, 0, 1]]
    return LegPath(*(np.tile(np.array(each, float), (frames, 1)) for each in places))


def pose_leg(leg: LegPath, ankle: np.ndarray):
    return leg.pose(leg.hip, ankle, reach_ankle(leg, leg.hip, ankle, 60.0))


def test_a_leg_keeps_its_pose_if_its_places_stay():
    leg = build_leg(0.02)
    posed, *turns = pose_leg(leg, leg.ankle)
    np.testing.assert_allclose(np.array(posed), np.array(leg), atol=1e-7)
    np.testing.assert_allclose(turns, np.broadcast_to(np.eye(3), (2, 60, 3, 3)), atol=1e-6)


def test_a_bent_leg_reaches_its_place_with_its_own_lengths():
    leg, shift = build_leg(0.15), np.array([0.03, 0.02, 0.05])
    posed, thigh_turn, shin_turn = pose_leg(leg, leg.ankle + shift)
    np.testing.assert_allclose(posed.ankle, leg.ankle + shift, atol=1e-4)
    np.testing.assert_allclose(posed.lengths_m, 0.4, atol=1e-9)
    np.testing.assert_allclose(np.einsum("tij,tj->ti", thigh_turn, leg.knee - leg.hip), posed.knee - posed.hip, atol=1e-9)
    np.testing.assert_allclose(np.einsum("tij,tj->ti", shin_turn, leg.ankle - leg.knee), posed.ankle - posed.knee, atol=1e-9)


def test_a_straight_leg_bends_forward_and_yields_smoothly_where_its_place_is_out_of_reach():
    leg = build_leg(0.0)
    pull = np.zeros((60, 3))
    pull[20:40, 1], pull[40:, 1] = 0.02, -0.02  # nearer, then out of reach
    posed = pose_leg(leg, leg.ankle + pull)[0]
    assert (posed.knee[24:36, 2] > 0.05).all()
    np.testing.assert_allclose(posed.ankle[24:36], (leg.ankle + pull)[24:36], atol=2e-3)
    np.testing.assert_allclose(posed.ankle[50:], leg.ankle[50:], atol=1e-3)


def test_the_root_follows_legs_that_do_not_reach_and_stays_where_it_must():
    legs, is_allowed = [build_leg(0.005, 240), build_leg(0.005, 240)], np.ones(240, bool)
    is_allowed[:20] = False
    lowered = [leg.ankle - [0.0, 0.03, 0.0] for leg in legs]
    moved = find_root_displacement(legs, lowered, is_allowed, 120.0)
    np.testing.assert_allclose(moved[120:, 1], -0.03, atol=0.002)
    np.testing.assert_allclose(moved[:20], 0.0, atol=1e-5)
    far = find_root_displacement(legs, [leg.ankle - [0.0, 0.5, 0.0] for leg in legs], is_allowed, 120.0)
    assert 0.09 < np.linalg.norm(far, axis=1).max() <= MAX_ROOT_DISPLACEMENT_M
    np.testing.assert_allclose(find_root_displacement(legs, [leg.ankle for leg in legs], is_allowed, 120.0), 0.0, atol=1e-12)
    assert not find_root_displacement([], [], np.ones(2, bool), 120.0).any()
