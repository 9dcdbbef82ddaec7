"""glTF 2.0: the container of binary files (.glb), the nodes of a document, arrays and animations that are added, and whole files.

Source: Khronos, glTF 2.0, section 4 (GLB File Format) and 3.4: metres, Y up, facing +Z in the rest pose. What is added to a
document leaves the rest of it byte by byte: pygltflib loses empty objects such as `extras`, and the padding behind images.

A written motion has a node for every joint, with its rotations as unit quaternions; the root also has its positions. All are
joints of a skin, since programs recognise a skeleton only there; its mesh shows every bone as a slender double pyramid.
"""

import json
import math
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, NoReturn

import numpy as np
import scipy
from jaxtyping import Float, Int, Shaped

from mocapfix.errors import ReadError, WriteError
from mocapfix.io.files import replace_atomically
from mocapfix.kernels import lie
from mocapfix.model.skeleton import Skeleton, make_names_unique

GLB_MAGIC = b"glTF"
GLB_VERSION = 2
GLB_HEADER = struct.Struct("<4sII")
GLB_CHUNK_HEADER = struct.Struct("<II")
JSON_CHUNK, BINARY_CHUNK = 0x4E4F534A, 0x004E4942
CHUNK_ALIGNMENT = 4  # bytes; every chunk begins and ends at a multiple of it
MAX_GLB_BYTES = 2**32 - 1  # the length of the file is stored in four bytes


@dataclass(frozen=True)
class GlbContent:
    """The content of a .glb."""

    document: dict[str, Any]  # the JSON document, an object
    binary: bytes  # the binary chunk with its padding, empty if there is none
    other_chunks: tuple[tuple[int, bytes], ...] = ()  # type and content of each further chunk


def is_glb(head: bytes) -> bool:
    """Return whether a file with this beginning is a GLB."""
    return head.startswith(GLB_MAGIC)


def parse_glb(path: Path, data: bytes) -> GlbContent:
    """Return the content of a GLB. Bytes after its declared length are ignored."""
    if len(data) < GLB_HEADER.size + GLB_CHUNK_HEADER.size or not is_glb(data):
        raise ReadError(f"{path}: is no GLB, or was cut off within its header; export it again.")
    _, version, length = GLB_HEADER.unpack_from(data)
    if version != GLB_VERSION:
        raise ReadError(f"{path}: is version {version} of GLB, and only version {GLB_VERSION} is read; export it as glTF 2.0.")
    if length > len(data):
        raise ReadError(f"{path}: was cut off: it has {len(data)} of {length} bytes; copy or export it again.")
    chunks = list(_split_chunks(path, data[:length]))
    if chunks[0][0] != JSON_CHUNK:
        raise ReadError(f"{path}: its first chunk is not JSON; export it again.")
    binary = chunks[1][1] if len(chunks) > 1 and chunks[1][0] == BINARY_CHUNK else b""
    other_chunks = tuple(chunks[2 if binary else 1 :])
    return GlbContent(parse_gltf_document(path, chunks[0][1]), binary, other_chunks)


def _split_chunks(path: Path, data: bytes) -> list[tuple[int, bytes]]:
    chunks: list[tuple[int, bytes]] = []
    start = GLB_HEADER.size
    while start + GLB_CHUNK_HEADER.size <= len(data):
        length, kind = GLB_CHUNK_HEADER.unpack_from(data, start)
        start += GLB_CHUNK_HEADER.size
        if start + length > len(data):
            raise ReadError(f"{path}: chunk {len(chunks) + 1} has {length} bytes and ends beyond the file; export it again.")
        chunks.append((kind, data[start : start + length]))
        start += length
    return chunks


