"""The files of contacts and of events of gait: frames of the BVH at any rate, the file's own frames, several people."""

import csv
import json
import re

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from mocapfix import pipeline
from mocapfix.contacts.contacts import CONTACT_JOINTS, BodyContacts, Floor, GaitEvent
from mocapfix.errors import SceneError, WriteError
from mocapfix.io.contact_files import list_intervals_at_rate, read_contacts, write_contacts, write_gait_events
from mocapfix.model.motion import FrameStatus, Motion, resample_motion
from mocapfix.options import OutputOptions
from mocapfix.synthetic import compose_take
from tests.conftest import build_c3d

FRAMES = 240
FLOOR = Floor(0.0, 0.0, (0.0,))


def build_contacts(is_contact: np.ndarray, rate: float = 120.0, events: tuple[GaitEvent, ...] = ()) -> BodyContacts:
    columns = np.repeat(is_contact[:, None], 4, axis=1)
    return BodyContacts(CONTACT_JOINTS, columns, columns * 0.9, np.ones_like(columns), FLOOR, rate, events)


def build_still_motion(frames: int) -> Motion:
    zeros = np.zeros(frames, int)
    return Motion(
        np.zeros((frames, 3)), np.tile(np.eye(3), (frames, 1, 1, 1)), zeros + FrameStatus.PLACED, zeros, np.zeros((frames, 0)),
        np.zeros((frames, 1)),
    )  # fmt: skip


@given(
    edges=st.lists(st.integers(0, FRAMES - 1), min_size=2, max_size=12, unique=True).map(sorted),
    rate=st.sampled_from([100.0, 119.88, 120.0, 240.0]),
    new_rate=st.sampled_from([23.976, 24.0, 25.0, 29.97, 30.0, 59.94, 60.0, 100.0, 119.88, 120.0, 240.0]),
)
@example(edges=[120, 216], rate=24.0, new_rate=25.0)  # 120 * (25 / 24) is 125.00000000000001
@example(edges=[0, FRAMES - 1], rate=120.0, new_rate=24.0)
def test_frames_at_another_rate_are_those_within_the_contacts(edges, rate, new_rate):
    is_contact = np.zeros(FRAMES, bool)
    for first, last in zip(edges[::2], edges[1::2], strict=False):
        is_contact[first : last + 1] = True
    contacts = build_contacts(is_contact, rate)
    intervals = list_intervals_at_rate(contacts, "LeftFoot", new_rate)
    count = resample_motion(build_still_motion(FRAMES), rate, new_rate).frame_count
    times = np.arange(count) * rate / new_rate  # in frames of the take
    expected = np.zeros(count, bool)
    for first, last in contacts.list_intervals("LeftFoot"):
        expected |= (times > first - 1e-6) & (times < last + 1e-6)
    found = np.zeros(count, bool)
    for first, last in intervals:
        assert 0 <= first <= last < count
        found[first : last + 1] = True
    np.testing.assert_array_equal(found, expected)


def test_contacts_are_intervals_of_frames_by_joint(tmp_path):
    is_contact = np.zeros(FRAMES, bool)
    is_contact[10:30] = is_contact[200:] = True
    write_contacts(tmp_path / "walk.contacts.json", build_contacts(is_contact), 120.0)
    assert json.loads((tmp_path / "walk.contacts.json").read_text(encoding="utf-8")) == {
        joint: [[10, 29], [200, 239]] for joint in CONTACT_JOINTS
    }


def test_contacts_that_were_written_are_read(tmp_path):
    is_contact = np.zeros(FRAMES, bool)
    is_contact[10:30] = is_contact[200:] = True
    write_contacts(tmp_path / "walk.contacts.json", build_contacts(is_contact), 120.0)
    read = read_contacts(tmp_path / "walk.contacts.json", FRAMES)
    assert set(read) == set(CONTACT_JOINTS)
    for each in read.values():
        np.testing.assert_array_equal(each, is_contact)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"LeftToe": [[0, 1]]}', r"mine.json: LeftToe: a file of contacts has no such joint; its joints are LeftFoot, "),
        ('{"LeftFoot": [[100, 240]]}', r"LeftFoot: \[100, 240\] is no first and last frame .* the animation's last one is 239"),
        ('{"LeftFoot": [[9, 5]]}', r"LeftFoot: \[9, 5\] is no first and last frame"),
        ('{"LeftFoot": [[-1, 5]]}', r"LeftFoot.0.0: "),
        ('{"LeftFoot": [3, 5]}', r"LeftFoot.0: must be a list"),
        ("[[3, 5]]", r"contains no key: value pairs"),
        ('{"LeftFoot": [[3, 5]', r"mine.json, line 2: not valid YAML"),
    ],
)
def test_a_file_of_contacts_with_an_error_is_refused(tmp_path, text, message):
    (tmp_path / "mine.json").write_text(text, encoding="utf-8")
    with pytest.raises(SceneError, match=message):
        read_contacts(tmp_path / "mine.json", FRAMES)


def test_events_are_a_table_with_the_files_frames(tmp_path):
    events = (GaitEvent("left", "foot strike", 0.5, "markers"), GaitEvent("right", "foot off", 1.23456, "force plate"))
    write_gait_events(tmp_path / "walk.events.csv", build_contacts(np.zeros(FRAMES, bool), events=events), 301)
    assert (tmp_path / "walk.events.csv").read_text(encoding="utf-8").splitlines() == [
        "time_s,frame,side,event,source",
        "0.5000,361.00,left,foot strike,markers",
        "1.2346,449.15,right,foot off,force plate",
    ]


