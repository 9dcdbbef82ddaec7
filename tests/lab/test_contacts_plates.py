"""The benchmark of gait events: errors from known loads, frames between events, and captures without plates."""

from pathlib import Path

import numpy as np
import pytest

from mocapfix.contacts.contacts import CONTACT_JOINTS, BodyContacts, Floor, GaitEvent
from mocapfix.contacts.plate_contacts import PlateContact
from mocapfix.lab.contacts import (
    PlateAgreement,
    PlateEventError,
    clean_without_plates,
    compare_events,
    compute_agreement,
    find_contact_between_events,
    measure_plate_events,
    summarise_contacts,
)
from mocapfix.synthetic import compose_take, write_synthetic_take

CAPTURES = Path(__file__).parents[3] / "shared" / "data" / "captures" / "c3d"


def build_contacts(*events: GaitEvent) -> BodyContacts:
    """Return contacts of 200 frames at 100 frames per second."""
    nothing = np.zeros((200, 4), bool)
    return BodyContacts(CONTACT_JOINTS, nothing, nothing * 0.0, nothing, Floor(0.0, 0.0, (0.0,)), 100.0, events)


STRIKE = GaitEvent("left", "foot strike", 0.5, "markers")
OFF = GaitEvent("left", "foot off", 1.1, "markers")


def test_events_are_compared_with_the_nearest_of_their_kind():
    errors = compare_events("capture", PlateContact("left", 0.49, 1.105), build_contacts(STRIKE, OFF))
    assert [each.error_ms for each in errors] == pytest.approx([10.0, -5.0])


def test_events_that_are_far_away_are_not_found():
    errors = compare_events("capture", PlateContact("left", 0.1, np.nan), build_contacts(STRIKE, OFF))
    assert [each.kind for each in errors] == ["foot strike"]
    assert np.isnan(errors[0].error_ms)


def test_a_foot_is_in_contact_between_its_events():
    both = find_contact_between_events(build_contacts(STRIKE, OFF), "left")
    assert np.flatnonzero(both).tolist() == list(range(50, 111))
    assert np.flatnonzero(find_contact_between_events(build_contacts(OFF), "left")).tolist() == list(range(111))
    assert np.flatnonzero(find_contact_between_events(build_contacts(STRIKE), "left")).tolist() == list(range(50, 200))
    assert not find_contact_between_events(build_contacts(STRIKE, OFF), "right").any()


def test_f1_by_frame_is_over_all_loads():
    agreements = [PlateAgreement("a", "events", 10, 10, 10), PlateAgreement("b", "events", 10, 30, 10)]
    assert compute_agreement(agreements)["f1"] == pytest.approx(2 * 20 / 60)
    tables = summarise_contacts([], [], [PlateEventError("a", "left", "foot off", 4.0)], agreements)
    assert tables["plate frames"]["events"]["recall"] == 1
    assert tables["plate events"]["foot off"] == {"events": 1, "found": 1, "median_error_ms": 4.0, "median_delay_ms": 4.0}


def test_files_without_plates_are_left_out(tmp_path):
    path = tmp_path / "take.c3d"
    write_synthetic_take(path, compose_take(seconds=1.0))
    (tmp_path / "damaged.c3d").write_bytes(b"not a C3D")
    assert clean_without_plates(path) is None
    assert measure_plate_events(tmp_path) == ([], [])


@pytest.mark.skipif(not CAPTURES.exists(), reason="the captures are not here")
def test_events_of_a_walk_agree_with_its_plates():
    errors, frames = measure_plate_events(CAPTURES / "FunctionalWalk.c3d")
    assert len(errors) == 6
    assert np.abs([each.error_ms for each in errors]).max() < 25
    assert compute_agreement([each for each in frames if each.method == "events"])["f1"] > 0.95
