"""Retarget a motion: pose a character like another one.

    segments = compute_segment_motion(...)      the source's body segments
    rotation = spread_rotations(...)            the same segments of the target, its spine and neck bent alike
    kept     = compute_kept_positions(...)      targets of pelvis and feet, scaled by the legs
    kept     = rest_feet(...)                   feet that tilt less in contacts
    ankles   = hold_kept_feet(...)              the same of feet in contact, if these are locked
    kept     = fit_legs(...)                    pelvis and feet displaced over the whole motion, so that knees bend alike
    hands    = fit_arms(...)                    targets of the hands, likewise
    poses    = solve_segments(...)              under terms for all of these
    motion   = compose_character_motion(...)    bones with their shares of the twist

The terms of the solve are orientations of pelvis, chest, head, hands and feet; directions of thighs, shins, upper arms and
forearms, and the planes in which limbs bend; ankles, wrists and pelvis at their targets; the other rotations; and the joint
limits of the character. Their weights are the same in all frames, and the targets are smooth, so that no joint jumps. The solved
tree has a joint for each segment, or for each bone of spine and neck.

An upper arm or thigh twists relative to the bone before it: near that bone its parts take little of the twist, at the far end
all. A forearm or shin twists with the hand or foot: near the elbow or knee its parts take none of the hand's twist, near the
wrist most. So the skin does not wring at one joint.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from mocapfix.characters import kept_positions
from mocapfix.characters.alignment import SkeletonAlignment
from mocapfix.characters.body_frames import (
    CHAIN_SEGMENTS,
    LIMB_AXES,
    OUTER_BONE_SEGMENTS,
    BodyFrame,
    SegmentMotion,
    build_body_frame,
    compute_segment_motion,
    fit_chain,
    list_fingers,
    measure_hand_poses,
    pose_fingers,
)
from mocapfix.characters.character import LIMB_ENDS, SIDES, Character, CharacterMotion, compute_character_poses
from mocapfix.characters.fingers import HandPoses
from mocapfix.characters.kept_positions import Points, Rotations
from mocapfix.characters.limb_fit import compute_pushes, fit_arms, fit_legs
from mocapfix.contacts.contacts import NO_FLOOR, BodyContacts, Floor
from mocapfix.model.skeleton import UNLIMITED_RAD, Skeleton, compute_local_rotations, find_ancestor
from mocapfix.options import FEET_LOCK
from mocapfix.solve.kinematics import Poses, compute_tree_poses
from mocapfix.solve.minimise import SolverSettings, minimise
from mocapfix.solve.terms import (
    JOINT_LIMIT_SD_RAD,
    DirectionTerm,
    JointLimitTerm,
    KinematicTree,
    OrientationTerm,
    PointTerm,
    TrackingTerm,
)
from mocapfix.stats.rigid_alignment import find_nearest_points

JointRotations = Float[np.ndarray, "T N 3 3"]
FIXED_SEGMENTS = ("neck", "toe")  # segments that keep their rotation relative to their parent


@dataclass(frozen=True)
class SolveTree:
    """N joints of a character, the pelvis first."""

    skeleton: Skeleton  # the joints have the names of their segments, of spine and neck with the number of the bone: spine.0
    bones: Int[np.ndarray, " N"]  # the bone that has each joint's rotation
    free: Bool[np.ndarray, " N"]  # the joints that the solver turns
    standard_rotations: Float[np.ndarray, "N 3 3"]  # C of `BodyFrame`
    leg_length_m: float

    @property
    def kernel_tree(self) -> KinematicTree:
        """The joints as the kernels take them."""
        return KinematicTree(self.skeleton.parents, self.skeleton.offsets, self.free)

    @property
    def chest(self) -> int:
        """The index of the outermost joint of the spine, -1 without a spine."""
        return max((k for k, segment in enumerate(self.skeleton.names) if segment.startswith("spine.")), default=-1)

    def find_joint(self, segment: str) -> int:
        """Return the index of a segment's joint, -1 if the character lacks it."""
        return self.skeleton.names.index(segment) if segment in self.skeleton.names else -1


