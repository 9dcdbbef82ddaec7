"""Contacts as later stages use them: intervals, feet, a lowered floor, and what was done to the feet."""

from dataclasses import replace

import numpy as np
import pytest

from mocapfix import pipeline
from mocapfix.contacts.contacts import (
    CONTACT_JOINTS,
    NO_FLOOR,
    BodyContacts,
    EventDisagreement,
    Floor,
    GaitEvent,
    build_no_contacts,
)


@pytest.fixture
def contacts() -> BodyContacts:
    is_contact = np.zeros((100, 4), bool)
    is_contact[10:20, 0] = is_contact[15:30, 1] = is_contact[90:, 3] = True
    return BodyContacts(
        CONTACT_JOINTS, is_contact, is_contact * 0.9, np.ones((100, 4), bool), Floor(0.01, 0.0, (0.1, 0.4)), 100.0
    )


def test_intervals_are_inclusive(contacts):
    assert [contacts.list_intervals(joint) for joint in CONTACT_JOINTS] == [[(10, 19)], [(15, 29)], [], [(90, 99)]]


def test_a_foot_is_in_contact_with_heel_or_ball(contacts):
    assert np.flatnonzero(contacts.find_foot_contact("left")).tolist() == list(range(10, 30))
    assert np.flatnonzero(contacts.find_foot_contact("right")).tolist() == list(range(90, 100))


def test_contacts_that_are_changed_are_certain(contacts):
    other = contacts.is_contact.copy()
    other[10:15, 0], other[50:60, 2] = False, True
    changed = contacts.change_contacts(other)
    assert np.array_equal(changed.is_contact, other)
    assert (changed.probability[10:15, 0] == 0).all()
    assert (changed.probability[50:60, 2] == 1).all()
    assert (changed.probability[15:20, 0] == 0.9).all()


def test_added_joints_have_no_contacts_and_feet_are_selected(contacts):
    added = contacts.add_other_joints()
    assert added.is_contact.shape == added.probability.shape == added.is_known.shape == (100, 10)
    assert not added.probability[:, 4:].any()
    feet = added.select_feet(np.arange(5, 25))
    assert feet.joints == CONTACT_JOINTS
    assert np.array_equal(feet.probability, contacts.probability[5:25])


def test_a_lowered_floor_keeps_its_slope(contacts):
    lowered = contacts.lower_floor(0.1)
    assert lowered.floor.level_heights_m == pytest.approx((0.0, 0.3))
    assert lowered.floor.slope_x == 0.01
    assert replace(contacts, floor=NO_FLOOR).lower_floor(0.1).floor is NO_FLOOR


def test_events_of_a_part_are_those_in_its_time(contacts):
    events = tuple(GaitEvent("left", "foot strike", time_s, "markers") for time_s in (0.5, 1.0, 1.5, 2.0))
    late = GaitEvent("left", "foot strike", 1.03, "force plate")
    pairs = (EventDisagreement(late, events[1]),)
    moved = replace(contacts, events=events, event_disagreements=pairs).move_events(-1.0, 1.0)
    assert [event.time_s for event in moved.events] == [0.0, 0.5]
    (pair,) = moved.event_disagreements
    assert (pair.event.time_s, pair.other.time_s) == (pytest.approx(0.03), 0.0)


def test_a_body_without_feet_has_none(contacts):
    assert contacts.has_feet
    assert not build_no_contacts(10, 100.0).has_feet


@pytest.mark.parametrize("mode", ["soft", "off", "lock"])
def test_what_was_done_to_the_feet_is_known(brief, mode):
    result = pipeline.clean(brief.path, subject=brief.subject, feet=mode, prior_scope="lost-limbs")
    other = pipeline.clean(brief.path, subject=brief.subject, feet="off", prior_scope="lost-limbs")
    assert result.subject is not None
    assert result.contacts is not None
    assert result.joint_position_world is not None
    assert other.joint_position_world is not None
    feet = [result.subject.skeleton.names.index(joint) for joint in CONTACT_JOINTS]
    moved_m = np.linalg.norm((result.joint_position_world - other.joint_position_world)[:, feet], axis=-1).max()
    assert result.contacts.held_feet.mode == mode
    assert result.contacts.held_feet.largest_displacement_m == pytest.approx(moved_m, abs=1e-9)
    assert "contacts" in result.report
    assert (moved_m > 0) == (mode != "off")
    assert result.report["contacts"]["feet"]["largest_displacement_mm"] == pytest.approx(moved_m * 1e3, abs=0.006)
