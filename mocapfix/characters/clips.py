"""The clip of a motion that is delivered: which frames, how they are closed to a loop, and the root motion that carries its path.

From one cycle of a loop, whose last frame leads into the first, to the next the body moves on over the floor and turns: a step
that is no fault of a walk. Relative to that step the last frame becomes the pose of the first. Half of the difference is added at
the beginning of the motion, half taken away at its end, and both fade within BLEND_S: of the rotations of the bones, of the place
of the pelvis, and of their speeds, by polynomials of the fifth degree without steps in speed or acceleration. Feet keep their
contacts: a foot that stands at the beginning or the end is moved as a whole, for as long as it stands, and the difference fades
while it swings. Thigh and shin follow by the closed form of two bones, in the plane in which the knee bends.

Engines move a character by a bone on the floor, and the pelvis relative to it. The path is the place of the pelvis on the floor,
the heading the turn of the pelvis about the vertical, compared with the rest pose (the twist of its rotation, which a body that
lies or bends has too). Both are smoothed by a Gaussian of SMOOTHING_S: a pelvis sways with every stride, at about 1 Hz, and what
is left of that is 1 degree in walks. At the ends of a motion the path goes on as it came, so that the root is under the pelvis
there; the path of a loop goes on as the loop does.

A root bone that the character has is used: the highest joint above the pelvis that is near the floor. Otherwise one is added
above the pelvis, in a glTF as a joint of its skins that moves no corner of the mesh. What hangs at a root bone beside the body,
such as control bones, goes with it.
"""

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from mocapfix.characters.character import (
    SIDES,
    Character,
    CharacterMotion,
    CharacterSource,
    compute_character_poses,
    reparent_bones,
)
from mocapfix.characters.read_gltf import open_gltf
from mocapfix.io.gltf import GlbContent, GltfBuffer, build_glb, parse_glb, read_gltf_nodes
from mocapfix.io.gltf_mesh import UNREADABLE, compute_node_matrices, read_array
from mocapfix.model.motion import FRAME_TOLERANCE
from mocapfix.model.skeleton import Skeleton
from mocapfix.model.take import Take
from mocapfix.options import ROOT_BONE, ROOT_IN_PLACE
from mocapfix.solve.kinematics import LegPath
from mocapfix.stats.sequences import find_runs

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


BLEND_S = 0.4  # time in which the difference at the seam fades: about one swing of a foot
MAX_STANDING_TRAVEL_M = 0.2  # way of the pelvis from the first to the last frame up to which a body returns: under half a step
MAX_STANDING_TURN_RAD = np.deg2rad(20.0)  # the same of its heading
MIN_LOOP_FRAMES = 5
SPEED_SHARES = {(False, False): (0.5, 0.5), (True, False): (0.0, 1.0), (False, True): (1.0, 0.0), (True, True): (0.0, 0.0)}
"""How much of a difference of a foot's speeds is taken at the beginning and at the end, by whether the foot stands there."""
MIN_RESERVE_M = 1e-4  # length by which a leg is shorter than its bones, at least
SHORT_SWING_SHARE = 0.4  # of BLEND_S: a foot that swings for less than 0.16 s is held


def find_trimmed_frames(trim: tuple[int, int] | None, take: Take, rate: float) -> slice:
    """Return the frames of a motion at a rate that lie within the first and the last frame of a range of the take."""
    if trim is None:
        return slice(None)
    first, last = ((frame - take.first_frame) * rate / take.rate for frame in trim)
    return slice(max(math.ceil(first - FRAME_TOLERANCE), 0), max(math.floor(last + FRAME_TOLERANCE) + 1, 0))


