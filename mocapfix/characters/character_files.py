"""Write the motion of a character beside the other outputs: GLB, BVH, NPZ, its mapping of bones as YAML, and on request others.

The GLB is the user's own file, or has a test skin for a character without mesh. In the user's file, mesh, skin, materials,
existing animations and everything unknown stay as they are: the animation is appended to the document, and its arrays to the
binary chunk behind the old bytes. Other formats of the whole character are written from the GLB.

The BVH has the character's own bones. BVH has no rest rotations. They are folded into the offsets: with all angles zero the bones
are in the rest pose of the character, and their axes are those of the world. Y is up. The unit is that in which the character's
file gives the position of the pelvis, or centimetres if that is none of metres, centimetres, millimetres and inches.
"""

import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from mocapfix.characters.body_frames import build_body_frame, list_fingers, measure_hand_poses
from mocapfix.characters.character import (
    FINGERS,
    SIDES,
    Character,
    CharacterMotion,
    build_cmu31_character,
    compute_character_poses,
    convert_motion,
)
from mocapfix.characters.character_yaml import write_mapping_file
from mocapfix.characters.clips import carry_path, close_loop, list_source_joints, name_whole_stride, prepare_root_bone
from mocapfix.characters.fbx import write_fbx
from mocapfix.characters.fingers import HandPoses, fit_finger, has_named_fingers
from mocapfix.characters.kept_positions import resample_foot_contacts
from mocapfix.characters.load_character import load_character
from mocapfix.characters.retarget_motion import retarget_motion
from mocapfix.contacts.contacts import BodyContacts, build_no_contacts
from mocapfix.errors import ReadError, SceneError, WriteError, format_name_list
from mocapfix.hands.hand_model import JOINTS_PER_RAY
from mocapfix.hands.solve_hands import BodyWithHands, HandMotion
from mocapfix.io import gltf
from mocapfix.io.bvh import CENTIMETRE_M, write_bvh_tree
from mocapfix.io.files import make_scratch_folder, replace_atomically
from mocapfix.io.gltf_mesh import NODE_PROPERTIES
from mocapfix.io.npz import write_character_npz
from mocapfix.io.usd import write_usd
from mocapfix.model.animation import Animation
from mocapfix.model.motion import Motion, resample_motion
from mocapfix.model.skeleton import Skeleton, decompose_transforms, make_names_unique
from mocapfix.options import ROOT_BONE, OutputOptions

MIN_MOVED_ELEMENT = 1e-6
"""difference of an element of a rotation matrix from the rest pose, from which a bone without segment gets a curve"""


MIN_MOVED_OFFSET_M = 1e-5
"""distance of a bone in the rest pose from its place in the file, relative to its parent, from which it gets positions"""


def list_moving_bones(character: Character, motion: CharacterMotion) -> list[int]:
    """Return the bones of all segments, their twist bones, and others that the motion turns from their rest rotation."""
    mapped = {bone for group in (character.mapping.bones, character.mapping.twists) for chain in group.values() for bone in chain}
    difference = np.abs(motion.local_rotations - character.skeleton.rest_rotations).max(axis=(0, 2, 3), initial=0.0)
    return sorted(mapped.union(np.flatnonzero(difference > MIN_MOVED_ELEMENT).tolist()))