def build_solve_tree(frame: BodyFrame) -> SolveTree:
    """Return the tree of a character's segments.

    Limits of the bones of an upper arm or thigh that share its twist are for their shares, so they do not apply to its joint. The
    first bone of a forearm or shin takes no share.
    """
    skeleton, mapping = frame.character.skeleton, frame.character.mapping
    joints: list[tuple[str, tuple[int, ...], int]] = []  # segment, bones, and the bone that has the rotation
    for segment, chain in mapping.bones.items():
        if segment in CHAIN_SEGMENTS:
            joints += [(f"{segment}.{k}", (bone,), bone) for k, bone in enumerate(chain)]
        elif chain:
            joints.append((segment, chain, frame.segment_bones[segment]))
    joints.sort(key=lambda joint: (joint[0] != "pelvis", joint[1][0]))  # bones come after their parents
    joint_of_bone = np.full(len(skeleton.names), -1)
    for k, (_, chain, _) in enumerate(joints):
        joint_of_bone[list(chain)] = k
    parents, offsets = np.full(len(joints), -1), np.zeros((len(joints), 3))
    for k, (_, chain, _) in list(enumerate(joints))[1:]:
        if (above := find_ancestor(chain[0], skeleton.parents, joint_of_bone >= 0)) >= 0:
            parents[k] = joint_of_bone[above]
            _, parent_chain, parent_bone = joints[parents[k]]
            vector = frame.rest_position[chain[0]] - frame.rest_position[parent_chain[0]]
            offsets[k] = frame.rest_rotation[parent_bone].T @ vector
    segments = tuple(segment for segment, _, _ in joints)
    free = np.array([not segment.partition(".")[0].endswith(FIXED_SEGMENTS) for segment in segments])
    bones = np.array([bone for _, _, bone in joints])
    is_shared = np.array([segment.endswith(OUTER_BONE_SEGMENTS) and len(chain) > 1 for segment, chain, _ in joints])
    solved = Skeleton(
        segments,
        parents,
        offsets,
        ends=np.full(offsets.shape, np.nan),
        rest_rotations=compute_local_rotations(frame.rest_rotation[bones], parents),
        limits_rad=np.where(is_shared[:, None, None], UNLIMITED_RAD, skeleton.limits_rad[bones]),
    )
    standard = np.stack([frame.standard_rotations[bone] for bone in bones.tolist()])
    return SolveTree(solved, bones, free, standard, frame.leg_length_m)


ANKLE_SD, WRIST_SD, PELVIS_SD = 0.0004, 0.0077, 0.005
"""Standard deviations of positions about their targets, in lengths of the leg, that of the wrist in those of the arm."""
ORIENTATION_SD_RAD = {"pelvis": 0.01, "chest": 0.05, "head": 0.02, "hand": 0.03, "foot": 0.005}
"""Standard deviations of orientations in the world, by segment."""
BONE_DIRECTION_SD_RAD = 0.025
"""Standard deviation of the direction of a limb's bone. It is small: the pelvis moves a little before a straight knee bends, and
shoulders before a straight arm that is pushed folds in a plane that nothing shows."""
TRACKING_SD_RAD = {"spine": 0.03, "clavicle": 0.03}  # standard deviations of rotations relative to the parent, by segment
OTHER_TRACKING_SD_RAD = 0.3
BEND_AXES = {"upper_arm": (0.0, 1.0, 0.0), "forearm": (0.0, 1.0, 0.0), "thigh": (1.0, 0.0, 0.0), "shin": (1.0, 0.0, 0.0)}
"""Axis of a limb's segment about which its elbow or knee bends."""
BEND_AXIS_SD_RAD = 0.2
"""Standard deviation of the direction of such an axis: it keeps the plane in which an elbow or knee bends."""


class SegmentTargets(NamedTuple):
    """What is kept, over T frames."""

    rotation: JointRotations  # of the joints of a `SolveTree`, in the world; also the start of the solve
    pelvis: Points
    points: dict[str, Points]  # segment (feet and hands) to where it shall begin, in metres

    def select_frames(self, is_selected: Bool[np.ndarray, " T"]) -> "SegmentTargets":
        points = {segment: place[is_selected] for segment, place in self.points.items()}
        return SegmentTargets(self.rotation[is_selected], self.pelvis[is_selected], points)


