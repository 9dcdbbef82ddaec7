"""Load the character that an option names, and check its sides: a shipped figure of scenes/rigs, or a file of any format.

The format of a file is detected from the content, only YAML from the extension. BVH has no rest rotations: with all angles zero
the axes of all bones are the file's.
"""

import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache, lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from mocapfix.characters.body_frames import compute_facing
from mocapfix.characters.bone_mapping import find_detached_bones, map_bones
from mocapfix.characters.character import (
    LIMB_ENDS,
    SIDES,
    BoneMapping,
    Character,
    CharacterSource,
    build_bone_matrices,
    compute_tail,
    reparent_bones,
)
from mocapfix.characters.character_yaml import apply_mapping_file, has_fingers, read_character_yaml, read_feet_flat
from mocapfix.characters.fbx import convert_fbx, is_fbx
from mocapfix.characters.fingers import find_fingers, find_palms
from mocapfix.characters.read_gltf import is_gltf, open_gltf, parse_character_gltf, read_gltf_skeletons
from mocapfix.characters.rest_poses import choose_rest_pose
from mocapfix.errors import ReadError, SceneError, format_name_list
from mocapfix.io.bvh import is_bvh, read_bvh
from mocapfix.io.capture import extract_head
from mocapfix.io.file_content import read_file_bytes
from mocapfix.io.gltf_mesh import GltfMesh, compute_node_matrices, move_nodes, read_gltf_mesh
from mocapfix.io.shipped import find_shipped_folder
from mocapfix.model.animation import Animation
from mocapfix.model.skeleton import Skeleton, find_ancestor, is_below, load_cmu31_skeleton, make_names_unique
from mocapfix.options import CHARACTER_PRESETS
from mocapfix.stats.rigid_alignment import compute_shortest_rotation, find_nearest_points

MAX_BACKWARD_COSINE = -0.5  # cosine of the horizontal angle between a foot and the front, below which it points backwards
MIN_HORIZONTAL_FOOT_SHARE = 0.3
"""horizontal length of a foot, as a share of its length, from which it points anywhere; on high heels it may not"""
MIN_SPREAD_RAD, MAX_SPREAD_RAD = np.deg2rad(12.0), np.deg2rad(30.0)
"""of the shins from the vertical, in skeletons like those of CMU's recordings, whose legs are spread by 20 degrees"""
MAX_SPREAD_DIFFERENCE_RAD = np.deg2rad(3.0)
MAX_STRAIGHT_YAW_RAD = np.deg2rad(2.0)  # angle between the front and a foot that points straight ahead


def check_sides(character: Character, name: str) -> None:
    """Raise SceneError, which begins with `name`, if left and right are swapped.

    The front follows from left and right. They are swapped if both feet point backwards, or if the arms give another front than
    the legs. Feet without toes point nowhere.
    """
    position, _ = character.skeleton.compute_rest_pose()
    bones = character.mapping.bones
    what_to_do = "exchange the bones of both sides in a mapping file (--character-map) or in their names"
    legs, arms = (position[bones[f"left_{each}"][0]] - position[bones[f"right_{each}"][0]] for each in ("thigh", "upper_arm"))
    if legs @ arms < 0:
        pairs = " and ".join(repr(character.skeleton.names[bones[f"left_{each}"][0]]) for each in ("thigh", "upper_arm"))
        raise SceneError(f"{name}: {pairs}, both of the left, are on different sides of the body; {what_to_do}.")
    axes = compute_facing(character)
    toes: list[str] = []
    for side in SIDES:
        if toe := bones.get(f"{side}_toe"):
            foot = axes.T @ (position[toe[0]] - position[bones[f"{side}_foot"][0]])
            length = float(np.hypot(foot[0], foot[2]))
            is_horizontal = length > MIN_HORIZONTAL_FOOT_SHARE * np.linalg.norm(foot)
            if is_horizontal and foot[2] < MAX_BACKWARD_COSINE * length:
                toes.append(repr(character.skeleton.names[toe[0]]))
    if len(toes) == len(SIDES):
        problem = "point backwards, so the bones of left and right are swapped, or the feet are"
        raise SceneError(f"{name}: the toes {' and '.join(toes)} {problem}; {what_to_do}.")


