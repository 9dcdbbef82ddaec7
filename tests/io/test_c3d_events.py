"""Gait events in the EVENT group of a C3D: in every encoding, once, without a change of anything else."""

from pathlib import Path

import ezc3d
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import mocapfix
from mocapfix.contacts.contacts import GaitEvent
from mocapfix.io.c3d_events import (
    MAX_EVENTS,
    FileEvent,
    add_c3d_events,
    read_c3d_events,
    read_gait_events,
    read_header_events,
)
from mocapfix.io.c3d_parameters import C3dHead
from mocapfix.io.capture import read_take
from mocapfix.options import ReadOptions
from tests.c3d_files import ENCODINGS, c3d_bytes, get_layout
from tests.captures import CAPTURES, needs_captures

C3D_CAPTURES = CAPTURES / "c3d"
RATE = 120.0
EVENTS = (
    GaitEvent("left", "foot strike", 0.25, "markers"),
    GaitEvent("right", "foot off", 0.5, "force plate"),
    GaitEvent("left", "foot off", 61.5, "markers"),
)


def make_file(encoding=(84, True), first: int = 1, extra=None) -> bytes:
    """Return the bytes of a C3D of 40 frames."""
    xyz = np.random.default_rng(0).uniform(0, 1000, (40, 4, 3))
    return c3d_bytes(xyz, ["LHEE", "RHEE", "LTOE", "RTOE"], encoding=encoding, first=first, extra=extra)


def write(path: Path, data: bytes) -> int:
    """Write a file, and return where its data begin."""
    path.write_bytes(data)
    return get_layout(read_take(path, ReadOptions(up_axis="Z"))).data_start_byte


def read_events(path: Path):
    """Return the events of a file, and its layout."""
    layout = get_layout(read_take(path, ReadOptions(up_axis="Z")))
    return read_c3d_events(C3dHead(path.read_bytes()[: layout.data_start_byte])), layout


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_events_are_read_as_they_were_written(tmp_path, encoding):
    path = tmp_path / "walk.c3d"
    start = write(path, make_file(encoding))
    assert add_c3d_events(path, start, {"": EVENTS}, 1, RATE) == 3
    found, _ = read_events(path)
    assert [(event.context, event.label, event.description) for event in found] == [
        ("Left", "Foot Strike", "detected from markers"),
        ("Right", "Foot Off", "detected from force plate"),
        ("Left", "Foot Off", "detected from markers"),
    ]
    assert [event.time_s for event in found] == pytest.approx([0.25, 0.5, 61.5], abs=1e-5)
    assert [event.icon for event in found] == [1, 2, 2]


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_markers_and_all_bytes_of_data_are_unchanged(tmp_path, encoding):
    path, data = tmp_path / "walk.c3d", make_file(encoding)
    start = write(path, data)
    before = read_take(path, ReadOptions(up_axis="Z"))
    add_c3d_events(path, start, {"": EVENTS}, 1, RATE)
    after, layout = read_take(path, ReadOptions(up_axis="Z")), read_events(path)[1]
    assert path.read_bytes()[layout.data_start_byte :] == data[start:]
    np.testing.assert_array_equal(after.markers, before.markers)
    assert after.labels == before.labels


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_all_other_parameters_are_unchanged(tmp_path, encoding):
    path = tmp_path / "walk.c3d"
    start = write(path, make_file(encoding, extra={"SUBJECTS:NAMES": ["Ann", "Bob"], "POINT:DESCRIPTIONS": ["a", "b", "c", "d"]}))
    before = C3dHead(path.read_bytes()[:start]).records
    add_c3d_events(path, start, {"": EVENTS}, 1, RATE)
    after = C3dHead(path.read_bytes()[: get_layout(read_take(path, ReadOptions(up_axis="Z"))).data_start_byte]).records
    kept = {(each.group, each.name): each.content for each in after}
    for each in before:
        if each.name != "DATA_START":
            assert kept[each.group, each.name] == each.content


def test_the_time_counts_from_frame_one_of_the_file(tmp_path):
    path = tmp_path / "cut.c3d"
    start = write(path, make_file(first=121))
    add_c3d_events(path, start, {"": EVENTS[:1]}, 121, RATE)
    assert read_events(path)[0][0].time_s == pytest.approx(1.25, abs=1e-5)