def close_loop(
    character: Character, motion: CharacterMotion, is_standing: Mapping[str, Bool[np.ndarray, " T"]]
) -> tuple[CharacterMotion, str]:
    """Return a motion closed to a loop, and a sentence on its seam.

    Args:
        motion: Of T frames, in which the bones above the pelvis keep the rest pose.
        is_standing: When each foot is in contact, by side.
    """
    if motion.frame_count < MIN_LOOP_FRAMES:
        return motion, f"A loop has at least {MIN_LOOP_FRAMES} frames, and the motion {motion.frame_count}: it is left as it is."
    floor_path = measure_floor_path(character, motion)
    step, start = floor_path.measure_step(), floor_path.position[0]
    returns = np.linalg.norm(floor_path.position[-1] - start) < MAX_STANDING_TRAVEL_M
    if returns and abs(np.sin(step.yaw_rad / 2)) < np.sin(MAX_STANDING_TURN_RAD / 2):
        step = CycleStep(0.0, np.zeros(3))  # its place is the same
    blended = _blend_poses(character, motion, step)
    closed = _place_feet(character, motion, blended, step, is_standing)
    before, after = (_describe_seam(character, each, step) for each in (motion, closed))
    duration_s, travel_m = (motion.frame_count - 1) / motion.rate, np.linalg.norm(start - step.undo(start))
    path = f"A cycle travels {travel_m:.2f} m and turns by {np.rad2deg(step.yaw_rad):.0f} degrees."
    return closed, f"Loop of {duration_s:.2f} s: its ends differed by {before}, now by {after}. {path}"


MIN_STRIDE_S, MAX_END_SHIFT_S = 0.5, 0.7  # time of a stride; a whole one ends at most so long before or after another frame
SPEED_TIME_S = 0.1  # time by which speeds count beside poses
MAX_DIFFERENCE_RATIO = 0.7  # of a whole stride's ends to those of another clip: 0.2 to 0.5 where these are 0.1 s apart


def name_whole_stride(character: Character, motion: CharacterMotion, frames: slice) -> str:
    """Return a sentence on the frame near the last of some frames of a motion that is more like the first, "" if none is."""
    first, stop, _ = frames.indices(motion.frame_count)
    bones = {bone for chain in character.mapping.bones.values() for bone in chain} - {character.mapping.bones["pelvis"][0]}
    poses = motion.local_rotations[:, sorted(bones)]
    reach, earliest = round(MAX_END_SHIFT_S * motion.rate), first + max(round(MIN_STRIDE_S * motion.rate), 1)
    ends = np.arange(max(earliest, stop - 1 - reach), min(stop + reach, motion.frame_count))
    if not len(ends):
        return ""
    speeds = SPEED_TIME_S * motion.rate * np.gradient(poses, axis=0)
    difference = np.hypot(*(np.linalg.norm((each - each[first]).reshape(len(each), -1), axis=1) for each in (poses, speeds)))
    shift = int(ends[difference[ends].argmin()]) - (stop - 1)
    if difference[stop - 1 + shift] >= MAX_DIFFERENCE_RATIO * difference[stop - 1]:
        return ""
    when = f"{abs(shift) / motion.rate:.2f} s ({abs(shift)} frames) {'later' if shift > 0 else 'earlier'}"
    return (
        f"The last frame is less like the first than the one {when}, where a whole stride may end; move the end of --trim there."
    )


def _describe_seam(character: Character, motion: CharacterMotion, step: CycleStep) -> str:
    """Return the largest differences of the body's bones between the last frame and the first, as part of a sentence."""
    bones = sorted({bone for chain in character.mapping.bones.values() for bone in chain})
    positions, rotations = (each[:, bones] for each in compute_character_poses(character, motion))
    place_mm = 1e3 * np.linalg.norm(step.undo(positions[-1]) - positions[0], axis=1).max()
    turn_deg = np.rad2deg(np.linalg.norm(_compute_vectors(rotations[0], step.rotation.T @ rotations[-1]), axis=1).max())
    speed = np.linalg.norm(_compute_speed_gap(positions, step, motion.rate), axis=1).max()
    return f"{place_mm:.1f} mm, {turn_deg:.1f} degrees and {speed:.2f} m/s"


def _compute_speed_gap(positions: Float[np.ndarray, "T *n 3"], step: CycleStep, rate: float) -> Float[np.ndarray, "*n 3"]:
    """Return the velocity in m/s at the end less that at the beginning, as seen in the first cycle."""
    return rate * ((positions[-1] - positions[-2]) @ step.rotation - (positions[1] - positions[0]))