def are_soles_flat(character: Character) -> bool:
    """Return whether the soles lie flat in the rest pose of a character without a mesh of its own.

    They do, except in skeletons like those of CMU's recordings: their legs are spread to the sides, and the feet are turned with
    the shins, straight ahead only when the shins are vertical.
    """
    kind, bones = character.source.kind if character.source else "yaml", character.mapping.bones
    is_bare = kind == "bvh" or (kind == "gltf" and set(load_cmu31_skeleton().names) <= set(character.skeleton.names))
    if not is_bare or not all(bones.get(f"{side}_toe") for side in SIDES):
        return True
    place, spreads = character.skeleton.rest_positions @ compute_facing(character), list[float]()
    for side, outward in zip(SIDES, (1.0, -1.0), strict=True):
        shin, foot = np.diff([place[bones[f"{side}_{segment}"][0]] for segment in ("shin", "foot", "toe")], axis=0)
        turned = compute_shortest_rotation(shin, np.array([0.0, -1.0, 0.0])) @ foot
        yaw, turned_yaw = (float(np.arctan2(outward * each[0], each[2])) for each in (foot, turned))
        spreads.append(float(np.arctan2(outward * shin[0], -shin[1])))
        if not MIN_SPREAD_RAD < spreads[-1] < MAX_SPREAD_RAD or abs(turned_yaw) > min(MAX_STRAIGHT_YAW_RAD, abs(yaw)):
            return True
    return bool(np.ptp(spreads) > MAX_SPREAD_DIFFERENCE_RAD)


@cache
def load_character_preset(name: str) -> Character:
    """Load a shipped character by its name, one of CHARACTER_PRESETS.

    Its bones, tree, axes and unit are those of the program; its lengths are those of an adult of about 1.75 m.

    Raises:
        SceneError: If there is no preset of the name. The message lists the presets.
    """
    if name not in CHARACTER_PRESETS:
        raise SceneError(f"There is no character preset {name!r}; choose one of {', '.join(CHARACTER_PRESETS)}, or give a file.")
    return read_character_yaml(find_shipped_folder("scenes") / "rigs" / f"{name}.yaml")


def build_bvh_character(path: Path, data: bytes, animation: Animation) -> Character:
    """Return the bones of a BVH, with the unit and the up axis that `read_bvh` inferred, as a character without mapping."""
    count, unit_m = len(animation.names), animation.unit_m
    positions = np.where(animation.is_below_body_root[:, None], animation.bone_offsets, animation.offsets) * unit_m
    positions[0] = animation.rotation_y_up_file @ positions[0]
    rotations = np.tile(np.eye(3), (count, 1, 1))
    rotations[0] = animation.rotation_y_up_file
    tails = np.full((count, 3), np.nan)
    for joint, ends in enumerate(animation.end_sites):
        tails[joint] = compute_tail(np.concatenate([animation.bone_offsets[animation.parents == joint], ends]) * unit_m)
    return Character(
        name=path.stem,
        skeleton=Skeleton(make_names_unique(animation.names), animation.parents, positions, tails, rotations),
        mapping=BoneMapping({}),
        scales=np.full(count, unit_m),
        root_scale=unit_m,
        rotation_y_up_file=animation.rotation_y_up_file,
        source=CharacterSource(str(path), data, np.zeros(0, int), "bvh"),
    )


YAML_SUFFIXES = (".yaml", ".yml")


def read_character_skeletons(path: str | Path) -> list[Character]:
    """Read the skeletons of a character, the one with the most joints first.

    The file is glTF 2.0 (.glb, .gltf), VRM 0.x and 1.0 (.vrm), FBX, BVH, or YAML of the form of the presets. A VRM or YAML gives
    the bones of the segments of the body. The mapping of another file is empty.

    Raises:
        ReadError: If the file cannot be opened, has no supported format or is invalid. The message names the file.
        SceneError: If a YAML file is invalid. The message names the file and the key.
    """
    path = Path(path)
    data = read_file_bytes(path)
    if is_bvh(extract_head(data)):
        return [build_bvh_character(path, data, read_bvh(path, data))]
    if path.suffix.lower() in YAML_SUFFIXES:
        return [read_character_yaml(path)]
    if is_fbx(path, data):
        return read_gltf_skeletons(path, convert_fbx(path))
    if is_gltf(data):
        return read_gltf_skeletons(path, data)
    raise ReadError(f"{path}: is no character that mocapfix reads; give a .glb, .gltf, .vrm, .fbx, .bvh or .yaml file.")


UNUSABLE_CHARACTERS = re.compile(r"[^\w-]+")  # in the name of a character, which is part of the names of files
MIN_LIMB_LENGTH_M = 1e-6


