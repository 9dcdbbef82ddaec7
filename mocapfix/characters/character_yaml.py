"""Read a character from a YAML file, with or without the segments of its body."""

from pathlib import Path

from mocapfix.characters.character import Character
from mocapfix.characters.character_file import read_character_file
from mocapfix.errors import SceneError


def read_character_yaml(path: str | Path) -> Character:
    """Read a character from a YAML file of the form of the presets in scenes/rigs.

    Raises:
        SceneError: If the file is invalid. The message gives the file and the key.
    """
    character = read_character_file(Path(path))
    if not character.mapping.bones:
        raise SceneError(f"{path}: segments: is missing; give the bones of each segment of the body.")
    return character
