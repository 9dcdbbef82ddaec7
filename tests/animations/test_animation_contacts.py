"""Contacts of animations: those of the same motion on the body's own skeleton, without a change to the file."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from mocapfix import pipeline
from mocapfix.animations.clean import AnimationResult
from mocapfix.contacts.contacts import CONTACT_JOINTS, BodyContacts
from mocapfix.contacts.find_contacts import find_contacts
from mocapfix.io import bvh
from mocapfix.io.bvh import write_bvh
from mocapfix.options import OutputOptions
from mocapfix.report.report import ContactSection
from mocapfix.result import CleaningResult
from mocapfix.solve import kinematics
from mocapfix.stats.sequences import find_runs
from mocapfix.synthetic import SyntheticTake, compose_take
from tests.captures import CAPTURES, needs_captures


def get_contacts(result: CleaningResult) -> BodyContacts:
    assert result.contacts is not None
    return result.contacts


def get_section(result: CleaningResult) -> ContactSection:
    assert "contacts" in result.report
    return result.report["contacts"]


@pytest.fixture(scope="module")
def truth() -> SyntheticTake:
    return compose_take(seed=3, seconds=6.0)


@pytest.fixture(scope="module")
def path(truth, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("walk") / "walk.bvh"
    write_bvh(path, truth.subject.skeleton, truth.motion, truth.rate)
    return path


@pytest.mark.parametrize("feet", ["soft", "off"])
def test_contacts_are_those_of_the_body_and_the_file_is_unchanged(truth, path, tmp_path, feet):
    result = pipeline.clean(path, feet=feet)
    assert isinstance(result, AnimationResult)
    outputs = result.write(tmp_path, options=OutputOptions(extra_formats=("contacts", "events", "npz"), output_rate_hz=60.0))
    assert outputs["bvh"].read_bytes() == path.read_bytes()
    joints = kinematics.compute_world_poses(truth.subject.skeleton, truth.motion)[0]
    expected = find_contacts(truth.subject.skeleton, truth.motion, joints, truth.rate)
    found = get_contacts(result)
    for joint in CONTACT_JOINTS:
        column = found.joints.index(joint)
        assert (found.is_contact[:, column] == expected.is_contact[:, column]).mean() > 0.995
        assert len(expected.list_intervals(joint)) > 2
    contacts = json.loads(outputs["contacts.json"].read_text(encoding="utf-8"))
    assert contacts["LeftFoot"] == [list(each) for each in found.list_intervals("LeftFoot")]  # the BVH keeps its rate
    report = get_section(result)
    assert report["floor"] is not None
    assert report["feet"] == {"mode": "off", "largest_displacement_mm": 0.0, "yielded_s": 0.0}
    assert {event["source"] for event in report["events"]} == {"joints"}
    assert report["floor"]["height_m"] == pytest.approx(found.floor.height_m, abs=1e-4)
    with np.load(outputs["npz"]) as arrays:
        assert arrays["contacts"].shape[0] == len(arrays["markers"]) == 720
        assert len(arrays["root"]) == 360


def test_reports_of_animations_show_contacts_in_their_own_terms(path, tmp_path):
    outputs = pipeline.clean(path).write(tmp_path)
    page = outputs["report.html"].read_text(encoding="utf-8")
    assert "Contacts with the floor" in page
    assert "Feet in contact are as they were in the file" in page
    assert "marker" not in re.sub(r"<style>.*?</style>", "", page, flags=re.DOTALL)


def test_events_follow_the_strikes_of_the_motion(truth, path):
    contacts = get_contacts(pipeline.clean(path))
    strikes = [event for event in contacts.events if event.kind == "foot strike"]
    assert len(strikes) >= 4
    for event in strikes:
        is_contact, frame = contacts.find_foot_contact(event.side), round(event.time_s * truth.rate)
        starts = [first for first, last in find_runs(is_contact) if last > frame]
        assert abs(starts[0] - frame) < 0.2 * truth.rate  # the foot stops later than it strikes


def test_reference_pose_before_the_motion_has_no_contacts(truth, path, tmp_path):
    lines = path.read_text(encoding="utf-8").split("\n")
    head = next(n for n, line in enumerate(lines) if line.startswith("Frame Time")) + 1
    count = len(lines[head].split())
    lines.insert(head, " ".join(["0"] * count))
    (tmp_path / "posed.bvh").write_text("\n".join(lines).replace("Frames: 720", "Frames: 721"), encoding="utf-8")
    posed, plain = (get_contacts(pipeline.clean(each)) for each in (tmp_path / "posed.bvh", path))
    assert bvh.read_bvh(tmp_path / "posed.bvh").has_reference_pose
    assert not posed.is_contact[0].any()
    np.testing.assert_array_equal(posed.is_contact[1:], plain.is_contact)
    times = [[event.time_s for event in each.events] for each in (plain, posed)]
    np.testing.assert_allclose(np.array(times[1]) - 1 / 120, times[0], atol=1e-6)


def test_a_figure_without_feet_has_no_contacts_and_a_note(path, tmp_path):
    text = path.read_text(encoding="utf-8")
    for side in ("Left", "Right"):
        for joint in ("Foot", "ToeBase"):
            text = re.sub(rf"JOINT {side}{joint}\n", f"JOINT {side}Stump{joint[0]}\n", text)
    (tmp_path / "stumps.bvh").write_text(text, encoding="utf-8")
    result = pipeline.clean(tmp_path / "stumps.bvh", feet="lock")
    assert not get_contacts(result).is_contact.any()
    assert get_section(result)["joints"] == {}
    assert any("The joints do not show both feet" in note for note in result.subject_report["notes"])
    assert result.changes == ()


@needs_captures
@pytest.mark.parametrize("name", ["cmu/02_01.bvh", "bvh-other/Male1_B3_Walk.bvh"])
def test_captured_walks_have_steps_of_both_feet(name):
    gait = get_section(pipeline.clean(CAPTURES / name))["gait"]
    assert gait["steps"] >= 4
    assert gait["cadence_steps_per_min"] is not None
    assert 80 < gait["cadence_steps_per_min"] < 130
