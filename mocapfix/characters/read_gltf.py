"""Read the bones of a character from glTF 2.0 (.glb, .gltf) and VRM (.vrm).

The bones are the joints of the skins with all nodes above them, such as the armature, which often scales and turns the rest.
The bones are in the pose of the nodes, which is what a viewer shows without an animation, but not always the rest pose: see
`rest_poses`.

Embedded and side files are packed into one GLB, to which an animation can be added; the bytes of buffers and images are kept. A
VRM names its humanoid bones (VRM Consortium, VRM 0.0, extension VRM, and VRM 1.0, extension VRMC_vrm, section humanoid).

The bind pose follows from the skins (Khronos, glTF 2.0, section 3.7.3). A vertex v is shown at the weighted mean of W B v over
its joints, with the transform W of each joint's node and its inverse bind matrix B. In the bind pose W B is the same G for all
joints, so the mesh has its original shape. Exporters differ in whether G is the identity or the transform of the mesh's node; the
scales of the nodes show which.
"""

import base64
import binascii
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import unquote, urlsplit

import numpy as np
from jaxtyping import Float

from mocapfix.characters.bone_mapping import find_side_twists
from mocapfix.characters.character import (
    SIDES,
    TWISTING_SEGMENTS,
    BoneMapping,
    Character,
    CharacterSource,
    build_bone_mapping,
    compute_tail,
    get_next_segment,
)
from mocapfix.errors import ReadError, SceneError
from mocapfix.io import gltf
from mocapfix.io.gltf_mesh import UNREADABLE, compute_node_matrices, extract_rotations, move_nodes, read_array
from mocapfix.model.skeleton import Skeleton, decompose_transforms

ALIGNMENT_BYTES = 16  # of a buffer that is appended to another: enough for every component and for compressed data
EXTENDED_LISTS = ("accessors", "bufferViews", "buffers", "animations", "nodes", "meshes", "skins", "scenes")
"""lists of the document in which every entry must be an object"""
COMPRESSION_EXTENSIONS = ("EXT_meshopt_compression", "KHR_meshopt_compression")
"""extensions of a bufferView that refer to a buffer of their own"""
IMAGE_TYPES = {b"\x89PNG": "image/png", b"\xff\xd8\xff": "image/jpeg", b"\xabKTX": "image/ktx2", b"RIFF": "image/webp"}
"""beginning of an image to its type"""


def read_packed_gltf(path: Path, data: bytes) -> tuple[gltf.GlbContent, bytes]:
    """Return a glTF, binary or text, as one GLB whose binary chunk holds its buffers: its content and its bytes.

    Buffers in data URIs and side files, and images in side files, are appended to the binary chunk. An image that is missing is
    left as it is: a viewer shows the mesh without it.

    Raises:
        ReadError: If the container, the document or a buffer is damaged or missing. The message names the file.
    """
    content = gltf.parse_glb(path, data) if gltf.is_glb(data) else gltf.GlbContent(gltf.parse_gltf_document(path, data), b"")
    _check_document(path, content.document)
    buffers = content.document.get("buffers", [])
    if content.binary and buffers and "uri" not in buffers[0]:
        if buffers[0]["byteLength"] > len(content.binary):
            sizes = f"{buffers[0]['byteLength']} bytes, its binary chunk {len(content.binary)}"
            raise ReadError(f"{path}: its first buffer has {sizes}; the file was cut off, so export it again.")
        if not any("uri" in each for each in buffers) and not _list_side_images(content.document):
            return content, data
    content = _pack(path, content)
    return content, gltf.build_glb(content)