def load_character(name_or_path: str | Path, mapping_path: str | Path | None = None, rest_frame: int | None = None) -> Character:
    """Load a preset by its name, or the character in a file, in its rest pose and with all segments that retargeting needs.

    Of several skeletons in a file, the first is taken whose bones form a body, or are those of the mapping in a file, which
    replaces the one that the character has. The rest pose is frame `rest_frame` of the file, or as in `choose_rest_pose`.

    Raises:
        ReadError: If its file cannot be read.
        SceneError: If there is no such character, its bones do not form a body, or the file has no rest pose.
    """
    if str(name_or_path) in CHARACTER_PRESETS:
        skeletons = [load_character_preset(str(name_or_path))]
    else:
        path = Path(name_or_path)
        if not path.suffix and not path.exists():
            choices = ", ".join(CHARACTER_PRESETS)
            raise SceneError(f"There is no character {str(name_or_path)!r}; choose one of {choices}, or give a file.")
        name = UNUSABLE_CHARACTERS.sub("-", path.stem).strip("-") or "character"
        skeletons = [replace(character, name=name) for character in read_character_skeletons(path)]

    def assign(character: Character) -> Character:
        skeleton, skinned = character.skeleton, compute_skin_vertices(character).bones
        is_skinned = np.isin(np.arange(len(skeleton.names)), skinned) | (not len(skinned))
        moved = find_detached_bones(skeleton.names, skeleton.parents, skeleton.rest_positions, is_skinned)
        character = reparent_bones(character, moved)
        if mapping_path is not None:
            character = apply_mapping_file(mapping_path, character)
        elif character.mapping.missing_segments:
            mapping = map_bones(character)
            mapping = replace(mapping, bones=find_palms(skeleton.names, character.skeleton.parents, mapping.bones))
            character = replace(character, mapping=mapping)
        if mapping_path is None or not has_fingers(mapping_path):
            tree, mapping = character.skeleton, character.mapping
            fingers = find_fingers(tree.names, tree.parents, tree.rest_positions, mapping.bones)
            character = replace(character, mapping=replace(mapping, fingers=fingers))
        character, strays = attach_stray_bones(character)
        if names := [skeleton.names[bone] for bone in moved] + strays:
            sentence = f"The body moves {format_name_list(names)}, though none of its bones carries them."
            character = replace(character, mapping=character.mapping.add_sentence(sentence))
        if character.source is not None and character.source.kind == "bvh":  # which does not state its unit
            sentence = f"Its unit is taken as {character.root_scale * 1e3:.4g} mm, by its height."
            character = replace(character, mapping=character.mapping.add_sentence(sentence))
        return character

    character = _choose_skeleton(skeletons, assign, rest_frame)
    check_lengths(character, str(name_or_path))
    check_sides(character, str(name_or_path))
    if (stands := stand_on_soles(character)) is not None:
        return stands
    is_given = mapping_path is not None and read_feet_flat(mapping_path) is not None
    return character if is_given else replace(character, has_feet_flat=character.has_feet_flat and are_soles_flat(character))


def _choose_skeleton(skeletons: list[Character], assign: Callable[[Character], Character], rest_frame: int | None) -> Character:
    """Return the first skeleton of a file that has a mapping and a rest pose. Raises what is wrong with the first if none has."""
    errors: list[SceneError] = []
    for character in skeletons:
        try:
            return choose_rest_pose(character, assign, rest_frame)
        except SceneError as error:
            errors.append(error)
    raise errors[0]


def check_lengths(character: Character, name: str) -> None:
    """Raise SceneError, which begins with `name`, if a thigh, shin, upper arm or forearm has no length in the rest pose."""
    position, _ = character.skeleton.compute_rest_pose()
    bones = character.mapping.bones
    for side in SIDES:
        for start, end in LIMB_ENDS.items():
            first, last = bones[f"{side}_{start}"][0], bones.get(f"{side}_{end}", ())
            if last and not np.linalg.norm(position[last[0]] - position[first]) > MIN_LIMB_LENGTH_M:
                pair = f"{character.skeleton.names[first]!r} and {character.skeleton.names[last[0]]!r}"
                raise SceneError(
                    f"{name}: the bones {pair} ({side} {start.replace('_', ' ')}) are at one place, so the character cannot be "
                    "posed; correct its rest pose or the mapping (--character-map)."
                )


class SkinVertices(NamedTuple):
    """The V vertices of the meshes that the bones of a character carry, skinned or fixed to a bone."""

    positions: Float[np.ndarray, "V 3"]  # m: in the world, in the rest pose
    bones: Int[np.ndarray, " V"]  # the bone of the greatest weight, or that carries the mesh
    is_weighted: Bool[np.ndarray, " V"]  # whether the bone has a weight


