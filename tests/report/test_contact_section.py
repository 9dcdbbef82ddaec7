"""The report's figures of contacts, steps and events, and the notes, by contacts that are known."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.contacts.contacts import NO_FLOOR, EventDisagreement, Floor, GaitEvent, build_no_contacts
from mocapfix.report.build_report import build_contact_section, build_gait_entry, describe_contacts
from mocapfix.report.terms import JOINT_TERMS, MARKER_TERMS
from tests.report.contact_examples import JOINTS, build_contacts, build_empty_take, build_walk


def describe(contacts, mode="soft", floor_height_m=0.0, terms=MARKER_TERMS) -> list[str]:
    return describe_contacts(contacts, mode, floor_height_m, terms)


def test_contacts_are_counted_by_joint():
    joints = build_contact_section(build_contacts(), build_empty_take())["joints"]
    assert joints["LeftFoot"] == {
        "contacts": 2,
        "seconds": 3.0,
        "share": 0.3,
        "probability": 0.9,
        "inferred": 1,
        "inferred_s": 0.1,
    }
    assert joints["RightFingerBase"] == {
        "contacts": 1,
        "seconds": 0.1,
        "share": 0.01,
        "probability": 0.9,
        "inferred": 0,
        "inferred_s": 0.0,
    }
    assert joints["RightToeBase"]["contacts"] == 0


def test_section_is_json_with_the_files_frame_numbers():
    events = (GaitEvent("left", "foot strike", float(np.float64(4.005)), "force plate"),)
    section = json.loads(json.dumps(build_contact_section(build_contacts(events=events), build_empty_take())))
    assert section["events"] == [
        {"side": "left", "event": "foot strike", "time_s": 4.005, "frame": 501.5, "source": "force plate"}
    ]
    assert section["feet"] == {"mode": "soft", "largest_displacement_mm": 3.4, "yielded_s": 0.0}
    assert section["floor"] == {"height_m": 0.002, "tilt_deg": 0.0, "level_heights_m": [0.002]}


def test_levels_and_tilt_of_the_floor_are_in_the_section():
    floor = build_contact_section(build_contacts(Floor(np.tan(np.radians(1.2)), 0.0, (0.01, 0.35))), build_empty_take())["floor"]
    assert floor == {"height_m": 0.01, "tilt_deg": 1.2, "level_heights_m": [0.01, 0.35]}


def test_feet_that_are_not_seen_have_no_entries():
    section = build_contact_section(build_no_contacts(100, 100.0), build_empty_take(100))
    assert (section["floor"], section["joints"], section["events"]) == (None, {}, [])
    assert section["gait"] == {"strikes": {"left": 0, "right": 0}, "steps": 0, "cadence_steps_per_min": None}


@given(step_s=st.floats(0.25, 1.1), count=st.integers(6, 30))
def test_cadence_of_a_steady_walk(step_s, count):
    entry = build_gait_entry(build_walk(step_s, count))
    assert entry["steps"] == count - 1
    assert sum(entry["strikes"].values()) == count
    assert entry["cadence_steps_per_min"] == pytest.approx(60 / step_s, abs=0.06)


def test_pauses_and_hops_are_no_steps():
    hops = tuple(event._replace(side="left") for event in build_walk(0.5, 10))
    assert build_gait_entry(hops)["steps"] == 0
    paused = (*build_walk(0.5, 6), *(event._replace(time_s=event.time_s + 20) for event in build_walk(0.5, 6)))
    entry = build_gait_entry(paused)
    assert (entry["steps"], entry["cadence_steps_per_min"]) == (10, 120.0)
    assert build_gait_entry(build_walk(0.5, 4))["cadence_steps_per_min"] is None


def test_a_level_floor_at_the_assumed_height_needs_no_note():
    seen = replace(build_contacts(), is_known=np.ones_like(build_contacts().is_known))
    assert describe(seen) == []
    assert describe(replace(seen, floor=Floor(0.0, 0.0, (0.5,))), floor_height_m=0.49) == []


def test_what_a_technician_must_know_of_the_floor_is_noted():
    low, tilted, steps = (Floor(0.0, 0.0, (-0.052,)), Floor(0.0, np.tan(np.radians(1.2)), (0.0,)), Floor(0.0, 0.0, (0.0, 0.35)))
    assert "52 mm below height 0 m; --floor -0.052" in describe(build_contacts(low))[0]
    assert "tilted by 1.2 degrees" in describe(build_contacts(tilted))[0]
    assert "2 levels, at heights of 0.00 and 0.35 m" in describe(build_contacts(steps))[0]


def test_inferred_contacts_are_noted():
    assert describe(build_contacts()) == [
        "1 contact of a heel or a ball of a foot is partly inferred: for 0.10 s in all, too few markers show the foot."
    ]
    known = build_contacts().is_known.copy()
    known[np.flatnonzero(~known.all(1))[1:]] = True
    assert "for 0.01 s in all" in describe(replace(build_contacts(), is_known=known, rate=200.0))[0]


def test_the_largest_disagreement_of_events_is_noted_and_all_are_in_the_section():
    strike, off = GaitEvent("right", "foot strike", 1.823, "force plate"), GaitEvent("left", "foot off", 2.467, "file")
    pairs = (
        EventDisagreement(strike, strike._replace(time_s=1.883, source="file")),
        EventDisagreement(off, off._replace(time_s=2.36, source="markers")),
    )
    contacts = replace(build_contacts(), is_known=np.ones_like(build_contacts().is_known), event_disagreements=pairs)
    [note] = describe(contacts)
    assert note == (
        "The left foot off at 2.467 s by the file is 107 ms earlier by the markers (and 1 more in the report); "
        "force plates count before the file, and the file before markers."
    )
    listed = build_contact_section(contacts, build_empty_take())["event_disagreements"]
    assert [(each["source"], each["other_source"], each["delay_ms"]) for each in listed] == [
        ("force plate", "file", 60.0),
        ("file", "markers", -107.0),
    ]


def test_missing_feet_and_feet_that_never_stand_are_noted():
    unseen = build_no_contacts(100, 100.0)
    assert describe(unseen) == [
        "The markers do not show both feet, so no contacts with the floor are detected, and --feet soft has no effect."
    ]
    assert describe(unseen, "off", terms=JOINT_TERMS) == [
        "The joints do not show both feet, so no contacts with the floor are detected."
    ]
    assert describe(replace(build_contacts(NO_FLOOR), is_contact=np.zeros((1000, len(JOINTS)), bool))) == [
        "No foot stands still in this take, so no floor is detected."
    ]
