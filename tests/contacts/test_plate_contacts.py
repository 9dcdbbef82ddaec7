"""Contacts with force plates: which foot stands on which plate, events in place of those of markers, and contacts that agree."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.contacts.contacts import CONTACT_JOINTS, FILE_SOURCE, PLATE_SOURCE, BodyContacts, Floor, GaitEvent
from mocapfix.contacts.gait_events import FootPoints
from mocapfix.contacts.plate_contacts import (
    PlateContact,
    align_contacts_with_plates,
    compute_half_step,
    find_plate_contacts,
    is_file_event_wrong,
    merge_events,
)
from mocapfix.io.force_plates import ForcePlate
from tests.contacts.walking_feet import make_path, walk

RATE, PLATE_RATE, SECONDS = 100.0, 1000.0, 5.5
FLAT = Floor(0.0, 0.0, (0.0,))
LEFT, RIGHT = walk()


def make_feet() -> dict[str, FootPoints]:
    """Return the points of both walking feet."""
    toes = {"left": make_path(LEFT, SECONDS, RATE), "right": make_path(RIGHT, SECONDS, RATE)}
    return {side: FootPoints(toe + [0.0, 0.0, -0.2], toe, np.ones((len(toe), 2), bool)) for side, toe in toes.items()}


def make_plate(first_s: float, last_s: float, z: tuple[float, float], x: tuple[float, float] = (0.0, 0.4)) -> ForcePlate:
    """Return a plate that bears 700 N for a while, with 5 N of noise."""
    time_s = np.arange(round(SECONDS * PLATE_RATE)) / PLATE_RATE
    force = np.random.default_rng(0).normal(0, 2, len(time_s))
    force[(time_s >= first_s) & (time_s < last_s)] += 700.0
    corners = np.array([[x[0], 0, z[0]], [x[1], 0, z[0]], [x[1], 0, z[1]], [x[0], 0, z[1]]])
    return ForcePlate(force, PLATE_RATE, corners)


def test_the_foot_on_a_plate_is_found_with_its_times():
    first_s, last_s, place = LEFT[1]
    plate = make_plate(first_s, last_s, (place[2] - 0.3, place[2] + 0.1))
    [contact] = find_plate_contacts([plate], make_feet(), FLAT, RATE)
    assert contact.side == "left"
    assert contact.strike_s == pytest.approx(first_s, abs=0.0011)
    assert contact.off_s == pytest.approx(last_s, abs=0.0011)


def test_a_foot_that_is_partly_beside_its_plate_does_not_count():
    first_s, last_s, place = LEFT[1]
    assert not find_plate_contacts([make_plate(first_s, last_s, (place[2] - 0.1, place[2] + 0.1))], make_feet(), FLAT, RATE)


def test_a_plate_under_both_feet_does_not_count():
    first_s, _, _ = LEFT[1]
    plate = make_plate(first_s, first_s + 1.2, (-0.5, 3.0), (-0.4, 0.4))
    assert not find_plate_contacts([plate], make_feet(), FLAT, RATE)


def test_a_foot_that_swings_over_a_plate_does_not_matter():
    first_s, last_s, place = LEFT[1]
    plate = make_plate(first_s, last_s, (place[2] - 0.3, place[2] + 0.1), (-0.4, 0.4))
    contacts = find_plate_contacts([plate], make_feet(), FLAT, RATE)
    assert [contact.side for contact in contacts] == ["left"]


def test_a_load_at_the_end_of_a_take_has_no_off():
    first_s, _, place = LEFT[-1]
    [contact] = find_plate_contacts([make_plate(first_s, 99.0, (place[2] - 0.3, place[2] + 0.1))], make_feet(), FLAT, RATE)
    assert np.isnan(contact.off_s)


def test_events_of_plates_replace_those_of_markers():
    events = [
        GaitEvent("left", "foot strike", 1.02, "markers"),
        GaitEvent("right", "foot off", 1.2, "markers"),
        GaitEvent("left", "foot off", 1.3, "markers"),
        GaitEvent("left", "foot off", 1.58, "markers"),
        GaitEvent("left", "foot strike", 2.5, "markers"),
    ]
    replaced, disagreements = merge_events(events, [], [PlateContact("left", 1.0, 1.6)])
    assert [(event.side, event.kind, event.time_s, event.source) for event in replaced] == [
        ("left", "foot strike", 1.0, PLATE_SOURCE),
        ("right", "foot off", 1.2, "markers"),
        ("left", "foot off", 1.6, PLATE_SOURCE),
        ("left", "foot strike", 2.5, "markers"),
    ]
    assert disagreements == ()
    assert merge_events(events, [], []) == (tuple(events), ())


def make_walk_events(source: str, delay_s: float = 0.0) -> list[GaitEvent]:
    """Return strikes and offs of both feet, in strides of 1.1 s."""
    steps = [("left", 0.5), ("right", 1.05), ("left", 1.6), ("right", 2.15), ("left", 2.7)]
    events = [GaitEvent(side, "foot strike", start_s + delay_s, source) for side, start_s in steps]
    return events + [GaitEvent(side, "foot off", start_s + 0.65 + delay_s, source) for side, start_s in steps]


def list_times(events) -> list[tuple[str, str, float, str]]:
    """Return events as tuples in order."""
    return sorted((event.side, event.kind, round(event.time_s, 6), event.source) for event in events)


@given(delay_s=st.floats(-0.25, 0.25).filter(lambda delay_s: abs(abs(delay_s) - 0.05) > 1e-6))
def test_the_events_of_the_file_win_and_none_is_there_twice(delay_s):
    recorded = make_walk_events(FILE_SOURCE)[:7]
    events, disagreements = merge_events(make_walk_events("markers", delay_s), recorded, [])
    assert len(events) == len(make_walk_events("markers"))
    assert set(list_times(recorded)) <= set(list_times(events))
    assert len(disagreements) == (len(recorded) if abs(delay_s) > 0.05 else 0)
    assert all(each.delay_s == pytest.approx(delay_s) for each in disagreements)


def test_a_plate_counts_before_the_file_and_tells_that_it_is_wrong():
    recorded = [event._replace(time_s=event.time_s + 0.04) for event in make_walk_events(FILE_SOURCE)]
    events, disagreements = merge_events(make_walk_events("markers"), recorded, [PlateContact("left", 1.6, 2.25)])
    assert ("left", "foot strike", 1.6, PLATE_SOURCE) in list_times(events)
    assert len(events) == len(recorded)
    assert [(each.event.kind, each.other.source) for each in disagreements] == [("foot strike", "file"), ("foot off", "file")]
    assert all(is_file_event_wrong(each) for each in disagreements)


def test_half_a_step_follows_the_strides_and_is_that_of_walking_without_any():
    assert compute_half_step(make_walk_events("markers")) == pytest.approx(1.1 / 4)
    assert compute_half_step(make_walk_events("markers")[:2]) == 0.25


def build_contacts(heel: slice, ball: slice) -> BodyContacts:
    """Return contacts of a left foot."""
    is_contact = np.zeros((300, 4), bool)
    is_contact[heel, 0] = is_contact[ball, 1] = True
    return BodyContacts(CONTACT_JOINTS, is_contact, is_contact * 0.9, np.ones((300, 4), bool), FLAT, RATE)


@pytest.mark.parametrize(
    ("heel", "ball"), [(slice(110, 140), slice(115, 150)), (slice(90, 140), slice(90, 175)), (slice(0), slice(0))]
)
def test_contacts_begin_and_end_with_the_load(heel, ball):
    aligned = align_contacts_with_plates(build_contacts(heel, ball), [PlateContact("left", 1.0, 1.6)])
    assert np.flatnonzero(aligned.find_foot_contact("left")).tolist() == list(range(100, 161))
    assert not aligned.find_foot_contact("right").any()
    is_changed = aligned.is_contact != build_contacts(heel, ball).is_contact
    assert np.array_equal(aligned.probability, np.where(is_changed, aligned.is_contact, 0.9 * aligned.is_contact))


def test_other_contacts_of_the_foot_are_kept():
    contacts = build_contacts(slice(110, 140), slice(115, 150))
    contacts.is_contact[20:60, 1] = contacts.is_contact[200:250, 0] = True
    aligned = align_contacts_with_plates(contacts, [PlateContact("left", 1.0, 1.6)])
    assert aligned.list_intervals("LeftToeBase")[0] == (20, 59)
    assert aligned.list_intervals("LeftFoot")[-1] == (200, 249)


def test_a_load_that_never_begins_or_ends():
    aligned = align_contacts_with_plates(build_contacts(slice(110, 140), slice(115, 150)), [PlateContact("left", np.nan, np.nan)])
    assert aligned.find_foot_contact("left").all()
