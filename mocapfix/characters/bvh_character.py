"""The bones of a BVH as a character: the rest pose is that of its bones, with all angles zero.

BVH has no rest rotations: in the rest pose the axes of all bones are the file's.
"""

from pathlib import Path

import numpy as np

from mocapfix.animation import Animation
from mocapfix.characters.bone_tails import compute_tail
from mocapfix.characters.character import BoneMapping, Character, CharacterSource


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
