"""Retarget a motion: pose a character like another one.

segments = compute_segment_motion(...)      the source's body segments
rotation = spread_rotations(...)            the same segments of the target, its spine and neck bent alike
kept     = compute_kept_positions(...)      targets of pelvis and feet, scaled by the legs
ankles   = hold_kept_feet(...)              the same of feet in contact, if these are locked
hands    = compute_hand_targets(...)        targets of the hands
poses    = solve_segments(...)              under terms for all of these
motion   = compose_character_motion(...)    bones with their shares of the twist

The shares of a limb's twist that its bones take, so that the skin does not wring at one joint.

An upper arm or thigh twists relative to the bone before it: near that bone its parts take little of the twist, at the far end
all. A forearm or shin twists with the hand or foot: near the elbow or knee its parts take none of the hand's twist, near the
wrist most.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from mocapfix.characters.body_frames import (
    LIMB_DIRECTIONS,
    OUTER_BONE_SEGMENTS,
    BodyFrame,
    SegmentMotion,
    build_body_frame,
    compute_segment_motion,
    keep_chain_direction,
    resample_chain,
)
from mocapfix.characters.character import LIMB_ENDS, SIDES, Character, CharacterMotion
from mocapfix.characters.kept_positions import (
    compute_hand_targets,
    compute_kept_positions,
    hold_kept_feet,
    keep_feet_within_reach,
    level_feet,
    measure_flat_feet,
    move_hands_out_of_thighs,
    resample_foot_contacts,
)
from mocapfix.characters.pose_segments import (
    SegmentTargets,
    SolveTree,
    build_solve_tree,
    compute_rotations_to_parents,
    solve_segments,
)
from mocapfix.contacts.contacts import BodyContacts
from mocapfix.options import FEET_LOCK
from mocapfix.solve.kinematics import Poses, compute_tree_poses

LEG_AXIS = np.array([0.0, 1.0, 0.0])
NEIGHBOUR_SEGMENTS = {"upper_arm": "clavicle", "thigh": "pelvis", "forearm": "hand", "shin": "foot"}
"""The segment relative to which each limb segment twists."""


def compute_twisted_bones(
    frame: BodyFrame, rotation: dict[str, Float[np.ndarray, "T 3 3"]]
) -> dict[int, Float[np.ndarray, "T 3 3"]]:
    """Return the world rotations (T, 3, 3) of the bones that share a twist, by bone.

    rotation  segment to S (T, 3, 3)
    """
    mapping = frame.character.mapping
    twisted: dict[int, Float[np.ndarray, "T 3 3"]] = {}
    for side in SIDES:
        for segment, neighbour in NEIGHBOUR_SEGMENTS.items():
            name, other = f"{side}_{segment}", neighbour if neighbour == "pelvis" else f"{side}_{neighbour}"
            chain, beside = mapping.bones.get(name, ()), mapping.twists.get(name, ())
            if len(chain) + len(beside) < 2 or other not in rotation:
                continue
            axis = LIMB_DIRECTIONS[side] if segment in ("upper_arm", "forearm") else LEG_AXIS
            is_outer = segment in OUTER_BONE_SEGMENTS
            relative = np.swapaxes(rotation[name], 1, 2) @ rotation[other]  # in the segment's axes
            angle = compute_twist_angle(relative, axis)
            shares = {bone: k / (len(chain) - 1) for k, bone in enumerate(chain)} if len(chain) > 1 else {}
            shares |= {bone: _find_share_along(frame, bone, name, f"{side}_{LIMB_ENDS[segment]}") for bone in beside}
            for bone, share in shares.items():
                turn = (1.0 - share) * angle if is_outer else share * angle
                twisted[bone] = (
                    rotation[name] @ Rotation.from_rotvec(turn[:, None] * axis).as_matrix() @ frame.standard_rotations[bone]
                )
    return twisted


def compute_twist_angle(rotation: Float[np.ndarray, "T 3 3"], axis: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " T"]:
    """Return the angle in radians of the part of rotations that turns about an axis (swing-twist), without jumps by a turn.

    The median over the frames is within half a turn, so that a limb is not twisted the long way round for a whole take.
    """
    quaternion = Rotation.from_matrix(rotation).as_quat(canonical=True)  # the scalar part is not negative
    angle = np.unwrap(2.0 * np.arctan2(quaternion[:, :3] @ axis, quaternion[:, 3]))
    return angle - 2 * np.pi * np.round(np.median(angle) / (2 * np.pi)) if len(angle) else angle


def _find_share_along(frame: BodyFrame, bone: int, start: str, end: str) -> float:
    """Return how far along a segment a bone begins, from 0 to 1."""
    if end not in frame.segment_bones:
        return 0.5
    vector = frame.find_head(end) - frame.find_head(start)
    return float(np.clip((frame.rest_position[bone] - frame.find_head(start)) @ vector / (vector @ vector), 0.0, 1.0))


MAX_SEPARATIONS = 3
"""How often hands are moved out of thighs: the arms do not reach a new target at once, since other terms hold them back."""
MIN_SEPARATION_M = 5e-4  # movement of a hand's target below which a frame is not solved again


@dataclass(frozen=True)
class RetargetProblem:
    """What is kept of a source's motion on a target character, and what is needed to solve it.

    source, target  the two bodies
    segments        the source's segments in every frame
    tree            the target's joints
    targets         for `solve_segments`
    """

    source: BodyFrame
    target: BodyFrame
    segments: SegmentMotion
    tree: SolveTree
    targets: SegmentTargets

    @property
    def wrists(self) -> dict[str, Float[np.ndarray, "T 3"]]:
        """The targets of the wrists in metres, by side; empty if a body lacks hands."""
        points = self.targets.points
        return {side: points[f"{side}_hand"] for side in SIDES if f"{side}_hand" in points}


def retarget_motion(
    source: Character,
    motion: CharacterMotion,
    target: Character,
    *,
    contacts: BodyContacts | None = None,
) -> CharacterMotion:
    """Return the motion of a target character that moves like the source.

    Both mappings must have all required segments. Places are scaled about the origin by the ratio of the legs' lengths.

    contacts  of the source, at any rate. Their floor comes to height 0, feet that lie flat do so on the target, and if the feet
              of the source were locked in them, so are the target's. Without contacts the source's floor is at height 0
    """
    problem = build_retarget_problem(source, motion, target, contacts=contacts)
    problem, (pelvis, local) = solve_retarget_problem(problem)
    return compose_character_motion(problem.target, problem.tree, pelvis, local, motion.rate)


def build_retarget_problem(
    source: Character,
    motion: CharacterMotion,
    target: Character,
    *,
    contacts: BodyContacts | None = None,
) -> RetargetProblem:
    """Return what is kept of the motion; arguments as for `retarget_motion`."""
    source_frame, target_frame = build_body_frame(source), build_body_frame(target)
    segments, tree = compute_segment_motion(source_frame, motion), build_solve_tree(target_frame)
    feet_contacts = resample_foot_contacts(contacts, motion.frame_count, motion.rate) if contacts is not None else None
    flat_feet = measure_flat_feet(source_frame, segments, feet_contacts)
    floor_height_m = contacts.floor.height_m if contacts is not None else 0.0
    kept = compute_kept_positions(source_frame, target_frame, segments, flat_feet, floor_height_m)
    segments = level_feet(segments, flat_feet)
    rotation = spread_rotations(source_frame, target_frame, tree, segments)
    kept = keep_feet_within_reach(target_frame, kept, segments.rotation["pelvis"])
    ankles = kept.ankles
    if feet_contacts is not None and feet_contacts.held_feet.mode == FEET_LOCK:
        feet = {side: segments.rotation[f"{side}_foot"] for side in SIDES}
        ankles, feet = hold_kept_feet(target_frame, ankles, feet, feet_contacts)
        for side, foot in feet.items():
            joint = tree.find_joint(f"{side}_foot")
            rotation[:, joint] = foot @ tree.standard_rotations[joint]
    points = {f"{side}_foot": ankle for side, ankle in ankles.items()}
    if source_frame.has_hands and target_frame.has_hands:
        start = compute_tree_poses(tree.tree, kept.pelvis, compute_rotations_to_parents(tree, rotation))[0]
        hands = compute_hand_targets(source_frame, target_frame, segments, name_positions(tree, start))
        points |= {f"{side}_hand": wrist for side, wrist in hands.items()}
    return RetargetProblem(source_frame, target_frame, segments, tree, SegmentTargets(rotation, kept.pelvis, points))


def solve_retarget_problem(problem: RetargetProblem) -> tuple[RetargetProblem, Poses]:
    """Return the solved poses, and the problem with the targets of hands that were moved.

    Frames in which a palm is nearer to a thigh than in the source are solved again, with targets farther from it.
    """
    tree, targets, wrists = problem.tree, problem.targets, problem.wrists
    pelvis, local = solve_segments(tree, problem.target.character, targets)
    for _ in range(MAX_SEPARATIONS if wrists else 0):
        position = name_positions(tree, compute_tree_poses(tree.tree, pelvis, local)[0])
        moved = move_hands_out_of_thighs(problem.source, problem.target, problem.segments, position, wrists)
        is_moved = np.any([np.abs(moved[side] - wrists[side]).max(1) > MIN_SEPARATION_M for side in SIDES], axis=0)
        if not is_moved.any():
            break
        wrists = moved
        targets = targets.replace_points({f"{side}_hand": wrist for side, wrist in wrists.items()})
        pelvis[is_moved], local[is_moved] = solve_segments(tree, problem.target.character, targets.select_frames(is_moved))
    return replace(problem, targets=targets), (pelvis, local)


def spread_rotations(
    source: BodyFrame, target: BodyFrame, tree: SolveTree, segments: SegmentMotion
) -> Float[np.ndarray, "T N 3 3"]:
    """Return the world rotations of the bones of a target's solve tree that have the source's segments' rotations."""
    counts = {chain: len(target.character.mapping.bones.get(chain, ())) for chain in ("spine", "neck")}
    spine, neck = resample_chain(segments.spine, counts["spine"] + 1), resample_chain(segments.neck, counts["neck"] + 2)
    if spine.shape != segments.spine.shape:
        offsets, source_offsets = target.compute_chain_offsets("spine"), source.compute_chain_offsets("spine")
        spine[:, 1:-1] = keep_chain_direction(source_offsets, segments.spine[:, 1:-1], offsets, spine[:, 1:-1])
    if neck.shape != segments.neck.shape:
        offsets, source_offsets = target.compute_chain_offsets("neck", "head"), source.compute_chain_offsets("neck", "head")
        neck[:, 1:-1] = keep_chain_direction(source_offsets, segments.neck[:, 1:-1], offsets, neck[:, 1:-1])
    rotations: list[Float[np.ndarray, "T 3 3"]] = []
    for segment, standard in zip(tree.segments, tree.standard_rotations, strict=True):
        name, _, number = segment.partition(".")
        chain = {"spine": spine, "neck": neck}.get(name)
        rotations.append((segments.rotation[name] if chain is None else chain[:, int(number) + 1]) @ standard)
    return np.ascontiguousarray(np.stack(rotations, axis=1))