def solve_segments(tree: SolveTree, targets: SegmentTargets) -> Poses:
    """Return positions of the pelvis in metres and local rotations of the joints that reach the targets."""
    local = compute_local_rotations(targets.rotation, tree.skeleton.parents)
    low, high = np.ascontiguousarray(np.moveaxis(tree.skeleton.limits_rad, 2, 0))
    sd = np.array([TRACKING_SD_RAD.get(_get_base_segment(segment), OTHER_TRACKING_SD_RAD) for segment in tree.skeleton.names])
    weight = np.where(np.arange(len(sd)) == 0, 0.0, sd**-2)[None]
    terms = (
        _build_point_term(tree, targets),
        _build_direction_term(tree, targets.rotation),
        _build_orientation_term(tree, targets.rotation),
        TrackingTerm(local, weight, targets.pelvis, np.full(len(targets.pelvis), (PELVIS_SD * tree.leg_length_m) ** -2)),
        JointLimitTerm(tree.skeleton.rest_rotations, low, high, JOINT_LIMIT_SD_RAD**-2),
    )
    return minimise(tree.kernel_tree, terms, (targets.pelvis, local), SolverSettings(max_iterations=30)).poses


def _get_base_segment(segment: str) -> str:
    """Return a segment without its side and number."""
    return segment.removeprefix("left_").removeprefix("right_").partition(".")[0]


def _build_point_term(tree: SolveTree, targets: SegmentTargets) -> PointTerm:
    joints = np.array([tree.find_joint(segment) for segment in targets.points])
    measured = np.ascontiguousarray(np.stack(list(targets.points.values()), axis=1))
    lengths_m = np.linalg.norm(tree.skeleton.offsets[[joints, tree.skeleton.parents[joints]]], axis=2).sum(axis=0)
    sd = lengths_m * np.array([ANKLE_SD if segment.endswith("foot") else WRIST_SD for segment in targets.points])
    return PointTerm(joints, np.zeros((len(joints), 3)), measured, np.tile(sd**-2, (len(measured), 1)))


def _build_direction_term(tree: SolveTree, rotation: JointRotations) -> DirectionTerm:
    directions: list[tuple[int, Float[np.ndarray, " 3"], float]] = []  # joint, unit vector in its axes, standard deviation
    for side in SIDES:
        for start, end in LIMB_ENDS.items():
            joint, tip = tree.find_joint(f"{side}_{start}"), tree.find_joint(f"{side}_{end}")
            length = np.linalg.norm(tree.skeleton.offsets[tip]) if tip >= 0 and tree.skeleton.parents[tip] == joint >= 0 else 0.0
            if length > 0:
                directions.append((joint, tree.skeleton.offsets[tip] / length, BONE_DIRECTION_SD_RAD))
            if joint >= 0:
                directions.append((joint, tree.standard_rotations[joint].T @ BEND_AXES[start], BEND_AXIS_SD_RAD))
    joints, axes, sd = (np.array(each) for each in zip(*directions, strict=True))
    measured = np.ascontiguousarray((rotation[:, joints] @ axes[:, :, None])[..., 0])
    return DirectionTerm(joints, axes, measured, np.tile(sd**-2.0, (len(measured), 1)))


def _build_orientation_term(tree: SolveTree, rotation: JointRotations) -> OrientationTerm:
    sd = {k: ORIENTATION_SD_RAD.get(_get_base_segment(segment)) for k, segment in enumerate(tree.skeleton.names)}
    if tree.chest >= 0:
        sd[tree.chest] = ORIENTATION_SD_RAD["chest"]
    known = {k: each for k, each in sd.items() if each is not None}
    joints, weight = np.array(list(known)), np.array(list(known.values())) ** -2
    return OrientationTerm(joints, np.ascontiguousarray(rotation[:, joints]), np.tile(weight, (len(rotation), 1)))


NEIGHBOUR_SEGMENTS = {"upper_arm": "clavicle", "thigh": "pelvis", "forearm": "hand", "shin": "foot"}
"""The segment relative to which each limb segment twists."""


def compute_twisted_bones(frame: BodyFrame, rotation: dict[str, Rotations]) -> dict[int, Rotations]:
    """Return the world rotations of the bones that share a twist, by bone, from the rotations S of the segments."""
    mapping = frame.character.mapping
    twisted: dict[int, Rotations] = {}
    for side in SIDES:
        for segment, neighbour in NEIGHBOUR_SEGMENTS.items():
            name, other = f"{side}_{segment}", neighbour if neighbour == "pelvis" else f"{side}_{neighbour}"
            chain, beside = mapping.bones.get(name, ()), mapping.twists.get(name, ())
            if len(chain) + len(beside) < 2 or other not in rotation:
                continue
            axis = LIMB_AXES[name]
            angle = compute_twist_angle(np.swapaxes(rotation[name], 1, 2) @ rotation[other], axis)
            shares = {bone: k / (len(chain) - 1) for k, bone in enumerate(chain)} if len(chain) > 1 else {}
            shares |= {bone: _find_share_along(frame, bone, name, f"{side}_{LIMB_ENDS[segment]}") for bone in beside}
            for bone, share in shares.items():
                turn = (1.0 - share if segment in OUTER_BONE_SEGMENTS else share) * angle[:, None] * axis
                twisted[bone] = rotation[name] @ Rotation.from_rotvec(turn).as_matrix() @ frame.standard_rotations[bone]
    return twisted