def write_character_glb(target: Path, character: Character, motion: CharacterMotion, take_name: str) -> None:
    """Write the motion of a character as a GLB.

    The animation has the rotations of the bones of all segments and of others that move, and the positions of the pelvis and of
    bones that have another parent in the file than in the body. A rotation that does not change has one key. So has what only
    other animations of the file move, such as fingers: Blender and engines leave it where the animation before had it.

    Args:
        character: The character. The file that it was read from, if that was a glTF, is kept; else it gets a test skin.
        take_name: Name of the animation; a number is appended if the file has an animation of that name.

    Raises:
        WriteError: If `target` is not writable.
    """
    content, nodes = _open_document(character)
    curves = _compute_node_curves(character, motion, content, nodes)
    buffer = gltf.GltfBuffer(content.document, content.binary)
    written = {(int(nodes[bone]), "translation") for bone in curves.positions}
    written |= {(int(nodes[bone]), "rotation") for bone in curves.turning}
    others = _list_animated_nodes(content.document, set(nodes.tolist())).difference(written)
    entries = content.document["nodes"]
    for node, _ in written | others:
        _replace_matrix(entries[node])
    rest_values = {(node, path): entries[node].get(path, NODE_PROPERTIES[path]) for node, path in sorted(others)}
    name = _make_name_unique(take_name, content.document.get("animations", []))
    positions = {int(nodes[bone]): position for bone, position in curves.positions.items()}
    turned_nodes = {bone: int(nodes[bone]) for bone in curves.turning}
    gltf.add_animation(buffer, name, curves.rotations, positions, turned_nodes, motion.rate, rest_values)
    data = gltf.build_glb(gltf.GlbContent(content.document, buffer.finish(), content.other_chunks))
    with replace_atomically(Path(target)) as part:
        part.write_bytes(data)


def _open_document(character: Character) -> tuple[gltf.GlbContent, Int[np.ndarray, " J"]]:
    """Return the content to which the animation is appended, and the node of each bone."""
    source = character.source
    if source is not None and source.kind == "gltf":
        return gltf.parse_glb(Path(source.path), source.data), source.nodes
    shown_parents = character.skeleton.parents.copy()
    shown_parents[character.mapping.bones["pelvis"][0]] = -1  # no bone is shown from a root bone to the pelvis
    buffer = gltf.build_skinned_document(character.skeleton, shown_parents)
    return gltf.GlbContent(buffer.document, buffer.finish()), np.arange(len(shown_parents))


def _list_animated_nodes(document: Mapping[str, Any], nodes: Collection[int]) -> set[tuple[int, str]]:
    """Return node and path of what the animations of a document move, of some nodes."""
    found: set[tuple[int, str]] = set()
    for animation in document.get("animations", []):
        channels = animation.get("channels")
        for channel in channels if isinstance(channels, list) else ():
            target = channel.get("target") if isinstance(channel, dict) else None
            if isinstance(target, dict) and target.get("node") in nodes and target.get("path") in NODE_PROPERTIES:
                found.add((target["node"], target["path"]))
    return found


class NodeCurves(NamedTuple):
    """The motion of the bones as the nodes of a glTF have it."""

    rotations: Float[np.ndarray, "T J 3 3"]  # to the axes of the node above
    turning: list[int]  # bones that get a curve of rotations
    positions: dict[int, Float[np.ndarray, "T 3"]]  # bone to its positions in the unit of the node above


def _compute_node_curves(
    character: Character, motion: CharacterMotion, content: gltf.GlbContent, nodes: Int[np.ndarray, " J"]
) -> NodeCurves:
    """Return the curves that move the nodes of a document like the bones.

    In the user's file a node may be below another one than in the body, such as a foot below the root, and in another pose than
    the rest pose.
    """
    pelvis, turning = character.mapping.bones["pelvis"][0], list_moving_bones(character, motion)
    if character.source is None or character.source.kind != "gltf":
        return NodeCurves(motion.local_rotations, turning, {pelvis: motion.pelvis_position, **motion.positions})
    tree = gltf.read_gltf_nodes(Path(character.source.path), content.document)
    place = {node: bone for bone, node in enumerate(nodes.tolist())}
    ordered = [node for node in tree.ordered if node in place]
    at_rest, order = gltf.compute_bone_transforms(tree, ordered), np.argsort([place[node] for node in ordered])
    parents = np.array([place.get(int(tree.parents[node]), -1) for node in nodes])
    local_positions, rotations = decompose_transforms(*compute_character_poses(character, motion), parents)
    is_moved = np.abs(at_rest.positions[order] - character.skeleton.offsets).max(1) >= MIN_MOVED_OFFSET_M
    is_moved |= parents != character.skeleton.parents
    moved = {pelvis, *motion.positions, *np.flatnonzero(is_moved).tolist()}
    difference = np.abs(rotations - at_rest.rotations[order]).max(axis=(0, 2, 3), initial=0.0)
    scales = np.where(parents < 0, character.root_scale, character.scales[parents])
    turning = sorted({*turning, *np.flatnonzero(difference > MIN_MOVED_ELEMENT).tolist()})
    return NodeCurves(rotations, turning, {bone: local_positions[:, bone] / scales[bone] for bone in sorted(moved)})


