"""Feet of an animation held where they stand: only legs change, only on request, and each change is on record."""

import re
from pathlib import Path

import numpy as np
import pytest
import yaml

from mocapfix import pipeline
from mocapfix.animations.clean import AnimationResult
from mocapfix.io import bvh
from mocapfix.io.bvh import write_bvh
from mocapfix.model.motion import Motion
from mocapfix.options import CleanOptions
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


def test_only_legs_change(locked):
    assert find_changed_joints(locked) == LEGS
    before, after = locked.input_animation.compute_world_poses()[0], locked.animation.compute_world_poses()[0]
    others = [n for n, name in enumerate(locked.animation.names) if not re.search("Leg|Foot|Toe", name)]
    np.testing.assert_array_equal(before[:, others], after[:, others])


def test_every_changed_value_is_on_record(locked):
    is_recorded = np.zeros(720, bool)
    for change in locked.changes:
        assert change.kind == "foot slide"
        assert change.markers in (("LeftUpLeg", "LeftLeg", "LeftFoot"), ("RightUpLeg", "RightLeg", "RightFoot"))
        assert "slides by up to" in change.why
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
    columns = {c for name in LEGS for c in written.joint_columns[written.names.index(name)].tolist()}
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
    middle = (declined["first"] + declined["last"]) // 2 - 1
    columns = np.concatenate([again.animation.joint_columns[again.animation.names.index(name)] for name in declined["markers"]])
    runs = [
        (first, last) for first, last in again.contacts.list_intervals(f"{side.capitalize()}ToeBase") if first <= middle <= last
    ]
    first, last = runs[0]
    inner = slice(first + 30, last - 29) if last - first > 80 else slice(middle, middle + 1)
    np.testing.assert_array_equal(again.animation.values[inner, columns], again.input_animation.values[inner, columns])
    assert [change.decision for change in again.changes if change.id == declined["id"]] == [decision]
    others = [change.id for change in again.changes if change.decision == "accept"]
    assert len(others) >= len(locked.changes) - 2


@pytest.mark.parametrize(
    ("options", "joints"),
    [
        ({"keep": ("LeftLeg",)}, {name for name in LEGS if name.startswith("Right")}),
        ({"frames": (100, 250)}, LEGS),
        ({"feet": "soft"}, set()),
    ],
)
def test_options_limit_what_changes(path, options, joints):
    result = pipeline.clean(path, CleanOptions().change(**{"feet": "lock", **options}))
    assert isinstance(result, AnimationResult)
    assert find_changed_joints(result) == joints
    if "frames" in options:
        frames = np.flatnonzero((result.input_animation.values != result.animation.values).any(1)) + 1
        assert (frames.min(), frames.max()) >= (100, 100)
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
