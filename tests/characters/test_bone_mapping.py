"""Mapping of bones to segments: by names in many spellings, and by the shape of skeletons with unknown names."""

import re
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mocapfix.characters.bone_geometry import find_segments_by_shape
from mocapfix.characters.bone_mapping import find_detached_bones, find_segments_by_name, map_bones
from mocapfix.characters.character import SEGMENTS, BoneMapping, Character, reparent_bones
from mocapfix.characters.load_character import load_character_preset
from mocapfix.errors import SceneError
from mocapfix.model.skeleton import Skeleton, load_cmu31_body
from mocapfix.options import CHARACTER_PRESETS
from tests.characters.character_files import change_bones

# Bones that characters have besides those of the body.
EXTRA_PARTS = ("tail", "skirt", "hair", "breasts", "weapon", "wings", "cape", "face", "ik", "sleeves", "root")
SCALES = (0.3, 1.0, 100.0)
NOISE_M = 0.001
MAX_SEARCH_S = 5.0


def build_character(names: list[str], parents: list[int], positions: np.ndarray) -> Character:
    """Return a character of bones at world positions, all with the world's axes."""
    offsets = positions - np.where(np.array(parents)[:, None] >= 0, positions[parents], 0.0)
    count = len(names)
    return Character(
        "test", Skeleton(tuple(names), np.array(parents), offsets, np.full((count, 3), np.nan)), BoneMapping({}), np.ones(count)
    )


class Figure:
    """The bones of a preset, to which others are added."""

    def __init__(self, preset: Character) -> None:
        self.names, self.parents = list(preset.skeleton.names), preset.skeleton.parents.tolist()
        self.positions = list(preset.skeleton.compute_rest_pose()[0])
        self.bones = preset.mapping.bones

    def add(self, name: str, parent: int, *points: np.ndarray | list[float]) -> None:
        """Add a chain of bones at world positions."""
        for point in points:
            self.names.append(name)
            self.parents.append(parent)
            self.positions.append(np.array(point, float))
            parent = len(self.names) - 1

    def add_part(self, part: str) -> None:
        bones, at = self.bones, self.positions
        pelvis, chest, head = (bones[segment][-1] for segment in ("pelvis", "spine", "head"))
        hands = {side: bones[f"{side}_hand"][0] for side in ("left", "right")}
        match part:
            case "tail":
                self.add(part, pelvis, *(at[pelvis] + [0, -0.02 - 0.15 * i, -0.1 - 0.12 * i] for i in range(6)))
            case "skirt":
                for k in range(8):
                    out = np.array([np.sin(k * np.pi / 4 + 0.4), 0, np.cos(k * np.pi / 4 + 0.4)])
                    self.add(part, pelvis, *(at[pelvis] + [0, -0.05 - 0.2 * i, 0] + out * (0.15 + 0.06 * i) for i in range(5)))
            case "hair":
                for side in (1, -1):
                    self.add(part, head, *(at[head] + [side * (0.1 + 0.01 * i), 0.1 - 0.14 * i, -0.08] for i in range(7)))
                self.add(part, head, *(at[head] + [0, 0.12 - 0.12 * i, -0.1 - 0.02 * i] for i in range(6)))
            case "breasts":
                for side in (1, -1):
                    self.add(part, chest, at[chest] + [side * 0.08, -0.05, 0.08], at[chest] + [side * 0.09, -0.06, 0.14])
            case "weapon":
                self.add(part, hands["right"], *(at[hands["right"]] + [0, -0.05, z] for z in (0.05, 0.6, 1.2)))
            case "wings":
                for side in (1, -1):
                    shape = ([0.06, 0.1, -0.1], [0.5, 0.4, -0.2], [1.1, 0.5, -0.3], [1.6, 0.2, -0.3])
                    self.add(part, chest, *(at[chest] + np.array(point) * [side, 1, 1] for point in shape))
            case "cape":
                for x in (-0.15, 0.0, 0.15):
                    self.add(part, chest, *(at[chest] + [x, 0.1 - 0.27 * i, -0.12 - 0.03 * i] for i in range(6)))
            case "face":
                for point in ([0.03, 0.08, 0.08], [-0.03, 0.08, 0.08], [0, 0.01, 0.05]):
                    self.add(part, head, at[head] + point)
            case "ik":
                self.add(part, 0, [0, 0, 0])
                root = len(self.names) - 1
                for side, hand in hands.items():
                    for bone in (bones[f"{side}_foot"][0], hand):
                        self.add(part, root, at[bone])
            case "sleeves":
                for side, hand in hands.items():
                    elbow = bones[f"{side}_forearm"][0]
                    middle = (at[elbow] + at[hand]) / 2
                    self.add(part, elbow, *(middle + [0, -0.1 * (i + 1), 0] for i in range(3)))
            case "root":
                self.names.insert(0, part)
                self.parents = [-1, *(parent + 1 for parent in self.parents)]
                self.positions.insert(0, np.zeros(3))
                self.bones = {segment: tuple(bone + 1 for bone in chain) for segment, chain in self.bones.items()}
            case _:
                raise AssertionError(part)

    def shuffle(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, dict[str, tuple[int, ...]]]:
        """Return parents, positions and segments with the bones in another order, parents before children."""
        order: list[int] = []
        ready = [bone for bone, parent in enumerate(self.parents) if parent < 0]
        while ready:
            order.append(ready.pop(int(rng.integers(len(ready)))))
            ready += [bone for bone, parent in enumerate(self.parents) if parent == order[-1]]
        place = {bone: new for new, bone in enumerate(order)} | {-1: -1}
        parents = np.array([place[self.parents[bone]] for bone in order])
        bones = {segment: tuple(place[bone] for bone in chain) for segment, chain in self.bones.items()}
        return parents, np.array(self.positions)[order], bones