def _replace_matrix(node: dict[str, Any]) -> None:
    """Give the transform of a node as translation, rotation and scale: a node with a matrix cannot be animated."""
    if "matrix" not in node:
        return
    matrix = np.array(node.pop("matrix"), float).reshape(4, 4).T
    scales = np.linalg.norm(matrix[:3, :3], axis=0)
    node["translation"] = matrix[:3, 3].tolist()
    node["rotation"] = Rotation.from_matrix(matrix[:3, :3] / scales).as_quat().tolist()
    node["scale"] = scales.tolist()


def write_clips(target: Path, paths: Sequence[Path]) -> None:
    """Write the motions of one character in several GLBs of `write_character_glb` as animations of one file.

    Raises:
        WriteError: If `target` is not writable.
    """
    first, *others = (gltf.parse_glb(path, path.read_bytes()) for path in paths)
    buffer = gltf.GltfBuffer(first.document, first.binary)
    for place, other in enumerate(others, start=1):
        name = _make_name_unique(other.document["animations"][0]["name"], first.document["animations"])
        gltf.copy_first_animation(buffer, name, other, place)
    with replace_atomically(target) as part:
        part.write_bytes(gltf.build_glb(gltf.GlbContent(first.document, buffer.finish(), first.other_chunks)))


def _make_name_unique(name: str, animations: Iterable[dict[str, Any]]) -> str:
    """Return the name, with a number behind it if an animation has that name."""
    names = [animation.get("name") for animation in animations]
    used = {each for each in names if isinstance(each, str)}
    candidates = (name, *(f"{name}.{number:03d}" for number in range(1, len(used) + 2)))
    return next(candidate for candidate in candidates if candidate not in used)


BVH_UNITS_M = (1.0, 0.01, 0.001, 0.0254)
UNIT_TOLERANCE = 1e-4  # relative difference from one of BVH_UNITS_M, up to which a scale is that unit
DEFAULT_END_FRACTION = 0.3  # length of a last bone without a tail, as a fraction of its parent's
MIN_END_M = 0.01  # and at least so much
BVH_NAME_SEPARATORS = re.compile(r"[\s{}]+")  # what a name in a BVH must not have


