"""Character files like those of Mixamo and VRoid, built by pygltflib, and motions of their bones."""

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pygltflib
import yaml
from scipy.spatial.transform import Rotation

from mocapfix.characters.character import BoneMapping, Character, CharacterMotion
from mocapfix.io.gltf import GlbContent, build_glb, parse_glb
from mocapfix.model.skeleton import Skeleton
from tests.io.read_back import smooth_rotations

SIDES = (("Left", 1.0), ("Right", -1.0))
TRUNK = (
    ("Hips", "", (0, 100, 0)),
    ("Spine", "Hips", (0, 10, -1)),
    ("Spine1", "Spine", (0, 12, 0)),
    ("Spine2", "Spine1", (0, 13, 1)),
    ("Neck", "Spine2", (0, 15, 0)),
    ("Head", "Neck", (0, 10, 2)),
    ("HeadTop_End", "Head", (0, 18, 0)),
)
LIMBS = (
    ("Shoulder", "Spine2", (6, 9, 0)),
    ("Arm", "Shoulder", (12, 0, -1)),
    ("ForeArm", "Arm", (28, 0, 0)),
    ("Hand", "ForeArm", (27, 0, 1)),
    ("HandIndex1", "Hand", (9, 0, 2)),
    ("UpLeg", "Hips", (9, -6, 0)),
    ("Leg", "UpLeg", (0, -44, 1)),
    ("Foot", "Leg", (0, -42, -2)),
    ("ToeBase", "Foot", (0, -8, 13)),
    ("Toe_End", "ToeBase", (0, 0, 7)),
)
"""bones of a figure of 1.7 m in a T-pose that faces +Z: name, parent, and offset in the world in centimetres"""
PREFIX = "mixamorig:"
ARMATURE_ROTATION = Rotation.from_euler("x", -90, degrees=True)
ARMATURE_SCALE = 0.01
SEGMENTS = {
    "pelvis": ("Hips",), "spine": ("Spine", "Spine1", "Spine2"), "neck": ("Neck",), "head": ("Head",),
    **{f"{side.lower()}_{segment}": (f"{side}{bone}",) for side, _ in SIDES for segment, bone in (
        ("clavicle", "Shoulder"), ("upper_arm", "Arm"), ("forearm", "ForeArm"), ("hand", "Hand"),
        ("thigh", "UpLeg"), ("shin", "Leg"), ("foot", "Foot"), ("toe", "ToeBase"),
    )},
}  # fmt: skip
VRM_BONES = {
    "hips": "Hips", "spine": "Spine", "chest": "Spine1", "upperChest": "Spine2", "neck": "Neck", "head": "Head",
    **{f"{side.lower()}{vrm}": f"{side}{bone}" for side, _ in SIDES for vrm, bone in (
        ("Shoulder", "Shoulder"), ("UpperArm", "Arm"), ("LowerArm", "ForeArm"), ("Hand", "Hand"),
        ("UpperLeg", "UpLeg"), ("LowerLeg", "Leg"), ("Foot", "Foot"), ("Toes", "ToeBase"),
    )},
}  # fmt: skip
IMAGE = b"\x89PNG\r\n\x1a\n" + bytes(range(61))


@dataclass(frozen=True)
class Figure:
    """The bones of the figure in the rest pose: J names, parents (J,), heads (J, 3) m and axes (J, 3, 3) in the world."""

    names: tuple[str, ...]
    parents: np.ndarray
    heads: np.ndarray
    axes: np.ndarray