def name_positions(tree: SolveTree, position: Float[np.ndarray, "T N 3"]) -> dict[str, Float[np.ndarray, "T 3"]]:
    """Return the positions of the joints of a solve tree by segment; spine and neck are where their first bone begins."""
    positions = {segment: position[:, k] for k, segment in enumerate(tree.segments)}
    for chain in ("spine", "neck"):
        if f"{chain}.0" in positions:
            positions[chain] = positions[f"{chain}.0"]
    return positions


def compose_character_motion(
    frame: BodyFrame, tree: SolveTree, pelvis: Float[np.ndarray, "T 3"], local: Float[np.ndarray, "T N 3 3"], rate: float
) -> CharacterMotion:
    """Return the motion of all bones of a character, from the solved joints.

    pelvis  (T, 3) m: in the world
    local   (T, N, 3, 3): relative to the tree's parents
    """
    character = frame.character
    _, world = compute_tree_poses(tree.tree, pelvis, local)
    rotation = {
        segment: world[:, k] @ tree.standard_rotations[k].T for k, segment in enumerate(tree.segments) if "." not in segment
    }
    chest = [k for k, segment in enumerate(tree.segments) if segment.startswith("spine.")]
    for side in SIDES:
        rotation.setdefault(
            f"{side}_clavicle", world[:, chest[-1]] @ tree.standard_rotations[chest[-1]].T if chest else rotation["pelvis"]
        )
    placed = {int(bone): world[:, k] for k, bone in enumerate(tree.bones)} | compute_twisted_bones(frame, rotation)
    rotations, above = build_local_rotations(character, placed, len(pelvis))
    pelvis_bone = character.mapping.bones["pelvis"][0]
    parent = int(character.parents[pelvis_bone])
    position = pelvis
    if parent >= 0:
        position = np.einsum("tji,tj->ti", above[parent], pelvis - frame.rest_position[parent])
    return CharacterMotion(position, rotations, rate)


def build_local_rotations(
    character: Character, placed: dict[int, Float[np.ndarray, "T 3 3"]], frame_count: int
) -> tuple[Float[np.ndarray, "T J 3 3"], dict[int, Float[np.ndarray, "T 3 3"]]]:
    """Return the local rotations of all bones, of which some are placed in the world, and the world rotations of parents.

    Bones that are not placed keep their rest rotation relative to their parents.
    """
    local = np.tile(character.rest_rotations, (frame_count, 1, 1, 1))
    is_parent = np.isin(np.arange(len(character.names)), character.parents)
    world: dict[int, Float[np.ndarray, "T 3 3"]] = {}
    for bone, parent in enumerate(character.parents.tolist()):
        if bone in placed:
            world[bone] = placed[bone]
            local[:, bone] = np.swapaxes(world[parent], 1, 2) @ world[bone] if parent >= 0 else world[bone]
        elif is_parent[bone]:
            world[bone] = world[parent] @ local[:, bone] if parent >= 0 else local[:, bone]
    return local, world
