"""Read the bones of a character from glTF 2.0 (.glb, .gltf) and VRM (.vrm).

The bones are the joints of the skins with all nodes above them, such as the armature, which often scales and turns the rest.
The rest pose is the transforms of the nodes: what a viewer shows without an animation. The skins have a second pose, that of
their inverse bind matrices, in which the mesh has its original shape. Exporters may set the nodes to another pose, for example
to the first frame of an animation. The nodes are used nevertheless: bones without skin and preset characters have no other
pose, and bones that an animation leaves out are in this pose in every program. Meshes are not decoded.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from mocapfix.characters.bone_tails import compute_tail
from mocapfix.characters.character import BoneMapping, Character, CharacterSource
from mocapfix.characters.gltf_nodes import GltfNodes, are_numbers, compute_bone_transforms, read_gltf_nodes, read_indices
from mocapfix.characters.gltf_packing import read_packed_gltf
from mocapfix.characters.side_twists import find_side_twists
from mocapfix.characters.vrm_bones import build_vrm_mapping, list_spring_nodes, read_vrm_bones
from mocapfix.errors import ReadError
from mocapfix.files.glb import is_glb

MIN_BODY_NODES = 12
"""of a file without skin: fewer nodes form no body"""
MAX_BONES = 5_000
GLTF_SCALE_M = 1.0
"""length of a unit of glTF in metres"""


def is_gltf(head: bytes) -> bool:
    """Return whether a file with this beginning is a glTF, binary or text."""
    return is_glb(head) or head.removeprefix(b"\xef\xbb\xbf").lstrip().startswith(b"{")


def read_gltf_skeletons(path: Path, data: bytes) -> list[Character]:
    """Read the skeletons of a glTF, the one with the most joints first, each with all skins that share its joints.

    Only a VRM gives a mapping, and only one skeleton, which includes its humanoid bones; the mapping of others is empty.

    Args:
        path: The file, which may refer to files beside it.
        data: Its bytes.

    Raises:
        ReadError: If the file is damaged, has no skeleton, or bones have a scale that bones cannot have. The message names the
            file and the bone.
    """
    content, packed_data = read_packed_gltf(path, data)
    nodes = read_gltf_nodes(path, content.document)
    vrm_bones = read_vrm_bones(path, content.document, len(nodes.entries))
    skeletons = _group_joints(nodes, _read_skins(path, content.document, len(nodes.entries))) or [_find_body_nodes(nodes)]
    if vrm_bones:
        humanoid = set(vrm_bones.values())
        skeletons = [max(skeletons, key=lambda joints: len(humanoid & joints)) | humanoid]
    characters = [_build_character(nodes, joints, packed_data, vrm_bones) for joints in skeletons]
    if not vrm_bones:
        return characters
    springs = list_spring_nodes(content.document)
    return [_add_vrm_twists(character, springs) for character in characters]


def _read_skins(path: Path, document: Mapping[str, Any], node_count: int) -> list[list[int]]:
    """Return the joints of each skin."""
    skins = document.get("skins", [])
    return [read_indices(path, f"skins[{index}].joints", skin.get("joints"), node_count) for index, skin in enumerate(skins)]


def _group_joints(nodes: GltfNodes, skins: Sequence[Sequence[int]]) -> list[set[int]]:
    """Return the joints of each skeleton, the largest first. Skins belong together if they share a joint or one above."""
    joints = {joint for skin in skins for joint in skin}
    tops: dict[int, int] = {}  # node to the highest joint at or above it, -1 if there is none
    for node in nodes.ordered:
        above = tops.get(int(nodes.parents[node]), -1)
        tops[node] = node if above < 0 and node in joints else above
    groups: list[set[int]] = []  # of highest joints
    for skin in skins:
        group = {tops[joint] for joint in skin}
        shared = [each for each in groups if each & group]
        groups = [each for each in groups if not each & group] + [group.union(*shared)]
    found = [{joint for joint in joints if tops[joint] in group} for group in groups]
    return sorted((each for each in found if each), key=len, reverse=True)


def _find_body_nodes(nodes: GltfNodes) -> set[int]:
    """Return the nodes of the largest tree in a file without skin."""
    root_of: dict[int, int] = {}
    for node in nodes.ordered:
        root_of[node] = root_of.get(int(nodes.parents[node]), node)
    roots = list(root_of.values())
    largest = max(set(roots), key=roots.count) if len(set(roots)) < MAX_BONES and roots else -1
    members = {node for node, root in root_of.items() if root == largest}
    if len(members) < MIN_BODY_NODES:
        problem = "has no skin, and its nodes form no body"
        raise ReadError(f"{nodes.path}: {problem}; export the character with its armature and its skinned mesh.")
    return members


def _build_character(nodes: GltfNodes, joints: set[int], data: bytes, vrm_bones: Mapping[str, int]) -> Character:
    """Return the character of some joints and of the nodes above them."""
    members = joints.union(*(nodes.list_ancestors(joint) for joint in joints))
    bones = [node for node in nodes.ordered if node in members]
    if len(bones) > MAX_BONES:
        raise ReadError(f"{nodes.path}: has {len(bones)} bones, and at most {MAX_BONES} are read; export only the deform bones.")
    transforms = compute_bone_transforms(nodes, bones)
    place = {node: bone for bone, node in enumerate(bones)}
    return Character(
        name=nodes.path.stem,
        names=tuple(nodes.names[node] for node in bones),
        parents=np.array([place.get(int(nodes.parents[node]), -1) for node in bones]),
        rest_positions=transforms.positions,
        rest_rotations=transforms.rotations,
        tails=_find_tails(nodes, bones, transforms.scales),
        mapping=build_vrm_mapping(nodes, bones, vrm_bones) if vrm_bones else BoneMapping({}),
        scales=transforms.scales,
        root_scale=GLTF_SCALE_M,
        source=CharacterSource(str(nodes.path), data, np.array(bones), "gltf"),
    )


def _add_vrm_twists(character: Character, spring_nodes: set[int]) -> Character:
    """Return the character with the twist bones beside its limbs, which a VRM does not name. Springs are none."""
    positions, _ = character.compute_rest_pose()
    mapping, nodes = character.mapping, [] if character.source is None else character.source.nodes.tolist()
    found = find_side_twists(character.names, character.parents, positions, mapping.bones)
    twists = {segment: tuple(bone for bone in chain if nodes[bone] not in spring_nodes) for segment, chain in found.items()}
    return replace(character, mapping=replace(mapping, twists={segment: chain for segment, chain in twists.items() if chain}))


def _find_tails(nodes: GltfNodes, bones: Sequence[int], scales: Float[np.ndarray, " B"]) -> Float[np.ndarray, "B 3"]:
    """Return the tail of each bone: the mean of its farther children, also of nodes that are no joints and have no mesh."""
    tails = np.full((len(bones), 3), np.nan)
    for bone, (node, scale) in enumerate(zip(bones, scales, strict=True)):
        children = [child for child in nodes.entries[node].get("children", []) if "mesh" not in nodes.entries[child]]
        offsets = [_read_offset(nodes.entries[child]) for child in children]
        tails[bone] = compute_tail(scale * np.array(offsets).reshape(-1, 3))
    return tails


def _read_offset(entry: Mapping[str, Any]) -> Float[np.ndarray, " 3"]:
    """Return the position of a node in its parent's axes and the file's units, zero if it is invalid."""
    matrix = entry.get("matrix")
    offset = matrix[12:15] if isinstance(matrix, list) else entry.get("translation")
    is_valid = isinstance(offset, list) and len(offset) == 3 and are_numbers(offset)
    return np.array(offset if is_valid else [0.0, 0.0, 0.0], float)