def test_adding_events_twice_changes_nothing(tmp_path):
    path = tmp_path / "walk.c3d"
    start = write(path, make_file())
    add_c3d_events(path, start, {"": EVENTS}, 1, RATE)
    once, layout = path.read_bytes(), read_events(path)[1]
    shifted = [event._replace(time_s=event.time_s + 0.02) for event in EVENTS]
    assert add_c3d_events(path, layout.data_start_byte, {"": shifted}, 1, RATE) == 0
    assert path.read_bytes() == once


def test_events_of_the_file_are_kept_first(tmp_path):
    path = tmp_path / "walk.c3d"
    start = write(path, make_file())
    add_c3d_events(path, start, {"": EVENTS[:1]}, 1, RATE)
    layout = read_events(path)[1]
    other = GaitEvent("right", "foot strike", 0.1, "markers")
    assert add_c3d_events(path, layout.data_start_byte, {"": [other]}, 1, RATE) == 1
    found, _ = read_events(path)
    assert [(event.context, event.label) for event in found] == [("Left", "Foot Strike"), ("Right", "Foot Strike")]


def test_events_of_several_people_have_their_names(tmp_path):
    path = tmp_path / "two.c3d"
    start = write(path, make_file(extra={"SUBJECTS:NAMES": ["Ann", "Bob"]}))
    assert add_c3d_events(path, start, {"Ann": EVENTS, "Bob": EVENTS[:1]}, 1, RATE) == 4
    found, layout = read_events(path)
    assert [event.subject for event in found] == ["Ann", "Ann", "Ann", "Bob"]
    assert add_c3d_events(path, layout.data_start_byte, {"Ann": EVENTS, "Bob": EVENTS[:2]}, 1, RATE) == 1  # not Ann's foot off
    assert read_events(path)[0][-1][:4] == ("Foot Off", "Right", "detected from force plate", "Bob")


def test_an_event_without_a_name_is_that_of_the_named_person(tmp_path):
    path = tmp_path / "walk.c3d"
    start = write(path, make_file())
    add_c3d_events(path, start, {"": EVENTS}, 1, RATE)
    assert add_c3d_events(path, read_events(path)[1].data_start_byte, {"Ann": EVENTS}, 1, RATE) == 0


def test_no_event_leaves_the_file_as_it_is(tmp_path):
    path, data = tmp_path / "walk.c3d", make_file()
    start = write(path, data)
    assert add_c3d_events(path, start, {"": ()}, 1, RATE) == 0
    assert path.read_bytes() == data


def test_more_events_than_a_parameter_can_hold(tmp_path):
    path = tmp_path / "walk.c3d"
    start = write(path, make_file())
    events = [GaitEvent("left", "foot strike", 0.5 * k, "markers") for k in range(MAX_EVENTS + 20)]
    assert add_c3d_events(path, start, {"": events}, 1, RATE) == MAX_EVENTS
    found, _ = read_events(path)
    assert len(found) == MAX_EVENTS
    assert found[-1].time_s == pytest.approx(0.5 * (MAX_EVENTS - 1), abs=1e-4)


@given(st.lists(st.floats(0, 3000), min_size=1, max_size=30, unique_by=lambda time: round(time)))
def test_any_times_are_kept(tmp_path_factory, times):
    path = tmp_path_factory.mktemp("events") / "walk.c3d"
    start = write(path, make_file())
    add_c3d_events(path, start, {"": [GaitEvent("left", "foot strike", time, "markers") for time in times]}, 1, RATE)
    assert [event.time_s for event in read_events(path)[0]] == pytest.approx(times, abs=1e-4)


def test_ezc3d_reads_the_events(tmp_path):
    path = tmp_path / "walk.c3d"
    start = write(path, make_file())
    add_c3d_events(path, start, {"": EVENTS}, 1, RATE)
    event = ezc3d.c3d(str(path))["parameters"]["EVENT"]
    assert event["USED"]["value"][0] == 3
    assert event["LABELS"]["value"] == ["Foot Strike", "Foot Off", "Foot Off"]
    assert event["CONTEXTS"]["value"] == ["Left", "Right", "Left"]
    np.testing.assert_allclose(event["TIMES"]["value"], [[0, 0, 1], [0.25, 0.5, 1.5]], atol=1e-5)