def build_figure() -> Figure:
    """Return the figure. Each bone's Y points to its first child, about which it is turned by some angle."""
    bones = list(TRUNK)
    for side, sign in SIDES:
        names = {name for name, _, _ in LIMBS}
        bones += [
            (f"{side}{name}", f"{side}{parent}" if parent in names else parent, (sign * x, y, z))
            for name, parent, (x, y, z) in LIMBS
        ]
    names = tuple(name for name, _, _ in bones)
    parents = np.array([names.index(parent) if parent else -1 for _, parent, _ in bones])
    heads = np.array([offset for _, _, offset in bones], float) / 100
    for bone, parent in enumerate(parents):
        heads[bone] += heads[parent] if parent >= 0 else 0
    axes = np.tile(np.eye(3), (len(names), 1, 1))
    for bone in range(len(names)):
        child = next((c for c in range(len(names)) if parents[c] == bone), None)
        direction = heads[child] - heads[bone] if child is not None else axes[parents[bone]][:, 1]
        swing = Rotation.align_vectors(direction[None], np.array([[0.0, 1.0, 0.0]]))[0]
        axes[bone] = (swing * Rotation.from_euler("y", 20 * bone, degrees=True)).as_matrix()
    return Figure(names, parents, heads, axes)


FIGURE = build_figure()


def build_mixamo_glb() -> bytes:
    """Return a GLB as Mixamo's characters come out of Blender: an armature node that scales by 0.01 and turns by -90 degrees.

    The nodes are listed with children before parents. Besides the skinned mesh there are an image, an animation, an
    unknown extension and extras.
    """
    count = len(FIGURE.names)
    nodes = [pygltflib.Node() for _ in range(count + 2)]
    for bone, name in enumerate(FIGURE.names):
        above = FIGURE.axes[FIGURE.parents[bone]] if FIGURE.parents[bone] >= 0 else ARMATURE_ROTATION.as_matrix()
        start = FIGURE.heads[FIGURE.parents[bone]] if FIGURE.parents[bone] >= 0 else np.zeros(3)
        nodes[node_of(bone)] = pygltflib.Node(
            name=f"{PREFIX}{name}",
            translation=(above.T @ (FIGURE.heads[bone] - start) / ARMATURE_SCALE).tolist(),
            rotation=Rotation.from_matrix(above.T @ FIGURE.axes[bone]).as_quat().tolist(),
            children=[node_of(int(child)) for child in np.flatnonzero(FIGURE.parents == bone)],
        )
    nodes[count] = pygltflib.Node(
        name="Armature",
        rotation=ARMATURE_ROTATION.as_quat().tolist(),
        scale=[ARMATURE_SCALE] * 3,
        children=[node_of(0), count + 1],
    )
    nodes[count + 1] = pygltflib.Node(name="Body", mesh=0, skin=0)
    data = bytearray()
    file = pygltflib.GLTF2(
        asset=pygltflib.Asset(generator="a test"),
        scene=0,
        scenes=[pygltflib.Scene(nodes=[count])],
        nodes=nodes,
        extensionsUsed=["EXT_unknown"],
        extensions={"EXT_unknown": {"anything": [1, 2.5, "\u9aa8"]}},
        extras={"author": "a name"},
    )

    def add(values: np.ndarray, kind: str, component: int, **bounds: Any) -> int:
        file.bufferViews.append(pygltflib.BufferView(buffer=0, byteOffset=len(data), byteLength=values.nbytes))
        data.extend(values.tobytes() + bytes(-values.nbytes % 4))
        view = len(file.bufferViews) - 1
        file.accessors.append(
            pygltflib.Accessor(bufferView=view, componentType=component, count=len(values), type=kind, **bounds)
        )
        return len(file.accessors) - 1

    corners = np.concatenate([head + 0.03 * np.eye(3) for head in FIGURE.heads]).astype("<f4")
    joints = np.repeat([[bone, 0, 0, 0] for bone in range(count)], 3, axis=0).astype("<u2")
    worlds = np.tile(np.eye(4), (count, 1, 1))
    worlds[:, :3, :3], worlds[:, :3, 3] = FIGURE.axes * ARMATURE_SCALE, FIGURE.heads
    inverse = np.linalg.inv(worlds)
    inverse[:, 3] = [0, 0, 0, 1]
    attributes = pygltflib.Attributes(
        POSITION=add(corners, "VEC3", 5126, min=corners.min(0).tolist(), max=corners.max(0).tolist()),
        JOINTS_0=add(joints, "VEC4", 5123),
        WEIGHTS_0=add(np.tile([1, 0, 0, 0], (len(corners), 1)).astype("<f4"), "VEC4", 5126),
    )
    file.meshes = [pygltflib.Mesh(name="Body", primitives=[pygltflib.Primitive(attributes=attributes)])]
    matrices = add(inverse.swapaxes(1, 2).astype("<f4"), "MAT4", 5126)
    file.skins = [pygltflib.Skin(joints=[node_of(bone) for bone in range(count)], inverseBindMatrices=matrices)]
    times, values = np.array([0, 1], "<f4"), np.array([[0, 0, 0, 1], [0, 1, 0, 0]], "<f4")
    sampler = pygltflib.AnimationSampler(input=add(times, "SCALAR", 5126, min=[0.0], max=[1.0]), output=add(values, "VEC4", 5126))
    target = pygltflib.AnimationChannelTarget(node=node_of(1), path="rotation")
    channel = pygltflib.AnimationChannel(sampler=0, target=target)
    file.animations = [pygltflib.Animation(name="walk", samplers=[sampler], channels=[channel])]
    file.bufferViews.append(pygltflib.BufferView(buffer=0, byteOffset=len(data), byteLength=len(IMAGE)))
    data.extend(IMAGE)
    file.buffers = [pygltflib.Buffer(byteLength=len(data))]
    file.set_binary_blob(bytes(data))
    return b"".join(file.save_to_bytes())


