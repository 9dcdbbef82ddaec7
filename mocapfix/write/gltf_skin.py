"""A test skin for bones without a mesh: a slender double pyramid for every bone, so that the skeleton is visible.

Programs recognise a skeleton only where its joints are those of a skin.
"""

from typing import Any

import numpy as np
from jaxtyping import Float, Int

from mocapfix.write.gltf_buffer import ARRAY_BUFFER, GltfBuffer

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
