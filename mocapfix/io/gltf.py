"""Write a motion as binary glTF 2.0 (.glb) for Blender, Unreal, Unity, Godot and viewers in browsers.

Metres, Y up, facing +Z in the rest pose, as glTF requires (Khronos, glTF 2.0, 3.4). Every joint is a node with its rotations as
unit quaternions, and the root also has its positions. All are joints of a skin, whose mesh shows the bones.

Animations that are appended to a glTF document.

A test skin for bones without a mesh: a slender double pyramid for every bone, so that the skeleton is visible.

Programs recognise a skeleton only where its joints are those of a skin.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from mocapfix.io.files import replace_atomically
from mocapfix.io.glb import ARRAY_BUFFER, GLTF_ASSET, GlbContent, GltfBuffer, build_glb
from mocapfix.kernels import lie
from mocapfix.model.motion import Motion
from mocapfix.model.skeleton import Skeleton

MAX_CONSTANT_CHORD = 5e-7
"""of unit quaternions: the distance of two rotations that differ by 1e-6 rad. A rotation that stays within it has one key"""


def add_animation(
    buffer: GltfBuffer,
    name: str,
    local_rotations: Float[np.ndarray, "T J 3 3"],
    position: Float[np.ndarray, "T 3"],
    nodes: Mapping[int, int],
    position_node: int,
    rate: float,
) -> None:
    """Add an animation to the document, with a key in every frame, or a single one of a rotation that does not change.

    Args:
        buffer: The buffer and the document.
        name: Name of the animation.
        local_rotations: Axes of each bone to its parent's.
        position: Of `position_node`, in the unit of its parent.
        nodes: Bone to node, of the bones that get a curve.
        position_node: Node of the curve of positions.
        rate: Frames per second.
    """
    frame_count = len(position)
    times: dict[int, int] = {}

    def add_curve(node: int, path: str, kind: str, values: Float[np.ndarray, "K N"]) -> None:
        if len(values) not in times:
            times[len(values)] = buffer.add_array(np.arange(len(values)) / rate, "SCALAR", has_bounds=True)
        channels.append({"sampler": len(samplers), "target": {"node": node, "path": path}})
        output = buffer.add_array(values, kind)
        samplers.append({"input": times[len(values)], "output": output, "interpolation": "LINEAR"})

    channels: list[dict[str, Any]] = []
    samplers: list[dict[str, Any]] = []
    add_curve(position_node, "translation", "VEC3", position)
    for bone, node in nodes.items():
        rotation = lie.extract_joint_quaternions(local_rotations, bone, np.ones(frame_count, bool))
        is_constant = bool((np.linalg.norm(rotation - rotation[0], axis=1) <= MAX_CONSTANT_CHORD).all())
        add_curve(node, "rotation", "VEC4", rotation[:1] if is_constant else rotation)
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


def write_gltf(target: Path, skeleton: Skeleton, motion: Motion, rate: float) -> None:
    """Write a motion at `rate` frames per second. Raises WriteError if `target` is not writable."""
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
    nodes_of_joints = dict(enumerate(range(count)))
    add_animation(buffer, target.stem, motion.local_rotations, motion.root_position, nodes_of_joints, 0, rate)
    with replace_atomically(Path(target)) as part:
        part.write_bytes(build_glb(GlbContent(document, buffer.finish())))
