"""Feet that lie flat."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.characters.body_frames import build_body_frame, compute_segment_motion
from mocapfix.characters.character import SIDES, CharacterMotion, compute_character_poses
from mocapfix.characters.kept_positions import LEVEL_SHARE, KeptPositions, level_feet, measure_flat_feet, rest_feet
from mocapfix.characters.load_character import load_character_preset
from mocapfix.characters.retarget_motion import retarget_motion
from mocapfix.contacts.contacts import Floor, build_no_contacts
from tests.characters.walking_body import load_walk

FRAMES = 30
FLOOR_M = 0.1
BALL_M = 0.05
INCLINATION_DEG = 8.0


@pytest.fixture(scope="module")
def standing():
    """The average body standing: feet inclined by 8 degrees, balls 50 mm above a floor at 0.1 m; and its contacts."""
    character, motion = load_walk()
    local = np.tile(character.skeleton.rest_rotations, (FRAMES, 1, 1, 1))
    for side, spread_deg in (("left", -20.0), ("right", 20.0)):
        bones = character.mapping.bones
        local[:, bones[f"{side}_thigh"][0]] = Rotation.from_euler("z", spread_deg, degrees=True).as_matrix()
        local[:, bones[f"{side}_foot"][0]] = Rotation.from_euler("x", INCLINATION_DEG, degrees=True).as_matrix()
    frame = build_body_frame(character)
    still = CharacterMotion(np.zeros((FRAMES, 3)), local, motion.rate)
    segments = compute_segment_motion(frame, still)
    balls = [segments.position[f"{side}_foot"] + segments.rotation[f"{side}_foot"] @ frame.compute_ball(side) for side in SIDES]
    raised = replace(still, pelvis_position=still.pelvis_position + [0.0, FLOOR_M + BALL_M - balls[0][0, 1], 0.0])
    contacts = build_no_contacts(FRAMES, motion.rate)
    contacts = replace(contacts, is_contact=np.ones_like(contacts.is_contact), floor=Floor(0.0, 0.0, (FLOOR_M,)))
    return character, raised, contacts


def test_height_and_inclination_of_flat_feet_are_measured(standing):
    character, motion, contacts = standing
    frame = build_body_frame(character)
    feet = measure_flat_feet(frame, compute_segment_motion(frame, motion), contacts)
    for foot in feet.values():
        assert foot.ball_height_m == pytest.approx(BALL_M, abs=1e-3)
        angle_deg = np.degrees(np.linalg.norm(Rotation.from_matrix(foot.inclination).as_rotvec()))
        assert angle_deg == pytest.approx(INCLINATION_DEG, abs=1.5)  # the composed bones spread by about 20 degrees, not exactly


def test_level_feet_have_no_inclination_where_they_lie_flat(standing):
    character, motion, contacts = standing
    frame = build_body_frame(character)
    segments = compute_segment_motion(frame, motion)
    level = level_feet(segments, measure_flat_feet(frame, segments, contacts))
    for side in SIDES:
        np.testing.assert_allclose(level.rotation[f"{side}_foot"][:, 1], np.tile([0, 1, 0], (FRAMES, 1)), atol=1e-9)


@pytest.mark.parametrize("pitch_deg", [0.0, 25.0])
def test_feet_that_roll_in_contacts_roll_less_about_their_balls_and_stay_on_their_toes(standing, pitch_deg):
    character, motion, contacts = standing
    frame = build_body_frame(character)
    segments = compute_segment_motion(frame, motion)
    angles = np.stack([4.0 * (-1.0) ** np.arange(FRAMES), np.full(FRAMES, pitch_deg)], axis=1)
    rolled = Rotation.from_euler("zx", angles, degrees=True).as_matrix()
    segments = replace(segments, rotation={**segments.rotation, "left_foot": rolled})
    kept = KeptPositions(np.zeros((FRAMES, 3)), {side: segments.position[f"{side}_foot"] for side in SIDES}, {})
    rested, turned = rest_feet(frame, kept, segments, contacts)
    roll_deg, pitches_deg, _ = Rotation.from_matrix(turned.rotation["left_foot"]).as_euler("zxy", degrees=True).T
    np.testing.assert_allclose(roll_deg, (1 - LEVEL_SHARE) * angles[:, 0], atol=0.1)
    np.testing.assert_allclose(pitches_deg, pitch_deg, atol=0.1)
    ball = frame.compute_ball("left")
    before, after = kept.ankles["left"] + rolled @ ball, rested.ankles["left"] + turned.rotation["left_foot"] @ ball
    np.testing.assert_allclose(after, before, atol=1e-12)
    free = replace(contacts, is_contact=np.zeros_like(contacts.is_contact))
    np.testing.assert_allclose(rest_feet(frame, kept, segments, free)[1].rotation["left_foot"], segments.rotation["left_foot"])


def test_feet_that_are_usually_a_little_inclined_in_contacts_lie_flatter(standing):
    character, motion, contacts = standing
    frame = build_body_frame(character)
    segments = level_feet(
        compute_segment_motion(frame, motion), measure_flat_feet(frame, compute_segment_motion(frame, motion), contacts)
    )
    pitched = segments.rotation["left_foot"] @ Rotation.from_euler("x", 2.0, degrees=True).as_matrix()
    segments = replace(segments, rotation={**segments.rotation, "left_foot": pitched})
    kept = KeptPositions(np.zeros((FRAMES, 3)), {side: segments.position[f"{side}_foot"] for side in SIDES}, {})
    turned = rest_feet(frame, kept, segments, contacts)[1]
    assert np.degrees(np.arccos(turned.rotation["left_foot"][:, 1, 1])).max() < 2.0 * (1.1 - LEVEL_SHARE)


def test_soles_of_a_character_lie_on_the_floor(standing):
    character, motion, contacts = standing
    target = load_character_preset("mixamo")
    frame = build_body_frame(target)
    position, _ = compute_character_poses(target, retarget_motion(character, motion, target, contacts=contacts))
    for side in SIDES:
        ankle, ball = (position[:, target.mapping.bones[f"{side}_{segment}"][0], 1] for segment in ("foot", "toe"))
        np.testing.assert_allclose(ball, frame.ball_height_m, atol=2e-3)
        np.testing.assert_allclose(ankle, frame.ankle_height_m, atol=2e-3)


def test_feet_that_are_never_flat_are_those_of_the_skeleton(standing):
    character, motion, _ = standing
    frame = build_body_frame(character)
    segments = compute_segment_motion(frame, motion)
    for contacts in (None, build_no_contacts(FRAMES, motion.rate)):
        for foot in measure_flat_feet(frame, segments, contacts).values():
            assert foot.ball_height_m == frame.ball_height_m
            np.testing.assert_array_equal(foot.inclination, np.eye(3))


@pytest.mark.parametrize("steep_deg", [20, 60])
def test_a_foot_that_stands_on_its_toes_or_an_edge_is_not_taken_to_be_flat(standing, steep_deg):
    character, motion, contacts = standing
    steep = motion.local_rotations.copy()
    bone = character.mapping.bones["left_foot"][0]
    steep[:, bone] = steep[:, bone] @ Rotation.from_euler("x", steep_deg, degrees=True).as_matrix()
    frame = build_body_frame(character)
    segments = compute_segment_motion(frame, replace(motion, local_rotations=steep))
    feet = measure_flat_feet(frame, segments, contacts)
    upward = {side: foot.inclination[1] for side, foot in feet.items()}
    np.testing.assert_allclose(upward["left"], upward["right"] * [-1, 1, 1], atol=1e-12)  # like that of the other foot
    angle_deg = np.degrees(np.arccos(upward["left"][1]))
    assert angle_deg == pytest.approx(INCLINATION_DEG, abs=1.5)


@pytest.mark.parametrize(("sway_deg", "is_levelled"), [(2.0, True), (20.0, False)])
def test_a_foot_of_constant_inclination_lies_flat(standing, sway_deg, is_levelled):
    """Skeletons of other programs have the ankle higher above the ball, so that their feet point down by 40 degrees."""
    character, motion, contacts = standing
    local = motion.local_rotations.copy()
    pitch = 30.0 + sway_deg * np.sin(np.arange(FRAMES))
    for foot in (character.mapping.bones[f"{side}_foot"][0] for side in SIDES):
        local[:, foot] = Rotation.from_euler("x", pitch[:, None], degrees=True).as_matrix() @ local[:, foot]
    frame = build_body_frame(character)
    feet = measure_flat_feet(frame, compute_segment_motion(frame, replace(motion, local_rotations=local)), contacts)
    angle_deg = np.degrees(np.linalg.norm(Rotation.from_matrix(feet["left"].inclination).as_rotvec()))
    assert angle_deg == pytest.approx(30.0 + INCLINATION_DEG if is_levelled else 0.0, abs=3.0)
