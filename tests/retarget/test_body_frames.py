"""The standard pose of a character."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.characters.character import SIDES
from mocapfix.characters.character_presets import load_character_preset
from mocapfix.files.option_choices import CHARACTER_PRESETS
from mocapfix.retarget.body_frames import LIMB_DIRECTIONS, build_body_frame
from tests.retarget.walking_body import load_walk, scale_limbs, turn_axes


@pytest.mark.parametrize("name", CHARACTER_PRESETS)
def test_limbs_of_presets_are_straight_in_the_standard_pose(name):
    frame = build_body_frame(load_character_preset(name))
    for side in SIDES:
        for start, end, direction in (("thigh", "shin", [0, -1, 0]), ("upper_arm", "forearm", LIMB_DIRECTIONS[side])):
            vector = frame.compute_vector(f"{side}_{start}", frame.find_head(f"{side}_{end}"))
            np.testing.assert_allclose(vector / np.linalg.norm(vector), direction, atol=1e-6)
        assert frame.compute_ball(side)[2] > 0.05  # the toes point forward


def test_standard_axes_do_not_depend_on_the_axes_of_the_bones():
    character, _ = load_walk()
    frame, turned = build_body_frame(character), build_body_frame(turn_axes(character, np.random.default_rng(0)))
    for segment in frame.segment_bones:
        expected = frame.compute_vector(segment, np.array([0.3, 0.2, 0.1]))
        np.testing.assert_allclose(turned.compute_vector(segment, np.array([0.3, 0.2, 0.1])), expected, atol=1e-9)


@pytest.mark.parametrize("angle_deg", [0, 90, 180, -135])
def test_figure_may_face_any_way(angle_deg):
    character, _ = load_walk()
    turn = Rotation.from_euler("y", angle_deg, degrees=True).as_matrix()
    positions, rotations = character.rest_positions.copy(), character.rest_rotations.copy()
    positions[0], rotations[0] = turn @ positions[0], turn @ rotations[0]
    frame = build_body_frame(replace(character, rest_positions=positions, rest_rotations=rotations))
    np.testing.assert_allclose(frame.facing, turn, atol=1e-9)
    reference = build_body_frame(character)
    for segment, bone in frame.segment_bones.items():
        np.testing.assert_allclose(frame.standard_rotations[bone], reference.standard_rotations[bone], atol=1e-9, err_msg=segment)


def test_measures_follow_the_bones():
    character, _ = load_walk()
    frame, scaled = build_body_frame(character), build_body_frame(scale_limbs(character, legs=0.7, arms=1.3))
    assert scaled.leg_length_m == pytest.approx(0.7 * frame.leg_length_m)
    assert scaled.arm_length_m == pytest.approx(1.3 * frame.arm_length_m)
    assert scaled.trunk_length_m == pytest.approx(frame.trunk_length_m)


def test_foot_without_toes_has_an_estimated_ball():
    character, _ = load_walk()
    bones = {segment: chain for segment, chain in character.mapping.bones.items() if not segment.endswith("toe")}
    tails = np.full_like(character.tails, np.nan)
    frame = build_body_frame(replace(character, tails=tails, mapping=replace(character.mapping, bones=bones)))
    ball = frame.compute_ball("left")
    assert ball[2] == pytest.approx(0.15 * frame.leg_length_m)
    assert ball[1] < 0
