"""The HTML report's part on contacts: strips that cover the take, bars where contacts are, marks of events, and the table."""

import re
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.contacts.contacts import NOT_HELD, Floor, GaitEvent, HeldFeet, build_no_contacts
from mocapfix.report.build_report import build_contact_section
from mocapfix.report.html_report import write_html_report
from mocapfix.report.terms import JOINT_TERMS, MARKER_TERMS
from mocapfix.report.timeline import (
    MAX_STRIP_S,
    MAX_STRIPS,
    ContactPart,
    build_contact_part,
    describe_contact_section,
    divide_take,
)
from tests.report.contact_examples import FIRST_FRAME, RATE, build_contacts, build_empty_take, build_walk

STRIKE = GaitEvent("left", "foot strike", 4.0, "markers")


def build_part(contacts, frames=1000, terms=MARKER_TERMS) -> ContactPart:
    take = build_empty_take(frames)
    part = build_contact_part(build_contact_section(contacts, take), contacts, take, terms)
    assert part is not None
    return part


def read_runs(path: str) -> list[tuple[float, float]]:
    return [(float(a), float(b)) for a, b in re.findall(r"M(\S+) 0H([\d.]+)V1", path)]


@given(frames=st.integers(1, 200_000))
def test_strips_cover_every_frame_once(frames):
    spans = divide_take(build_empty_take(frames))
    assert (spans[0][0], spans[-1][1]) == (0, frames)
    assert all(before[1] == after[0] for before, after in pairwise(spans))
    assert len(spans) <= MAX_STRIPS
    if frames / RATE <= MAX_STRIP_S * MAX_STRIPS:
        assert all(stop - first <= MAX_STRIP_S * RATE + 1 for first, stop in spans)


def test_bars_are_where_the_contacts_are():
    (strip,) = build_part(build_contacts()).strips
    heel = strip.lanes[0]
    assert heel.label == "left heel"
    assert read_runs(heel.seen_path) == [(0.0, 0.19), (0.4, 0.5)]
    assert read_runs(heel.inferred_path) == [(0.19, 0.2)]
    assert [lane.label for lane in strip.lanes] == ["left heel", "left toes", "right heel", "right toes", "right wrist"]
    assert strip.lanes[2].seen_path == ""


def test_bars_of_a_long_take_are_those_of_the_whole_take():
    contacts = build_contacts(frames=7000)
    is_contact = np.zeros_like(contacts.is_contact)
    is_contact[2000:5000, 0] = True  # over a border between strips
    changed = replace(contacts, is_contact=is_contact, is_known=np.ones_like(is_contact), events=(), held_feet=NOT_HELD)
    part = build_part(changed, 7000)
    spans = divide_take(build_empty_take(7000))
    assert len(part.strips) == len(spans) == 3
    frames = [
        (round(first + a * (stop - first)), round(first + b * (stop - first)))
        for (first, stop), strip in zip(spans, part.strips, strict=True)
        for a, b in read_runs(strip.lanes[0].seen_path)
    ]
    assert (frames[0][0], frames[-1][1]) == (2000, 5000)
    assert all(before[1] == after[0] for before, after in pairwise(frames))
    ticks = [tick for strip in part.strips for tick in strip.ticks]
    assert all(tick.frame_number == FIRST_FRAME + round(tick.time_s * RATE) for tick in ticks)
    assert [tick.time_s for tick in ticks] == sorted(tick.time_s for tick in ticks)


def test_events_are_marked_on_their_foot():
    strip = build_part(build_contacts(events=(STRIKE, STRIKE._replace(side="right", kind="foot off", time_s=7.5)))).strips[0]
    left, right = strip.lanes[0].marks, strip.lanes[2].marks
    assert [(mark.share, mark.css_class) for mark in left] == [(0.4, "strike")]
    assert [(mark.share, mark.css_class) for mark in right] == [(0.75, "off")]
    assert left[0].title == "left foot strike, 4.000 s, from markers"


def test_table_and_legend_name_what_is_there():
    part = build_part(build_contacts(events=(STRIKE,)))
    assert part.rows[0] == ("left heel", "2", "3.0", "30%", "1", "0.10")
    assert [text for _, text in part.legend] == ["in contact", "inferred: too few markers show the joint", "foot strike"]
    contacts = build_contacts()
    seen = replace(contacts, is_known=np.ones_like(contacts.is_known), events=(), held_feet=NOT_HELD)
    assert build_part(seen).header == ("Joint", "Contacts", "Seconds", "Share")


def test_text_gives_floor_feet_events_and_cadence():
    events = (*build_walk(0.5, 8), STRIKE._replace(time_s=9.0, source="force plate"))
    contacts = build_contacts(Floor(0.0, np.tan(np.radians(1.2)), (0.01, 0.35)), events, HeldFeet("lock", 0.0061))
    text = describe_contact_section(build_contact_section(contacts, build_empty_take()), MARKER_TERMS)
    assert "Floor levels at heights of 10 and 350 mm, tilted by 1.2 degrees." in text
    assert "held at one place; they were moved by at most 6.1 mm." in text
    assert "9 events of gait, 1 of them from force plates. 7 steps, 120 a minute." in text
    unchanged = build_contact_section(build_contacts(held=HeldFeet("off", 0.0)), build_empty_take())
    assert "Feet in contact are as they were in the file." in describe_contact_section(unchanged, JOINT_TERMS)


def test_without_feet_there_is_no_part():
    take, contacts = build_empty_take(), build_no_contacts(1000, RATE)
    assert build_contact_part(build_contact_section(contacts, take), contacts, take, MARKER_TERMS) is None
    assert build_contact_part(None, None, take, MARKER_TERMS) is None


@pytest.mark.parametrize("has_contacts", [True, False])
def test_page_shows_the_part(scene, tmp_path, has_contacts):
    contacts = build_contacts(events=(STRIKE._replace(time_s=1.0),), frames=240)
    if has_contacts:
        scene = scene.replace_comparison(contacts=contacts)
        scene.report["contacts"] = build_contact_section(contacts, scene.comparison.input_take)
    write_html_report(tmp_path / "walk.html", scene.report, scene.comparison)
    page = (tmp_path / "walk.html").read_text(encoding="utf-8")
    assert ("Contacts with the floor" in page) == has_contacts
    assert ('aria-label="contacts of the left heel"' in page) == has_contacts
    assert ('class="strike" style="left:' in page) == has_contacts