def parse_gltf_document(path: Path, data: bytes) -> dict[str, Any]:
    """Return the JSON document of a glTF file. Raises ReadError if it is not one object of valid JSON with finite numbers."""

    def refuse_constant(text: str) -> NoReturn:
        raise ValueError(f"{text} is not a number of JSON")

    def parse_finite(text: str) -> float:
        number = float(text)
        return number if math.isfinite(number) else refuse_constant(text)

    try:
        document = json.loads(data.decode("utf-8-sig"), parse_constant=refuse_constant, parse_float=parse_finite)
    except UnicodeDecodeError as error:
        raise ReadError(f"{path}: its JSON is not valid UTF-8 at byte {error.start}; export it again.") from error
    except json.JSONDecodeError as error:
        problem = f"{error.msg} in line {error.lineno}, column {error.colno}"
        raise ReadError(f"{path}: its JSON is damaged ({problem}); export it again.") from error
    except (ValueError, RecursionError) as error:
        problem = "it is nested too deeply" if isinstance(error, RecursionError) else str(error).split(";")[0]
        raise ReadError(f"{path}: its JSON is invalid ({problem}); export it again.") from error
    if not isinstance(document, dict):
        raise ReadError(f"{path}: its JSON is no object, so it is no glTF; export it again.")
    return document


def build_glb(content: GlbContent) -> bytes:
    """Return the bytes of a GLB. Raises WriteError if they are more than the format can hold."""
    try:
        encoded = json.dumps(content.document, ensure_ascii=False, separators=(",", ":")).encode()
    except UnicodeEncodeError:  # half of a surrogate pair, which only an escape can give
        encoded = json.dumps(content.document, separators=(",", ":")).encode()
    chunks = [(JSON_CHUNK, encoded + b" " * (-len(encoded) % CHUNK_ALIGNMENT))]
    if content.binary:
        chunks.append((BINARY_CHUNK, content.binary + bytes(-len(content.binary) % CHUNK_ALIGNMENT)))
    chunks += content.other_chunks
    length = GLB_HEADER.size + sum(GLB_CHUNK_HEADER.size + len(chunk) for _, chunk in chunks)
    if length > MAX_GLB_BYTES:
        raise WriteError(f"A GLB of {length / 1e9:.1f} GB cannot be written, as the format ends at 4.3 GB; use a smaller mesh.")
    parts = [GLB_HEADER.pack(GLB_MAGIC, GLB_VERSION, length)]
    for kind, chunk in chunks:
        parts += [GLB_CHUNK_HEADER.pack(len(chunk), kind), chunk]
    return b"".join(parts)


GLTF_ASSET = {"version": "2.0", "generator": "mocapfix"}  # of a document that is not one of the user
FLOAT, UNSIGNED_SHORT = 5126, 5123  # component types of glTF
ARRAY_BUFFER = 34962  # target of the bufferView of vertices
ELEMENT_ALIGNMENT = 4  # bytes


class GltfBuffer:
    """The first buffer of a document, the binary chunk of the GLB, with a view and an accessor for each array added to it.

    Attributes:
        document: The document, whose lists are extended.
        data: The binary chunk so far.
    """

    def __init__(self, document: dict[str, Any], data: bytes = b"") -> None:
        self.document = document
        self.data = bytearray(data)

    def add_array(
        self, values: Shaped[np.ndarray, "N ..."], kind: str, target: int | None = None, *, has_bounds: bool = False
    ) -> int:
        """Add an array with one element per row, and return the index of its accessor.

        Integers are stored in two bytes (always four of them), other numbers as floats, so that every element lies at a multiple
        of four bytes, as the format requires.
        """
        is_integer = values.dtype.kind == "i"
        values = np.ascontiguousarray(values, "<u2" if is_integer else "<f4")
        self.data += bytes(-len(self.data) % ELEMENT_ALIGNMENT)
        view: dict[str, Any] = {"buffer": 0, "byteOffset": len(self.data), "byteLength": values.nbytes}
        if target is not None:
            view["target"] = target
        self.data += values.tobytes()
        views, accessors = (self.document.setdefault(name, []) for name in ("bufferViews", "accessors"))
        views.append(view)
        component = UNSIGNED_SHORT if is_integer else FLOAT
        accessor: dict[str, Any] = {
            "bufferView": len(views) - 1, "componentType": component, "count": len(values), "type": kind,
        }  # fmt: skip
        if has_bounds:
            rows = values.reshape(len(values), -1)
            accessor |= {"min": rows.min(0).tolist(), "max": rows.max(0).tolist()}
        accessors.append(accessor)
        return len(accessors) - 1

    def finish(self) -> bytes:
        """Set the length of the buffer in the document, and return the binary chunk."""
        buffers = self.document.setdefault("buffers", [])
        if buffers:
            buffers[0]["byteLength"] = len(self.data)
        else:
            buffers.append({"byteLength": len(self.data)})
        return bytes(self.data)