def compute_twist_angle(rotation: Rotations, axis: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " T"]:
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
    return float(find_nearest_points(frame.rest_position[bone], frame.find_head(start), frame.find_head(end))[0])


def retarget_motion(
    source: Character,
    motion: CharacterMotion,
    target: Character,
    *,
    contacts: BodyContacts | None = None,
    hands: Mapping[str, HandPoses] | None = None,
) -> CharacterMotion:
    """Return the motion of a target character that moves like the source.

    Both mappings must have all required segments. Places are scaled about the origin by the ratio of the legs' lengths.

    Args:
        source: The source.
        motion: Its motion.
        target: The target.
        contacts: Of the source, at any rate. Their floor comes to height 0, feet that lie flat do so on the target, and if the
            feet of the source were locked in them, so are the target's. Without contacts the source's floor is at height 0.
        hands: Of the source, in the same frames, by side; by default those of its bones. Fingers of other hands keep their rest
            pose.
    """
    if hands is None:
        hands = measure_hand_poses(source, *compute_character_poses(source, motion)) if source.mapping.fingers else {}
    posed = [side for side in hands if list_fingers(target, side)]
    frames = build_body_frame(source), build_body_frame(target, posed)
    tree = build_solve_tree(frames[1])
    segments = compute_segment_motion(frames[0], motion)
    segments = replace(segments, rotation={**segments.rotation, **{f"{side}_hand": hands[side].palm for side in posed}})
    targets = compute_segment_targets(frames, tree, segments, contacts, motion.rate)
    floor = NO_FLOOR if contacts is None else contacts.floor
    poses = solve_pushed_segments(frames, tree, targets, segments, floor, motion.rate)
    return compose_character_motion(frames[1], tree, *poses, motion.rate, {side: hands[side] for side in posed})


MAX_PUSHES = 3
"""How often targets are moved out of floor and body: limbs do not reach a target at once, since other terms hold them back."""
MIN_PUSH_M, NO_PUSH_M = 1e-3, 2e-5  # largest push from which a motion is solved again, and push of a frame that is not


def solve_pushed_segments(
    frames: tuple[BodyFrame, BodyFrame],
    tree: SolveTree,
    targets: SegmentTargets,
    segments: SegmentMotion,
    floor: Floor,
    rate: float,
) -> Poses:
    """Return the poses that reach the targets; frames in which a part is in the floor, or a palm in the body, are solved again.

    Args:
        frames: Source and target.
        tree: Of the target.
        targets: Of the target.
        segments: Of the source.
        floor: Of the source.
        rate: Frames per second.
    """
    pelvis, local = solve_segments(tree, targets)
    for _ in range(MAX_PUSHES if len(pelvis) else 0):
        solved = name_positions(tree, compute_tree_poses(tree.kernel_tree, pelvis, local)[0])
        pushes = compute_pushes(frames, segments, solved, floor, rate)
        size = np.max([np.abs(push).max(axis=1) for push in pushes.values()], axis=0)
        if size.max() < MIN_PUSH_M:
            break
        points = {segment: place + pushes.get(segment, 0.0) for segment, place in targets.points.items()}
        targets = SegmentTargets(targets.rotation, targets.pelvis + pushes["pelvis"], points)
        is_moved = size > NO_PUSH_M
        pelvis[is_moved], local[is_moved] = solve_segments(tree, targets.select_frames(is_moved))
    return pelvis, local


def name_positions(tree: SolveTree, position: Float[np.ndarray, "T N 3"]) -> dict[str, Points]:
    """Return the positions of the joints of a solve tree by segment; spine and neck are where their first bone begins."""
    return {segment.removesuffix(".0"): position[:, k] for k, segment in enumerate(tree.skeleton.names)}


