"""Load the character that an option names, with the mapping of its bones: of its file, an edited one, or one that is found.

The characters that ship with mocapfix: the standard figures of programs, in scenes/rigs.

The bones of a BVH as a character: the rest pose is that of its bones, with all angles zero.

BVH has no rest rotations: in the rest pose the axes of all bones are the file's.

Read a character from a file of any format. The format is detected from the content, only YAML from the extension.
"""

import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from mocapfix.characters.bone_mapping import map_bones
from mocapfix.characters.character import SIDES, BoneMapping, Character, CharacterSource, compute_tail
from mocapfix.characters.character_yaml import apply_mapping_file, read_character_yaml, read_feet_flat
from mocapfix.characters.read_gltf import is_gltf, read_gltf_skeletons
from mocapfix.characters.rest_poses import are_soles_flat, check_sides, describe_posed_limbs
from mocapfix.errors import ReadError, SceneError
from mocapfix.io.bvh import is_bvh, read_bvh
from mocapfix.io.capture import extract_head
from mocapfix.io.file_content import read_file_bytes
from mocapfix.io.shipped import find_shipped_folder
from mocapfix.model.animation import Animation
from mocapfix.options import CHARACTER_PRESETS


@cache
def load_character_preset(name: str) -> Character:
    """Load a shipped character by its name, one of CHARACTER_PRESETS.

    Its bones, tree, axes and unit are those of the program; its lengths are those of an adult of about 1.75 m.

    Raises:
        SceneError: If there is no preset of the name. The message lists the presets.
    """
    if name not in CHARACTER_PRESETS:
        raise SceneError(f"There is no character preset {name!r}; choose one of {', '.join(CHARACTER_PRESETS)}, or give a file.")
    return read_character_yaml(find_shipped_folder("scenes") / "rigs" / f"{name}.yaml")


def build_bvh_character(path: Path, data: bytes, animation: Animation) -> Character:
    """Return the bones of a BVH as a character. Its mapping is empty.

    Args:
        path: The file.
        data: Its bytes.
        animation: Its content, with the unit and the up axis that `read_bvh` inferred.
    """
    count, unit_m = len(animation.names), animation.unit_m
    positions = np.where(animation.is_below_body_root[:, None], animation.bone_offsets, animation.offsets) * unit_m
    positions[0] = animation.rotation_y_up_file @ positions[0]
    rotations = np.tile(np.eye(3), (count, 1, 1))
    rotations[0] = animation.rotation_y_up_file
    tails = np.full((count, 3), np.nan)
    for joint, ends in enumerate(animation.end_sites):
        tails[joint] = compute_tail(np.concatenate([animation.bone_offsets[animation.parents == joint], ends]) * unit_m)
    return Character(
        name=path.stem,
        names=make_names_unique(animation.names),
        parents=animation.parents,
        rest_positions=positions,
        rest_rotations=rotations,
        tails=tails,
        mapping=BoneMapping({}),
        scales=np.full(count, unit_m),
        root_scale=unit_m,
        rotation_y_up_file=animation.rotation_y_up_file,
        source=CharacterSource(str(path), data, np.zeros(0, int), "bvh"),
    )


