"""Read the bones of a character from a BVH: the rest pose is that of its offsets, with all angles zero.

BVH has no rest rotations: in the rest pose the axes of all bones are the file's.
"""

from pathlib import Path

import numpy as np

from mocapfix.characters.character import BoneMapping, Character, CharacterSource
from mocapfix.characters.read_gltf import compute_tail
from mocapfix.read.bvh import read_bvh


def read_bvh_character(path: Path, data: bytes) -> Character:
    """Read the character of a BVH. Its mapping is empty. The unit and the up axis are inferred as `read_bvh` does.

    Raises:
        ReadError: If the file is invalid. The message names file and line.
    """
    animation = read_bvh(path, data)
    count, unit_m = len(animation.names), animation.unit_m
    positions = animation.offsets * unit_m
    positions[0] = animation.rotation_y_up_file @ positions[0]
    rotations = np.tile(np.eye(3), (count, 1, 1))
    rotations[0] = animation.rotation_y_up_file
    tails = np.full((count, 3), np.nan)
    for joint, ends in enumerate(animation.end_sites):
        tails[joint] = compute_tail(np.concatenate([animation.offsets[animation.parents == joint], ends]) * unit_m)
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
