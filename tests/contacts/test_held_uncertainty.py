"""A held foot is more certain while it is hidden, on its whole length, and nothing else changes."""

import numpy as np
import pytest

from mocapfix.contacts.body_contacts import ROLLING_SD_M, reduce_held_uncertainty
from mocapfix.contacts.contacts import CONTACT_JOINTS, BodyContacts, Floor
from mocapfix.model.motion import Motion
from mocapfix.synthetic import compose_take

SUBJECT = compose_take(seed=0, seconds=0.1).subject
NAMES = SUBJECT.skeleton.names
HIDDEN = slice(40, 80)


def make_motion() -> Motion:
    """Return a motion whose left foot is uncertain for a while."""
    joint_sd, marker_sd = np.full((120, len(NAMES)), 0.004), np.full((120, len(SUBJECT.labels)), 0.003)
    for name in ("LeftLeg", "LeftFoot", "LeftToeBase"):
        joint_sd[HIDDEN, NAMES.index(name)] = 0.03
        marker_sd[HIDDEN][:, SUBJECT.joints == NAMES.index(name)] = 0.03
    return Motion(
        np.zeros((120, 3)), np.zeros((120, len(NAMES), 3, 3)), np.zeros(120, int), np.zeros(120, int), marker_sd, joint_sd
    )


def make_contacts(is_contact: bool) -> BodyContacts:
    """Return contacts of both feet, the left one of which is hidden for a while."""
    is_known = np.ones((120, 4), bool)
    is_known[HIDDEN, :2] = False
    contact = np.ones((120, 4), bool)
    contact[50:60, :2] = is_contact
    return BodyContacts(CONTACT_JOINTS, contact, contact * 0.9, is_known, Floor(0.0, 0.0, (0.0,)), 120.0)


def test_a_held_foot_is_known_up_to_its_rolling():
    motion = make_motion()
    held = reduce_held_uncertainty(SUBJECT, motion, make_contacts(True))
    on_foot = [k for k, joint in enumerate(SUBJECT.joints) if NAMES[joint] in ("LeftFoot", "LeftToeBase")]
    for name in ("LeftFoot", "LeftToeBase"):
        np.testing.assert_allclose(held.joint_sd[HIDDEN, NAMES.index(name)], np.hypot(0.004, ROLLING_SD_M))
    np.testing.assert_allclose(held.marker_sd[HIDDEN][:, on_foot], np.hypot(0.003, ROLLING_SD_M))
    np.testing.assert_array_equal(held.joint_sd[:40], motion.joint_sd[:40])
    unchanged = [k for k, joint in enumerate(SUBJECT.joints) if "Left" not in NAMES[joint]]
    np.testing.assert_array_equal(held.marker_sd[:, unchanged], motion.marker_sd[:, unchanged])


def test_markers_of_the_shin_are_the_more_certain_the_nearer_they_are_to_the_ankle():
    held = reduce_held_uncertainty(SUBJECT, make_motion(), make_contacts(True))
    ankle, shin = (held.marker_sd[60, SUBJECT.labels.index(label)] for label in ("LANK", "LSHN"))
    assert np.hypot(0.003, ROLLING_SD_M) < ankle < shin < 0.03


@pytest.mark.parametrize("side", ["joint_sd", "marker_sd"])
def test_a_hidden_foot_that_may_have_stepped_stays_uncertain(side):
    motion = make_motion()
    held = reduce_held_uncertainty(SUBJECT, motion, make_contacts(False))
    np.testing.assert_array_equal(getattr(held, side), getattr(motion, side))


@pytest.mark.parametrize("hidden", [slice(0, 120), slice(40, 80)])
def test_a_hidden_foot_without_a_known_place_stays_uncertain(hidden):
    motion, contacts = make_motion(), make_contacts(True)
    contacts.is_known[hidden, :2] = contacts.is_contact[:, :2] = False
    contacts.is_contact[hidden, :2] = True
    held = reduce_held_uncertainty(SUBJECT, motion, contacts)
    np.testing.assert_array_equal(held.joint_sd, motion.joint_sd)
    np.testing.assert_array_equal(held.marker_sd, motion.marker_sd)