def write_character_bvh(target: Path, character: Character, motion: CharacterMotion) -> None:
    """Write the motion of a character as BVH: rotations Z Y X in degrees, and positions of the root and of the pelvis.

    Nodes above the bones that only place an armature are left out. If the character has several roots, a joint at the origin
    that has the character's name carries them.

    Raises:
        WriteError: If `target` is not writable.
    """
    bones = _list_written_bones(character)
    place = {bone: joint for joint, bone in enumerate(bones)}
    parents = np.array([place.get(int(character.skeleton.parents[bone]), -1) for bone in bones])
    rest_positions, rest_rotations = (each[bones] for each in character.skeleton.compute_rest_pose())
    positions, rotations = (each[:, bones] for each in compute_character_poses(character, motion))
    turned = rotations @ rest_rotations.swapaxes(-1, -2)
    names = [BVH_NAME_SEPARATORS.sub("_", character.skeleton.names[bone]) for bone in bones]
    tails = np.einsum("jab,jb->ja", rest_rotations, character.skeleton.ends[bones])
    if (parents < 0).sum() > 1:
        names = [BVH_NAME_SEPARATORS.sub("_", character.name) or "Root", *names]
        parents = np.concatenate([[-1], parents + 1])
        rest_positions, tails = (np.concatenate([np.zeros((1, 3)), each]) for each in (rest_positions, tails))
        positions = np.concatenate([np.zeros((motion.frame_count, 1, 3)), positions], axis=1)
        turned = np.concatenate([np.tile(np.eye(3), (motion.frame_count, 1, 1, 1)), turned], axis=1)
    offsets = np.where(parents[:, None] < 0, rest_positions, rest_positions - rest_positions[parents])
    local_positions, local_rotations = decompose_transforms(positions, turned, parents)
    skeleton = Skeleton(tuple(names), parents, offsets, _choose_ends(parents, offsets, tails))
    moved = (place[bone] + len(names) - len(bones) for bone in (character.mapping.bones["pelvis"][0], *motion.positions))
    positioned = {joint: local_positions[:, joint] for joint in (0, *moved)}
    # that in which the character's file gives the position of the pelvis
    above = int(character.skeleton.parents[character.mapping.bones["pelvis"][0]])
    scale = float(character.scales[above]) if above >= 0 else character.root_scale
    unit_m = next((unit for unit in BVH_UNITS_M if abs(scale / unit - 1) < UNIT_TOLERANCE), CENTIMETRE_M)
    write_bvh_tree(target, skeleton, positioned, np.ascontiguousarray(local_rotations), motion.rate, unit_m)


def _list_written_bones(character: Character) -> list[int]:
    """Return the bones that are written: all but nodes of a glTF at the top that are no joints and carry a single bone."""
    joints = list_source_joints(character)
    bones, mapped = list(range(len(character.skeleton.names))), character.mapping.bones["pelvis"][0]
    while joints and bones[0] not in joints and bones[0] != mapped:
        children = np.flatnonzero(character.skeleton.parents == bones[0])
        is_single_tree = len(children) == 1 and (character.skeleton.parents < 0).sum() == 1
        if not is_single_tree:
            break
        bones = bones[1:]
    return bones


def _choose_ends(
    parents: Int[np.ndarray, " J"], offsets: Float[np.ndarray, "J 3"], tails: Float[np.ndarray, "J 3"]
) -> Float[np.ndarray, "J 3"]:
    """Return the end sites of the leaves: their tails, or else a point that continues the bone above."""
    ends = np.full(tails.shape, np.nan)
    for joint in np.flatnonzero(~np.isin(np.arange(len(parents)), parents)):
        ends[joint] = tails[joint]
        if not np.linalg.norm(tails[joint]) > 0:
            length = np.linalg.norm(offsets[joint])
            direction = offsets[joint] / length if length > 0 else np.array([0.0, 1.0, 0.0])
            ends[joint] = direction * max(DEFAULT_END_FRACTION * length, MIN_END_M)
    return ends


def convert_hand_motion(hand: HandMotion, hand_rate: float, rate: float) -> HandPoses:
    """Return the poses of a solved hand at another rate; both are in frames per second."""
    moved, offsets = resample_motion(hand.motion, hand_rate, rate), hand.hand.model.ray_offsets.reshape(len(FINGERS), -1, 3)
    rotations = moved.local_rotations
    first, second, third = (rotations[:, 1 + joint :: JOINTS_PER_RAY] for joint in range(JOINTS_PER_RAY))
    turned = np.stack([first, first @ second, first @ second @ third], axis=2)
    fingers = {finger: turned[:, k] for k, finger in enumerate(FINGERS)}
    return HandPoses(rotations[:, 0], fingers, moved.root_position, dict(zip(FINGERS, offsets, strict=True)))