MAX_SCALE_DEVIATION = 1e-3  # relative difference of scales along a bone's axes that count as equal: rounding of exporters
MIN_SCALE = 1e-9  # a smaller scale is none
MAX_COORDINATE_M = 1e6  # a bone farther from the origin than this is a sign of damage


@dataclass(frozen=True)
class GltfNodes:
    """The N nodes of a glTF document."""

    path: Path
    entries: Sequence[Mapping[str, Any]]  # N objects of the document
    names: tuple[str, ...]  # N unique names: those of the file, with a number where one is missing or used before
    parents: Int[np.ndarray, " N"]  # index of each node's parent, -1 for roots
    ordered: tuple[int, ...]  # N indices, parents before children, children in the order of the file

    def list_ancestors(self, node: int) -> list[int]:
        """Return the nodes above a node, from its parent to its root."""
        found: list[int] = []
        while (node := int(self.parents[node])) >= 0:
            found.append(node)
        return found


@dataclass(frozen=True)
class BoneTransforms:
    """The transforms of B nodes."""

    positions: Float[np.ndarray, "B 3"]  # m: in the parent's axes, the scales of all nodes above multiplied out
    rotations: Float[np.ndarray, "B 3 3"]  # (B, 3, 3): to the parent's axes
    scales: Float[np.ndarray, " B"]  # metres in a unit of length along each node's own axes


def read_gltf_nodes(path: Path, document: Mapping[str, Any]) -> GltfNodes:
    """Return the tree of the nodes. Raises ReadError if an index is out of range, or the nodes form no trees."""
    entries = document.get("nodes", [])
    parents = np.full(len(entries), -1)
    for index, entry in enumerate(entries):
        for child in read_indices(path, f"nodes[{index}].children", entry.get("children", []), len(entries)):
            if parents[child] >= 0:
                problem = f"node {child} is a child of node {parents[child]} and of node {index}"
                raise ReadError(f"{path}: {problem}; the file is damaged, so export it again.")
            parents[child] = index
    ordered = tuple(_iterate_depth_first(entries, np.flatnonzero(parents < 0).tolist()))
    if len(ordered) < len(entries):
        looped = min(set(range(len(entries))).difference(ordered))
        raise ReadError(f"{path}: node {looped} is below itself; the file is damaged, so export it again.")
    return GltfNodes(path, entries, _choose_names(entries), parents, ordered)


def read_indices(path: Path, place: str, values: object, count: int) -> list[int]:
    """Return a list of indices of the document. Raises ReadError if it is not one, or an index is not below `count`."""
    if not isinstance(values, list):
        raise ReadError(f"{path}: {place} is no list of indices; the file is damaged, so export it again.")
    return [read_index(path, place, value, count) for value in values]


def read_index(path: Path, place: str, value: object, count: int) -> int:
    """Return an index of the document. Raises ReadError if it is not an integer from 0 to below `count`."""
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < count:
        raise ReadError(f"{path}: {place} refers to entry {str(value)[:20]} of {count}; the file is damaged, so export it again.")
    return value


def _iterate_depth_first(entries: Sequence[Mapping[str, Any]], roots: list[int]) -> Iterator[int]:
    stack = roots[::-1]
    while stack:
        node = stack.pop()
        yield node
        stack.extend(reversed(entries[node].get("children", [])))


def _choose_names(entries: Sequence[Mapping[str, Any]]) -> tuple[str, ...]:
    given = [(entry.get("name"), f"node {index}") for index, entry in enumerate(entries)]
    names = (name if isinstance(name, str) and name.strip() else number for name, number in given)
    # no halves of surrogate pairs, which no file can have
    return make_names_unique(tuple(name.encode("utf-8", "replace").decode() for name in names))