@given(
    name=st.sampled_from(CHARACTER_PRESETS),
    parts=st.lists(st.sampled_from(EXTRA_PARTS), unique=True),
    heading=st.floats(0, 2 * np.pi),
    scale=st.sampled_from(SCALES),
    seed=st.integers(0, 2**32 - 1),
)
@settings(max_examples=60, deadline=None)
def test_shape_gives_the_segments_of_every_preset(name: str, parts: list[str], heading: float, scale: float, seed: int) -> None:
    """With any extra bones, in any order, facing any direction, at any size, and a little asymmetric."""
    rng = np.random.default_rng(seed)
    figure = Figure(load_character_preset(name))
    for part in parts:
        figure.add_part(part)
    parents, positions, expected = figure.shuffle(rng)
    turned = (positions + rng.normal(0, NOISE_M, positions.shape)) @ Rotation.from_euler("y", heading).as_matrix().T
    found = find_segments_by_shape(parents, scale * turned + rng.normal(0, 1, 3))
    assert found.faces_forward
    assert found.bones == expected


@pytest.mark.parametrize("name", CHARACTER_PRESETS)
def test_names_give_the_segments_and_twist_bones_of_every_preset(name: str):
    preset = load_character_preset(name)
    mapping = map_bones(preset)
    assert mapping.bones == preset.mapping.bones
    assert mapping.twists == preset.mapping.twists


@pytest.mark.parametrize("name", CHARACTER_PRESETS)
def test_unknown_names_give_the_same_segments_and_twist_bones(name: str):
    preset = load_character_preset(name)
    mapping = map_bones(change_bones(preset, names=tuple(f"bone_{i:03d}" for i in range(len(preset.skeleton.names)))))
    assert mapping.bones == preset.mapping.bones
    assert mapping.twists == preset.mapping.twists
    assert mapping.reason.startswith("By the shape of the skeleton: ")


@pytest.mark.parametrize(
    ("name", "pattern", "replacement"),
    [
        ("mixamo", "mixamorig:", "mixamorig1:"),
        ("mixamo", "mixamorig:", "mixamorig_"),
        ("mixamo", "mixamorig:", "Scene|Bob:"),
        ("mixamo", "mixamorig:", ""),
        ("humanik", "^", "Character1_"),
        ("unreal", "^", "Manny:"),
        ("rigify", r"\.", ""),
        ("rigify", "DEF-", ""),
        ("daz-g8", "^", "Genesis8Female_"),
        ("vrm", "^", "J_"),
    ],
)
def test_prefixes_and_separators_are_ignored(name: str, pattern: str, replacement: str):
    preset = load_character_preset(name)
    renamed = change_bones(preset, names=tuple(re.sub(pattern, replacement, bone) for bone in preset.skeleton.names))
    mapping = map_bones(renamed)
    assert " names: " in mapping.reason
    assert mapping.bones == preset.mapping.bones


@pytest.mark.parametrize(
    "spell",
    [
        lambda side, bone: f"{bone}_{side[0]}",
        lambda side, bone: f"{side[0].upper()}_{bone}",
        lambda side, bone: f"{side.capitalize()}{bone.replace('_', ' ').title().replace(' ', '')}",
        lambda side, bone: f"{bone}.{side[0].upper()}",
        lambda side, bone: f"{side} {bone}",
    ],
)
def test_sides_are_recognised_in_many_spellings(spell):  # pyright: ignore
    words = {
        "thigh": "thigh", "shin": "shin", "foot": "foot", "upper_arm": "upper_arm", "forearm": "forearm", "hand": "hand",
        "clavicle": "shoulder", "toe": "toe",
    }  # fmt: skip
    preset = load_character_preset("humanik")
    names = [f"extra{i}" for i in range(len(preset.skeleton.names))]
    for segment, chain in preset.mapping.bones.items():
        side, _, part = segment.partition("_")
        if part:
            names[chain[0]] = spell(side, words[part])
    for segment, renamed in (("pelvis", ["hips"]), ("spine", ["spine", "chest", "upper_chest"]), ("neck", ["neck"])):
        for bone, new in zip(preset.mapping.bones[segment], renamed, strict=True):
            names[bone] = new
    names[preset.mapping.bones["head"][0]] = "head"
    named = find_segments_by_name(names, preset.skeleton.parents)
    assert named
    assert dict(named.bones) == dict(preset.mapping.bones)