def _check_document(path: Path, document: dict[str, Any]) -> None:
    """Raise ReadError unless the version is 2 and the lists that are read or extended have objects in them."""
    asset = document.get("asset")
    version = asset.get("version") if isinstance(asset, dict) else None
    if not isinstance(version, str) or not version.startswith("2."):
        raise ReadError(f"{path}: is glTF version {str(version)[:9]}, and only version 2 is read; export it as glTF 2.0.")
    for name in EXTENDED_LISTS:
        entries = document.get(name, [])
        if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
            raise ReadError(f"{path}: {name} is no list of objects; the file is damaged, so export it again.")
    for index, buffer in enumerate(document.get("buffers", [])):
        length = buffer.get("byteLength")
        if not isinstance(length, int) or isinstance(length, bool) or not 1 <= length <= gltf.MAX_GLB_BYTES:
            raise ReadError(f"{path}: buffers[{index}] has no valid byteLength; the file is damaged, so export it again.")


def _pack(path: Path, content: gltf.GlbContent) -> gltf.GlbContent:
    """Append all buffers to the binary chunk. Those without data (fallbacks of compressed ones) stay entries of their own."""
    document, packed = content.document, bytearray()
    places: dict[int, tuple[int, int]] = {}  # index of an old buffer: index of its new one, and its first byte there
    kept: list[dict[str, Any]] = []
    for index, buffer in enumerate(document.get("buffers", [])):
        data = _load_buffer(path, index, buffer, content.binary)
        if data is None:
            kept.append(buffer)
            places[index] = (len(kept), 0)
        else:
            places[index] = (0, _append(packed, data))
    for view in document.get("bufferViews", []):
        extensions = view.get("extensions")
        compressions = [extensions.get(name) for name in COMPRESSION_EXTENSIONS] if isinstance(extensions, dict) else []
        for entry in (view, *(each for each in compressions if isinstance(each, dict))):
            _move_view(path, entry, places)
    for image, data, kind in _load_side_images(path, document):
        start = _append(packed, data)
        document.setdefault("bufferViews", []).append({"buffer": 0, "byteOffset": start, "byteLength": len(data)})
        del image["uri"]
        image |= {"bufferView": len(document["bufferViews"]) - 1, "mimeType": kind}
    if packed:
        document["buffers"] = [{"byteLength": len(packed)}, *kept]
    return gltf.GlbContent(document, bytes(packed), content.other_chunks)


def _append(packed: bytearray, data: bytes) -> int:
    """Append data at an aligned byte, and return that."""
    packed.extend(bytes(-len(packed) % ALIGNMENT_BYTES))
    start = len(packed)
    packed.extend(data)
    return start


def _move_view(path: Path, view: dict[str, Any], places: dict[int, tuple[int, int]]) -> None:
    """Let a view refer to the place that its buffer has now."""
    index, start = view.get("buffer"), view.get("byteOffset", 0)
    if not isinstance(index, int) or index not in places or not isinstance(start, int):
        raise ReadError(f"{path}: a bufferView refers to buffer {str(index)[:9]}, which is not there; export the file again.")
    view["buffer"] = places[index][0]
    if places[index][1] + start or "byteOffset" in view:
        view["byteOffset"] = places[index][1] + start


def _load_buffer(path: Path, index: int, buffer: dict[str, Any], binary: bytes) -> bytes | None:
    """Return the bytes of a buffer, None if it has none of its own."""
    uri, length = buffer.get("uri"), buffer["byteLength"]
    if uri is None:
        if index > 0 or not binary:
            if isinstance(buffer.get("extensions"), dict):
                return None
            raise ReadError(f"{path}: buffers[{index}] has no data; export the file again, best as .glb.")
        data = binary
    else:
        data = _load_uri(path, f"buffers[{index}]", uri)
    if len(data) < length:
        raise ReadError(f"{path}: buffers[{index}] has {len(data)} of {length} bytes; copy or export its file again.")
    return data[:length]


def _load_uri(path: Path, place: str, uri: object) -> bytes:
    """Return the bytes of a data URI or of a file in the folder of the glTF."""
    if not isinstance(uri, str):
        raise ReadError(f"{path}: the uri of {place} is no text; the file is damaged, so export it again.")
    if uri.startswith("data:"):
        try:
            return base64.b64decode(uri.partition(",")[2], validate=True)
        except (binascii.Error, ValueError) as error:
            raise ReadError(f"{path}: the data of {place} is not valid base64; export the file again.") from error
    side_path = _find_side_file(path, uri)
    if side_path is None:
        problem = "is no file in the folder of the glTF"
        raise ReadError(f"{path}: {uri[:60]!r} of {place} {problem}; put it beside the glTF, or export it as .glb.")
    try:
        return side_path.read_bytes()
    except (OSError, ValueError) as error:
        problem = "cannot be read" if side_path.exists() else "is missing"
        raise ReadError(f"{path}: its file {uri[:60]!r} {problem}; put it beside the glTF, or export it as .glb.") from error


