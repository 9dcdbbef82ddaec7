"""The mapping of a character's bones as a file that people edit."""

from dataclasses import replace
from pathlib import Path

import pytest

from mocapfix.characters.character import SEGMENTS, BoneMapping, Character
from mocapfix.characters.character_yaml import read_mapping_file, write_mapping_file
from mocapfix.characters.load_character import load_character_preset
from mocapfix.errors import SceneError, WriteError
from mocapfix.options import CHARACTER_PRESETS
from tests.characters.character_files import change_bones


@pytest.fixture
def daz() -> Character:
    return load_character_preset("daz-g9")


@pytest.mark.parametrize("name", CHARACTER_PRESETS)
def test_written_mapping_is_read_back(name: str, tmp_path: Path):
    preset = load_character_preset(name)
    write_mapping_file(tmp_path / "a.map.yaml", preset)
    mapping = read_mapping_file(tmp_path / "a.map.yaml", preset)
    assert dict(mapping.bones) == dict(preset.mapping.bones)
    assert dict(mapping.twists) == dict(preset.mapping.twists)
    assert mapping.reason == "The mapping file a.map.yaml."


def test_file_explains_its_use_and_lists_the_other_bones(daz: Character, tmp_path: Path):
    write_mapping_file(tmp_path / "a.yaml", daz)
    text = (tmp_path / "a.yaml").read_text(encoding="utf-8")
    assert "--character-map" in text
    assert daz.mapping.reason in text
    assert [line.split(":")[0].strip() for line in text.splitlines() if line.startswith("  ")][:20] == list(SEGMENTS)
    comment = text.split("# bones without a segment:")[1]
    assert {"l_thumb1", "pelvis"} <= set(comment.replace("#", " ").replace(",", " ").split())
    assert "spine1" not in comment
    assert max(map(len, text.splitlines())) <= 131


def test_missing_segments_are_empty_lists(daz: Character, tmp_path: Path):
    bones = {segment: chain for segment, chain in daz.mapping.bones.items() if segment not in ("neck", "left_toe")}
    partial = replace(daz, mapping=BoneMapping(bones))
    write_mapping_file(tmp_path / "a.yaml", partial)
    assert "  left_toe: []\n" in (tmp_path / "a.yaml").read_text(encoding="utf-8")
    mapping = read_mapping_file(tmp_path / "a.yaml", partial)
    assert dict(mapping.bones) == bones
    assert not mapping.twists


def test_edited_bone_is_used(daz: Character, tmp_path: Path):
    write_mapping_file(tmp_path / "a.yaml", daz)
    text = (tmp_path / "a.yaml").read_text(encoding="utf-8")
    (tmp_path / "a.yaml").write_text(
        text.replace("pelvis: [hip]", "pelvis: hip").replace("[spine1, spine2, ", "[spine2, "), encoding="utf-8"
    )
    mapping = read_mapping_file(tmp_path / "a.yaml", daz)
    assert mapping.bones["pelvis"] == (daz.skeleton.find_joint("hip"),)
    assert [daz.skeleton.names[bone] for bone in mapping.bones["spine"]] == ["spine2", "spine3", "spine4"]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("head: [head]", "head: [haed]", "segments.head: there is no bone 'haed' in this character; check its spelling."),
        ("head: [head]", "head: [neck2]", "segments.head: the bone 'neck2' is already in segments.neck; a bone has one place."),
        ("head: [head]", "haed: [head]", "segments.haed: there is no such segment; the segments are pelvis, spine, "),
        ("[spine1, spine2,", "[spine2, spine1,", "segments.spine: the bone 'spine1' is not below 'spine2'; name the bones from"),
        ("left_foot: [l_foot]", "left_foot: [r_foot]", "segments.right_foot: the bone 'r_foot' is already in segments.left_foot"),
        ("left_foot: [l_foot]", "left_foot: []", "segments.left_foot: is missing; a body needs left_foot."),
        ("left_foot: [l_foot]", "left_foot: [l_foot, l_metatarsal]", "segments.left_foot: has 2 bones, but this segment is one"),
        ("left_shin: [l_shin]", "left_shin: [l_foot]", "is already in segments.left_shin"),
        ("pelvis: [hip]", "pelvis: [pelvis]", "segments.spine: the bone 'spine1' is not below 'pelvis'"),
        ("left_thigh: [l_thightwist1,", "left_hand: [l_thightwist1,", "twists.left_hand: there are no such twist bones"),
        ("left_thigh: [l_thightwist1,", "left_thigh: [r_thightwist1,", "twists.right_thigh: the bone 'r_thightwist1' is already"),
        ("left_forearm: [l_forearmtwist1,", "left_forearm: [l_pectoral,", "the bone 'l_pectoral' is not below 'l_forearm'"),
        ("\ntwists:", "\ntwist:", "twist: there is no such key; check its spelling."),
        ("\n  pelvis: [hip]", " [hip]\nx:", "segments: must be key: value pairs."),
    ],
)
def test_wrong_entry_is_explained_with_file_and_key(old: str, new: str, message: str, daz: Character, tmp_path: Path):
    path = tmp_path / "a.yaml"
    write_mapping_file(path, daz)
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(SceneError) as caught:
        read_mapping_file(path, daz)
    assert str(caught.value).startswith(f"{path}: ")
    assert message in str(caught.value)


def test_names_with_line_breaks_stay_in_comments(daz: Character, tmp_path: Path):
    names = tuple("strange\nname: [" if name == "l_pectoral" else name for name in daz.skeleton.names)
    write_mapping_file(tmp_path / "a.yaml", replace(change_bones(daz, names=names), name="two\nlines"))
    assert dict(read_mapping_file(tmp_path / "a.yaml", daz).bones) == dict(daz.mapping.bones)


def test_failed_writing_is_an_error(daz: Character, tmp_path: Path):
    with pytest.raises(WriteError):
        write_mapping_file(tmp_path / "missing" / "a.yaml", daz)
