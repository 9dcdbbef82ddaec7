"""Write the motion of a character as BVH, with its own bones.

BVH has no rest rotations. They are folded into the offsets: with all angles zero the bones are in the rest pose of the character,
and their axes are those of the world. Y is up. The unit is that in which the character's file gives the position of the pelvis,
or centimetres if that is none of metres, centimetres, millimetres and inches.
"""

import re
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from mocapfix.characters.character import Character, CharacterMotion, compute_character_poses
from mocapfix.files.glb import parse_glb
from mocapfix.skeleton import Skeleton
from mocapfix.write.bvh_tree import CENTIMETRE_M, write_bvh_tree
from mocapfix.write.character_bones import get_parent_scale

BVH_UNITS_M = (1.0, 0.01, 0.001, 0.0254)
UNIT_TOLERANCE = 1e-4
"""relative difference from one of BVH_UNITS_M, up to which a scale is that unit"""
DEFAULT_END_FRACTION = 0.3
"""length of a last bone without a tail, as a fraction of its parent's"""
MIN_END_M = 0.01
"""and at least so much"""
BVH_NAME_SEPARATORS = re.compile(r"[\s{}]+")
"""what a name in a BVH must not have"""


def write_character_bvh(target: Path, character: Character, motion: CharacterMotion) -> None:
    """Write the motion of a character as BVH: rotations Z Y X in degrees, and positions of the root and of the pelvis.

    Nodes above the bones that only place an armature are left out. If the character has several roots, a joint at the origin
    that has the character's name carries them.

    Raises:
        WriteError: If `target` is not writable.
    """
    bones = _list_written_bones(character)
    place = {bone: joint for joint, bone in enumerate(bones)}
    parents = np.array([place.get(int(character.parents[bone]), -1) for bone in bones])
    rest_positions, rest_rotations = (each[bones] for each in character.compute_rest_pose())
    positions, rotations = (each[:, bones] for each in compute_character_poses(character, motion))
    turned = rotations @ rest_rotations.swapaxes(-1, -2)
    names = [BVH_NAME_SEPARATORS.sub("_", character.names[bone]) for bone in bones]
    tails = np.einsum("jab,jb->ja", rest_rotations, character.tails[bones])
    if (parents < 0).sum() > 1:
        names = [BVH_NAME_SEPARATORS.sub("_", character.name) or "Root", *names]
        parents = np.concatenate([[-1], parents + 1])
        rest_positions, tails = (np.concatenate([np.zeros((1, 3)), each]) for each in (rest_positions, tails))
        positions = np.concatenate([np.zeros((motion.frame_count, 1, 3)), positions], axis=1)
        turned = np.concatenate([np.tile(np.eye(3), (motion.frame_count, 1, 1, 1)), turned], axis=1)
    is_root = parents < 0
    offsets = np.where(is_root[:, None], rest_positions, rest_positions - rest_positions[parents])
    local_rotations = np.where(is_root[:, None, None], np.eye(3), turned[:, parents]).swapaxes(-1, -2) @ turned
    skeleton = Skeleton(tuple(names), parents, offsets, _choose_ends(parents, offsets, tails))
    pelvis = place[character.mapping.bones["pelvis"][0]] + len(names) - len(bones)
    positioned = {0: positions[:, 0]}
    if pelvis:
        above = int(parents[pelvis])
        positioned[pelvis] = np.einsum("tba,tb->ta", turned[:, above], positions[:, pelvis] - positions[:, above])
    unit_m = _choose_unit(character)
    write_bvh_tree(target, skeleton, positioned, np.ascontiguousarray(local_rotations), motion.rate, unit_m)


def _list_written_bones(character: Character) -> list[int]:
    """Return the bones that are written: all but nodes of a glTF at the top that are no joints and carry a single bone."""
    joints = _list_source_joints(character)
    bones, mapped = list(range(len(character.names))), character.mapping.bones["pelvis"][0]
    while joints and bones[0] not in joints and bones[0] != mapped:
        children = np.flatnonzero(character.parents == bones[0])
        is_single_tree = len(children) == 1 and (character.parents < 0).sum() == 1
        if not is_single_tree:
            break
        bones = bones[1:]
    return bones


def _list_source_joints(character: Character) -> set[int]:
    """Return the bones that are joints of a skin, none for a character without a glTF."""
    source = character.source
    if source is None or source.kind != "gltf":
        return set()
    skins = parse_glb(Path(source.path), source.data).document.get("skins", [])
    joints = {joint for skin in skins for joint in skin["joints"]}
    return {bone for bone, node in enumerate(source.nodes.tolist()) if node in joints}


def _choose_ends(
    parents: Int[np.ndarray, " J"], offsets: Float[np.ndarray, "J 3"], tails: Float[np.ndarray, "J 3"]
) -> Float[np.ndarray, "J 3"]:
    """Return the end sites of the leaves: their tails, or else a point that continues the bone above."""
    ends = np.full(tails.shape, np.nan)
    for joint in np.flatnonzero(~np.isin(np.arange(len(parents)), parents)):
        ends[joint] = tails[joint]
        if not np.linalg.norm(tails[joint]) > 0:
            length = np.linalg.norm(offsets[joint])
            direction = offsets[joint] / length if length > 0 else np.array([0.0, 1.0, 0.0])
            ends[joint] = direction * max(DEFAULT_END_FRACTION * length, MIN_END_M)
    return ends


def _choose_unit(character: Character) -> float:
    scale = get_parent_scale(character, character.mapping.bones["pelvis"][0])
    return next((unit for unit in BVH_UNITS_M if abs(scale / unit - 1) < UNIT_TOLERANCE), CENTIMETRE_M)