def _find_side_file(path: Path, uri: str) -> Path | None:
    """Return the path of a relative URI within the folder of the glTF, None for all others."""
    try:
        parts = urlsplit(uri)
        side_path = (path.parent / unquote(parts.path)).resolve()
        side_path.exists()
    except (OSError, ValueError):
        return None
    is_inside = not parts.scheme and not parts.netloc and side_path.is_relative_to(path.parent.resolve())
    return side_path if is_inside else None


def _list_side_images(document: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the images that are in files of their own."""
    images = document.get("images", [])
    images = [image for image in images if isinstance(image, dict)] if isinstance(images, list) else []
    return [image for image in images if isinstance(image.get("uri"), str) and not image["uri"].startswith("data:")]


def _load_side_images(path: Path, document: dict[str, Any]) -> list[tuple[dict[str, Any], bytes, str]]:
    """Return the images in files of their own that can be embedded, with their bytes and types."""
    found: list[tuple[dict[str, Any], bytes, str]] = []
    for image in _list_side_images(document):
        side_path = _find_side_file(path, image["uri"])
        try:
            data = side_path.read_bytes() if side_path else b""
        except OSError:
            data = b""
        kind = next((kind for beginning, kind in IMAGE_TYPES.items() if data.startswith(beginning)), None)
        if kind:
            found.append((image, data, kind))
    return found


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
SEGMENTS_BELOW = {"spine": ("spine", "neck", "head"), "neck": ("neck", "head")} | {
    segment: (get_next_segment(segment),) for segment in TWISTING_SEGMENTS
}
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
            found[name] = gltf.read_index(path, f"the humanoid bone {name}", node, node_count)
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


def build_vrm_mapping(nodes: gltf.GltfNodes, bones: list[int], vrm_bones: Mapping[str, int]) -> BoneMapping:
    """Build the mapping of the humanoid bones of a VRM.

    A bone between two humanoid bones of one limb belongs to the segment of the upper one, and takes a share of its rotation.
    Between spine and head the bones above the arms belong to the neck.

    Args:
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
                    for bone in between:  # a bone of the spine above all that carries an arm is one of the neck
                        is_neck = segment_of[above] == "spine" and arm_carriers and bone not in arm_carriers
                        segments.setdefault("neck" if is_neck else segment_of[above], []).append(bone)
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


MIN_BODY_NODES = 12  # of a file without skin: fewer nodes form no body
MAX_BONES = 5_000
GLTF_SCALE_M = 1.0  # length of a unit of glTF in metres


def is_gltf(head: bytes) -> bool:
    """Return whether a file with this beginning is a glTF, binary or text."""
    return gltf.is_glb(head) or head.removeprefix(b"\xef\xbb\xbf").lstrip().startswith(b"{")


def read_gltf_skeletons(path: Path, data: bytes) -> list[Character]:
    """Read the skeletons of a glTF, the one with the most joints first, each with all skins that share its joints.

    Only a VRM gives a mapping, and only one skeleton, which includes its humanoid bones; the mapping of others is empty.

    Args:
        path: The file, which may refer to files beside it.

    Raises:
        ReadError: If the file is damaged, has no skeleton, or bones have a scale that bones cannot have. The message names the
            file and the bone.
    """
    content, packed_data = read_packed_gltf(path, data)
    nodes = gltf.read_gltf_nodes(path, content.document)
    vrm_bones = read_vrm_bones(path, content.document, len(nodes.entries))
    skins = [
        gltf.read_indices(path, f"skins[{index}].joints", skin.get("joints"), len(nodes.entries))
        for index, skin in enumerate(content.document.get("skins", []))
    ]
    skeletons = _group_joints(nodes, skins) or [_find_body_nodes(nodes)]
    if vrm_bones:
        humanoid = set(vrm_bones.values())
        skeletons = [max(skeletons, key=lambda joints: len(humanoid & joints)) | humanoid]
    characters = [_build_character(nodes, joints, packed_data, vrm_bones) for joints in skeletons]
    if not vrm_bones:
        return characters
    springs = list_spring_nodes(content.document)
    return [_add_vrm_twists(character, springs) for character in characters]


def _group_joints(nodes: gltf.GltfNodes, skins: Sequence[Sequence[int]]) -> list[set[int]]:
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


def _find_body_nodes(nodes: gltf.GltfNodes) -> set[int]:
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


def _build_character(nodes: gltf.GltfNodes, joints: set[int], data: bytes, vrm_bones: Mapping[str, int]) -> Character:
    """Return the character of some joints and of the nodes above them."""
    members = joints.union(*(nodes.list_ancestors(joint) for joint in joints))
    bones = [node for node in nodes.ordered if node in members]
    if len(bones) > MAX_BONES:
        raise ReadError(f"{nodes.path}: has {len(bones)} bones, and at most {MAX_BONES} are read; export only the deform bones.")
    transforms = gltf.compute_bone_transforms(nodes, bones)
    place = {node: bone for bone, node in enumerate(bones)}
    return Character(
        name=nodes.path.stem,
        skeleton=Skeleton(
            names=tuple(nodes.names[node] for node in bones),
            parents=np.array([place.get(int(nodes.parents[node]), -1) for node in bones]),
            offsets=transforms.positions,
            ends=_find_tails(nodes, bones, transforms.scales),
            rest_rotations=transforms.rotations,
        ),
        mapping=build_vrm_mapping(nodes, bones, vrm_bones) if vrm_bones else BoneMapping({}),
        scales=transforms.scales,
        root_scale=GLTF_SCALE_M,
        source=CharacterSource(str(nodes.path), data, np.array(bones), "gltf"),
    )


def _add_vrm_twists(character: Character, spring_nodes: set[int]) -> Character:
    """Return the character with the twist bones beside its limbs, which a VRM does not name. Springs are none."""
    positions, _ = character.skeleton.compute_rest_pose()
    mapping, nodes = character.mapping, [] if character.source is None else character.source.nodes.tolist()
    found = find_side_twists(character.skeleton.names, character.skeleton.parents, positions, mapping.bones)
    twists = {segment: tuple(bone for bone in chain if nodes[bone] not in spring_nodes) for segment, chain in found.items()}
    return replace(character, mapping=replace(mapping, twists={segment: chain for segment, chain in twists.items() if chain}))


def _find_tails(nodes: gltf.GltfNodes, bones: Sequence[int], scales: Float[np.ndarray, " B"]) -> Float[np.ndarray, "B 3"]:
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
    is_valid = isinstance(offset, list) and len(offset) == 3 and gltf.are_numbers(offset)
    return np.array(offset if is_valid else [0.0, 0.0, 0.0], float)


MAX_BIND_SCALE_ERROR = 0.02  # relative difference of the scale of a bone in the bind pose from that of its node


class BonePoses(NamedTuple):
    """T poses of J bones, as the offsets and rest rotations of a skeleton."""

    offsets: Float[np.ndarray, "T J 3"]  # m
    rotations: Float[np.ndarray, "T J 3 3"]


def open_gltf(character: Character) -> tuple[gltf.GlbContent, gltf.GltfNodes, dict[int, int]] | None:
    """Return the glTF of a character, not to be changed, and its bones by node; None for a character of another kind."""
    source = character.source
    if source is None or source.kind != "gltf":
        return None
    return *parse_character_gltf(source.path, source.data), {node: bone for bone, node in enumerate(source.nodes.tolist())}


@lru_cache(maxsize=1)
def parse_character_gltf(path: str, data: bytes) -> tuple[gltf.GlbContent, gltf.GltfNodes]:
    """Return the content and the nodes of a file, not to be changed."""
    content = gltf.parse_glb(Path(path), data)
    return content, gltf.read_gltf_nodes(Path(path), content.document)


def _convert_to_poses(character: Character, matrices: Float[np.ndarray, "T J 4 4"]) -> BonePoses:
    """Return poses from the transforms of the bones to the world."""
    rotations = extract_rotations(matrices)
    return BonePoses(*decompose_transforms(matrices[..., :3, 3], rotations, character.skeleton.parents))


def read_bind_pose(character: Character) -> BonePoses | None:
    """Return the pose in which the mesh was bound to the bones; None if the file is no glTF or does not have it.

    Bones that are no joints of a skin keep their transform relative to the bone above.
    """
    if (file := open_gltf(character)) is None:
        return None
    content, nodes, bone_of = file
    shown, bound = compute_node_matrices(content, nodes)[0], dict[int, Float[np.ndarray, "4 4"]]()
    for skin in range(len(content.document.get("skins", []))):
        bound = _bind_joints(content, nodes, shown, skin) | bound
    if bound.keys().isdisjoint(bone_of):
        return None
    return _convert_to_poses(character, move_nodes(nodes, shown, bound)[None, list(bone_of)])


def _bind_joints(
    content: gltf.GlbContent, nodes: gltf.GltfNodes, shown: Float[np.ndarray, "N 4 4"], skin: int
) -> dict[int, Float[np.ndarray, "4 4"]]:
    """Return the transforms of the joints of a skin to the world in the bind pose, nothing if these are not known."""
    meshes = [node for node, entry in enumerate(nodes.entries) if "mesh" in entry and entry.get("skin") == skin]
    joints: list[int] = content.document["skins"][skin]["joints"]
    try:
        stored = read_array(content, content.document["skins"][skin]["inverseBindMatrices"]).astype(float)
        inverse = stored.reshape(len(joints), 4, 4).swapaxes(1, 2)  # stored by columns
        bind, wanted = np.linalg.inv(inverse), np.cbrt(np.linalg.det(shown[joints][:, :3, :3]))
    except UNREADABLE:
        return {}
    # the last choice: as if the first joint were in the bind pose
    for choice in (np.eye(4), *shown[meshes[:1]], shown[joints[0]] @ inverse[0]):
        matrices = choice @ bind
        with np.errstate(all="ignore"):
            scales = np.cbrt(np.linalg.det(matrices[:, :3, :3])) / wanted
        if np.isfinite(matrices).all() and (np.abs(scales - 1.0) < MAX_BIND_SCALE_ERROR).all():
            return dict(zip(joints, matrices, strict=True))
    return {}


def iterate_animations(character: Character) -> Iterator[BonePoses]:
    """Yield the poses of each animation of a glTF that moves its bones, one for every time that has a key."""
    if (file := open_gltf(character)) is None:
        return
    content, nodes, bone_of = file
    for animation in content.document.get("animations", []):
        try:
            times_s = _list_key_times(content, animation, bone_of)
            matrices = compute_node_matrices(content, nodes, animation, times_s)[:, list(bone_of)]
        except UNREADABLE:
            continue
        is_sound = np.isfinite(matrices).all((1, 2, 3)) & (np.linalg.det(matrices[..., :3, :3]) > 0).all(1)
        if is_sound.all() and len(times_s):
            yield _convert_to_poses(character, matrices)


def _list_key_times(content: gltf.GlbContent, animation: dict[str, Any], bone_of: dict[int, int]) -> Sequence[float]:
    """Return the times in seconds at which a bone has a key. Raises one of UNREADABLE."""
    samplers = [each["sampler"] for each in animation["channels"] if each["target"].get("node") in bone_of]
    inputs = {animation["samplers"][sampler]["input"] for sampler in samplers}
    times = [read_array(content, each)[:, 0] for each in sorted(inputs)]
    return np.unique(np.concatenate([np.zeros(0), *times])).tolist()
