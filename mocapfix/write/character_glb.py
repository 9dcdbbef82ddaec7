"""Write the motion of a character as binary glTF: into the user's own file, or with a test skin for a character without mesh.

In the user's file, mesh, skin, materials, existing animations and everything unknown stay as they are: the animation is appended
to the document, and its arrays to the binary chunk behind the old bytes.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from mocapfix.characters.character import Character, CharacterMotion, compute_character_poses
from mocapfix.contacts.contacts import BodyContacts
from mocapfix.files.glb import GlbContent, build_glb, parse_glb
from mocapfix.files.output_files import replace_atomically
from mocapfix.write.character_bones import compute_leg_length, get_parent_scale, list_moving_bones
from mocapfix.write.gltf_animation import add_animation
from mocapfix.write.gltf_buffer import GLTF_ASSET, GltfBuffer
from mocapfix.write.gltf_skin import add_test_skin
from mocapfix.write.key_reduction import KeyReduction, MotionKeys, measure_key_reduction, select_motion_keys
from mocapfix.write.standing_feet import LegCurves, build_leg_curves


def write_character_glb(
    target: Path,
    character: Character,
    motion: CharacterMotion,
    take_name: str,
    key_error_rad: float | None = None,
    contacts: BodyContacts | None = None,
) -> KeyReduction | None:
    """Write the motion of a character as a GLB.

    The animation has the rotations of the bones of all segments and of others that move, and the positions of the pelvis. A
    rotation that does not change has one key.

    Args:
        target: The file.
        character: The character. The file that it was read from, if that was a glTF, is kept; else it gets a test skin.
        motion: Its motion.
        take_name: Name of the animation; a number is appended if the file has an animation of that name.
        key_error_rad: Write only the keys that keep every rotation within this angle, and the pelvis within the distance that
            it means at the end of a leg (angle times leg length), and standing feet where they are. Every frame by default.
        contacts: Of the motion, at their own rate: when its feet stand. Without any, slow feet stand.

    Returns:
        The errors of the reduction, None without one.

    Raises:
        WriteError: If `target` is not writable.
    """
    content, nodes = _open_document(character)
    bones = list_moving_bones(character, motion)
    legs = None if key_error_rad is None else build_leg_curves(character, motion, contacts)
    leg_length_m = compute_leg_length(character)
    keys = select_motion_keys(bones, motion.local_rotations, motion.pelvis_position, key_error_rad, leg_length_m, legs)
    pelvis = character.mapping.bones["pelvis"][0]
    buffer = GltfBuffer(content.document, content.binary)
    has_own_scale = character.source is not None and character.source.kind == "gltf"
    position_scale = get_parent_scale(character, pelvis) if has_own_scale else 1.0
    for bone in {pelvis, *bones}:
        _replace_matrix(content.document["nodes"][nodes[bone]])
    name = _make_name_unique(take_name, content.document.get("animations", []))
    add_animation(buffer, name, keys, [int(nodes[bone]) for bone in bones], int(nodes[pelvis]), position_scale, motion.rate)
    data = build_glb(GlbContent(content.document, buffer.finish(), content.other_chunks))
    with replace_atomically(Path(target)) as part:
        part.write_bytes(data)
    return None if key_error_rad is None else _measure_character_keys(character, motion, keys, key_error_rad, legs)


def _measure_character_keys(
    character: Character, motion: CharacterMotion, keys: MotionKeys, key_error_rad: float, legs: LegCurves | None
) -> KeyReduction:
    """Measure the errors of a character's motion between its keys, at the heads and tails of all bones."""

    def compute_points(position: Float[np.ndarray, "T 3"], rotations: Float[np.ndarray, "T J 3 3"]) -> Float[np.ndarray, "T P 3"]:
        heads, axes = compute_character_poses(character, CharacterMotion(position, rotations, motion.rate))
        return np.concatenate([heads, heads + (axes @ np.nan_to_num(character.tails)[..., None])[..., 0]], axis=1)

    return measure_key_reduction(keys, motion.local_rotations, key_error_rad, compute_points, legs)


def _open_document(character: Character) -> tuple[GlbContent, Int[np.ndarray, " J"]]:
    """Return the content to which the animation is appended, and the node of each bone."""
    source = character.source
    if source is not None and source.kind == "gltf":
        return parse_glb(Path(source.path), source.data), source.nodes
    buffer = GltfBuffer(_build_skinned_document(character))
    positions, rotations = character.compute_rest_pose()
    has_child = np.isin(np.arange(len(positions)), character.parents)
    tails = positions + np.einsum("jab,jb->ja", rotations, character.tails)
    add_test_skin(buffer, character.parents, positions, rotations, np.where(has_child[:, None], np.nan, tails))
    return GlbContent(buffer.document, buffer.finish()), np.arange(len(positions))


def _build_skinned_document(character: Character) -> dict[str, Any]:
    """Return a document with the bones as its first nodes, in metres, and a node for mesh 0 and skin 0."""
    quaternions = Rotation.from_matrix(character.rest_rotations).as_quat()
    nodes: list[dict[str, Any]] = [
        {"name": name, "translation": position.tolist(), "rotation": quaternion.tolist()}
        for name, position, quaternion in zip(character.names, character.rest_positions, quaternions, strict=True)
    ]
    for bone, parent in enumerate(character.parents):
        if parent >= 0:
            nodes[parent].setdefault("children", []).append(bone)
    roots = np.flatnonzero(character.parents < 0).tolist()
    nodes.append({"name": "Bones", "mesh": 0, "skin": 0})
    scene_nodes = [*roots, len(nodes) - 1]
    if len(roots) > 1:  # the joints of a skin need a common ancestor
        nodes.append({"name": "Armature", "children": roots})
        scene_nodes = [len(nodes) - 1, len(nodes) - 2]
    return {"asset": GLTF_ASSET, "scene": 0, "scenes": [{"nodes": scene_nodes}], "nodes": nodes}


def _replace_matrix(node: dict[str, Any]) -> None:
    """Give the transform of a node as translation, rotation and scale: a node with a matrix cannot be animated."""
    if "matrix" not in node:
        return
    matrix = np.array(node.pop("matrix"), float).reshape(4, 4).T
    scales = np.linalg.norm(matrix[:3, :3], axis=0)
    node["translation"] = matrix[:3, 3].tolist()
    node["rotation"] = Rotation.from_matrix(matrix[:3, :3] / scales).as_quat().tolist()
    node["scale"] = scales.tolist()


def _make_name_unique(name: str, animations: Iterable[dict[str, Any]]) -> str:
    """Return the name, with a number behind it if an animation has that name."""
    names = [animation.get("name") for animation in animations]
    used = {each for each in names if isinstance(each, str)}
    candidates = (name, *(f"{name}.{number:03d}" for number in range(1, len(used) + 2)))
    return next(candidate for candidate in candidates if candidate not in used)