def compute_bone_transforms(nodes: GltfNodes, bones: Sequence[int]) -> BoneTransforms:
    """Compute the transforms of some nodes, with which all nodes above them are given, parents before children.

    Raises:
        ReadError: If a transform is invalid, or scales by different factors along its axes, by zero, or mirrors.
    """
    transforms = [_read_local_transform(nodes, node) for node in bones]
    index = {node: bone for bone, node in enumerate(bones)}
    parents = [index.get(int(nodes.parents[node]), -1) for node in bones]
    scales, positions = np.ones(len(bones)), np.zeros((len(bones), 3))
    with np.errstate(over="ignore", invalid="ignore"):
        for bone, (translation, _, scale) in enumerate(transforms):
            above = scales[parents[bone]] if parents[bone] >= 0 else 1.0
            scales[bone], positions[bone] = above * scale, above * translation
    is_sound = (np.abs(positions) < MAX_COORDINATE_M).all(1) & (scales > MIN_SCALE) & (scales < 1 / MIN_SCALE)
    if not is_sound.all():
        bone = int(np.argmin(is_sound))
        problem = f"is {np.abs(positions[bone]).max():.3g} m from its parent at a scale of {scales[bone]:.3g}"
        raise ReadError(f"{nodes.path}: the bone {nodes.names[bones[bone]]!r} {problem}; check the scale of the export.")
    return BoneTransforms(positions, np.array([rotation for _, rotation, _ in transforms]).reshape(-1, 3, 3), scales)


def _read_local_transform(nodes: GltfNodes, node: int) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, "3 3"], float]:
    """Return translation in the file's units, rotation and uniform scale of a node."""
    entry = nodes.entries[node]
    if "matrix" in entry:
        matrix = _read_numbers(nodes, node, "matrix", np.eye(4).ravel()).reshape(4, 4).T  # stored by columns
        translation, linear = matrix[:3, 3], matrix[:3, :3]
        scales = np.linalg.norm(linear, axis=0)
        if np.linalg.det(linear / np.where(scales > 0, scales, 1.0)) < 0:
            scales = -scales
        rotation = linear / np.where(scales == 0, 1.0, scales)
        if scales.all() and np.abs(rotation.T @ rotation - np.eye(3)).max() > MAX_SCALE_DEVIATION:
            raise ReadError(f"{nodes.path}: the bone {nodes.names[node]!r} is sheared; apply its transform before the export.")
    else:
        translation = _read_numbers(nodes, node, "translation", np.zeros(3))
        quaternion = _read_numbers(nodes, node, "rotation", np.array([0.0, 0.0, 0.0, 1.0]))
        if np.linalg.norm(quaternion) < MIN_SCALE:
            problem = f"the rotation of {nodes.names[node]!r} is zero; the file is damaged, so export it again"
            raise ReadError(f"{nodes.path}: {problem}.")
        rotation = scipy.spatial.transform.Rotation.from_quat(quaternion).as_matrix()
        scales = _read_numbers(nodes, node, "scale", np.ones(3))
    if (scales <= MIN_SCALE).any() or np.ptp(scales) > MAX_SCALE_DEVIATION * scales.max():
        shown = ", ".join(f"{scale:.4g}" for scale in scales)
        problem = f"has the scale ({shown}), but bones need one positive scale for all axes"
        raise ReadError(f"{nodes.path}: the bone {nodes.names[node]!r} {problem}; apply the scale before the export.")
    return translation, scipy.spatial.transform.Rotation.from_matrix(rotation).as_matrix(), float(np.cbrt(np.prod(scales)))