def compute_skin_vertices(character: Character) -> SkinVertices:
    """Return the vertices that the bones carry in the rest pose, none for a character without a mesh."""
    content, nodes, bone_of = open_gltf(character) or (None, None, {})
    if content is None or nodes is None or character.source is None:
        return SkinVertices(np.zeros((0, 3)), np.zeros(0, int), np.zeros(0, bool))
    mesh, posed = _read_mesh(character.source.path, character.source.data), build_bone_matrices(character)
    placed, carriers = {node: posed[bone] for node, bone in bone_of.items()}, np.full(len(nodes.parents), -1)
    for node in nodes.ordered:
        carriers[node] = bone_of.get(node, carriers[nodes.parents[node]] if nodes.parents[node] >= 0 else -1)
    matrices = move_nodes(nodes, compute_node_matrices(content, nodes)[0], placed)
    followed = mesh.nodes[mesh.strongest]
    bones, is_weighted = carriers[followed], np.isin(followed, list(bone_of))
    return SkinVertices(mesh.pose(matrices)[bones >= 0], bones[bones >= 0], is_weighted[bones >= 0])


@lru_cache(maxsize=1)
def _read_mesh(path: str, data: bytes) -> GltfMesh:
    return read_gltf_mesh(*parse_character_gltf(path, data))


SOLE_END_SHARE = 0.33  # of a foot's length: its heel, and its front, at whose lowest vertices it stands
MIN_SOLE_DEPTH_SHARE = 0.02  # distance of a sole from the ankle, as a share of the leg's length; less is the mesh of a bare bone
LEVEL_SOLE_RAD, MAX_SOLE_RAD = np.deg2rad(2.0), np.deg2rad(50.0)
"""inclinations between which a sole is levelled: a smaller one is that of the shoe, a larger one is no sole"""


def stand_on_soles(character: Character) -> Character | None:
    """Return a character whose rest pose stands at height 0 on the soles of its mesh; None without a mesh of both feet.

    The sole of a foot goes through the lowest vertices of its heel and of its front. A foot that is inclined is turned until it
    lies flat, as feet are in the rest poses of bodies that stand on their toes or with spread legs. Then the body is lowered.
    """
    skeleton, bones = character.skeleton, character.mapping.bones
    vertices, (place, world) = compute_skin_vertices(character), skeleton.compute_rest_pose()
    rotations, heights = skeleton.rest_rotations.copy(), list[float]()
    front = compute_facing(character)[:, 2]
    leg = np.diff([place[bones[f"left_{segment}"][0]] for segment in ("thigh", "shin", "foot")], axis=0)
    for side in SIDES:
        foot = bones[f"{side}_foot"][0]
        is_carried = np.array([bone == foot or is_below(bone, foot, skeleton.parents) for bone in range(len(place))])
        points = vertices.positions[is_carried[vertices.bones]] - place[foot]
        if not len(points):
            return None
        toe = bones.get(f"{side}_toe")
        forward = (place[toe[0]] - place[foot] if toe else points.mean(0)) * [1, 0, 1]
        forward = forward / np.linalg.norm(forward) if np.linalg.norm(forward) > MIN_LIMB_LENGTH_M else front
        turn = np.eye(3)
        for along in (forward, np.cross(forward, [0.0, 1.0, 0.0])):
            turn = _level_sole(points @ turn.T, along) @ turn
        lowest = float((points @ turn.T)[:, 1].min())
        if -lowest < MIN_SOLE_DEPTH_SHARE * np.linalg.norm(leg, axis=1).sum():
            return None
        heights.append(place[foot, 1] + lowest)
        rotations[foot] = rotations[foot] @ world[foot].T @ turn @ world[foot]
    pelvis, offsets = bones["pelvis"][0], skeleton.offsets.copy()
    above = int(skeleton.parents[pelvis])
    lowered = np.array([0.0, -float(np.mean(heights)), 0.0])
    offsets[pelvis] += lowered if above < 0 else world[above].T @ lowered
    standing = replace(character, skeleton=replace(skeleton, offsets=offsets, rest_rotations=rotations), has_feet_flat=True)
    return replace(standing, hulls=find_hulls(standing))


