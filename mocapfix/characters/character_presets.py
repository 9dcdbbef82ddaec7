"""The characters that ship with mocapfix: the standard figures of programs, in scenes/rigs."""

from functools import cache

from mocapfix.characters.character import Character
from mocapfix.characters.character_yaml import read_character_yaml
from mocapfix.errors import SceneError
from mocapfix.files.option_choices import CHARACTER_PRESETS
from mocapfix.files.shipped import find_shipped_folder


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
