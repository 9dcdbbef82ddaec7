"""Write a motion as binary glTF 2.0 (.glb) for Blender, Unreal, Unity, Godot and viewers in browsers.

Metres, Y up, facing +Z in the rest pose, as glTF requires (Khronos, glTF 2.0, 3.4). Every joint is a node with its rotations as
unit quaternions, and the root also has its positions. All are joints of a skin, because programs recognise a skeleton only then.
The mesh of the skin is a slender double pyramid for every bone, so that the skeleton is visible.
"""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Shaped

from mocapfix.files.output_files import replace_atomically
from mocapfix.kernels import quaternions
from mocapfix.motion import Motion
from mocapfix.skeleton import Skeleton

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


def write_gltf(target: Path, skeleton: Skeleton, motion: Motion, rate: float) -> None:
    """Write a motion at `rate` frames per second.

    Raises:
        WriteError: If `target` is not writable.
    """
    import pygltflib

    positions, buffer = skeleton.rest_positions, _GltfBuffer(pygltflib)
    joints = list(range(len(skeleton.names)))
    mesh, skin = _build_mesh(buffer, skeleton, positions), _build_skin(buffer, positions, joints)
    nodes = [
        pygltflib.Node(
            name=name, translation=skeleton.offsets[j].tolist(), children=np.flatnonzero(skeleton.parents == j).tolist()
        )
        for j, name in enumerate(skeleton.names)
    ]
    file = pygltflib.GLTF2(
        asset=pygltflib.Asset(generator="mocapfix"),
        scene=0,
        scenes=[pygltflib.Scene(nodes=[0, len(joints)])],
        nodes=[*nodes, pygltflib.Node(name="Bones", mesh=0, skin=0)],
        meshes=[mesh],
        skins=[skin],
        animations=[_build_animation(buffer, target.stem, motion, rate)],
        accessors=buffer.accessors,
        bufferViews=buffer.views,
        buffers=[pygltflib.Buffer(byteLength=len(buffer.data))],
    )
    file.set_binary_blob(bytes(buffer.data))
    with replace_atomically(Path(target)) as part:
        part.write_bytes(b"".join(file.save_to_bytes()))


class _GltfBuffer:
    """The one buffer of the file, with a view and an accessor for each array in it."""

    def __init__(self, gltf: Any) -> None:
        self.gltf = gltf  # the library, which is imported only where a file is written
        self.data = bytearray()
        self.views: list[Any] = []
        self.accessors: list[Any] = []

    def add_array(
        self,
        values: Shaped[np.ndarray, "N ..."],
        kind: str,
        target: int | None = None,
        *,
        has_bounds: bool = False,
    ) -> int:
        """Add an array with one element per row, and return the index of its accessor.

        Integers are stored in two bytes (always four of them), other numbers as floats, so that every element lies at a multiple
        of four bytes, as the format requires.
        """
        gltf, is_integer = self.gltf, values.dtype.kind == "i"
        values = np.ascontiguousarray(values, np.uint16 if is_integer else np.float32)
        code = gltf.UNSIGNED_SHORT if is_integer else gltf.FLOAT
        self.views.append(gltf.BufferView(buffer=0, byteOffset=len(self.data), byteLength=values.nbytes, target=target))
        self.data += values.tobytes()
        rows = values.reshape(len(values), -1)
        low, high = (rows.min(0).tolist(), rows.max(0).tolist()) if has_bounds else ([], [])
        view = len(self.views) - 1
        self.accessors.append(gltf.Accessor(bufferView=view, componentType=code, count=len(values), type=kind, min=low, max=high))
        return len(self.accessors) - 1


def _build_animation(buffer: _GltfBuffer, name: str, motion: Motion, rate: float) -> Any:
    """Return the positions of the root and the rotations of each joint, which share their times."""
    gltf, joints = buffer.gltf, range(motion.local_rotations.shape[1])
    times = buffer.add_array(np.arange(motion.frame_count) / rate, gltf.SCALAR, has_bounds=True)
    is_known = np.ones(motion.frame_count, bool)
    outputs = [buffer.add_array(motion.root_position, gltf.VEC3)]
    outputs += [
        buffer.add_array(quaternions.extract_joint_quaternions(motion.local_rotations, j, is_known), gltf.VEC4) for j in joints
    ]
    targets = [gltf.AnimationChannelTarget(node=0, path="translation")]
    targets += [gltf.AnimationChannelTarget(node=j, path="rotation") for j in joints]
    return gltf.Animation(
        name=name,
        samplers=[gltf.AnimationSampler(input=times, output=output) for output in outputs],
        channels=[gltf.AnimationChannel(sampler=k, target=target) for k, target in enumerate(targets)],
    )


def _build_skin(buffer: _GltfBuffer, positions: Float[np.ndarray, "J 3"], joints: list[int]) -> Any:
    """Return the skin. The axes of joints are the world's in the rest pose, so only their positions are inverted."""
    inverse = np.tile(np.eye(4), (len(positions), 1, 1))
    inverse[:, 3, :3] = -positions  # glTF stores matrices by columns
    return buffer.gltf.Skin(inverseBindMatrices=buffer.add_array(inverse, buffer.gltf.MAT4), skeleton=0, joints=joints)


def _build_mesh(buffer: _GltfBuffer, skeleton: Skeleton, positions: Float[np.ndarray, "J 3"]) -> Any:
    """Return every bone that has a length as a double pyramid that moves with its joint."""
    gltf = buffer.gltf
    bones = [(int(parent), positions[j]) for j, parent in enumerate(skeleton.parents) if parent >= 0]
    bones += [(j, positions[j] + end) for j, end in enumerate(skeleton.ends) if np.isfinite(end).all()]
    bones = [(j, end) for j, end in bones if np.linalg.norm(end - positions[j]) > 0]
    corners = np.concatenate([_build_pyramid(positions[j], end) for j, end in bones])
    corner_joints = np.repeat([[j, 0, 0, 0] for j, _ in bones], PYRAMID_FACES.size, axis=0)
    faces = corners.reshape(-1, 3, 3)
    normals = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
    normals = np.repeat(normals / np.linalg.norm(normals, axis=-1, keepdims=True), 3, axis=0)
    attributes = gltf.Attributes(
        POSITION=buffer.add_array(corners, gltf.VEC3, gltf.ARRAY_BUFFER, has_bounds=True),
        NORMAL=buffer.add_array(normals, gltf.VEC3, gltf.ARRAY_BUFFER),
        JOINTS_0=buffer.add_array(corner_joints, gltf.VEC4, gltf.ARRAY_BUFFER),
        WEIGHTS_0=buffer.add_array(np.tile([1.0, 0, 0, 0], (len(corners), 1)), gltf.VEC4, gltf.ARRAY_BUFFER),
    )
    return gltf.Mesh(name="Bones", primitives=[gltf.Primitive(attributes=attributes)])


def _build_pyramid(start: Float[np.ndarray, " 3"], end: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "24 3"]:
    """Return the corners of the triangles of a double pyramid, anticlockwise as seen from outside."""
    along = end - start
    length = np.linalg.norm(along)
    across = np.cross(along, np.eye(3)[np.abs(along).argmin()])
    across *= length / np.linalg.norm(across)
    axes = np.stack([across, along, np.cross(across, along) / length])
    return (start + PYRAMID_CORNERS @ axes)[PYRAMID_FACES].reshape(-1, 3)