def compute_segment_targets(
    frames: tuple[BodyFrame, BodyFrame], tree: SolveTree, segments: SegmentMotion, contacts: BodyContacts | None, rate: float
) -> SegmentTargets:
    """Return what is kept of the segments of a source, the first of the frames, on the tree of the target, the second."""
    source_frame, target_frame = frames
    feet_contacts, floor_height_m = None, 0.0
    if contacts is not None:
        feet_contacts = kept_positions.resample_foot_contacts(contacts, len(segments.rotation["pelvis"]), rate)
        floor_height_m = contacts.floor.height_m
    flat_feet = kept_positions.measure_flat_feet(source_frame, segments, feet_contacts)
    kept = kept_positions.compute_kept_positions(source_frame, target_frame, segments, flat_feet, floor_height_m)
    segments = kept_positions.level_feet(segments, flat_feet)
    if feet_contacts is not None:
        kept, segments = kept_positions.rest_feet(target_frame, kept, segments, feet_contacts)
        kept, segments = kept_positions.settle_soles(source_frame, target_frame, kept, segments, feet_contacts)
    rotation = spread_rotations(source_frame, target_frame, tree, segments)
    local = compute_local_rotations(rotation, tree.skeleton.parents)
    start = name_positions(tree, compute_tree_poses(tree.kernel_tree, kept.pelvis, local)[0])
    ankles = kept.ankles
    if feet_contacts is not None and feet_contacts.held_feet.mode == FEET_LOCK:
        feet = {side: segments.rotation[f"{side}_foot"] for side in SIDES}
        ankles, feet = kept_positions.hold_kept_feet(target_frame, ankles, feet, feet_contacts)
        for side, foot in feet.items():
            joint = tree.find_joint(f"{side}_foot")
            rotation[:, joint] = foot @ tree.standard_rotations[joint]
    kept = fit_legs(frames, segments, replace(kept, ankles=ankles), start, feet_contacts, rate)
    points = {f"{side}_foot": ankle for side, ankle in kept.ankles.items()}
    if source_frame.has_hands and target_frame.has_hands:
        moved = {segment: place + kept.pelvis - start["pelvis"] for segment, place in start.items()}
        hands = fit_arms(frames, segments, moved, rate)
        points |= {f"{side}_hand": wrist for side, wrist in hands.items()}
    return SegmentTargets(rotation, kept.pelvis, points)


def spread_rotations(source: BodyFrame, target: BodyFrame, tree: SolveTree, segments: SegmentMotion) -> JointRotations:
    """Return the world rotations of the bones of a target's solve tree that have the source's segments' rotations."""
    chains = {segment: fit_chain(source, target, segments, segment) for segment in CHAIN_SEGMENTS}
    rotations: list[Rotations] = []
    for segment, standard in zip(tree.skeleton.names, tree.standard_rotations, strict=True):
        name, _, number = segment.partition(".")
        rotations.append((chains[name][:, int(number) + 1] if number else segments.rotation[name]) @ standard)
    return np.ascontiguousarray(np.stack(rotations, axis=1))


def compose_character_motion(
    frame: BodyFrame, tree: SolveTree, pelvis: Points, local: JointRotations, rate: float, hands: Mapping[str, HandPoses]
) -> CharacterMotion:
    """Return the motion of all bones from the pelvis in the world, the local rotations of a solve tree, and the hands by side."""
    skeleton, mapping = frame.character.skeleton, frame.character.mapping
    _, world = compute_tree_poses(tree.kernel_tree, pelvis, local)
    standard = world @ np.swapaxes(tree.standard_rotations, 1, 2)
    rotation = {segment: standard[:, k] for k, segment in enumerate(tree.skeleton.names) if "." not in segment}
    for side in SIDES:
        rotation.setdefault(f"{side}_clavicle", standard[:, max(tree.chest, 0)])
    placed = {int(bone): world[:, k] for k, bone in enumerate(tree.bones)} | compute_twisted_bones(frame, rotation)
    for side, hand in hands.items():
        placed |= pose_fingers(frame, side, rotation[f"{side}_hand"], hand)
    source_joints = np.full(len(skeleton.names), -1)
    source_joints[list(placed)] = np.arange(len(placed))
    alignment = SkeletonAlignment(skeleton, source_joints, np.tile(np.eye(3), (len(skeleton.names), 1, 1)))
    rotations = alignment.convert_rotations(np.stack(list(placed.values()), axis=1))
    parent = int(skeleton.parents[mapping.bones["pelvis"][0]])
    if parent >= 0:
        pelvis = (pelvis - frame.rest_position[parent]) @ frame.rest_rotation[parent]
    return CharacterMotion(pelvis, rotations, rate)