class Fade(NamedTuple):
    """How a correction fades: weights of a difference of places and of one of speeds, over T frames."""

    place: Float[np.ndarray, " T"]  # from 1 at the seam to 0
    speed_s: Float[np.ndarray, " T"]  # 0 at the seam, where it rises by the share of the speed per second, and 0 later

    @staticmethod
    def build(frame_count: int, rate: float, lasts: "FadeFrames", speed_share: float) -> "Fade":
        """Return a fade.

        Args:
            lasts: How long.
            speed_share: How much of the difference of speeds is taken at this side of the seam.
        """
        s, u = (np.clip(each, 0.0, 1.0) for each in (
            (np.arange(frame_count) - lasts.held) / lasts.fading, np.arange(frame_count) / lasts.speed_fading,
        ))  # fmt: skip
        place = 1.0 - s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
        speed = u - 6.0 * u**3 + 8.0 * u**4 - 3.0 * u**5
        return Fade(place, speed_share * lasts.speed_fading / rate * speed)


class FadeFrames(NamedTuple):
    """How many frames a correction lasts."""

    held: int  # in which the difference of places is corrected in full
    fading: int  # in which that fades then
    speed_fading: int  # in which the difference of speeds fades, from the seam on


def _close(
    fades: tuple[Fade, Fade], gap: Float[np.ndarray, "*n 3"], speed_gap: Float[np.ndarray, "*n 3"]
) -> tuple[Float[np.ndarray, "T *n 3"], Float[np.ndarray, "T *n 3"]]:
    """Return what is added at the beginning and at the end, from the fades of both and the differences end less beginning."""
    start, end = (np.multiply.outer(each.place, 0.5 * gap) for each in fades)
    start_speed, end_speed = (np.multiply.outer(each.speed_s, speed_gap) for each in fades)
    return start + start_speed, (end_speed - end)[::-1]


def _close_places(
    place: Float[np.ndarray, "T 3"], step: CycleStep, fades: tuple[Fade, Fade], rate: float
) -> Float[np.ndarray, "T 3"]:
    start, end = _close(fades, step.undo(place[-1]) - place[0], _compute_speed_gap(place, step, rate))
    return place + start + end @ step.rotation.T


def _close_rotations(
    rotations: Float[np.ndarray, "T n 3 3"], turns: Float[np.ndarray, "n 3 3"], fades: tuple[Fade, Fade], rate: float
) -> Float[np.ndarray, "T n 3 3"]:
    """Return rotations closed; the last of them, turned by `turns`, become the first."""
    gap = _compute_vectors(rotations[0], turns @ rotations[-1])
    speed_gap = rate * (_compute_vectors(rotations[-2], rotations[-1]) - _compute_vectors(rotations[0], rotations[1]))
    turn = np.sum(_close(fades, gap, speed_gap), axis=0)
    return rotations @ Rotation.from_rotvec(turn.reshape(-1, 3)).as_matrix().reshape(rotations.shape)


def _blend_poses(character: Character, motion: CharacterMotion, step: CycleStep) -> CharacterMotion:
    """Return the motion with the differences of all rotations and of the pelvis at the seam taken out."""
    count, rate, pelvis = motion.frame_count, motion.rate, character.mapping.bones["pelvis"][0]
    fade = Fade.build(count, rate, _find_fade(np.zeros(count, bool), rate), 0.5)
    positions, rotations = compute_character_poses(character, motion)
    local, turns = motion.local_rotations.copy(), np.tile(np.eye(3), (rotations.shape[1], 1, 1))
    local[:, pelvis], turns[pelvis] = rotations[:, pelvis], step.rotation.T
    local = _close_rotations(local, turns, (fade, fade), rate)
    place = _close_places(positions[:, pelvis], step, (fade, fade), rate)
    above = int(character.skeleton.parents[pelvis])
    if above >= 0:
        local[:, pelvis] = rotations[:, above].swapaxes(1, 2) @ local[:, pelvis]
        place = np.einsum("tba,tb->ta", rotations[:, above], place - positions[:, above])
    return replace(motion, pelvis_position=place, local_rotations=local)


