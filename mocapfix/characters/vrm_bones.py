"""The humanoid bones that a VRM file names, as the segments of a body.

Sources: VRM Consortium, VRM 0.0 (extension VRM) and VRM 1.0 (extension VRMC_vrm), section humanoid.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mocapfix.characters.character import SIDES, BoneMapping
from mocapfix.characters.gltf_nodes import GltfNodes, read_index
from mocapfix.characters.segment_bones import build_bone_mapping
from mocapfix.errors import ReadError, SceneError

VRM_TRUNK_BONES = {"hips": "pelvis", "spine": "spine", "chest": "spine", "upperChest": "spine", "neck": "neck", "head": "head"}
"""humanoid bones of the trunk, from the pelvis outwards, and their segments"""
VRM_LIMB_BONES = {
    "Shoulder": "clavicle", "UpperArm": "upper_arm", "LowerArm": "forearm", "Hand": "hand",
    "UpperLeg": "thigh", "LowerLeg": "shin", "Foot": "foot", "Toes": "toe",
}  # fmt: skip
"""ends of the names of humanoid bones of a side, and their segments"""
SEGMENTS_OF_VRM_BONES = VRM_TRUNK_BONES | {
    f"{side}{end}": f"{side}_{segment}" for side in SIDES for end, segment in VRM_LIMB_BONES.items()
}
SEGMENTS_BELOW = {
    "spine": ("spine", "neck", "head"),
    "neck": ("neck", "head"),
    **{f"{side}_{upper}": (f"{side}_{lower}",) for side in SIDES for upper, lower in (
        ("upper_arm", "forearm"), ("forearm", "hand"), ("thigh", "shin"), ("shin", "foot"),
    )},
}  # fmt: skip
"""segments of several bones to those that they carry; bones between the two are theirs"""


def read_vrm_bones(path: Path, document: Mapping[str, Any], node_count: int) -> dict[str, int]:
    """Return the humanoid bones of a VRM and their nodes, nothing for a glTF without that extension.

    Raises:
        ReadError: If the extension is damaged.
    """
    extensions = document.get("extensions")
    extensions = extensions if isinstance(extensions, dict) else {}
    extension = extensions.get("VRMC_vrm", extensions.get("VRM"))
    if extension is None:
        return {}
    humanoid = extension.get("humanoid") if isinstance(extension, dict) else None
    bones = humanoid.get("humanBones") if isinstance(humanoid, dict) else None
    if isinstance(bones, dict):  # VRM 1.0
        bones = [{"bone": name, **entry} for name, entry in bones.items() if isinstance(entry, dict)]
    if not isinstance(bones, list) or not all(isinstance(entry, dict) for entry in bones):
        raise ReadError(f"{path}: its VRM extension names no humanoid bones; export it again as a VRM avatar.")
    found: dict[str, int] = {}
    for entry in bones:
        name, node = entry.get("bone"), entry.get("node")
        if isinstance(name, str) and name in SEGMENTS_OF_VRM_BONES and node != -1:  # -1: not assigned
            found[name] = read_index(path, f"the humanoid bone {name}", node, node_count)
    return found


def list_spring_nodes(document: Mapping[str, Any]) -> set[int]:
    """Return the nodes that a VRM moves as springs, such as sleeves: the first of each chain (VRM 0.x) or all (VRM 1.0)."""
    found: set[int] = set()
    remaining: list[Any] = [_get_part(document, ("extensions", "VRM", "secondaryAnimation", "boneGroups"))]
    remaining.append(_get_part(document, ("extensions", "VRMC_springBone", "springs")))
    while remaining:
        part = remaining.pop()
        if isinstance(part, list):
            remaining += part
        elif isinstance(part, dict):
            remaining += [part.get("bones"), part.get("joints"), part.get("node")]
        elif isinstance(part, int):
            found.add(part)
    return found


def _get_part(document: Any, keys: tuple[str, ...]) -> Any:
    """Return a part of a document, None if it lacks it."""
    for key in keys:
        document = document.get(key) if isinstance(document, dict) else None
    return document


def build_vrm_mapping(nodes: GltfNodes, bones: list[int], vrm_bones: Mapping[str, int]) -> BoneMapping:
    """Build the mapping of the humanoid bones of a VRM.

    A bone between two humanoid bones of one limb belongs to the segment of the upper one, and takes a share of its rotation.
    Between spine and head the bones above the arms belong to the neck.

    Args:
        nodes: The nodes of the file.
        bones: The nodes that are bones of the character, parents before children.
        vrm_bones: Humanoid bone to node.

    Raises:
        ReadError: If a bone is missing or used twice, or not below the one before it.
    """
    segment_of = {node: SEGMENTS_OF_VRM_BONES[name] for name, node in vrm_bones.items()}
    arms = [vrm_bones[f"{side}UpperArm"] for side in SIDES if f"{side}UpperArm" in vrm_bones]
    arm_carriers = {above for arm in arms for above in nodes.list_ancestors(arm)}
    segments: dict[str, list[int]] = {}
    for name, segment in SEGMENTS_OF_VRM_BONES.items():
        if name in vrm_bones:
            segments.setdefault(segment, []).append(vrm_bones[name])
    for node, segment in segment_of.items():
        between: list[int] = []
        for above in nodes.list_ancestors(node):
            if above in segment_of:
                if segment in SEGMENTS_BELOW.get(segment_of[above], ()):
                    for bone in between:
                        segments.setdefault(_choose_segment(segment_of[above], bone, arm_carriers), []).append(bone)
                break
            between.append(above)
    place = {node: bone for bone, node in enumerate(bones)}
    chains = {segment: sorted(chain, key=place.__getitem__) for segment, chain in segments.items()}
    try:
        return build_bone_mapping(
            [nodes.names[node] for node in bones],
            np.array([place.get(int(nodes.parents[node]), -1) for node in bones]),
            {segment: [nodes.names[node] for node in chain] for segment, chain in chains.items()},
            {},
            reason="The humanoid bones that the VRM file names.",
            source=str(nodes.path),
        )
    except SceneError as error:
        raise ReadError(str(error)) from error


def _choose_segment(upper_segment: str, bone: int, arm_carriers: set[int]) -> str:
    """Return the segment of a bone between a humanoid bone of `upper_segment` and the next one."""
    return "neck" if upper_segment == "spine" and arm_carriers and bone not in arm_carriers else upper_segment
