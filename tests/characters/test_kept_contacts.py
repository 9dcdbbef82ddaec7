"""Feet of a character that are held in the contacts of the source."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.characters.body_frames import build_body_frame, compute_segment_motion
from mocapfix.characters.character import SIDES, compute_character_poses
from mocapfix.characters.kept_positions import bend_toe, hold_kept_feet, resample_foot_contacts
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


@pytest.mark.parametrize("has_toes", [True, False])
def test_soles_of_the_mesh_stand_on_the_floor_and_never_pass_it(contacts, has_toes):
    """Shoes are boxes: heel and ball on the foot, the tip on the toe if there is one, else on the foot."""
    character, motion = load_walk()
    target = load_character_preset("mixamo")
    bones, heads = target.mapping.bones, target.skeleton.rest_positions
    parts = {f"{side}_foot": heads[bones[f"{side}_foot"][0]] * [1, 0, 1] for side in SIDES}
    tips = {f"{side}_toe": heads[bones[f"{side}_toe"][0]] * [1, 0, 1] + [0, 0, 0.09] for side in SIDES}
    widths = np.array([[-0.04, 0.0, 0.0], [0.04, 0.0, 0.0]])
    soles = {foot: np.concatenate([place + widths + [0, 0, z] for z in (-0.07, 0.12)]) for foot, place in parts.items()}
    for toe, place in tips.items():
        carrier = toe if has_toes else toe.replace("toe", "foot")
        soles[carrier] = np.concatenate([soles.get(carrier, np.zeros((0, 3))), place + widths])
    target = replace(target, hulls=soles)
    positions, rotations = compute_character_poses(target, retarget_motion(character, motion, target, contacts=contacts))
    _, axes = target.skeleton.compute_rest_pose()
    feet = resample_foot_contacts(contacts, motion.frame_count, motion.rate)
    for side in SIDES:
        lowest = np.full(motion.frame_count, np.inf)
        for segment, points in soles.items():
            if segment.startswith(side):
                bone = bones[segment][0]
                vectors = (points - heads[bone]) @ axes[bone]
                heights = positions[:, None, bone, 1] + np.einsum("tb,pb->tp", rotations[:, bone, 1], vectors)
                lowest = np.minimum(lowest, heights.min(1))
        is_standing = feet.find_foot_contact(side)
        assert lowest.min() > -0.005
        assert np.percentile(lowest[is_standing], 95) < 0.005


def test_a_toe_is_bent_until_its_tip_is_on_the_floor():
    pitch = np.deg2rad([-30.0, 5.0, 40.0])
    rotation = Rotation.from_rotvec(pitch[:, None] * [1, 0, 0]).as_matrix()  # of a heel that is lifted by these angles
    sole = np.array([[0.0, -0.02, 0.0], [0.0, -0.02, 0.1]])
    bent = bend_toe(rotation, sole, np.full(3, 0.03))
    heights = 0.03 + bent[:, 1] @ sole[1]
    np.testing.assert_allclose(bent[:2], rotation[:2], atol=1e-9)
    np.testing.assert_allclose(heights[2], 0.0, atol=1e-9)
