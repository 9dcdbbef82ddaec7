"""Write a motion as binary glTF 2.0 (.glb) for Blender, Unreal, Unity, Godot and viewers in browsers.

Metres, Y up, facing +Z in the rest pose, as glTF requires (Khronos, glTF 2.0, 3.4). Every joint is a node with its rotations as
unit quaternions, and the root also has its positions. All are joints of a skin, whose mesh shows the bones.

Animations that are appended to a glTF document.

A test skin for bones without a mesh: a slender double pyramid for every bone, so that the skeleton is visible.

Programs recognise a skeleton only where its joints are those of a skin.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.io.files import replace_atomically
from mocapfix.io.glb import ARRAY_BUFFER, GLTF_ASSET, GlbContent, GltfBuffer, build_glb
from mocapfix.io.key_reduction import KeyReduction, MotionKeys, measure_key_reduction, select_motion_keys
from mocapfix.model.motion import Motion
from mocapfix.model.skeleton import Skeleton
from mocapfix.stats.rigid_alignment import compose_transforms

if TYPE_CHECKING:
    from mocapfix.contacts.contacts import BodyContacts


def add_animation(
    buffer: GltfBuffer, name: str, keys: MotionKeys, nodes: Sequence[int], position_node: int, position_scale: float, rate: float
) -> None:
    """Add an animation to the document. Curves with the same keys share their times.

    Args:
        buffer: The buffer and the document.
        name: Name of the animation.
        keys: The curves and their keys.
        nodes: Node of each curve of rotations.
        position_node: Node of the curve of positions.
        position_scale: Metres in a unit of its parent.
        rate: Frames per second.
    """
    times: dict[bytes, int] = {}

    def add_times(kept: Bool[np.ndarray, " T"]) -> int:
        key = kept.tobytes()
        if key not in times:
            times[key] = buffer.add_array(np.flatnonzero(kept) / rate, "SCALAR", has_bounds=True)
        return times[key]

    position = keys.position[keys.position_keys] / position_scale
    samplers = [{"input": add_times(keys.position_keys), "output": buffer.add_array(position, "VEC3")}]
    channels = [{"sampler": 0, "target": {"node": position_node, "path": "translation"}}]
    for node, rotation, kept in zip(nodes, keys.rotations, keys.rotation_keys, strict=True):
        channels.append({"sampler": len(samplers), "target": {"node": node, "path": "rotation"}})
        samplers.append({"input": add_times(kept), "output": buffer.add_array(rotation[kept], "VEC4")})
    samplers = [each | {"interpolation": "LINEAR"} for each in samplers]
    buffer.document.setdefault("animations", []).append({"name": name, "channels": channels, "samplers": samplers})


BONE_WAIST_FRACTION = 0.12  # of a bone's length: from its beginning to the widest place of its double pyramid
BONE_WIDTH_FRACTION = 0.07  # of a bone's length: from its axis to the corners there
# Corners of a double pyramid in units of the bone's length: beginning, four at the waist, end.
PYRAMID_CORNERS = np.array(
    [
        [0, 0, 0],
        [BONE_WIDTH_FRACTION, BONE_WAIST_FRACTION, BONE_WIDTH_FRACTION],
        [-BONE_WIDTH_FRACTION, BONE_WAIST_FRACTION, BONE_WIDTH_FRACTION],
        [-BONE_WIDTH_FRACTION, BONE_WAIST_FRACTION, -BONE_WIDTH_FRACTION],
        [BONE_WIDTH_FRACTION, BONE_WAIST_FRACTION, -BONE_WIDTH_FRACTION],
        [0, 1, 0],
    ]
)
PYRAMID_FACES = np.array([[0, k, k % 4 + 1] for k in (1, 2, 3, 4)] + [[5, k % 4 + 1, k] for k in (1, 2, 3, 4)])
MIN_SKIN_BONE_M = 1e-6
"""a shorter bone has no pyramid"""


def add_test_skin(
    buffer: GltfBuffer,
    parents: Int[np.ndarray, " J"],
    positions: Float[np.ndarray, "J 3"],
    rotations: Float[np.ndarray, "J 3 3"],
    tails: Float[np.ndarray, "J 3"],
) -> None:
    """Add mesh 0 and skin 0 to a document whose first J nodes are the bones.

    Args:
        buffer: The buffer and the document.
        parents: (J,) index of each bone's parent, -1 for roots.
        positions: (J, 3) m: heads in the world, in the rest pose.
        rotations: (J, 3, 3): axes of the bones to the world's, in the rest pose.
        tails: (J, 3) m: tails in the world of the bones that show no child; NaN for the others.
    """
    inverse = np.tile(np.eye(4), (len(positions), 1, 1))
    inverse[:, :3, :3] = rotations.swapaxes(-1, -2)
    inverse[:, :3, 3] = -np.einsum("jba,jb->ja", rotations, positions)
    matrices = buffer.add_array(inverse.swapaxes(-1, -2), "MAT4")  # stored by columns
    buffer.document["skins"] = [{"inverseBindMatrices": matrices, "joints": list(range(len(positions)))}]
    buffer.document["meshes"] = [
        {"name": "Bones", "primitives": [{"attributes": _add_pyramids(buffer, parents, positions, tails)}]}
    ]


def _add_pyramids(
    buffer: GltfBuffer, parents: Int[np.ndarray, " J"], positions: Float[np.ndarray, "J 3"], tails: Float[np.ndarray, "J 3"]
) -> dict[str, Any]:
    """Add every bone that has a length as a double pyramid that moves with its head, and return the attributes."""
    bones = [(int(parent), positions[j]) for j, parent in enumerate(parents) if parent >= 0]
    bones += [(j, tail) for j, tail in enumerate(tails) if np.isfinite(tail).all()]
    bones = [(j, end) for j, end in bones if np.linalg.norm(end - positions[j]) > MIN_SKIN_BONE_M]
    corners = np.concatenate([_build_pyramid(positions[j], end) for j, end in bones])
    corner_joints = np.repeat([[j, 0, 0, 0] for j, _ in bones], PYRAMID_FACES.size, axis=0)
    faces = corners.reshape(-1, 3, 3)
    normals = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
    normals = np.repeat(normals / np.linalg.norm(normals, axis=-1, keepdims=True), 3, axis=0)
    return {
        "POSITION": buffer.add_array(corners, "VEC3", ARRAY_BUFFER, has_bounds=True),
        "NORMAL": buffer.add_array(normals, "VEC3", ARRAY_BUFFER),
        "JOINTS_0": buffer.add_array(corner_joints, "VEC4", ARRAY_BUFFER),
        "WEIGHTS_0": buffer.add_array(np.tile([1.0, 0, 0, 0], (len(corners), 1)), "VEC4", ARRAY_BUFFER),
    }


def _build_pyramid(start: Float[np.ndarray, " 3"], end: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "24 3"]:
    """Return the corners of the triangles of a double pyramid, anticlockwise as seen from outside."""
    along = end - start
    length = np.linalg.norm(along)
    across = np.cross(along, np.eye(3)[np.abs(along).argmin()])
    across *= length / np.linalg.norm(across)
    axes = np.stack([across, along, np.cross(across, along) / length])
    return (start + PYRAMID_CORNERS @ axes)[PYRAMID_FACES].reshape(-1, 3)


def write_gltf(
    target: Path,
    skeleton: Skeleton,
    motion: Motion,
    rate: float,
    key_error_rad: float | None = None,
    contacts: "BodyContacts | None" = None,
) -> KeyReduction | None:
    """Write a motion at `rate` frames per second.

    With `key_error_rad` only the keys are written that keep rotations within this angle, and the root within the distance that
    it means at half the height of the skeleton, and standing feet where they are. `contacts` of the motion, at their own rate,
    have when the feet stand; without any, slow feet stand.

    Returns:
        The errors of the reduction, None without one.

    Raises:
        WriteError: If `target` is not writable.
    """
    count, positions = len(skeleton.names), skeleton.rest_positions
    nodes: list[dict[str, Any]] = [
        {"name": name, "translation": offset.tolist()} for name, offset in zip(skeleton.names, skeleton.offsets, strict=True)
    ]
    for joint, parent in enumerate(skeleton.parents):
        if parent >= 0:
            nodes[parent].setdefault("children", []).append(joint)
    document: dict[str, Any] = {
        "asset": GLTF_ASSET,
        "scene": 0,
        "scenes": [{"nodes": [0, count]}],
        "nodes": [*nodes, {"name": "Bones", "mesh": 0, "skin": 0}],
    }
    buffer = GltfBuffer(document)
    add_test_skin(buffer, skeleton.parents, positions, np.tile(np.eye(3), (count, 1, 1)), positions + skeleton.ends)
    leg_length_m = float(np.ptp(positions[:, 1])) / 2
    legs = None
    if key_error_rad is not None:
        from mocapfix.characters.character import build_cmu31_character, convert_motion  # few cleanings need them
        from mocapfix.io.key_reduction import build_leg_curves

        legs = build_leg_curves(build_cmu31_character(skeleton), convert_motion(motion, rate), contacts)
    keys = select_motion_keys(range(count), motion.local_rotations, motion.root_position, key_error_rad, leg_length_m, legs)
    add_animation(buffer, target.stem, keys, range(count), 0, 1.0, rate)
    with replace_atomically(Path(target)) as part:
        part.write_bytes(build_glb(GlbContent(document, buffer.finish())))
    if key_error_rad is None:
        return None

    def compute_points(root: Float[np.ndarray, "T 3"], rotations: Float[np.ndarray, "T J 3 3"]) -> Float[np.ndarray, "T P 3"]:
        offsets = np.tile(skeleton.offsets, (len(root), 1, 1))
        offsets[:, 0] = root
        heads, axes = compose_transforms(skeleton.parents, offsets, rotations)
        return np.concatenate([heads, heads + (axes @ np.nan_to_num(skeleton.ends)[..., None])[..., 0]], axis=1)

    return measure_key_reduction(keys, motion.local_rotations, key_error_rad, compute_points, legs)