def find_hulls(character: Character) -> dict[str, Float[np.ndarray, "P 3"]]:
    """Return by segment the vertices of feet, toes, hands and head that touch the floor first, inclined in any direction.

    What a hand holds is fixed to a bone, beside the skin of the hand, and does not count.
    """
    vertices, bones, parents = compute_skin_vertices(character), character.mapping.bones, character.skeleton.parents
    directions = -Rotation.from_euler("xz", INCLINATIONS_DEG, degrees=True).as_matrix()[:, 1] @ compute_facing(character).T
    carriers = {chain[0]: segment for segment, chain in bones.items() if segment.endswith(("foot", "toe", "hand", "head"))}
    is_end = np.isin(np.arange(len(parents)), list(carriers))
    carrier = np.array([bone if is_end[bone] else find_ancestor(bone, parents, is_end) for bone in range(len(parents))])
    hulls: dict[str, Float[np.ndarray, "P 3"]] = {}
    for bone, segment in carriers.items():
        is_own = carrier[vertices.bones] == bone
        is_skin = is_own & vertices.is_weighted
        points = vertices.positions[is_skin if segment.endswith("hand") and is_skin.any() else is_own]
        if len(points):
            hulls[segment] = points[np.unique((points @ directions.T).argmax(0))]
    return hulls


INCLINATIONS_DEG = np.array([[pitch, roll] for pitch in range(-180, 180, 10) for roll in range(-80, 81, 10)], float)


def _level_sole(points: Float[np.ndarray, "V 3"], along: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
    """Return the rotation that levels the sole of a foot, whose vertices are given, along a horizontal direction."""
    share = points @ along
    share = (share - share.min()) / max(float(np.ptp(share)), MIN_LIMB_LENGTH_M)
    ends = [points[is_end] for is_end in (share <= SOLE_END_SHARE, share >= 1 - SOLE_END_SHARE)]
    back, front = (each[each[:, 1].argmin()] for each in ends)
    slope = float(np.arctan2(front[1] - back[1], (front - back) @ along))
    if not LEVEL_SOLE_RAD < abs(slope) < MAX_SOLE_RAD:
        return np.eye(3)
    return compute_shortest_rotation(np.cos(slope) * along + np.sin(slope) * np.array([0.0, 1.0, 0.0]), along)


MAX_STRAY_DISTANCE_SHARE = 0.15
"""distance of the vertices of a bone from the body, as a share of the height of all bones, up to which they are a part of it"""
SAME_DISTANCE_SHARE = 0.005  # difference of two distances that count as the same, as a share of the same height
MAX_STRAY_SIZE_SHARE = 0.25  # their size, as a share of the same height; larger is a floor or a prop


def attach_stray_bones(character: Character) -> tuple[Character, list[str]]:
    """Return a character in which the nearest bone of the body carries each skinned bone that would stay behind, and those.

    Raises:
        SceneError: If a bone above the pelvis carries skin of the body. The message names both.
    """
    skeleton, mapping, vertices = character.skeleton, character.mapping, compute_skin_vertices(character)
    heads, ends, height = skeleton.rest_positions, skeleton.compute_rest_ends(), float(np.ptp(skeleton.rest_positions[:, 1]))
    pelvis, mapped = mapping.bones["pelvis"][0], [bone for chain in mapping.bones.values() for bone in chain]
    carriers = [bone for bone in mapped if bone not in mapping.bones.get("neck", ()) or not mapping.bones.get("head")]
    starts = heads[carriers]
    tips = np.where(np.isnan(ends[carriers]), starts, ends[carriers])
    body = {pelvis, *(bone for bone in range(len(heads)) if is_below(bone, pelvis, skeleton.parents))}
    strays = sorted(set(vertices.bones.tolist()) - body)
    found: dict[int, int] = {}
    for bone in strays:
        points = vertices.positions[vertices.bones == bone]
        centre, size = points.mean(0), float(np.ptp(points, axis=0).max())
        distance = np.linalg.norm(find_nearest_points(centre, starts, tips)[1], axis=1)
        is_nearest = distance <= distance.min() + SAME_DISTANCE_SHARE * height
        nearest = carriers[int(np.flatnonzero(is_nearest)[-1])]  # of two bones that meet there, the outer one
        if distance.min() > MAX_STRAY_DISTANCE_SHARE * height or size > MAX_STRAY_SIZE_SHARE * height:
            continue
        if is_below(pelvis, bone, skeleton.parents):
            if not vertices.is_weighted[vertices.bones == bone].any():
                continue
            pair = f"{skeleton.names[bone]!r} carries skin at {skeleton.names[nearest]!r}"
            raise SceneError(
                f"{character.origin}: the bone {pair}, but is above the pelvis and would stay behind; weight that skin to the "
                "pelvis, or name the bone as the pelvis in a mapping file (--character-map)."
            )
        if bone not in mapped and not any(is_below(bone, other, skeleton.parents) for other in strays):
            found[bone] = nearest
    return reparent_bones(character, found), [skeleton.names[bone] for bone in found]
