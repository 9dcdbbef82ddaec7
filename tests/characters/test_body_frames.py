"""The standard pose of a character."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.characters.body_frames import LIMB_DIRECTIONS, build_body_frame
from mocapfix.characters.character import SIDES
from mocapfix.characters.load_character import load_character_preset
from mocapfix.options import CHARACTER_PRESETS
from tests.characters.character_files import change_bones
from tests.characters.walking_body import load_walk, scale_limbs, turn_axes


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
    positions, rotations = character.skeleton.offsets.copy(), character.skeleton.rest_rotations.copy()
    positions[0], rotations[0] = turn @ positions[0], turn @ rotations[0]
    frame = build_body_frame(change_bones(character, offsets=positions, rest_rotations=rotations))
    np.testing.assert_allclose(frame.facing, turn, atol=1e-9)
    reference = build_body_frame(character)
    for segment, bone in frame.segment_bones.items():
        np.testing.assert_allclose(frame.standard_rotations[bone], reference.standard_rotations[bone], atol=1e-9, err_msg=segment)


def test_measures_follow_the_bones():
    character, _ = load_walk()
    frame, scaled = build_body_frame(character), build_body_frame(scale_limbs(character, legs=0.7, arms=1.3))
    assert scaled.leg_length_m == pytest.approx(0.7 * frame.leg_length_m)
    assert scaled.compute_length("upper_arm", "forearm", "hand") == pytest.approx(
        1.3 * frame.compute_length("upper_arm", "forearm", "hand")
    )
    assert scaled.trunk_length_m == pytest.approx(frame.trunk_length_m)


def pose_rest(character, turns: dict[str, np.ndarray]):
    """Return the same figure with another rest pose: bones turned in the world, with all that they carry."""
    rotations = character.skeleton.rest_rotations.copy()
    _, world = character.skeleton.compute_rest_pose()
    for segment, turn in turns.items():
        bone = character.mapping.bones[segment][0]
        rotations[bone] = rotations[bone] @ world[bone].T @ turn @ world[bone]
    return change_bones(character, rest_rotations=rotations)


def test_an_a_pose_and_feet_that_point_outwards_have_the_same_standard_pose():
    character = load_character_preset("mixamo")
    turns = {}
    for side, sign in (("left", -1), ("right", 1)):
        turns[f"{side}_upper_arm"] = Rotation.from_euler("z", sign * 45, degrees=True).as_matrix()
        turns[f"{side}_foot"] = Rotation.from_euler("y", -sign * 10, degrees=True).as_matrix()
    posed = pose_rest(character, turns)
    frame, other = build_body_frame(character), build_body_frame(posed)
    moved = np.linalg.norm(other.find_head("left_hand") - frame.find_head("left_hand"))
    assert moved > 0.3
    for segment in ("left_upper_arm", "right_forearm", "left_hand", "right_foot", "left_toe", "head"):
        bone = frame.segment_bones[segment]
        np.testing.assert_allclose(other.standard_rotations[bone], frame.standard_rotations[bone], atol=1e-6, err_msg=segment)


@pytest.mark.parametrize(("height_m", "expected_m"), [(0.02, 0.02), (0.0, 0.0), (-1e-9, 0.0), (-0.01, 0.0)])
def test_ball_height_is_that_of_the_rest_pose_on_the_floor(height_m, expected_m):
    character = load_character_preset("mixamo")
    frame = build_body_frame(character)
    lowered = character.skeleton.offsets.copy()
    lowered[0, 1] += height_m - frame.find_head("left_toe")[1]
    assert build_body_frame(change_bones(character, offsets=lowered)).ball_height_m == pytest.approx(expected_m, abs=1e-6)


def test_figure_that_does_not_stand_on_the_floor_has_an_estimated_ball_height():
    character = load_character_preset("mixamo")
    raised = character.skeleton.offsets.copy()
    raised[0, 1] += 1.0
    frame = build_body_frame(change_bones(character, offsets=raised))
    assert frame.ball_height_m == pytest.approx(0.03 * frame.leg_length_m)


def test_foot_without_toes_has_an_estimated_ball():
    character, _ = load_walk()
    bones = {segment: chain for segment, chain in character.mapping.bones.items() if not segment.endswith("toe")}
    tails = np.full_like(character.skeleton.ends, np.nan)
    mapping = replace(character.mapping, bones=bones)
    frame = build_body_frame(replace(change_bones(character, ends=tails), mapping=mapping))
    ball = frame.compute_ball("left")
    assert ball[2] == pytest.approx(0.15 * frame.leg_length_m)
    assert ball[1] < 0
