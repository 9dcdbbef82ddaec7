"""A motion as binary glTF 2.0 (.glb), for Blender, Unreal, Unity, Godot and viewers in browsers.

Metres, Y up, facing +Z in the rest pose, as glTF wants it (Khronos, glTF 2.0, 3.4). Every joint is a node with its
rotations as unit quaternions, the root with its places too, and all are joints of a skin: only so do programs take them for
a skeleton. The skin's mesh is a slender double pyramid for every bone, so that there is something to see.
"""

from pathlib import Path

import numpy as np

from mocapfix.files.output_files import replace_atomically
from mocapfix.kernels import quaternions
from mocapfix.motion import Motion
from mocapfix.skeleton import Skeleton

BONE_WAIST_FRACTION, BONE_WIDTH_FRACTION = (
    0.12,
    0.07,
)  # of a bone's length: where the double pyramid is widest, and how far it reaches there
PYRAMID_CORNERS = np.array([[0, 0, 0], [1, 0, 1], [-1, 0, 1], [-1, 0, -1], [1, 0, -1], [0, 1, 0]]) * [
    BONE_WIDTH_FRACTION,
    1,
    BONE_WIDTH_FRACTION,
]
PYRAMID_CORNERS[1:5, 1] = BONE_WAIST_FRACTION
PYRAMID_FACES = np.array([[0, k, k % 4 + 1] for k in (1, 2, 3, 4)] + [[5, k % 4 + 1, k] for k in (1, 2, 3, 4)])


def write_gltf(target: Path, skeleton: Skeleton, motion: Motion, rate: float) -> None:
    """Write `motion` at `rate` frames a second; `target` is put into place whole or not at all.

    Raises WriteError where the folder cannot be written.
    """
    import pygltflib as g

    places, packed = skeleton.rest_positions, _GltfBuffer(g)
    joints = list(range(len(skeleton.names)))
    mesh, skin = _build_mesh(g, packed, skeleton, places), _build_skin(g, packed, places, joints)
    nodes = [
        g.Node(name=name, translation=skeleton.offsets[j].tolist(), children=np.flatnonzero(skeleton.parents == j).tolist())
        for j, name in enumerate(skeleton.names)
    ]
    file = g.GLTF2(
        asset=g.Asset(generator="mocapfix"),
        scene=0,
        scenes=[g.Scene(nodes=[0, len(joints)])],
        nodes=[*nodes, g.Node(name="Bones", mesh=0, skin=0)],
        meshes=[mesh],
        skins=[skin],
        animations=[_build_animation(g, packed, target.stem, motion, rate)],
        accessors=packed.accessors,
        bufferViews=packed.views,
        buffers=[g.Buffer(byteLength=len(packed.data))],
    )
    file.set_binary_blob(bytes(packed.data))
    with replace_atomically(Path(target)) as part:
        part.write_bytes(b"".join(file.save_to_bytes()))


class _GltfBuffer:
    """The file's one buffer as it grows, and what lies where in it: a view and an accessor an array."""

    def __init__(self, g) -> None:
        self.g, self.data, self.views, self.accessors = g, bytearray(), [], []

    def add_array(self, values: np.ndarray, kind: str, target: int | None = None, bounds: bool = False) -> int:
        """-> the accessor of `values`, one element a row: whole numbers in two bytes (always four of them), others as floats,
        so that every element lies at a multiple of four bytes, as it must."""
        g, whole = self.g, values.dtype.kind == "i"
        values = np.ascontiguousarray(values, np.uint16 if whole else np.float32)
        code = g.UNSIGNED_SHORT if whole else g.FLOAT
        self.views.append(g.BufferView(buffer=0, byteOffset=len(self.data), byteLength=values.nbytes, target=target))
        self.data += values.tobytes()
        rows = values.reshape(len(values), -1)
        low, high = (rows.min(0).tolist(), rows.max(0).tolist()) if bounds else ([], [])
        where = len(self.views) - 1
        self.accessors.append(g.Accessor(bufferView=where, componentType=code, count=len(values), type=kind, min=low, max=high))
        return len(self.accessors) - 1


def _build_animation(g, packed: _GltfBuffer, name: str, motion: Motion, rate: float):
    """-> the root's places, then every joint's rotations, one after the other in the times that all share."""
    times = packed.add_array(np.arange(motion.frame_count) / rate, g.SCALAR, bounds=True)
    known, joints = np.ones(motion.frame_count, bool), range(motion.local_rotations.shape[1])
    outputs = [packed.add_array(motion.root_position, g.VEC3)]
    outputs += [packed.add_array(quaternions.extract_joint_quaternions(motion.local_rotations, j, known), g.VEC4) for j in joints]
    targets = [g.AnimationChannelTarget(node=0, path="translation")]
    targets += [g.AnimationChannelTarget(node=j, path="rotation") for j in joints]
    return g.Animation(
        name=name,
        samplers=[g.AnimationSampler(input=times, output=output) for output in outputs],
        channels=[g.AnimationChannel(sampler=k, target=target) for k, target in enumerate(targets)],
    )


def _build_skin(g, packed: _GltfBuffer, places: np.ndarray, joints: list[int]):
    """-> the skin; at rest a joint's axes are the world's, so that only its place is to be taken back."""
    inverse = np.tile(np.eye(4), (len(places), 1, 1))
    inverse[:, 3, :3] = -places  # glTF's matrices lie column by column
    return g.Skin(inverseBindMatrices=packed.add_array(inverse, g.MAT4), skeleton=0, joints=joints)


def _build_mesh(g, packed: _GltfBuffer, skeleton: Skeleton, places: np.ndarray):
    """-> every bone that has a length as a double pyramid that goes with its joint."""
    bones = [(int(parent), places[j]) for j, parent in enumerate(skeleton.parents) if parent >= 0]
    bones += [(j, places[j] + end) for j, end in enumerate(skeleton.ends) if np.isfinite(end).all()]
    bones = [(j, end) for j, end in bones if np.linalg.norm(end - places[j]) > 0]
    corners = np.concatenate([_build_pyramid(places[j], end) for j, end in bones])
    riding = np.repeat([[j, 0, 0, 0] for j, _ in bones], PYRAMID_FACES.size, axis=0)
    faces = corners.reshape(-1, 3, 3)
    normals = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
    normals = np.repeat(normals / np.linalg.norm(normals, axis=-1, keepdims=True), 3, axis=0)
    attributes = g.Attributes(
        POSITION=packed.add_array(corners, g.VEC3, g.ARRAY_BUFFER, bounds=True),
        NORMAL=packed.add_array(normals, g.VEC3, g.ARRAY_BUFFER),
        JOINTS_0=packed.add_array(riding, g.VEC4, g.ARRAY_BUFFER),
        WEIGHTS_0=packed.add_array(np.tile([1.0, 0, 0, 0], (len(corners), 1)), g.VEC4, g.ARRAY_BUFFER),
    )
    return g.Mesh(name="Bones", primitives=[g.Primitive(attributes=attributes)])


def _build_pyramid(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """-> (24, 3) the corners of the double pyramid's triangles, three by three, seen from outside anticlockwise."""
    along = end - start
    length = np.linalg.norm(along)
    across = np.cross(along, np.eye(3)[np.abs(along).argmin()])
    across *= length / np.linalg.norm(across)
    axes = np.stack([across, along, np.cross(across, along) / length])
    return (start + PYRAMID_CORNERS @ axes)[PYRAMID_FACES].reshape(-1, 3)
