"""Characters by name and from files, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest

from mocapfix.characters.character import REQUIRED_SEGMENTS, CharacterMotion
from mocapfix.characters.character_choice import are_shins_upright, check_lengths, load_character
from mocapfix.characters.character_presets import load_character_preset
from mocapfix.characters.cmu31_character import build_cmu31_character
from mocapfix.characters.mapping_file import write_mapping_file
from mocapfix.errors import ReadError, SceneError
from mocapfix.files.option_choices import CHARACTER_PRESETS
from mocapfix.skeleton import load_cmu31_skeleton
from mocapfix.write.character_bvh import write_character_bvh
from mocapfix.write.character_glb import write_character_glb


def rest_motion(character) -> CharacterMotion:
    """Return one frame of the rest pose."""
    pelvis = character.mapping.bones["pelvis"][0]
    return CharacterMotion(character.rest_positions[pelvis][None], character.rest_rotations[None], 30.0)


@pytest.mark.parametrize("name", CHARACTER_PRESETS)
def test_presets_are_loaded_by_name(name):
    assert load_character(name) is not None
    assert not load_character(name).mapping.missing_segments


@pytest.mark.parametrize(("suffix", "write"), [("glb", write_character_glb), ("bvh", write_character_bvh)])
def test_bones_of_a_file_are_mapped_by_their_names(tmp_path, suffix, write):
    preset = load_character_preset("mixamo")
    path = tmp_path / f"my hero.{suffix}"
    write(path, preset, rest_motion(preset), *(("rest",) if suffix == "glb" else ()))
    character = load_character(path)
    assert character.name == "my-hero"
    for segment in REQUIRED_SEGMENTS:
        names = [character.names[bone] for bone in character.mapping.bones[segment]]
        assert names == [preset.names[bone] for bone in preset.mapping.bones[segment]]


def test_an_edited_mapping_is_used_in_place_of_the_own_one(tmp_path):
    preset = load_character_preset("mixamo")
    bones = {segment: chain for segment, chain in preset.mapping.bones.items() if not segment.endswith("toe")}
    write_mapping_file(tmp_path / "map.yaml", replace(preset, mapping=replace(preset.mapping, bones=bones)))
    character = load_character("mixamo", tmp_path / "map.yaml")
    assert "left_toe" not in character.mapping.bones
    assert character.mapping.bones["left_foot"] == preset.mapping.bones["left_foot"]


def test_unknown_names_and_files_are_refused(tmp_path):
    with pytest.raises(SceneError, match=r"There is no character 'maya'; choose one of daz-g8, .*, or give a file\."):
        load_character("maya")
    with pytest.raises(ReadError, match=r"nowhere\.glb"):
        load_character(tmp_path / "nowhere.glb")


def test_a_limb_without_length_is_refused():
    character = build_cmu31_character(load_cmu31_skeleton())
    positions = character.rest_positions.copy()
    positions[character.mapping.bones["left_foot"][0]] = 0
    with pytest.raises(SceneError, match=r"hero: the bones 'LeftLeg' and 'LeftFoot' \(left shin\) are at one place"):
        check_lengths(replace(character, rest_positions=positions), "hero")


def test_spread_legs_of_the_31_joints_are_no_rest_pose_with_flat_feet():
    character = build_cmu31_character(load_cmu31_skeleton())
    assert not are_shins_upright(character)
    assert are_shins_upright(load_character_preset("unreal"))
    assert np.isfinite(character.rest_positions).all()