def test_missing_folder_is_named(tmp_path):
    contacts = build_contacts(np.zeros(FRAMES, bool))
    with pytest.raises(WriteError, match="nowhere"):
        write_contacts(tmp_path / "nowhere" / "walk.contacts.json", contacts, 120.0)
    with pytest.raises(WriteError, match="nowhere"):
        write_gait_events(tmp_path / "nowhere" / "walk.events.csv", contacts, 1)


@pytest.mark.parametrize("rate", [None, 60.0, 25.0])
def test_files_of_a_take_agree_with_its_bvh_and_npz(cleaned, tmp_path, rate):
    options = OutputOptions(extra_formats=("contacts", "events", "npz"), output_rate_hz=rate, floor_height_m=0.25)
    outputs = cleaned.result.write(tmp_path, options=options)
    contacts, bvh = json.loads(outputs["contacts.json"].read_text(encoding="utf-8")), outputs["bvh"].read_text(encoding="utf-8")
    frames = int(re.findall(r"Frames: (\d+)", bvh)[0])
    assert set(CONTACT_JOINTS) <= set(contacts)
    assert sum(len(contacts[joint]) for joint in CONTACT_JOINTS) > 10
    assert all(0 <= first <= last < frames for each in contacts.values() for first, last in each)
    with np.load(outputs["npz"]) as arrays:
        shape = len(arrays["markers"]), len(arrays["contact_joints"])
        assert all(arrays[key].shape == shape for key in ("contacts", "contact_probabilities", "contacts_known"))
        assert (arrays["contact_probabilities"][arrays["contacts"]] > 0.6).all()
        assert arrays["root"].shape[0] == frames
        step = float(arrays["marker_rate"]) / float(arrays["rate"])
        is_contact = arrays["contacts"][:, list(arrays["contact_joints"]).index("LeftToeBase")]
        middles = [round((first + last) / 2 * step) for first, last in contacts["LeftToeBase"]]
        assert is_contact[middles].all()
        assert arrays["floor_heights"] == pytest.approx(np.array(cleaned.result.contacts.floor.level_heights_m) - 0.25)
        times = arrays["event_times"]
        toes = arrays["joints"][:, list(arrays["names"]).index("LeftToeBase"), 1]
        assert toes.min() == pytest.approx(float(arrays["floor_heights"][0]), abs=0.06)
    rows = list(csv.DictReader(outputs["events.csv"].open()))
    np.testing.assert_allclose([float(row["time_s"]) for row in rows], times, atol=1e-4)
    assert {row["side"] for row in rows} == {"left", "right"}


def test_each_of_several_people_has_files(tmp_path):
    truth = compose_take(seed=3, seconds=2.0)
    pair = np.concatenate([truth.marker_positions, truth.marker_positions + [2.0, 0.0, 0.0]], axis=1)
    labels = [f"{name}:{label}" for name in ("Jim", "Ann") for label in truth.labels]
    (tmp_path / "two.c3d").write_bytes(build_c3d(pair, labels))
    result = pipeline.clean(tmp_path / "two.c3d", prior="none")
    assert result.contacts is None
    outputs = result.write(tmp_path / "out", options=OutputOptions(extra_formats=("contacts", "events", "npz")))
    jim, ann = (json.loads(outputs[f"{name}.contacts.json"].read_text(encoding="utf-8")) for name in ("Jim", "Ann"))
    assert sum(map(len, jim.values())) > 3
    reports = [part.subject_report for part in result.subject_results]
    assert len(reports) == 2
    for report in reports:
        assert "contacts" in report
        assert report["contacts"]["joints"]["LeftFoot"]["contacts"] > 0
    frames = len(truth.marker_positions)
    for joint in CONTACT_JOINTS:  # both people move alike
        masks = np.zeros((2, frames), bool)
        for mask, intervals in zip(masks, (jim[joint], ann[joint]), strict=True):
            for first, last in intervals:
                mask[first : last + 1] = True
        assert (masks[0] == masks[1]).mean() > 0.95
    for name in ("Jim", "Ann"):
        with np.load(outputs[f"{name}.npz"]) as arrays:
            assert arrays["contacts"].shape[0] == frames
        assert "Contacts with the floor" in outputs[f"{name}.report.html"].read_text(encoding="utf-8")


def test_a_take_without_visible_feet_has_empty_files_and_a_note(tmp_path):
    truth = compose_take(seed=3, seconds=1.5)
    kept = [m for m, label in enumerate(truth.labels) if label[1:] not in ("ANK", "HEE", "TOE", "MT5")]
    (tmp_path / "walk.c3d").write_bytes(build_c3d(truth.marker_positions[:, kept], [truth.labels[m] for m in kept]))
    result = pipeline.clean(tmp_path / "walk.c3d", prior="none")
    outputs = result.write(tmp_path / "out", options=OutputOptions(extra_formats=("contacts", "events")))
    assert set(map(tuple, json.loads(outputs["contacts.json"].read_text(encoding="utf-8")).values())) == {()}
    # the event is that of the file's header
    assert (
        outputs["events.csv"].read_text(encoding="utf-8")
        == "time_s,frame,side,event,source\n0.5000,61.00,right,foot strike,file\n"
    )
    assert "contacts" in result.subject_report
    assert result.subject_report["contacts"]["floor"] is None
    assert any("do not show both feet" in note for note in result.subject_report["notes"])
    assert "Contacts with the floor" not in outputs["report.html"].read_text(encoding="utf-8")