def _compute_vectors(one: Float[np.ndarray, "*n 3 3"], other: Float[np.ndarray, "*n 3 3"]) -> Float[np.ndarray, "*n 3"]:
    """Return the rotation vectors from one rotation to another, in the axes of the first."""
    turns = one.swapaxes(-1, -2) @ other
    return Rotation.from_matrix(turns.reshape(-1, 3, 3)).as_rotvec().reshape(turns.shape[:-1])


def _place_feet(
    character: Character,
    motion: CharacterMotion,
    blended: CharacterMotion,
    step: CycleStep,
    is_standing: Mapping[str, Bool[np.ndarray, " T"]],
) -> CharacterMotion:
    """Return the blended motion with the feet of the motion, moved as a whole while they stand at the seam."""
    count, rate, bones, parents = motion.frame_count, motion.rate, character.mapping.bones, character.skeleton.parents
    positions, rotations = compute_character_poses(character, motion)
    blended_positions, blended_rotations = compute_character_poses(character, blended)
    local = blended.local_rotations.copy()
    for side in SIDES:
        thigh, shin, foot = (bones[f"{side}_{segment}"][0] for segment in ("thigh", "shin", "foot"))
        place, axes, stands = positions[:, foot], rotations[:, [foot]], is_standing[side]
        shares = SPEED_SHARES[bool(stands[0]), bool(stands[-1])]
        fades = (
            Fade.build(count, rate, _find_fade(stands, rate), shares[0]),
            Fade.build(count, rate, _find_fade(stands[::-1], rate), shares[1]),
        )
        target = _close_places(place, step, fades, rate)
        turned = _close_rotations(axes, step.rotation.T[None], fades, rate)[:, 0]
        leg = LegPath.build(blended_positions[:, [thigh, shin, foot]], blended_rotations[:, thigh])
        # the ankle is as far from the hip as the target needs, less where the leg would be too straight
        distance, longest = np.linalg.norm(leg.ankle - leg.hip, axis=1), np.sum(leg.lengths_m, axis=0)
        longer, reserve = np.linalg.norm(target - leg.hip, axis=1) - distance, np.maximum(longest - distance, MIN_RESERVE_M)
        reach = distance + np.where(longer > 0, -reserve * np.expm1(-np.maximum(longer, 0.0) / reserve), longer)
        _, thigh_turn, shin_turn = leg.pose(leg.hip, target, reach)
        above_thigh, above_shin, above_foot = (blended_rotations[:, parents[bone]] for bone in (thigh, shin, foot))
        local[:, thigh] = above_thigh.swapaxes(1, 2) @ thigh_turn @ blended_rotations[:, thigh]
        local[:, shin] = (thigh_turn @ above_shin).swapaxes(1, 2) @ shin_turn @ blended_rotations[:, shin]
        local[:, foot] = (shin_turn @ above_foot).swapaxes(1, 2) @ turned
    return replace(blended, local_rotations=local)


def _find_fade(stands: Bool[np.ndarray, " T"], rate: float) -> FadeFrames:
    """Return how long the difference of a foot lasts from the seam on.

    It is held while the foot stands. A foot that soon stands, or soon stands again, keeps it too: in a short swing it would move
    too fast.
    """
    last_frame = len(stands) - 1
    duration = max(min(round(BLEND_S * rate), last_frame // 2), 1)  # it is gone in the middle of the motion
    held, following = 0, last_frame
    for first, last in find_runs(stands):
        if first - held > SHORT_SWING_SHARE * duration:
            following = first
            break
        held = last
    if last_frame - held < SHORT_SWING_SHARE * duration:  # it stands all the time: the difference fades all the time
        return FadeFrames(0, last_frame, duration)
    swing = int(np.argmax(stands)) or duration
    return FadeFrames(held, min(duration, following - held), min(duration, swing))