def _read_numbers(nodes: GltfNodes, node: int, key: str, default: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return the numbers of a node's property, which must be as many as in its default and finite."""
    values = nodes.entries[node].get(key)
    if values is None:
        return default
    if isinstance(values, list) and len(values) == len(default) and are_numbers(values):
        return np.array(values, float)
    problem = f"the {key} of {nodes.names[node]!r} is not {len(default)} finite numbers"
    raise ReadError(f"{nodes.path}: {problem}; the file is damaged, so export it again.")


def are_numbers(values: Sequence[object]) -> bool:
    """Return whether all values are finite numbers of a usable size."""
    return all(isinstance(value, int | float) and abs(value) < 1 / MIN_SCALE for value in values)


MAX_CONSTANT_CHORD = 5e-7  # of unit quaternions, 1e-6 rad: a rotation that stays within it has one key


def add_animation(
    buffer: GltfBuffer,
    name: str,
    local_rotations: Float[np.ndarray, "T J 3 3"],
    positions: Mapping[int, Float[np.ndarray, "T 3"]],
    nodes: Mapping[int, int],
    rate: float,
    rest_values: Mapping[tuple[int, str], Sequence[float]] = MappingProxyType({}),
) -> None:
    """Add an animation to the document, with a key in every frame, or a single one of a rotation that does not change.

    It becomes the first, which Blender shows when it opens the file.

    Args:
        local_rotations: Axes of each bone to its parent's.
        positions: Node to its positions in the unit of its parent, of the nodes that get such a curve.
        nodes: Bone to node, of the bones that get a curve of rotations.
        rate: Frames per second.
        rest_values: Node and path ("translation", "rotation" or "scale") to the value of its only key.
    """
    frame_count = len(local_rotations)
    times: dict[int, int] = {}

    def add_curve(node: int, path: str, kind: str, values: Float[np.ndarray, "K N"]) -> None:
        if len(values) not in times:
            times[len(values)] = buffer.add_array(np.arange(len(values)) / rate, "SCALAR", has_bounds=True)
        channels.append({"sampler": len(samplers), "target": {"node": node, "path": path}})
        output = buffer.add_array(values, kind)
        samplers.append({"input": times[len(values)], "output": output, "interpolation": "LINEAR"})

    channels: list[dict[str, Any]] = []
    samplers: list[dict[str, Any]] = []
    for node, position in positions.items():
        add_curve(node, "translation", "VEC3", position)
    for bone, node in nodes.items():
        rotation = lie.extract_joint_quaternions(local_rotations, bone, np.ones(frame_count, bool))
        is_constant = bool((np.linalg.norm(rotation - rotation[0], axis=1) <= MAX_CONSTANT_CHORD).all())
        add_curve(node, "rotation", "VEC4", rotation[:1] if is_constant else rotation)
    for (node, path), value in rest_values.items():
        add_curve(node, path, f"VEC{len(value)}", np.array([value], float))
    buffer.document.setdefault("animations", []).insert(0, {"name": name, "channels": channels, "samplers": samplers})


def copy_first_animation(buffer: GltfBuffer, name: str, other: GlbContent, place: int) -> None:
    """Insert the first animation of another document with the same nodes, which `add_animation` wrote, at a place in the list."""
    accessors, views = other.document["accessors"], other.document["bufferViews"]
    copied: dict[int, int] = {}

    def copy_array(index: int) -> int:
        if index not in copied:
            view = views[accessors[index]["bufferView"]]
            start, size = view.get("byteOffset", 0), view["byteLength"]
            buffer.data += bytes(-len(buffer.data) % ELEMENT_ALIGNMENT)
            buffer.document["bufferViews"].append(view | {"byteOffset": len(buffer.data)})
            buffer.data += other.binary[start : start + size]
            buffer.document["accessors"].append(accessors[index] | {"bufferView": len(buffer.document["bufferViews"]) - 1})
            copied[index] = len(buffer.document["accessors"]) - 1
        return copied[index]

    animation = other.document["animations"][0]
    samplers = [each | {key: copy_array(each[key]) for key in ("input", "output")} for each in animation["samplers"]]
    buffer.document["animations"].insert(place, animation | {"name": name, "samplers": samplers})


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
BONE_COLOUR = [0.55, 0.57, 0.6, 1.0]  # linear, opaque; without a material viewers show metal, almost black
MIN_SKIN_BONE_M = 1e-6  # a shorter bone has no pyramid


def build_skinned_document(
    skeleton: Skeleton,
    shown_parents: Int[np.ndarray, " J"],
    shapes: Sequence[tuple[int, Float[np.ndarray, "C 3"]]] = (),
) -> GltfBuffer:
    """Return a document with the joints as its first nodes, in metres, and a mesh that shows them, with a skin.

    Args:
        shown_parents: From which joint a bone is shown to each, -1 for none.
        shapes: Joint, and corners of triangles that it carries, three each, in the joint's axes.
    """
    quaternions = scipy.spatial.transform.Rotation.from_matrix(skeleton.rest_rotations).as_quat()
    is_turned = (skeleton.rest_rotations != np.eye(3)).any((1, 2))
    nodes: list[dict[str, Any]] = [
        {"name": name, "translation": offset.tolist()} | ({"rotation": quaternion.tolist()} if turned else {})
        for name, offset, quaternion, turned in zip(skeleton.names, skeleton.offsets, quaternions, is_turned, strict=True)
    ]
    for joint, parent in enumerate(skeleton.parents):
        if parent >= 0:
            nodes[parent].setdefault("children", []).append(joint)
    roots = np.flatnonzero(skeleton.parents < 0).tolist()
    nodes.append({"name": "Bones", "mesh": 0, "skin": 0})
    scene_nodes = [*roots, len(nodes) - 1]
    if len(roots) > 1:  # the joints of a skin need a common ancestor
        nodes.append({"name": "Armature", "children": roots})
        scene_nodes = [len(nodes) - 1, len(nodes) - 2]
    buffer = GltfBuffer({"asset": GLTF_ASSET, "scene": 0, "scenes": [{"nodes": scene_nodes}], "nodes": nodes})
    positions, rotations = skeleton.compute_rest_pose()
    inverse = np.tile(np.eye(4), (len(positions), 1, 1))
    inverse[:, :3, :3] = rotations.swapaxes(-1, -2)
    inverse[:, :3, 3] = -np.einsum("jba,jb->ja", rotations, positions)
    matrices = buffer.add_array(inverse.swapaxes(-1, -2), "MAT4")  # stored by columns
    buffer.document["skins"] = [{"inverseBindMatrices": matrices, "joints": list(range(len(positions)))}]
    tails = np.where(skeleton.is_leaf[:, None], skeleton.compute_rest_ends(), np.nan)
    carried = [(joint, positions[joint] + corners @ rotations[joint].T) for joint, corners in shapes]
    triangles = [*_build_pyramids(shown_parents, positions, tails), *carried]
    primitive = {"attributes": _add_triangles(buffer, triangles), "material": 0}
    buffer.document["materials"] = [{"pbrMetallicRoughness": {"baseColorFactor": BONE_COLOUR, "metallicFactor": 0.0}}]
    buffer.document["meshes"] = [{"name": "Bones", "primitives": [primitive]}]
    return buffer


def _build_pyramids(
    parents: Int[np.ndarray, " J"], positions: Float[np.ndarray, "J 3"], tails: Float[np.ndarray, "J 3"]
) -> list[tuple[int, Float[np.ndarray, "C 3"]]]:
    """Return the joint at the head of every bone that has a length, and the corners of its double pyramid in the rest pose."""
    bones = [(int(parent), positions[j]) for j, parent in enumerate(parents) if parent >= 0]
    bones += [(j, tail) for j, tail in enumerate(tails) if np.isfinite(tail).all()]
    return [(j, _build_pyramid(positions[j], end)) for j, end in bones if np.linalg.norm(end - positions[j]) > MIN_SKIN_BONE_M]


def _add_triangles(buffer: GltfBuffer, shapes: Sequence[tuple[int, Float[np.ndarray, "C 3"]]]) -> dict[str, Any]:
    """Add triangles in the rest pose that move with a joint each, and return the attributes."""
    corners = np.concatenate([each for _, each in shapes])
    corner_joints = np.concatenate([np.tile([joint, 0, 0, 0], (len(each), 1)) for joint, each in shapes])
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
    positions: Mapping[int, Float[np.ndarray, "T 3"]],
    local_rotations: Float[np.ndarray, "T J 3 3"],
    rate: float,
) -> None:
    """Write a motion; arguments as of `io.bvh.write_bvh_tree`. Raises WriteError if `target` is not writable."""
    buffer, nodes_of_joints = build_skinned_document(skeleton, skeleton.parents), dict(enumerate(range(len(skeleton.names))))
    add_animation(buffer, target.stem, local_rotations, dict(positions), nodes_of_joints, rate)
    with replace_atomically(Path(target)) as part:
        part.write_bytes(build_glb(GlbContent(buffer.document, buffer.finish())))
