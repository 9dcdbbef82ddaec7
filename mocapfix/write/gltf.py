"""A motion as binary glTF 2.0 (.glb), for Blender, Unreal, Unity, Godot and viewers in browsers.

Metres, Y up, facing +Z in the rest pose, as glTF wants it (Khronos, glTF 2.0, 3.4). Every joint is a node with its
rotations as unit quaternions, the root with its places too, and all are joints of a skin: only so do programs take them for
a skeleton. The skin's mesh is a slender double pyramid for every bone, so that there is something to see.
"""

from pathlib import Path

import numpy as np

from mocapfix.files import replacing
from mocapfix.kernels import quaternions
from mocapfix.motion import Motion
from mocapfix.skeleton import Skeleton

WAIST, WIDTH = 0.12, 0.07  # of a bone's length: where the double pyramid is widest, and how far it reaches there
CORNERS = np.array([[0, 0, 0], [1, 0, 1], [-1, 0, 1], [-1, 0, -1], [1, 0, -1], [0, 1, 0]]) * [WIDTH, 1, WIDTH]
CORNERS[1:5, 1] = WAIST
FACES = np.array([[0, k, k % 4 + 1] for k in (1, 2, 3, 4)] + [[5, k % 4 + 1, k] for k in (1, 2, 3, 4)])


def gltf(target: Path, skeleton: Skeleton, motion: Motion, rate: float) -> None:
    """Write `motion` at `rate` frames a second; `target` is put into place whole or not at all.

    Raises WriteError where the folder cannot be written.
    """
    import pygltflib as g

    places, packed = _resting(skeleton), _Packed(g)
    joints = list(range(len(skeleton.names)))
    mesh, skin = _mesh(g, packed, skeleton, places), _skin(g, packed, places, joints)
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
        animations=[_animation(g, packed, target.stem, motion, rate)],
        accessors=packed.accessors,
        bufferViews=packed.views,
        buffers=[g.Buffer(byteLength=len(packed.data))],
    )
    file.set_binary_blob(bytes(packed.data))
    with replacing(Path(target)) as part:
        part.write_bytes(b"".join(file.save_to_bytes()))


class _Packed:
    """The file's one buffer as it grows, and what lies where in it: a view and an accessor an array."""

    def __init__(self, g) -> None:
        self.g, self.data, self.views, self.accessors = g, bytearray(), [], []

    def add(self, values: np.ndarray, kind: str, target: int | None = None, bounds: bool = False) -> int:
        """-> the accessor of `values`, one element a row; every type used here is four bytes wide or a multiple of it."""
        g = self.g
        code = {"f": g.FLOAT, "u": g.UNSIGNED_SHORT}[values.dtype.kind]
        self.views.append(g.BufferView(buffer=0, byteOffset=len(self.data), byteLength=values.nbytes, target=target))
        self.data += np.ascontiguousarray(values).tobytes()
        rows = values.reshape(len(values), -1)
        low, high = (rows.min(0).tolist(), rows.max(0).tolist()) if bounds else ([], [])
        where = len(self.views) - 1
        self.accessors.append(g.Accessor(bufferView=where, componentType=code, count=len(values), type=kind, min=low, max=high))
        return len(self.accessors) - 1


def _animation(g, packed: _Packed, name: str, motion: Motion, rate: float):
    """-> the root's places, then every joint's rotations, one after the other in the times that all share."""
    times = packed.add(np.float32(np.arange(motion.frames) / rate), g.SCALAR, bounds=True)
    known = np.ones(motion.frames, bool)
    courses = [(0, "translation", np.float32(motion.root), g.VEC3)]
    for j in range(motion.rotations.shape[1]):
        courses.append((j, "rotation", np.float32(quaternions.of_joint(motion.rotations, j, known)), g.VEC4))
    made = g.Animation(name=name, samplers=[], channels=[])
    for joint, path, values, kind in courses:
        which = g.AnimationChannelTarget(node=joint, path=path)
        made.channels.append(g.AnimationChannel(sampler=len(made.samplers), target=which))
        made.samplers.append(g.AnimationSampler(input=times, output=packed.add(values, kind)))
    return made


def _skin(g, packed: _Packed, places: np.ndarray, joints: list[int]):
    """-> the skin; at rest a joint's axes are the world's, so that only its place is to be taken back."""
    inverse = np.tile(np.eye(4, dtype=np.float32), (len(places), 1, 1))
    inverse[:, 3, :3] = -places  # glTF's matrices lie column by column
    return g.Skin(inverseBindMatrices=packed.add(inverse, g.MAT4), skeleton=0, joints=joints)


def _mesh(g, packed: _Packed, skeleton: Skeleton, places: np.ndarray):
    """-> every bone that has a length as a double pyramid that goes with its joint."""
    bones = [(int(parent), places[j]) for j, parent in enumerate(skeleton.parents) if parent >= 0]
    bones += [(j, places[j] + end) for j, end in enumerate(skeleton.ends) if np.isfinite(end).all()]
    bones = [(j, end) for j, end in bones if np.linalg.norm(end - places[j]) > 0]
    corners = np.concatenate([_pyramids(places[j], end) for j, end in bones])
    riding = np.zeros((len(corners), 4), np.uint16)
    riding[:, 0] = np.repeat([j for j, _ in bones], FACES.size)
    faces = corners.reshape(-1, 3, 3)
    normals = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
    normals = np.repeat(normals / np.linalg.norm(normals, axis=-1, keepdims=True), 3, axis=0)
    attributes = g.Attributes(
        POSITION=packed.add(np.float32(corners), g.VEC3, g.ARRAY_BUFFER, bounds=True),
        NORMAL=packed.add(np.float32(normals), g.VEC3, g.ARRAY_BUFFER),
        JOINTS_0=packed.add(riding, g.VEC4, g.ARRAY_BUFFER),
        WEIGHTS_0=packed.add(np.tile(np.float32([1, 0, 0, 0]), (len(corners), 1)), g.VEC4, g.ARRAY_BUFFER),
    )
    return g.Mesh(name="Bones", primitives=[g.Primitive(attributes=attributes)])


def _pyramids(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """-> (24, 3) the corners of the double pyramid's triangles, three by three, seen from outside anticlockwise."""
    along = end - start
    length = np.linalg.norm(along)
    across = np.cross(along, np.eye(3)[np.abs(along).argmin()])
    across *= length / np.linalg.norm(across)
    axes = np.stack([across, along, np.cross(across, along) / length])
    return (start + CORNERS @ axes)[FACES].reshape(-1, 3)


def _resting(skeleton: Skeleton) -> np.ndarray:
    """-> (J, 3) metres: the joints in the rest pose."""
    places = skeleton.offsets.copy()
    for j, parent in enumerate(skeleton.parents):
        if parent >= 0:
            places[j] += places[parent]
    return places
