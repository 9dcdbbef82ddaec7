"""What rest poses show: swapped sides, posed limbs, and soles that lie flat."""

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mocapfix.characters.character import SIDES, Character, CharacterSource, build_cmu31_character
from mocapfix.characters.load_character import are_soles_flat, check_sides, describe_posed_limbs, load_character_preset
from mocapfix.errors import SceneError
from mocapfix.model.skeleton import load_cmu31_skeleton
from mocapfix.options import CHARACTER_PRESETS
from tests.characters.character_files import change_bones

SOLVED = build_cmu31_character(load_cmu31_skeleton())


def turn(character: Character, segment: str, axis: str, degrees: float) -> Character:
    """Return the character with a segment, and what it carries, turned about an axis of the world in its rest pose."""
    _, world = character.skeleton.compute_rest_pose()
    bone = character.mapping.bones[segment][0]
    above = world[character.skeleton.parents[bone]]
    rotations = character.skeleton.rest_rotations.copy()
    rotations[bone] = above.T @ Rotation.from_euler(axis, degrees, degrees=True).as_matrix() @ world[bone]
    return change_bones(character, rest_rotations=rotations)


def turn_both(character: Character, segment: str, axis: str, degrees: float) -> Character:
    """Turn both sides alike; about axes other than X in opposite directions, positive outwards for legs."""
    for side, sign in zip(SIDES, (1, -1), strict=True):
        character = turn(character, f"{side}_{segment}", axis, degrees if axis == "x" else sign * degrees)
    return character


def face(character: Character, degrees: float) -> Character:
    """Return the character facing another direction."""
    turned = Rotation.from_euler("y", degrees, degrees=True).as_matrix()
    positions, rotations = character.skeleton.offsets.copy(), character.skeleton.rest_rotations.copy()
    for bone in np.flatnonzero(character.skeleton.parents < 0):
        positions[bone], rotations[bone] = turned @ positions[bone], turned @ rotations[bone]
    return change_bones(character, offsets=positions, rest_rotations=rotations)


def swap_sides(character: Character, *segments: str) -> Character:
    """Return the character with the bones of both sides exchanged in its mapping."""
    bones = dict(character.mapping.bones)
    for segment in segments:
        left, right = f"left_{segment}", f"right_{segment}"
        bones[left], bones[right] = bones[right], bones[left]
    return replace(character, mapping=replace(character.mapping, bones=bones))


def as_file(character: Character, kind: str) -> Character:
    return replace(character, source=CharacterSource("a file", b"", np.zeros(0, int), kind))


@pytest.mark.parametrize("name", CHARACTER_PRESETS)
def test_presets_face_the_front_in_a_standard_pose(name):
    preset = load_character_preset(name)
    check_sides(preset, name)
    assert not describe_posed_limbs(preset)
    for segments in (("thigh", "shin", "foot", "toe", "clavicle", "upper_arm", "forearm", "hand"),):
        swapped = swap_sides(preset, *segments)
        with pytest.raises(SceneError, match=f"^{name}: the toes .* point backwards, so the bones of left and right are swapped"):
            check_sides(swapped, name)
    with pytest.raises(SceneError, match=r"are on different sides of the body; exchange"):
        check_sides(swap_sides(preset, "thigh", "shin", "foot", "toe"), name)


@given(heel=st.floats(-30, 55), toes_out=st.floats(-45, 60), facing=st.floats(-180, 180))
def test_feet_in_any_shoes_are_not_swapped(heel, toes_out, facing):
    character = turn_both(turn_both(load_character_preset("mixamo"), "foot", "x", heel), "foot", "y", toes_out)
    check_sides(face(character, facing), "a figure")


def test_figures_without_toes_are_no_evidence():
    preset = load_character_preset("mixamo")
    bones = {segment: chain for segment, chain in preset.mapping.bones.items() if not segment.endswith("toe")}
    segments = ("thigh", "shin", "foot", "clavicle", "upper_arm", "forearm", "hand")
    check_sides(swap_sides(replace(preset, mapping=replace(preset.mapping, bones=bones)), *segments), "a figure")


@pytest.mark.parametrize(
    ("segment", "axis", "degrees", "expected"),
    [
        ("left_thigh", "x", -55, "left thigh 56 degrees from the vertical"),
        ("right_shin", "x", 80, "right shin 85 degrees from the vertical"),
        ("left_upper_arm", "z", -45, "upper arms differ by 45 degrees"),
        ("right_forearm", "y", 60, "forearms differ by 60 degrees"),
    ],
)
@pytest.mark.parametrize("facing", [0, 130])
def test_a_posed_limb_is_named(segment, axis, degrees, expected, facing):
    character = face(turn(load_character_preset("mixamo"), segment, axis, degrees), facing)
    sentence = describe_posed_limbs(character)
    assert sentence.startswith("Its bones are not in a T- or A-pose (")
    assert re.search(expected, sentence), sentence


def test_a_lying_rest_pose_is_described_and_shows_no_swapped_sides():
    """Some BVH files have offsets of no pose at all: the trunk lies, and the legs do not face where the arms do."""
    character = load_character_preset("mixamo")
    bones = character.mapping.bones
    _, world = character.skeleton.compute_rest_pose()
    above = world[character.skeleton.parents[bones["spine"][0]]]
    rotations = character.skeleton.rest_rotations.copy()
    lying = Rotation.from_euler("yx", [180, 60], degrees=True).as_matrix()
    rotations[bones["spine"][0]] = above.T @ lying @ world[bones["spine"][0]]
    character = change_bones(character, rest_rotations=rotations)
    check_sides(character, "a file")
    assert re.search(r"\(trunk \d\d degrees from the vertical\)", describe_posed_limbs(character))


def test_other_standard_poses_are_not_posed():
    preset = load_character_preset("mixamo")
    for segment, axis, degrees in (("upper_arm", "z", -75), ("thigh", "z", 20), ("upper_arm", "x", 40), ("thigh", "x", -10)):
        assert not describe_posed_limbs(turn_both(preset, segment, axis, degrees)), (segment, axis)


@pytest.mark.parametrize("facing", [0, -70])
def test_feet_of_recorded_skeletons_go_with_their_spread_shins(facing):
    assert not are_soles_flat(face(as_file(SOLVED, "bvh"), facing))
    assert not are_soles_flat(as_file(SOLVED, "gltf"))  # the file that is written of the solved skeleton
    upright = turn_both(SOLVED, "thigh", "z", -20)
    assert are_soles_flat(as_file(upright, "bvh"))


@pytest.mark.parametrize("kind", ["gltf", "bvh"])
@pytest.mark.parametrize("spread", [13, 20])
def test_feet_that_stand_flat_below_spread_legs_stay_flat(kind, spread):
    preset = as_file(load_character_preset("mixamo"), kind)
    standing = turn_both(turn_both(preset, "thigh", "z", spread), "foot", "z", -spread)
    assert are_soles_flat(standing)
    assert are_soles_flat(turn_both(standing, "foot", "y", 15))
    assert are_soles_flat(turn_both(preset, "thigh", "z", spread)) is (kind == "gltf")
    assert are_soles_flat(turn(preset, "left_thigh", "z", spread))
