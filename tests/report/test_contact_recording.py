"""Contacts, floor and events in the recording, read back from the file."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.contacts.contacts import BodyContacts, Floor, GaitEvent, build_no_contacts
from mocapfix.report.recording import CONTACT_COLOUR, GRID_MARGIN_M, INFERRED_CONTACT_COLOUR, build_floor_grids, write_recording
from tests.report.contact_examples import LEVEL_FLOOR
from tests.report.test_recording import Recording

JOINTS = ("LeftFoot", "LeftToeBase", "RightFoot", "RightToeBase")
EVENTS = (GaitEvent("left", "foot strike", 0.5042, "markers"), GaitEvent("left", "foot off", 1.25, "force plate"))


def build_contacts(floor: Floor = LEVEL_FLOOR, frames: int = 240) -> BodyContacts:
    is_contact, is_known = np.zeros((frames, 4), bool), np.ones((frames, 4), bool)
    is_contact[60:150, :2] = is_contact[140:200, 2:] = True
    is_known[100:110, 0] = False
    return BodyContacts(JOINTS, is_contact, is_contact * 0.9, is_known, floor, 120.0, EVENTS)


@pytest.fixture
def recorded(scene, tmp_path):
    scene = scene.replace_comparison(contacts=build_contacts())
    write_recording(tmp_path / "walk.rrd", scene.comparison)
    return scene.comparison, Recording(tmp_path / "walk.rrd")


def test_joints_are_shown_while_they_are_in_contact(recorded):
    comparison, recording = recorded
    joints = comparison.joint_position_world[:, [comparison.skeleton.names.index(joint) for joint in JOINTS]]
    rows = recording.read_column("/world/contacts", "positions")
    assert len(rows) == 240
    for points, positions, is_contact in zip(rows, joints, comparison.contacts.is_contact, strict=True):
        np.testing.assert_allclose(np.reshape(points, (-1, 3)), positions[is_contact], atol=1e-6)
    colours = recording.read_column("/world/contacts", "colors")
    assert colours[105] == [INFERRED_CONTACT_COLOUR, CONTACT_COLOUR]
    assert colours[0] == []


def test_lanes_have_the_state_of_each_joint(recorded):
    _, recording = recorded
    assert recording.read_column("/contacts/left-heel", "state") == [["none"], ["contact"], ["inferred"], ["contact"], ["none"]]
    assert recording.read_column("/contacts/left-heel", "frame") == [101, 161, 201, 211, 251]


def test_events_are_logged_at_their_times(recorded):
    _, recording = recorded
    texts = recording.read_column("/events", "text")
    assert texts == [["left foot strike, from markers"], ["left foot off, from force plate"]]
    assert recording.read_column("/events", "time") == [504_200_000, 1_250_000_000]
    assert recording.read_column("/events", "frame") == [101 + 61, 101 + 150]


def test_floor_is_a_grid_in_the_recording(recorded):
    _, recording = recorded
    strips = next(value for name, value in recording.static["/world/floor/1"].items() if name.endswith("strips"))
    heights = np.array(strips[0])[..., 1]
    assert np.ptp(heights) == 0.0


@given(slope_x=st.floats(-0.05, 0.05), slope_z=st.floats(-0.05, 0.05), height=st.floats(-1, 1), seed=st.integers(0, 1000))
def test_grids_lie_on_the_floor_and_reach_beyond_the_contacts(slope_x, slope_z, height, seed):
    floor = Floor(slope_x, slope_z, (height, height + 0.4))
    rng = np.random.default_rng(seed)
    position = rng.uniform(-3, 3, (240, 4, 3))
    level = np.arange(240)[:, None] % 2 * 0.4
    plane = slope_x * position[..., 0] + slope_z * position[..., 2]
    position[..., 1] = height + level + plane + rng.uniform(0, 0.05, (240, 4))
    contacts = build_contacts(floor)
    grids = build_floor_grids(contacts, position)
    assert len(grids) == 2
    for n, lines in enumerate(grids):
        on_plane = lines[..., 1] - slope_x * lines[..., 0] - slope_z * lines[..., 2]
        np.testing.assert_allclose(on_plane, height + 0.4 * n, atol=1e-9)
        standing = position[n::2][contacts.is_contact[n::2]]
        assert (lines.reshape(-1, 3).min(0)[[0, 2]] <= standing.min(0)[[0, 2]] - GRID_MARGIN_M + 1e-9).all()
        assert (lines.reshape(-1, 3).max(0)[[0, 2]] >= standing.max(0)[[0, 2]] + GRID_MARGIN_M - 1e-9).all()


def test_feet_that_are_not_seen_leave_the_recording_without_contacts(scene, tmp_path):
    comparison = replace(scene.comparison, contacts=build_no_contacts(240, 120.0))
    write_recording(tmp_path / "walk.rrd", comparison)
    recording = Recording(tmp_path / "walk.rrd")
    assert not [entity for entity in (*recording.rows, *recording.static) if "/floor" in entity or entity.startswith("/events")]
    assert all(row == [] for row in recording.read_column("/world/contacts", "positions"))
