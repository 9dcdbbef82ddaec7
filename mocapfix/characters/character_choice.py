"""Load the character that an option names, with the mapping of its bones: of its file, an edited one, or one that is found."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from mocapfix.characters.bone_mapping import map_bones
from mocapfix.characters.character import SIDES, Character
from mocapfix.characters.character_presets import load_character_preset
from mocapfix.characters.character_reader import read_character
from mocapfix.characters.mapping_file import read_mapping_file
from mocapfix.errors import SceneError
from mocapfix.files.option_choices import CHARACTER_PRESETS

UNUSABLE_CHARACTERS = re.compile(r"[^\w-]+")
"""in the name of a character, which is part of the names of files"""
MIN_LIMB_LENGTH_M = 1e-6
MIN_UPRIGHT_SHIN_COSINE = float(np.cos(np.deg2rad(12.0)))
"""Cosine of the angle between a shin and the vertical from which it is upright."""


def load_character(name_or_path: str | Path, mapping_path: str | Path | None = None) -> Character:
    """Load a preset by its name, or the character in a file, with all segments that retargeting needs.

    mapping_path  an edited mapping of its bones, in place of the one that the character has

    Raises:
        ReadError, SceneError: If there is no such character, its file is invalid, or its bones do not form a body.
    """
    if str(name_or_path) in CHARACTER_PRESETS:
        character = load_character_preset(str(name_or_path))
    else:
        path = Path(name_or_path)
        if not path.suffix and not path.exists():
            choices = ", ".join(CHARACTER_PRESETS)
            raise SceneError(f"There is no character {str(name_or_path)!r}; choose one of {choices}, or give a file.")
        character = read_character(path)
        character = replace(character, name=UNUSABLE_CHARACTERS.sub("-", path.stem).strip("-") or "character")
    if mapping_path is not None:
        character = replace(character, mapping=read_mapping_file(Path(mapping_path), character))
    elif character.mapping.missing_segments:
        character = replace(character, mapping=map_bones(character))
    check_lengths(character, str(name_or_path))
    return replace(character, has_feet_flat=character.has_feet_flat and are_shins_upright(character))


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


def are_shins_upright(character: Character) -> bool:
    """Return whether the shins are vertical in the rest pose, so that the soles may lie flat.

    In the skeletons of CMU's recordings the legs are spread, and the feet are rotated with them.
    """
    position, _ = character.compute_rest_pose()
    for side in SIDES:
        shin, foot = (position[character.mapping.bones[f"{side}_{segment}"][0]] for segment in ("shin", "foot"))
        if shin[1] - foot[1] < MIN_UPRIGHT_SHIN_COSINE * np.linalg.norm(shin - foot):
            return False
    return True