def test_unreal_engine_4_mannequin_is_found_by_its_names():
    """It has three vertebrae and one neck; `calf_twist_01_l` is beside the shin."""
    preset = load_character_preset("unreal")
    keep = [bone for bone, name in enumerate(preset.skeleton.names) if name not in ("spine_04", "spine_05", "neck_02")]
    figure = Figure(preset)
    place = {bone: new for new, bone in enumerate(keep)} | {-1: -1}
    above = {bone: next(b for b in walk_up(preset, bone) if b in place) for bone in keep}
    names = [preset.skeleton.names[bone] for bone in keep]
    character = build_character(names, [place[above[bone]] for bone in keep], np.array(figure.positions)[keep])
    mapping = map_bones(character)
    assert [names[bone] for bone in mapping.bones["spine"]] == ["spine_01", "spine_02", "spine_03"]
    assert [names[bone] for bone in mapping.bones["neck"]] == ["neck_01"]
    assert mapping.reason.startswith("Unreal Engine 5 mannequin names: 38 of 77 bones")


def walk_up(character: Character, bone: int) -> list[int]:
    """Return the bones above a bone, and -1 at the end."""
    above: list[int] = []
    while bone >= 0:
        bone = int(character.skeleton.parents[bone])
        above.append(bone)
    return above


def test_reason_says_how_many_bones_have_a_segment():
    preset = load_character_preset("mixamo")
    assert map_bones(preset).reason == "Mixamo names: 22 of 65 bones."


def test_feet_without_toes_are_taken_to_face_forward():
    preset = load_character_preset("smpl")
    toes = {f"{side}_foot" for side in ("left", "right")}
    keep = [bone for bone, name in enumerate(preset.skeleton.names) if name not in toes]
    place = {bone: new for new, bone in enumerate(keep)} | {-1: -1}
    positions = preset.skeleton.compute_rest_pose()[0][keep]
    parents = [place[int(preset.skeleton.parents[bone])] for bone in keep]
    mapping = map_bones(build_character([f"b{i}" for i in keep], parents, positions))
    assert mapping.reason == "By the shape of the skeleton, taken to face +Z: 20 of 22 bones."
    assert set(SEGMENTS) - set(mapping.bones) == {"left_toe", "right_toe"}
    assert positions[mapping.bones["left_hand"][0], 0] > 0


def build_quadruped(names: tuple[str, ...] | None = None) -> Character:
    """Return an animal on four legs with a horizontal spine, head forward."""
    bones: list[tuple[str, int, list[float]]] = [("spine", -1, [0, 0.6, -0.4]), ("spine.001", 0, [0, 0.62, -0.1])]
    bones += [("spine.002", 1, [0, 0.62, 0.2]), ("spine.003", 2, [0, 0.65, 0.35]), ("head", 3, [0, 0.8, 0.5])]
    for side, sign in (("L", 1), ("R", -1)):
        for carrier, z, parts in (
            (0, -0.4, ("thigh", "shin", "foot", "toe")),
            (2, 0.3, ("upper_arm", "forearm", "hand", "finger")),
        ):
            parent = carrier
            for part, y, dz in zip(parts, (0.58, 0.32, 0.08, 0.01), (0, 0.05, 0, 0.1), strict=True):
                bones.append((f"{part}.{side}", parent, [sign * 0.1, y, z + dz]))
                parent = len(bones) - 1
    own = [name for name, _, _ in bones]
    return build_character(list(names or own), [p for _, p, _ in bones], np.array([x for _, _, x in bones], float))


def test_animal_on_four_legs_is_refused_by_names_and_by_shape():
    animal = build_quadruped()
    with pytest.raises(SceneError, match="stands on four legs"):
        map_bones(animal)
    with pytest.raises(SceneError, match=r"test: .*it stands on four legs.*--character-map"):
        map_bones(change_bones(animal, names=tuple(f"b{i}" for i in range(len(animal.skeleton.names)))))


