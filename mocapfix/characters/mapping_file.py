"""The mapping of a character's bones as a YAML file that people can read, correct and give back."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from pydantic import Field

from mocapfix.characters.character import REQUIRED_SEGMENTS, SEGMENTS, BoneMapping, Character
from mocapfix.characters.character_yaml import BoneNames
from mocapfix.characters.segment_bones import build_bone_mapping
from mocapfix.files.output_files import replace_atomically
from mocapfix.files.yaml_models import MAX_LINE_LENGTH, InlineSequence, StrictModel, dump_yaml, read_yaml_model

MAPPING_FILE_HEADER = """\
# The bones of {name} that form the segments of its body, for mocapfix. {reason}
# Correct a wrong bone here, and give the file with the same character: --character FILE --character-map THIS_FILE
# segments: the names of their bones. Spine, neck and the parts of limbs may have several, from the pelvis outwards, each below
#   the one before; an empty list [] is a segment that the character lacks.
#   Needed: {required}.
# twists: bones beside a limb that only take a share of its twist, from near to far.
# feet_flat: whether the soles lie flat in the rest pose; false: they do when the shins are vertical. Correct it where the feet of
#   the result are tilted to the side.
# All other bones keep their rest pose: fingers, face, hair, clothes. They are listed at the end.
"""


class _MappingModel(StrictModel):
    segments: dict[str, BoneNames]
    twists: dict[str, BoneNames] = Field(default_factory=dict)
    feet_flat: bool | None = None


def write_mapping_file(target: str | Path, character: Character) -> None:
    """Write the mapping of a character as YAML, with the names of its bones and comments on its use.

    Raises WriteError if the folder cannot be written; an existing file is then left unchanged.
    """
    names, mapping = character.names, character.mapping
    data: dict[str, Any] = {
        "segments": {segment: _list_names(names, mapping.bones, segment) for segment in SEGMENTS},
        "twists": {segment: _list_names(names, mapping.twists, segment) for segment in mapping.twists},
        "feet_flat": bool(character.has_feet_flat),
    }
    header = MAPPING_FILE_HEADER.format(
        name=_flatten(character.name), reason=_flatten(mapping.reason), required=_describe_required_segments()
    )
    with replace_atomically(Path(target)) as new_file:
        text = header + dump_yaml(data) + _comment_unmapped_bones(names, mapping)
        new_file.write_text(text, encoding="utf-8", newline="\n")


def read_mapping_file(path: str | Path, character: Character) -> BoneMapping:
    """Read the mapping of a character's bones from a file that `write_mapping_file` wrote, possibly edited since.

    Raises:
        SceneError: If the file is invalid, names a bone that the character lacks, a bone twice or one that is not below the bone
            before it, or lacks a segment that a body needs. The message gives the file and the key.
    """
    path = Path(path)
    model = read_yaml_model(_MappingModel, path)
    return build_bone_mapping(
        character.names,
        character.parents,
        model.segments,
        model.twists,
        reason=f"The mapping file {path.name}.",
        source=str(path),
    )


def read_feet_flat(path: str | Path) -> bool | None:
    """Read whether the soles lie flat in the rest pose from a mapping file, None if it lacks this. Raises SceneError."""
    return read_yaml_model(_MappingModel, Path(path)).feet_flat


def apply_mapping_file(path: str | Path, character: Character) -> Character:
    """Return a character with the mapping of a file, and its feet as the file gives them. Raises as `read_mapping_file`."""
    mapping, feet_flat = read_mapping_file(path, character), read_feet_flat(path)
    return replace(character, mapping=mapping, has_feet_flat=character.has_feet_flat if feet_flat is None else feet_flat)


def _list_names(names: tuple[str, ...], group: Mapping[str, tuple[int, ...]], segment: str) -> InlineSequence:
    return InlineSequence(names[bone] for bone in group.get(segment, ()))


def _describe_required_segments() -> str:
    """Return the segments that are needed, those of both sides in one."""
    both = dict.fromkeys(segment.removeprefix("left_").removeprefix("right_") for segment in REQUIRED_SEGMENTS)
    return ", ".join(both)


def _comment_unmapped_bones(names: tuple[str, ...], mapping: BoneMapping) -> str:
    """Return comment lines that name the bones without a segment."""
    used = {bone for group in (mapping.bones, mapping.twists) for chain in group.values() for bone in chain}
    lines = ["# bones without a segment:"]
    for bone, name in enumerate(names):
        if bone not in used:
            if len(lines[-1]) + len(name) > MAX_LINE_LENGTH - 2:
                lines.append("#")
            lines[-1] += f" {_flatten(name)},"
    return "\n".join(lines).rstrip(",") + "\n"


def _flatten(text: str) -> str:
    """Return a text on one line, as a comment must be: names in files may have any character."""
    return " ".join("".join(letter if letter.isprintable() else " " for letter in text).split())
