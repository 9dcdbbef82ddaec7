"""Load the character that an option names, with the mapping of its bones: of its file, an edited one, or one that is found."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from mocapfix.characters.bone_mapping import map_bones
from mocapfix.characters.character import SIDES, Character
from mocapfix.characters.character_presets import load_character_preset
from mocapfix.characters.character_reader import read_character_skeletons
from mocapfix.characters.mapping_file import apply_mapping_file, read_feet_flat
from mocapfix.characters.rest_poses import are_soles_flat, check_sides, describe_posed_limbs
from mocapfix.errors import SceneError
from mocapfix.files.option_choices import CHARACTER_PRESETS

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