def test_generated_rigify_rig_is_joined_by_its_deform_bones():
    """Its thighs are below bones that follow controls, not below the spine; other bones have the same names but for a prefix."""
    figure = Figure(load_character_preset("rigify"))
    thigh, pelvis = figure.names.index("DEF-thigh.L"), figure.names.index("DEF-spine")
    figure.add("ORG-spine", -1, [0, 0.9, 0])
    figure.add("ORG-thigh.L", len(figure.names) - 1, [0.1, 0.9, 0])
    figure.parents[thigh] = len(figure.names) - 2
    parents, positions, names = figure.parents, np.array(figure.positions), figure.names
    order = [len(names) - 2, len(names) - 1, *range(len(names) - 2)]
    place = {bone: new for new, bone in enumerate(order)} | {-1: -1}
    character = build_character([names[bone] for bone in order], [place[parents[bone]] for bone in order], positions[order])
    skeleton = character.skeleton
    with pytest.raises(SceneError, match="the names of its bones are unknown"):
        map_bones(character)
    all_skinned = np.ones(len(names), bool)
    found = find_detached_bones(skeleton.names, skeleton.parents, skeleton.rest_positions, all_skinned)
    assert found == {place[thigh]: place[pelvis]}
    assert not find_detached_bones(skeleton.names, skeleton.parents, skeleton.rest_positions, ~all_skinned)
    joined = reparent_bones(character, found)
    assert "Rigify (deform bones)" in map_bones(joined).reason
    np.testing.assert_allclose(
        joined.skeleton.rest_positions[joined.skeleton.find_joint("DEF-toe.L")],
        skeleton.rest_positions[skeleton.find_joint("DEF-toe.L")],
        atol=1e-9,
    )


def test_numbers_that_an_exporter_adds_to_all_names_are_ignored():
    preset = load_character_preset("mixamo")
    renamed = change_bones(preset, names=tuple(f"{name}_{2 * k}" for k, name in enumerate(preset.skeleton.names)))
    mapping = map_bones(renamed)
    assert "Mixamo names: " in mapping.reason
    assert mapping.bones == preset.mapping.bones


def test_skeleton_that_lies_down_is_refused():
    preset = load_character_preset("vrm")
    positions = preset.skeleton.compute_rest_pose()[0] @ Rotation.from_euler("x", 90, degrees=True).as_matrix().T
    with pytest.raises(ValueError, match="legs"):
        find_segments_by_shape(preset.skeleton.parents, positions)


def test_bent_trunk_is_refused():
    preset = load_character_preset("vrm")
    positions = preset.skeleton.compute_rest_pose()[0]
    chest = preset.skeleton.find_joint("spine")
    above = [bone for bone in range(len(preset.skeleton.names)) if chest in (bone, *walk_up(preset, bone))]
    turn = Rotation.from_euler("x", 80, degrees=True).as_matrix()
    positions[above] = (positions[above] - positions[chest]) @ turn.T + positions[chest]
    with pytest.raises(ValueError, match="not upright"):
        find_segments_by_shape(preset.skeleton.parents, positions)


@given(count=st.integers(1, 40), seed=st.integers(0, 2**32 - 1), spread=st.sampled_from([0.0, 1e-9, 1.0]))
@settings(max_examples=100, deadline=None)
def test_any_tree_gives_a_mapping_or_a_sentence(count: int, seed: int, spread: float) -> None:
    rng = np.random.default_rng(seed)
    parents = [-1, *(int(rng.integers(-1, bone)) for bone in range(1, count))]
    character = build_character([f"b{i}" for i in range(count)], parents, spread * rng.normal(size=(count, 3)))
    try:
        mapping = map_bones(character)
    except SceneError as error:
        mapping, message = None, str(error)
    else:
        message = mapping.reason
    assert message.endswith(".")
    assert mapping is None or not mapping.missing_segments


def test_many_strands_of_hair_are_searched_quickly():
    figure = Figure(load_character_preset("vrm"))
    head = figure.bones["head"][0]
    for k in range(60):
        out = 0.1 * np.array([np.sin(k * np.pi / 30), 0, np.cos(k * np.pi / 30)])
        figure.add("hair", head, *(figure.positions[head] + [0, 0.15 - 0.07 * i, 0] + out for i in range(14)))
    start = time.process_time()
    found = find_segments_by_shape(np.array(figure.parents), np.array(figure.positions))
    assert time.process_time() - start < MAX_SEARCH_S
    assert found.bones == figure.bones


def test_wrist_of_a_file_of_cmu_is_its_finger_base():
    skeleton = load_cmu31_body().skeleton
    mapping = find_segments_by_name(skeleton.names, skeleton.parents)
    assert mapping
    assert [skeleton.names[bone] for bone in mapping.bones["left_forearm"]] == ["LeftForeArm", "LeftHand"]
    assert [skeleton.names[bone] for bone in mapping.bones["left_hand"]] == ["LeftFingerBase"]