def make_names_unique(names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names with a number behind each that was used before."""
    used: dict[str, None] = {}
    for index, name in enumerate(names):
        unique = name
        while unique in used:
            unique = f"{unique}#{index}"
        used[unique] = None
    return tuple(used)


YAML_SUFFIXES = (".yaml", ".yml")


def read_character(path: str | Path) -> Character:
    """Read a character: glTF 2.0 (.glb, .gltf), VRM 0.x and 1.0 (.vrm), BVH, or YAML of the form of the presets.

    A VRM or YAML gives the bones of the segments of the body. The mapping of another file is empty. Of several skeletons in a
    glTF the one with the most joints is read.

    Raises:
        ReadError: If the file cannot be opened, has no supported format or is invalid. The message names the file.
        SceneError: If a YAML file is invalid. The message names the file and the key.
    """
    return read_character_skeletons(path)[0]


def read_character_skeletons(path: str | Path) -> list[Character]:
    """Read all skeletons of a character's file, the one with the most joints first. Raises as `read_character` does."""
    path = Path(path)
    data = read_file_bytes(path)
    if is_bvh(extract_head(data)):
        return [build_bvh_character(path, data, read_bvh(path, data))]
    if path.suffix.lower() in YAML_SUFFIXES:
        return [read_character_yaml(path)]
    if is_gltf(data):
        return read_gltf_skeletons(path, data)
    raise ReadError(f"{path}: is no character that mocapfix reads; give a .glb, .gltf, .vrm, .bvh or .yaml file.")


UNUSABLE_CHARACTERS = re.compile(r"[^\w-]+")
"""in the name of a character, which is part of the names of files"""
MIN_LIMB_LENGTH_M = 1e-6


def load_character(name_or_path: str | Path, mapping_path: str | Path | None = None) -> Character:
    """Load a preset by its name, or the character in a file, with all segments that retargeting needs.

    Of several skeletons in a file, the first is taken whose bones form a body, or are those of the mapping.

    mapping_path  an edited mapping of its bones, in place of the one that the character has

    Raises:
        ReadError, SceneError: If there is no such character, its file is invalid, or its bones do not form a body.
    """
    if str(name_or_path) in CHARACTER_PRESETS:
        skeletons = [load_character_preset(str(name_or_path))]
    else:
        path = Path(name_or_path)
        if not path.suffix and not path.exists():
            choices = ", ".join(CHARACTER_PRESETS)
            raise SceneError(f"There is no character {str(name_or_path)!r}; choose one of {choices}, or give a file.")
        name = UNUSABLE_CHARACTERS.sub("-", path.stem).strip("-") or "character"
        skeletons = [replace(character, name=name) for character in read_character_skeletons(path)]
    character = _choose_skeleton(skeletons, None if mapping_path is None else Path(mapping_path))
    check_lengths(character, str(name_or_path))
    check_sides(character, str(name_or_path))
    if posed := describe_posed_limbs(character):
        reason = f"{character.mapping.reason} {posed}"
        character = replace(character, mapping=replace(character.mapping, reason=reason))
    is_given = mapping_path is not None and read_feet_flat(mapping_path) is not None
    return character if is_given else replace(character, has_feet_flat=character.has_feet_flat and are_soles_flat(character))


def _choose_skeleton(skeletons: list[Character], mapping_path: Path | None) -> Character:
    """Return the first skeleton of a file that has a mapping, with it. Raises what is wrong with the first if none has."""
    first_error: SceneError | None = None
    for character in skeletons:
        try:
            if mapping_path is not None:
                return apply_mapping_file(mapping_path, character)
            return replace(character, mapping=map_bones(character)) if character.mapping.missing_segments else character
        except SceneError as error:
            first_error = first_error or error
    raise first_error or SceneError("The file of the character has no skeleton; export it with its armature.")


def check_lengths(character: Character, name: str) -> None:
    """Raise SceneError, which begins with `name`, if a thigh, shin, upper arm or forearm has no length in the rest pose."""
    position, _ = character.compute_rest_pose()
    bones = character.mapping.bones
    for side in SIDES:
        for start, end in (("thigh", "shin"), ("shin", "foot"), ("upper_arm", "forearm"), ("forearm", "hand")):
            first, last = bones[f"{side}_{start}"][0], bones.get(f"{side}_{end}", ())
            if last and not np.linalg.norm(position[last[0]] - position[first]) > MIN_LIMB_LENGTH_M:
                pair = f"{character.names[first]!r} and {character.names[last[0]]!r}"
                raise SceneError(
                    f"{name}: the bones {pair} ({side} {start.replace('_', ' ')}) are at one place, so the character cannot be "
                    "posed; correct its rest pose or the mapping (--character-map)."
                )