@needs_captures
@pytest.mark.parametrize("name", ["pc_int", "dec_real", "sgi_real", "FunctionalWalk", "JA1Gait35", "PiG_Motion-FlatFoot-Hole"])
def test_captures_keep_their_events_and_all_else(tmp_path, name):
    data = (C3D_CAPTURES / f"{name}.c3d").read_bytes()
    path = tmp_path / f"{name}.c3d"
    path.write_bytes(data)
    take = read_take(path)
    start = get_layout(take).data_start_byte
    known = read_c3d_events(C3dHead(data[:start]))
    added = add_c3d_events(path, start, {"": [GaitEvent("left", "foot strike", 977.0, "markers")]}, take.first_frame, take.rate)
    after = read_take(path)
    data_start = get_layout(after).data_start_byte
    found = read_c3d_events(C3dHead(path.read_bytes()[:data_start]))
    assert added == 1
    assert found[:-1] == known
    assert path.read_bytes()[data_start:] == data[start:]
    np.testing.assert_array_equal(after.markers, take.markers)


@pytest.mark.parametrize(
    ("label", "context", "expected"),
    [
        ("Foot Strike", "Left", ("left", "foot strike")),
        ("FOOT OFF", "RIGHT", ("right", "foot off")),
        ("LHS", "", ("left", "foot strike")),
        ("RTO", "", ("right", "foot off")),
        ("R_HS", "", ("right", "foot strike")),
        ("Left Toe Off", "", ("left", "foot off")),
        ("L Initial Contact", "", ("left", "foot strike")),
        ("Heel Strike R", "", ("right", "foot strike")),
        ("LOFF", "", ("left", "foot off")),
        ("TO", "Left", ("left", "foot off")),
        ("Foot Strike", "General", None),
        ("LMS", "", None),
        ("Load", "Left", None),
        ("Right turn", "", None),
        ("STRT", "", None),
    ],
)
def test_labels_of_laboratories_name_foot_and_kind(label, context, expected):
    assert FileEvent(label, context, "", "", 0.0, 1.0).foot_and_kind == expected


def write_events(path: Path, events, first: int = 1) -> int:
    """Write a file that has events, and return where its data begin."""
    start = write(path, make_file(first=first))
    add_c3d_events(path, start, {"": events}, first, RATE)
    return read_events(path)[1].data_start_byte


def test_events_are_read_as_seconds_after_the_first_frame(tmp_path):
    path = tmp_path / "cut.c3d"
    start = write_events(path, EVENTS, first=121)
    found = read_gait_events(path.read_bytes()[:start], "", (121, RATE), 10.0)
    assert [event[:2] for event in found] == [event[:2] for event in EVENTS[:2]]  # the third is after the end of the take
    assert [event.time_s for event in found] == pytest.approx([0.25, 0.5], abs=1e-5)
    assert {event.source for event in found} == {"file"}
    assert read_gait_events(path.read_bytes()[:start], "", (121 + 60, RATE), 10.0)[0].time_s == pytest.approx(0.0, abs=1e-5)


def test_events_of_another_person_are_not_read(tmp_path):
    path = tmp_path / "two.c3d"
    start = write(path, make_file())
    add_c3d_events(path, start, {"Ann": EVENTS[:1], "Bob": EVENTS[1:2]}, 1, RATE)
    head = path.read_bytes()[: read_events(path)[1].data_start_byte]
    assert [event.side for event in read_gait_events(head, "ann", (1, RATE), 10.0)] == ["left"]
    assert len(read_gait_events(head, "", (1, RATE), 10.0)) == 2


def test_parameters_without_events_leave_those_of_the_header():
    head = bytearray(make_file()[:512] + bytes(512))
    [event] = read_gait_events(bytes(head), "", (1, RATE), 10.0)  # of the header, where the parameters have none
    assert (event.side, event.kind, event.time_s) == ("right", "foot strike", 0.5)
    head[300:302] = bytes(2)
    assert read_gait_events(bytes(head), "", (1, RATE), 10.0) == ()


def test_an_event_within_half_a_step_is_not_added(tmp_path):
    path = tmp_path / "walk.c3d"
    start = write_events(path, EVENTS[:1])
    once = path.read_bytes()
    for delay_s in (-0.2, 0.12, 0.2):
        again = EVENTS[0]._replace(time_s=EVENTS[0].time_s + delay_s)
        assert add_c3d_events(path, start, {"": [again]}, 1, RATE) == 0
        assert path.read_bytes() == once


