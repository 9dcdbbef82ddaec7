"""Feet of a character that are held in the contacts of the source."""

from dataclasses import replace

import numpy as np
import pytest

from mocapfix.characters.body_frames import build_body_frame, compute_segment_motion
from mocapfix.characters.character import SIDES, compute_character_poses
from mocapfix.characters.kept_positions import hold_kept_feet, resample_foot_contacts
from mocapfix.characters.load_character import load_character_preset
from mocapfix.characters.retarget_motion import retarget_motion
from mocapfix.contacts.contacts import HeldFeet
from mocapfix.model.motion import Motion
from mocapfix.model.skeleton import load_cmu31_skeleton
from tests.characters.walking_body import RATE, build_contacts, load_walk


@pytest.fixture(scope="module")
def contacts():
    """The contacts of the walk."""
    character, motion = load_walk()
    zeros = np.zeros(motion.frame_count, int)
    skeleton = load_cmu31_skeleton()
    skeleton = type(skeleton)(skeleton.names, skeleton.parents, character.skeleton.offsets, skeleton.ends)
    solved = Motion(motion.pelvis_position, motion.local_rotations, zeros, zeros, np.zeros((0, 0)), np.zeros((0, 0)))
    return build_contacts(skeleton, solved, RATE)


def measure_drift_mm(character, motion, contacts) -> float:
    """Return the mean over contacts of the largest horizontal distance of ankle or ball from its mean place."""
    position, _ = compute_character_poses(character, motion)
    drifts = []
    for side in SIDES:
        for segment, joint in (("foot", "Foot"), ("toe", "ToeBase")):
            path = position[:, character.mapping.bones[f"{side}_{segment}"][0]][:, [0, 2]]
            for first, last in contacts.list_intervals(f"{side.capitalize()}{joint}"):
                place = path[first : last + 1]
                drifts.append(np.linalg.norm(place - place.mean(0), axis=1).max())
    return float(np.mean(drifts)) * 1e3


@pytest.mark.parametrize("name", ["mixamo", "smpl"])
def test_locked_feet_drift_less(contacts, name):
    character, motion = load_walk()
    target = load_character_preset(name)
    held = replace(contacts, held_feet=HeldFeet("lock", 0.0))
    free = measure_drift_mm(target, retarget_motion(character, motion, target, contacts=contacts), contacts)
    locked = measure_drift_mm(target, retarget_motion(character, motion, target, contacts=held), contacts)
    assert locked < 1.0
    assert locked < free / 2


def test_locked_balls_are_where_the_turned_feet_have_them(contacts):
    character, motion = load_walk()
    target = build_body_frame(load_character_preset("mixamo"))
    segments = compute_segment_motion(build_body_frame(character), motion)
    ankles = {side: segments.position[f"{side}_foot"] for side in SIDES}
    feet = {side: segments.rotation[f"{side}_foot"] for side in SIDES}
    at_rate = resample_foot_contacts(contacts, motion.frame_count, RATE)
    held_ankles, held_feet = hold_kept_feet(target, ankles, feet, at_rate)
    for side in SIDES:
        ball = held_ankles[side] + held_feet[side] @ target.compute_ball(side)
        for first, last in contacts.list_intervals(f"{side.capitalize()}ToeBase"):
            place = ball[first : last + 1, [0, 2]]
            assert np.linalg.norm(place - place.mean(0), axis=1).max() < 2e-3
        assert np.abs(held_feet[side] - feet[side]).max() > 1e-3


def test_contacts_at_half_the_rate_are_those_of_every_second_frame(contacts):
    half = resample_foot_contacts(contacts, len(contacts.is_contact) // 2, RATE / 2)
    assert half.rate == RATE / 2
    np.testing.assert_array_equal(half.is_contact, contacts.is_contact[: 2 * len(half.is_contact) : 2, :4])


def test_motion_longer_than_its_contacts_keeps_the_last(contacts):
    longer = resample_foot_contacts(contacts, len(contacts.is_contact) + 5, RATE)
    np.testing.assert_array_equal(longer.is_contact[-6:], np.repeat(contacts.is_contact[-1:, :4], 6, axis=0))