def measure_animation_hands(animation: Animation, rate: float) -> tuple[dict[str, HandPoses], list[str]]:
    """Return the hands of a BVH, by its rest pose as a character, at another rate in Hz, and sentences for the report."""
    if animation.path is None or animation.skeleton_path is not None or not has_named_fingers(animation.names, animation.parents):
        return {}, []
    try:
        character = load_character(animation.path)
        if not np.allclose(character.rotation_y_up_file, animation.rotation_y_up_file):
            raise SceneError(f"{animation.name}: its rest pose is not upright.")
        names = list(make_names_unique(animation.names))
        if missing := sorted({*character.skeleton.names} - {*names}):
            raise SceneError(f"{animation.name}: the file has changed since it was read: {format_name_list(missing)}.")
    except (ReadError, SceneError) as error:
        return {}, [f"The fingers of {animation.name} are not on other skeletons: {error}"]
    joints = [names.index(name) for name in character.skeleton.names]
    hands = measure_hand_poses(character, *(each[:, joints] for each in animation.compute_world_poses()))
    return {side: _resample_hand_poses(hand, animation.rate, rate) for side, hand in hands.items()}, []


def _resample_hand_poses(hand: HandPoses, hand_rate: float, rate: float) -> HandPoses:
    rotations, none = np.concatenate([hand.palm[:, None], *hand.fingers.values()], axis=1), np.zeros(len(hand.palm), int)
    motion = Motion(hand.position, rotations, none, none, np.zeros((len(none), 0)), np.zeros(rotations.shape[:2]))
    moved, counts = resample_motion(motion, hand_rate, rate), [each.shape[1] for each in hand.fingers.values()]
    palm, *fingers = np.split(moved.local_rotations, np.cumsum([1, *counts])[:-1], axis=1)
    return hand._replace(palm=palm[:, 0], fingers=dict(zip(hand.fingers, fingers, strict=True)), position=moved.root_position)


OTHER_SUFFIXES = ("bvh", "npz", "map.yaml")  # of the files beside the GLB
GLB_CONVERTERS: dict[str, Callable[[Path, Path, float], str | None]] = {"fbx": write_fbx, "usd": write_usd}
"""Formats of a whole character that are written from its GLB: suffix to a function of the file, the GLB and frames per second. It
returns a sentence why no file was written: one that is missing is no reason to fail a whole cleaning."""


@dataclass(frozen=True)
class CharacterFiles:
    """What is written of a character, with a root bone if that carries its path."""

    character: Character
    options: OutputOptions

    @property
    def converted(self) -> tuple[str, ...]:
        """The suffixes of the requested formats among GLB_CONVERTERS."""
        return tuple(each for each in dict.fromkeys(self.options.extra_formats) if each in GLB_CONVERTERS)

    @property
    def suffixes(self) -> tuple[str, ...]:
        """The suffixes of the files, after the stem of the take."""
        source = self.character.source
        is_vrm = source is not None and source.kind == "gltf" and Path(source.path).suffix.lower() == ".vrm"
        endings = ("vrm" if is_vrm else "glb", *OTHER_SUFFIXES, *self.converted)
        return tuple(f"{self.character.name}.{ending}" for ending in endings)

    def write(
        self,
        target: Path,
        skeleton: Skeleton,
        motion: Motion,
        rate: float,
        contacts: BodyContacts | None = None,
        frames: slice = slice(None),
        hands: Mapping[str, HandPoses] = MappingProxyType({}),
    ) -> list[str]:
        """Write the motion of a solved skeleton, retargeted onto the character, into a GLB or VRM and files beside it.

        If the feet of the motion are locked in its contacts, so are the character's. `frames` are those that are written. `hands`
        are those of the motion, by side; the fingers of others keep their rest pose.

        Returns sentences for the report. Raises WriteError if a file is not writable.
        """
        root_motion, source = self.options.root_motion, build_cmu31_character(skeleton)
        character = prepare_root_bone(self.character) if root_motion == ROOT_BONE else self.character
        retargeted = retarget_motion(source, convert_motion(motion, rate), character, contacts=contacts, hands=hands)
        delivered = retargeted.select_frames(frames)
        if not delivered.frame_count:
            raise WriteError(f"{target.name}: none of its frames is among those of --trim; name frames of the take.")
        scale = build_body_frame(character).leg_length_m / build_body_frame(source).leg_length_m
        notes = [f"{target.name}: {character.mapping.reason} Places are scaled by {scale:.3f}, as the legs are."]
        followed = {
            side: sum(fit_finger(hand, side, each, 3) is not None for each in list_fingers(character, side).values())
            for side, hand in hands.items()
        }
        counts = [f"{count} of the {side} hand" for side, count in followed.items()]
        notes += [f"{target.name}: Fingers that follow those of the take: {', '.join(counts)}."] if counts else []
        if contacts and (levels := contacts.floor.level_heights_m):
            lowest_m = compute_character_poses(source, convert_motion(motion, rate))[0][..., 1].min() - levels[0]
            notes += [f"{target.name}: {each}" for each in describe_depth(character, delivered, scale * min(lowest_m, 0.0))]
        if self.options.loop:
            count = motion.frame_count
            feet = resample_foot_contacts(contacts or build_no_contacts(count, rate), count, rate)
            is_standing = {side: feet.find_foot_contact(side)[frames] for side in SIDES}
            delivered, seam = close_loop(character, delivered, is_standing)
            notes += [f"{target.name}: {each}" for each in (seam, name_whole_stride(character, retargeted, frames)) if each]
        delivered = carry_path(character, delivered, root_motion, is_loop=self.options.loop)
        write_character_bvh(target.with_suffix(".bvh"), character, delivered)
        moving_bones = list_moving_bones(character, delivered)
        write_character_npz(target.with_suffix(".npz"), character, delivered, moving_bones)
        write_mapping_file(target.with_suffix(".map.yaml"), character)
        write_character_glb(target, character, delivered, target.name.removesuffix(f".{self.suffixes[0]}"))
        problems = [GLB_CONVERTERS[suffix](target.with_suffix(f".{suffix}"), target, rate) for suffix in self.converted]
        return notes + [each for each in problems if each]


