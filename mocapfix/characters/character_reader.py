"""Read a character from a file of any format. The format is detected from the content, only YAML from the extension."""

from pathlib import Path

from mocapfix.characters.bvh_character import build_bvh_character
from mocapfix.characters.character import Character
from mocapfix.characters.character_yaml import read_character_yaml
from mocapfix.characters.read_gltf import is_gltf, read_gltf_skeletons
from mocapfix.errors import ReadError
from mocapfix.read.bvh import is_bvh, read_bvh
from mocapfix.read.capture import extract_head
from mocapfix.read.file_content import read_file_bytes

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
