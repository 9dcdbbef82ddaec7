"""Characters by name and from files, and what is refused."""

from dataclasses import replace

import pytest

from mocapfix.characters.character import REQUIRED_SEGMENTS, CharacterMotion, build_cmu31_character
from mocapfix.characters.character_files import write_character_bvh, write_character_glb
from mocapfix.characters.character_yaml import write_mapping_file
from mocapfix.characters.load_character import check_lengths, load_character, load_character_preset, read_character_skeletons
from mocapfix.errors import ReadError, SceneError
from mocapfix.model.skeleton import load_cmu31_skeleton
from mocapfix.options import CHARACTER_PRESETS
from tests.characters.character_files import FIGURE, PREFIX, build_mixamo_glb, change_bones, edit_glb, node_of


def rest_motion(character) -> CharacterMotion:
    """Return one frame of the rest pose."""
    pelvis = character.mapping.bones["pelvis"][0]
    return CharacterMotion(character.skeleton.offsets[pelvis][None], character.skeleton.rest_rotations[None], 30.0)


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
        names = [character.skeleton.names[bone] for bone in character.mapping.bones[segment]]
        assert names == [preset.skeleton.names[bone] for bone in preset.mapping.bones[segment]]


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
    positions = character.skeleton.offsets.copy()
    positions[character.mapping.bones["left_foot"][0]] = 0
    with pytest.raises(SceneError, match=r"hero: the bones 'LeftLeg' and 'LeftFoot' \(left shin\) are at one place"):
        check_lengths(change_bones(character, offsets=positions), "hero")


def test_the_first_skeleton_that_forms_a_body_is_taken(tmp_path):
    """A rope of more joints than the body comes first in the file."""

    def edit(document):
        first, count = len(document["nodes"]), len(FIGURE.names) + 5
        document["nodes"] += [{"name": f"rope {k}", "children": [first + k + 1]} for k in range(count)]
        document["nodes"][-1].pop("children")
        document["scenes"][0]["nodes"].append(first)
        document["skins"].append({"joints": list(range(first, first + count))})

    path = tmp_path / "roped.glb"
    path.write_bytes(edit_glb(build_mixamo_glb(), edit))
    assert read_character_skeletons(path)[0].skeleton.names[0] == "rope 0"
    character = load_character(path)
    assert character.skeleton.names[character.mapping.bones["pelvis"][0]] == f"{PREFIX}Hips"
    write_mapping_file(tmp_path / "map.yaml", character)
    assert load_character(path, tmp_path / "map.yaml").skeleton.names == character.skeleton.names


def test_what_is_wrong_with_the_largest_skeleton_is_stated(tmp_path):
    def edit(document):
        document["skins"][0]["joints"] = [node_of(FIGURE.names.index(name)) for name in ("Hips", "LeftLeg", "LeftFoot")]

    (tmp_path / "leg.glb").write_bytes(edit_glb(build_mixamo_glb(), edit))
    with pytest.raises(SceneError, match=r"leg\.glb: "):
        load_character(tmp_path / "leg.glb")


@pytest.mark.parametrize("feet_flat", [True, False])
def test_the_mapping_file_decides_whether_soles_are_flat(tmp_path, feet_flat):
    character = load_character("mixamo")
    assert character.has_feet_flat
    write_mapping_file(tmp_path / "map.yaml", replace(character, has_feet_flat=feet_flat))
    assert load_character("mixamo", tmp_path / "map.yaml").has_feet_flat is feet_flat
    source = build_cmu31_character(load_cmu31_skeleton())
    write_character_bvh(tmp_path / "solved.bvh", source, rest_motion(source))
    solved = load_character(tmp_path / "solved.bvh")
    assert not solved.has_feet_flat
    write_mapping_file(tmp_path / "solved.yaml", replace(solved, has_feet_flat=feet_flat))
    assert load_character(tmp_path / "solved.bvh", tmp_path / "solved.yaml").has_feet_flat is feet_flat


def test_a_mapping_file_without_the_soles_leaves_them_to_the_rest_pose(tmp_path):
    source = build_cmu31_character(load_cmu31_skeleton())
    write_character_bvh(tmp_path / "solved.bvh", source, rest_motion(source))
    path = tmp_path / "solved.yaml"
    write_mapping_file(path, load_character(tmp_path / "solved.bvh"))
    text = path.read_text(encoding="utf-8")
    assert "\nfeet_flat: false\n" in text
    path.write_text(text.replace("\nfeet_flat: false\n", "\n"), encoding="utf-8")
    assert not load_character(tmp_path / "solved.bvh", path).has_feet_flat


def test_swapped_names_of_sides_are_refused(tmp_path):
    def edit(document):
        for node in document["nodes"]:
            for one, other in (("Left", "Right"), ("Right", "Left")):
                if node["name"].startswith(f"{PREFIX}{one}"):
                    node["name"] = node["name"].replace(one, other)
                    break

    path = tmp_path / "swapped.glb"
    path.write_bytes(edit_glb(build_mixamo_glb(), edit))
    with pytest.raises(SceneError, match=r"swapped\.glb: the toes 'mixamorig:LeftToeBase' and .* point backwards"):
        load_character(path)