MAX_DEPTH_LEG_SHARE = 0.03  # depth of a bone under the floor, in leg lengths, from which the report names it: flesh surrounds it


def describe_depth(character: Character, motion: CharacterMotion, lowest_m: float) -> list[str]:
    """Return a sentence on the bone deepest under the floor, which is at height 0, if it is far deeper than the performer's.

    `lowest_m` is the height in metres of the performer's lowest joint, scaled to the character; 0 if it is above the floor.
    """
    feet = {bone for name, chain in character.mapping.bones.items() if name.endswith(("foot", "toe")) for bone in chain}
    mapped = {bone for chain in character.mapping.bones.values() for bone in chain} - feet  # soles are measured by their mesh
    bones = [bone for bone, parent in enumerate(character.skeleton.parents) if {bone, parent} & mapped and bone not in feet]
    height = compute_character_poses(character, motion)[0][:, bones, 1]
    frame, lowest = np.unravel_index(height.argmin(), height.shape)
    depth_m = lowest_m - float(height[frame, lowest])
    if depth_m < MAX_DEPTH_LEG_SHARE * build_body_frame(character).leg_length_m:
        return []
    where = f"{character.skeleton.names[bones[lowest]]} is {depth_m * 1e3:.0f} mm under the floor in frame {frame + 1}"
    return [f"{where} of the file, the deepest: the figure does not reach the performer's pose there; correct it by hand."]


def write_skeleton(target: Path, body: BodyWithHands, rate: float) -> list[str]:
    """Write the solved skeleton in one of GLB_CONVERTERS. Returns sentences for the report. Raises WriteError."""
    others = {joint: each for joint, each in body.positions.items() if joint}
    motion = CharacterMotion(body.positions[0], body.local_rotations, rate, others)
    with make_scratch_folder() as folder:
        glb = folder / f"{target.stem}.glb"
        write_character_glb(glb, build_cmu31_character(body.skeleton), motion, target.stem)
        problem = GLB_CONVERTERS[target.suffix[1:]](target, glb, rate)
    return [problem] if problem else []