def test_an_event_that_a_plate_contradicts_is_moved_and_tells_its_earlier_time(tmp_path):
    path = tmp_path / "walk.c3d"
    start = write_events(path, EVENTS)
    on_plate = GaitEvent("left", "foot strike", 0.31, "force plate")
    assert add_c3d_events(path, start, {"": [on_plate]}, 1, RATE) == 0
    found, layout = read_events(path)
    assert len(found) == len(EVENTS)
    assert found[0].time_s == pytest.approx(0.31, abs=1e-5)
    assert found[0].description == "detected from force plate; was at 0.250 s"
    assert [event.time_s for event in found[1:]] == pytest.approx([0.5, 61.5], abs=1e-4)
    near = [GaitEvent("left", "foot strike", 0.33, "force plate")]
    once = path.read_bytes()
    assert add_c3d_events(path, layout.data_start_byte, {"": near}, 1, RATE) == 0
    assert path.read_bytes() == once


def test_new_events_have_the_only_name_that_the_others_have(tmp_path):
    path = tmp_path / "walk.c3d"
    start = write(path, make_file())
    add_c3d_events(path, start, {"Ann": EVENTS[:1]}, 1, RATE)
    add_c3d_events(path, read_events(path)[1].data_start_byte, {"": EVENTS[1:]}, 1, RATE)
    assert {event.subject for event in read_events(path)[0]} == {"Ann"}


@needs_captures
def test_events_of_the_header_are_read_in_every_encoding():
    for name in ("pc_int", "dec_real", "sgi_real"):
        data = (C3D_CAPTURES / f"{name}.c3d").read_bytes()
        events = read_header_events(C3dHead(data[: get_layout(read_take(C3D_CAPTURES / f"{name}.c3d")).data_start_byte]))
        assert [event.label for event in events] == ["RHS", "STRT", "RMS", "LHS", "RTO", "LMS", "STOP", "LTO", "EOF"]
        assert [event.time_s for event in events] == pytest.approx([0.38, 0.68, 0.72, 0.84, 0.92, 1.16, 1.2, 1.4, 1.76], abs=1e-4)
        assert [event.foot_and_kind for event in events if event.foot_and_kind] == [
            ("right", "foot strike"),
            ("left", "foot strike"),
            ("right", "foot off"),
            ("left", "foot off"),
        ]


LEFT_STRIKE, LEFT_OFF = ("left", "foot strike"), ("left", "foot off")
RIGHT_STRIKE, RIGHT_OFF = ("right", "foot strike"), ("right", "foot off")
PLATE_EVENTS = {
    "S4-AMGait05": {RIGHT_STRIKE: 0.247, LEFT_STRIKE: 0.788, RIGHT_OFF: 0.891, LEFT_OFF: 1.422},
    "PiG_Motion-FlatFoot-Hole": {LEFT_STRIKE: 1.95, LEFT_OFF: 2.674},
    "Qualisys": {LEFT_STRIKE: 0.0745, RIGHT_STRIKE: 0.538, LEFT_OFF: 0.617, RIGHT_OFF: 1.118},
    "sub_labels": {RIGHT_STRIKE: 1.823, LEFT_OFF: 2.009, RIGHT_OFF: 2.692},
}
"""per capture, the seconds after the first frame at which the load of one foot passes 20 N, as ezc3d reads the plates"""


@needs_captures
@pytest.mark.parametrize("name", PLATE_EVENTS)
def test_events_of_captures_are_within_two_frames_of_their_plates_and_none_is_there_twice(tmp_path, name):
    result = mocapfix.clean(C3D_CAPTURES / f"{name}.c3d", write_events=True, feet="off", prior="none")
    result.write_source_copy(tmp_path / f"{name}.c3d")
    take = read_take(tmp_path / f"{name}.c3d")
    start_s = (take.first_frame - 1) / take.rate
    found = read_c3d_events(C3dHead((tmp_path / f"{name}.c3d").read_bytes()[: get_layout(take).data_start_byte]))
    times: dict[tuple[str, str], list[float]] = {}
    for event in found:
        assert event.foot_and_kind is not None
        times.setdefault(event.foot_and_kind, []).append(event.time_s - start_s)
    for foot_and_kind, time_s in PLATE_EVENTS[name].items():
        assert min(abs(each - time_s) for each in times[foot_and_kind]) < 0.025
    assert all(np.diff(sorted(each)).min(initial=np.inf) > 0.25 for each in times.values())