def node_of(bone: int) -> int:
    """Return the node of a bone: the last bone comes first."""
    return len(FIGURE.names) - 1 - bone


def edit_glb(data: bytes, edit: Callable[[dict[str, Any]], object]) -> bytes:
    """Return a GLB with its document changed in place by `edit`."""
    content = parse_glb(Path("edited.glb"), data)
    edit(content.document)
    return build_glb(content)


def build_vrm(version: int) -> bytes:
    """Return the GLB as a VRM of version 0 or 1, with other names of bones."""

    def edit(document: dict[str, Any]) -> None:
        for index, node in enumerate(document["nodes"]):
            node["name"] = f"J_{index}"
        document["extensionsUsed"].append("VRMC_vrm" if version == 1 else "VRM")
        bones = {vrm: node_of(FIGURE.names.index(bone)) for vrm, bone in VRM_BONES.items()}
        if version == 1:
            human = {name: {"node": node} for name, node in bones.items()}
            document["extensions"]["VRMC_vrm"] = {"specVersion": "1.0", "humanoid": {"humanBones": human}}
        else:
            human = [{"bone": name, "node": node, "useDefaultValues": True} for name, node in bones.items()]
            human.append({"bone": "jaw", "node": -1})
            document["extensions"]["VRM"] = {"specVersion": "0.0", "humanoid": {"humanBones": human}}

    return edit_glb(build_mixamo_glb(), edit)


def map_figure(names: Sequence[str], prefix: str = PREFIX) -> BoneMapping:
    """Return the segments of the figure's bones."""
    return BoneMapping({segment: tuple(names.index(f"{prefix}{bone}") for bone in bones) for segment, bones in SEGMENTS.items()})


def build_figure_character(scale: float = 0.01) -> Character:
    """Return the figure as a character without a file, in a unit of `scale` metres."""
    is_root = FIGURE.parents < 0
    above = np.where(is_root[:, None, None], np.eye(3), FIGURE.axes[FIGURE.parents])
    starts = np.where(is_root[:, None], 0.0, FIGURE.heads[FIGURE.parents])
    tails = np.full((len(FIGURE.names), 3), np.nan)
    tails[FIGURE.names.index("HeadTop_End")] = [0, 0.05, 0]
    return Character(
        name="figure",
        skeleton=Skeleton(
            names=FIGURE.names,
            parents=FIGURE.parents,
            offsets=np.einsum("jba,jb->ja", above, FIGURE.heads - starts),
            ends=tails,
            rest_rotations=above.swapaxes(1, 2) @ FIGURE.axes,
        ),
        mapping=map_figure(FIGURE.names, ""),
        scales=np.full(len(FIGURE.names), scale),
        root_scale=scale,
    )


def change_bones(character: Character, **fields: Any) -> Character:
    """Return a character with other fields of its skeleton."""
    return replace(character, skeleton=replace(character.skeleton, **fields))


