"""Root motion: the path of a character on the floor and its heading, carried by a root bone or left out.

Engines move a character by a bone on the floor, and the pelvis relative to it. The path is the place of the pelvis on the floor,
the heading the turn of the pelvis about the vertical, compared with the rest pose (the twist of its rotation, which a body that
lies or bends has too). Both are smoothed by a Gaussian of SMOOTHING_S: a pelvis sways with every stride, at about 1 Hz, and what
is left of that is 1 degree in walks. At the ends of a motion the path goes on as it came, so that the root is under the pelvis
there; the path of a loop goes on as the loop does.

A root bone that the character has is used: the highest joint above the pelvis that is near the floor. Otherwise one is added
above the pelvis, in a glTF as a joint of its skins that moves no corner of the mesh. What hangs at a root bone beside the body,
such as control bones, goes with it.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from mocapfix.characters.character import Character, CharacterMotion, CharacterSource, compute_character_poses, reparent_bones
from mocapfix.characters.read_gltf import open_gltf
from mocapfix.io.gltf import GlbContent, GltfBuffer, build_glb, parse_glb, read_gltf_nodes
from mocapfix.io.gltf_mesh import UNREADABLE, compute_node_matrices, read_array
from mocapfix.model.skeleton import Skeleton
from mocapfix.options import ROOT_BONE, ROOT_IN_PLACE

SMOOTHING_S = 0.4
"""Standard deviation of the Gaussian that smooths path and heading. In eight CMU takes 0.2 s leaves 1 to 4 degrees of the sway in
walks, 0.4 s 1 to 2, at most 4 cm beside the pelvis in walks and 21 cm in jumps."""
MIN_UPRIGHT_SHARE = 0.3  # least length of a pelvis' quaternion that its turn about the vertical has: of a body not upside down
MAX_ROOT_HEIGHT_SHARE = 0.25  # height of a root bone in the rest pose, as a share of that of the pelvis
ROOT_NAMES = ("root", "root_motion")  # of a bone that is added: the first that no bone has


def turn_about_vertical(yaw_rad: float | Float[np.ndarray, " T"]) -> Rotation:
    """Return turns about Y."""
    return Rotation.from_rotvec(np.multiply.outer(yaw_rad, [0.0, 1.0, 0.0]))


class CycleStep(NamedTuple):
    """How the body moves on over the floor from one cycle to the next."""

    yaw_rad: float
    translation: Float[np.ndarray, " 3"]  # m, after the turn

    @property
    def rotation(self) -> Float[np.ndarray, "3 3"]:
        """The turn about the vertical."""
        return turn_about_vertical(self.yaw_rad).as_matrix()

    def undo(self, position: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """Return positions of the last frame as seen in the first cycle."""
        return (position - self.translation) @ self.rotation


class FloorPath(NamedTuple):
    """Where a figure is on the floor and where it faces, in each of T frames."""

    position: Float[np.ndarray, "T 3"]  # m, at height 0
    yaw_rad: Float[np.ndarray, " T"]  # turn about Y from the rest pose, without jumps

    @property
    def rotations(self) -> Float[np.ndarray, "T 3 3"]:
        """The turns as rotations."""
        return turn_about_vertical(self.yaw_rad).as_matrix()

    def measure_step(self) -> CycleStep:
        """Return the step from the first frame to the last."""
        yaw_rad = float(self.yaw_rad[-1] - self.yaw_rad[0])
        return CycleStep(yaw_rad, self.position[-1] - turn_about_vertical(yaw_rad).apply(self.position[0]))

    def continue_path(self, count: int) -> "FloorPath":
        """Return the path of a loop with `count` frames more before and behind: each cycle begins where the one before ended."""
        frames = np.arange(-count, len(self.yaw_rad) + count)
        cycle, place = np.divmod(frames, max(len(self.yaw_rad) - 1, 1))
        step, matrix = self.measure_step(), np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = step.rotation, step.translation
        steps = np.stack([np.linalg.matrix_power(matrix, k) for k in range(cycle[0], cycle[-1] + 1)])[cycle - cycle[0]]
        moved = np.einsum("tab,tb->ta", steps[:, :3, :3], self.position[place]) + steps[:, :3, 3]
        return FloorPath(moved, self.yaw_rad[place] + cycle * step.yaw_rad)


def measure_floor_path(character: Character, motion: CharacterMotion) -> FloorPath:
    """Return the path of the pelvis on the floor and its heading, without smoothing."""
    positions, rotations = compute_character_poses(character, motion)
    pelvis = character.mapping.bones["pelvis"][0]
    turned = rotations[:, pelvis] @ character.skeleton.compute_rest_pose()[1][pelvis].T
    quaternion = Rotation.from_matrix(turned).as_quat()
    is_known = np.hypot(quaternion[:, 1], quaternion[:, 3]) > MIN_UPRIGHT_SHARE
    frames = np.flatnonzero(is_known) if is_known.any() else np.arange(len(quaternion))
    known_yaw = np.unwrap(2.0 * np.arctan2(quaternion[frames, 1], quaternion[frames, 3]))
    return FloorPath(positions[:, pelvis] * [1.0, 0.0, 1.0], np.interp(np.arange(len(quaternion)), frames, known_yaw))


def smooth_floor_path(path: FloorPath, rate: float, *, is_loop: bool) -> FloorPath:
    """Return a path at `rate` frames per second smoothed; that of a loop is continued by itself, another one as it came."""
    sd = SMOOTHING_S * rate
    radius = int(np.ceil(4 * sd))
    kernel = np.exp(-0.5 * (np.arange(-radius, radius + 1) / sd) ** 2)
    kernel /= kernel.sum()
    if is_loop:
        longer = np.column_stack(path.continue_path(radius))
    else:
        longer = np.pad(np.column_stack(path), ((radius, radius), (0, 0)), mode="reflect", reflect_type="odd")
    x, y, z, yaw = (np.convolve(column, kernel, "valid") for column in longer.T)
    return FloorPath(np.column_stack([x, y, z]), yaw)


def carry_path(character: Character, motion: CharacterMotion, root_motion: str, *, is_loop: bool = False) -> CharacterMotion:
    """Return a motion whose path is carried by the root bone, or left out.

    Args:
        character: The character, of `prepare_root_bone`.
        motion: Its motion, in which the bones above the pelvis keep the rest pose.
        root_motion: "bone", "in-place" or "hips", which changes nothing.
        is_loop: Whether the last frame leads into the first.
    """
    if root_motion not in (ROOT_BONE, ROOT_IN_PLACE):
        return motion
    path = smooth_floor_path(measure_floor_path(character, motion), motion.rate, is_loop=is_loop)
    root, pelvis = find_root_bone(character), character.mapping.bones["pelvis"][0]
    positions, rotations = compute_character_poses(character, motion)
    rest_positions, rest_rotations = character.skeleton.compute_rest_pose()
    base = rest_positions[root] if root >= 0 else np.zeros(3)
    # the turn about the root bone that moves it, and all that hangs at it, from the rest pose to the path
    turns, place = path.rotations, path.position + base * [0.0, 1.0, 0.0]
    standing = np.einsum("tba,tb->ta", turns, positions[:, pelvis] - place) + base
    local_rotations = motion.local_rotations.copy()
    above = int(character.skeleton.parents[pelvis])
    axes, origin = (rest_rotations[above], rest_positions[above]) if above >= 0 else (np.eye(3), np.zeros(3))
    local_rotations[:, pelvis] = axes.T @ turns.swapaxes(1, 2) @ rotations[:, pelvis]
    moved: dict[int, Float[np.ndarray, "T 3"]] = {}
    if root_motion == ROOT_BONE:
        parent = int(character.skeleton.parents[root])
        parent_axes, start = (rest_rotations[parent], rest_positions[parent]) if parent >= 0 else (np.eye(3), np.zeros(3))
        local_rotations[:, root] = parent_axes.T @ turns @ rest_rotations[root]
        moved[root] = (place - start) @ parent_axes
    return replace(motion, pelvis_position=(standing - origin) @ axes, local_rotations=local_rotations, positions=moved)


def find_root_bone(character: Character) -> int:
    """Return the highest joint above the pelvis that is near the floor, -1 if there is none."""
    joints, bone = list_source_joints(character), character.mapping.bones["pelvis"][0]
    heights = character.skeleton.rest_positions[:, 1]
    limit, found = MAX_ROOT_HEIGHT_SHARE * heights[bone], -1
    while (bone := int(character.skeleton.parents[bone])) >= 0:
        if abs(heights[bone]) <= limit and (not joints or bone in joints):
            found = bone
    return found


def list_source_joints(character: Character) -> set[int]:
    """Return the bones that are joints of a skin, none for a character without a glTF."""
    if (file := open_gltf(character)) is None:
        return set()
    content, _, bone_of = file
    joints = {joint for skin in content.document.get("skins", []) for joint in skin["joints"]}
    return {bone for node, bone in bone_of.items() if node in joints}


def prepare_root_bone(character: Character) -> Character:
    """Return the character with a root bone: itself if it has one, otherwise with a new one above the pelvis."""
    if find_root_bone(character) >= 0:
        return character
    skeleton, pelvis = character.skeleton, character.mapping.bones["pelvis"][0]
    name = next((each for each in ROOT_NAMES if each not in skeleton.names), f"root of {character.name}")
    above = int(skeleton.parents[pelvis])
    root = Skeleton((name,), np.array([above]), np.zeros((1, 3)), np.full((1, 3), np.nan))
    _, *pairs = zip(vars(skeleton).values(), vars(root).values(), strict=True)  # of all arrays
    scale = character.scales[above] if above >= 0 else character.root_scale
    extended = replace(
        character,
        skeleton=Skeleton((*skeleton.names, name), *(np.concatenate(pair) for pair in pairs)),
        scales=np.append(character.scales, scale),
        source=_add_root_node(character, name),
    )
    return reparent_bones(extended, {pelvis: len(skeleton.names)})


def _add_root_node(character: Character, name: str) -> CharacterSource | None:
    """Return the file of a character with a node between the pelvis and what is above it, as the last node and joint."""
    source, pelvis = character.source, character.mapping.bones["pelvis"][0]
    if source is None or source.kind != "gltf":
        return source
    content = parse_glb(Path(source.path), source.data)
    buffer, node = GltfBuffer(content.document, content.binary), int(source.nodes[pelvis])
    nodes: list[dict[str, Any]] = content.document["nodes"]
    for entry in [*nodes, *content.document.get("scenes", [])]:
        for key in ("children", "nodes"):
            if node in entry.get(key, ()):
                entry[key] = [len(nodes) if each == node else each for each in entry[key]]
    nodes.append({"name": name, "children": [node]})
    for skin in content.document.get("skins", []):
        if node in skin["joints"]:
            _add_root_joint(buffer, content, skin, node)
    data = build_glb(GlbContent(content.document, buffer.finish(), content.other_chunks))
    return replace(source, data=data, nodes=np.append(source.nodes, len(nodes) - 1))


def _add_root_joint(buffer: GltfBuffer, content: GlbContent, skin: dict[str, Any], pelvis: int) -> None:
    """Make the last node the last joint of a skin. Its inverse bind matrix is where the mesh has the pelvis, seen from it."""
    nodes = content.document["nodes"]
    if "inverseBindMatrices" in skin:
        try:
            inverse_bind = read_array(content, skin["inverseBindMatrices"]).reshape(-1, 4, 4).swapaxes(1, 2)
        except UNREADABLE:  # compressed: the node moves the character without being a joint
            return
        matrices = compute_node_matrices(content, read_gltf_nodes(Path(), content.document))[0]
        added = np.linalg.inv(matrices[-1]) @ matrices[pelvis] @ inverse_bind[skin["joints"].index(pelvis)]
        matrices = np.concatenate([inverse_bind[: len(skin["joints"])], added[None]])
        skin["inverseBindMatrices"] = buffer.add_array(matrices.swapaxes(1, 2).reshape(-1, 16), "MAT4")
    skin["joints"] = [*skin["joints"], len(nodes) - 1]
    if skin.get("skeleton") == pelvis:
        skin["skeleton"] = len(nodes) - 1