def build_motion(character: Character, frame_count: int = 40, rate: float = 60.0, seed: int = 0) -> CharacterMotion:
    """Return a motion that turns the mapped bones by up to a radian and moves the pelvis by some decimetres."""
    turned = smooth_rotations(seed, frame_count, len(character.skeleton.names), swing=1.0)
    mapped = {bone for chain in character.mapping.bones.values() for bone in chain}
    rest = np.tile(character.skeleton.rest_rotations, (frame_count, 1, 1, 1))
    is_mapped = np.isin(np.arange(len(character.skeleton.names)), list(mapped))
    local_rotations = np.where(is_mapped[:, None, None], rest @ turned, rest)
    pelvis = character.mapping.bones["pelvis"][0]
    time = np.linspace(0, 1, frame_count)[:, None]
    position = character.skeleton.offsets[pelvis] + 0.2 * np.sin(2 * np.pi * time * [1, 2, 1] + [0, 1, 2])
    return CharacterMotion(position, np.ascontiguousarray(local_rotations), rate)


def read_accessor(document: dict[str, Any], binary: bytes, index: int) -> np.ndarray:
    """Return the rows of an accessor of floats."""
    accessor = document["accessors"][index]
    view, width = (
        document["bufferViews"][accessor["bufferView"]],
        {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}[accessor["type"]],
    )
    start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    return np.frombuffer(binary, "<f4", accessor["count"] * width, start).reshape(-1, width).astype(float)


def split_glb(data: bytes) -> tuple[bytes, bytes]:
    """Return the two chunks of a GLB, with a reader that is independent of the package."""
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON"
    text, start = data[20 : 20 + size], 28 + size
    binary_size, binary_kind = struct.unpack_from("<I4s", data, 20 + size)
    assert binary_kind == b"BIN\0"
    assert start + binary_size == len(data)
    return text, data[start:]


def rebuild(content: GlbContent, **changes: Any) -> bytes:
    """Return a GLB with some keys of its document replaced."""
    return build_glb(GlbContent(content.document | changes, content.binary, content.other_chunks))


def write_character_yaml(target: Path, character: Character) -> None:
    """Write a character as YAML that `read_character_yaml` reads, with the axes of the bones as quaternions."""
    heads, rotations = character.skeleton.compute_rest_pose()
    tails = heads + np.einsum("jab,jb->ja", rotations, character.skeleton.ends)
    names, parents = character.skeleton.names, character.skeleton.parents.tolist()
    bones: list[dict[str, Any]] = []
    for bone, name in enumerate(names):
        entry: dict[str, Any] = {"name": name, "parent": names[parents[bone]] if parents[bone] >= 0 else None}
        entry |= {"head": heads[bone].tolist(), "rotation": format_quaternion(rotations[bone])}
        if not np.isnan(tails[bone]).any():
            entry["tail"] = tails[bone].tolist()
        elif bone in parents:
            entry["tail"] = entry["head"]  # none, although it has a child
        bones.append(entry | {"scale_m": float(character.scales[bone])})
    segments, twists = (
        {segment: [names[bone] for bone in chain] for segment, chain in group.items()}
        for group in (character.mapping.bones, character.mapping.twists)
    )
    limits_deg = np.rad2deg(character.skeleton.limits_rad)
    limits = {
        names[bone]: dict(zip("xyz", limits_deg[bone].tolist(), strict=True))
        for bone in np.flatnonzero(np.isfinite(limits_deg).all((1, 2)))
    }
    data = {"kind": "character", "name": character.name, "unit_m": float(character.root_scale), "bones": bones}
    data |= {"file_rotation": format_quaternion(character.rotation_y_up_file), "feet_flat": bool(character.has_feet_flat)}
    data |= {"segments": segments, "twists": twists, "limits": limits}
    target.write_text(yaml.safe_dump(data, allow_unicode=True), encoding="utf-8")


def format_quaternion(rotation: np.ndarray) -> list[float]:
    return Rotation.from_matrix(rotation).as_quat(scalar_first=True).tolist()
