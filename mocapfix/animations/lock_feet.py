"""Hold the feet of an animation where they stand: `--feet lock`.

The feet are displaced as in a take (`contacts/foot_displacements.py`), and so that they do not slide where the path of the
animation does not fit its steps. The root moves, smoothly and by MAX_ROOT_DISPLACEMENT_M at most, so that legs keep their reach:
a knee that is nearly straight would bend far for a few millimetres. Thighs, shins and feet are posed by the knee's angle and the
directions from hip to ankle and to toes, and their knees stay in the planes of their legs.

Every contact whose foot slides is a fault of its own, and so is the root's displacement, so that their changes can be rejected in
review like any other. All other values stay as they are.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from mocapfix.animations.repair import RepairedAnimation
from mocapfix.characters.alignment import SkeletonAlignment
from mocapfix.contacts.contacts import CONTACT_JOINTS, FOOT_JOINTS, BodyContacts, HeldFeet
from mocapfix.contacts.foot_displacements import Lock, compute_foot_displacements, compute_step_displacements
from mocapfix.io.changes_file import ReviewedChange
from mocapfix.model import changes
from mocapfix.model.animation import Animation, build_joint_take, build_tip_take
from mocapfix.model.changes import compute_editable_mask
from mocapfix.model.faults import Fault
from mocapfix.model.motion import Motion
from mocapfix.model.skeleton import Skeleton
from mocapfix.options import FEET_LOCK, FillOptions
from mocapfix.solve.kinematics import LegPath, compute_world_poses, measure_length, reach_ankle
from mocapfix.solve.measured_segments import smooth_share
from mocapfix.stats.rigid_alignment import compute_shortest_rotations
from mocapfix.stats.sequences import find_runs, minimise_acceleration

ROOT_SD_M = 0.06  # standard deviation per axis of the root's displacement
ROOT_TIME_S = 0.08  # time constant with which it begins and ends
KNEE_SD_RAD = 0.15  # standard deviation of a knee's angle about what it was
MIN_REACH_SD_M = 0.001  # the same of the distance from hip to ankle, where the leg is straight
MAX_ROOT_DISPLACEMENT_M = 0.1
ROOT_LIMIT_EXPONENT = 8  # exponent with which the displacement approaches its limit
FIXED_SD_M = 1e-6  # standard deviation of a displacement that is not allowed
ROOT_ITERATIONS = 6


def find_root_displacement(
    legs: Sequence[LegPath], ankles: Sequence[Float[np.ndarray, "T 3"]], is_allowed: Bool[np.ndarray, " T"], rate: float
) -> Float[np.ndarray, "T 3"]:
    """Return the displacement of the root, in metres, with which legs reach their ankles by about the same angles of the knees.

    With d the displacement, it minimises the integral of |d|^2 + |ROOT_TIME_S^2 d''|^2 and of the squared changes of the legs'
    reach, in standard deviations, by the method of Gauss and Newton. `ankles` are where each leg's ankle shall be, in metres.
    """
    moved, stiffness = np.zeros((len(is_allowed), 3)), (ROOT_TIME_S * rate) ** 4 / ROOT_SD_M**2
    own = np.where(is_allowed, ROOT_SD_M, FIXED_SD_M)[:, None, None] ** -2.0 * np.eye(3)
    for _ in range(ROOT_ITERATIONS):
        information, pull = own, np.zeros_like(moved)
        for leg, ankle in zip(legs, ankles, strict=True):
            reach, change = leg.measure_reach(leg.knee_angle)
            weight = (1 / ((KNEE_SD_RAD * change) ** 2 + MIN_REACH_SD_M**2))[:, None]
            distance = measure_length(leg.hip + moved - ankle)
            along = (leg.hip + moved - ankle) / distance[:, None]
            information = information + weight[..., None] * along[:, :, None] * along[:, None, :]
            pull = pull + weight * ((along * moved).sum(1) + reach - distance)[:, None] * along
        moved = minimise_acceleration(information, pull, stiffness)
    ratio = np.linalg.norm(moved, axis=1, keepdims=True) / MAX_ROOT_DISPLACEMENT_M
    return moved / (1 + ratio**ROOT_LIMIT_EXPONENT) ** (1 / ROOT_LIMIT_EXPONENT)


LEG_BONES = ("UpLeg", "Leg", "Foot")
SLIDE_KIND, ROOT_KIND = "foot slide", "root shift"
MIN_LOCK_DISPLACEMENT_M = 1e-4  # displacement of a joint of the leg below which a frame keeps its values
ANIMATION_LOCK = Lock(contact_weight=10_000.0, acceleration_m_s2=12.0)  # no marker contradicts: feet are held more exactly
GIVEN_LOCK = ANIMATION_LOCK._replace(largest_m=1.0)  # in contacts that the user gives, however far a foot slides
MIN_ROTATION_CHANNELS = 3
LOCK_METHOD = "the place at which the foot stands"
ROOT_REASON = "The root moves by up to {:.1f} mm, so that the legs reach the places at which the feet stand."
HINGE_NOTE = "The {} foot is not held: in {} its thigh, shin or foot turns about fewer than three axes."
LOCK_NOTE = "To hold standing feet, feet were moved by up to {:.0f} mm and the root by up to {:.0f} mm (at most {:.0f} mm)."


class SlidingFeet(NamedTuple):
    """The contacts of an animation, and how far its feet slide in them."""

    contacts: BodyContacts
    slide: Float[np.ndarray, "T 3"]  # m: the path by which the body has moved too far for its steps, 0 if it fits them
    is_given: bool  # the contacts are the user's own, in which feet are held even if they move far


class LockedFeet(NamedTuple):
    """An animation whose feet are held."""

    repaired: RepairedAnimation  # the animation with the changes to its legs and its root
    contacts: BodyContacts  # the contacts, with what was done to the feet
    notes: list[str]  # sentences on what was moved, and on legs that cannot be held


class _Leg(NamedTuple):
    """A leg: its side, and its joints of the 31-joint skeleton and of the file: thigh (which names changes), shin, foot."""

    side: str
    model_joints: list[int]
    file_joints: list[int]


def lock_feet(
    repaired: RepairedAnimation,
    alignment: SkeletonAlignment,
    motion: Motion,
    feet: SlidingFeet,
    options: FillOptions,
    reviewed: Sequence[ReviewedChange],
) -> LockedFeet:
    """Hold standing feet at one place each, by the rotations of the animation's legs and the position of its root.

    Args:
        alignment: The 31-joint skeleton in the animation, which has the motion.
        feet: How they stand and slide.
        options: `keep` and `frames` limit what is changed.
        reviewed: Changes of an earlier cleaning that were declined: these contacts are not held, or the root does not move.
    """
    animation, is_editable = repaired.animation, compute_editable_mask(repaired.tips_before, options)
    found = {side: _find_leg(animation, alignment, side) for side in FOOT_JOINTS}
    notes = [HINGE_NOTE.format(side, animation.name) for side, leg in found.items() if leg is None]
    legs = [leg for leg in found.values() if leg]
    is_held = _find_held_frames(feet.contacts, legs, is_editable, reviewed)
    track = len(animation.names)  # that of the root's position
    can_move = len(animation.get_position_channels(animation.moving_joint)[0]) == 3
    can_move &= not any(each.entry.kind == ROOT_KIND for each in reviewed)
    is_root_free = np.all(is_held, axis=1) & np.all(is_editable[:, [track, animation.moving_joint]], axis=1) & can_move
    held, foot_m, is_posed = _hold_legs(animation, alignment.skeleton, motion, feet, is_held, is_root_free)
    is_changed, faults = np.zeros(is_editable.shape, bool), list[Fault]()
    for leg in legs:
        side = list(FOOT_JOINTS).index(leg.side)
        is_moved = is_posed[:, side] & is_editable[:, leg.file_joints].all(1)
        is_changed[:, leg.file_joints] = is_moved[:, None]
        animation = _turn_leg(animation, alignment, held, leg, np.flatnonzero(is_moved))
        is_standing = feet.contacts.find_foot_contact(leg.side) & is_held[:, side]
        faults += _list_slides(leg, is_standing, np.where(is_moved, foot_m[:, side], 0.0))
    root_m = np.linalg.norm(held.root_position - motion.root_position, axis=1)
    if (is_moved := root_m > MIN_LOCK_DISPLACEMENT_M).any():
        is_changed[:, track] = is_moved
        animation = _move_root(animation, held.root_position - motion.root_position, np.flatnonzero(is_moved))
        first, last = np.flatnonzero(is_moved)[[0, -1]].tolist()
        faults.append(Fault(ROOT_KIND, track, first, last, float(root_m.max()), ROOT_REASON.format(root_m.max() * 1e3), 1.0))
    if faults:
        notes.append(LOCK_NOTE.format(foot_m.max() * 1e3, root_m.max() * 1e3, MAX_ROOT_DISPLACEMENT_M * 1e3))
    done = HeldFeet(FEET_LOCK, float(foot_m.max(initial=0.0)))
    return LockedFeet(_record_changes(repaired, animation, faults, is_changed), replace(feet.contacts, held_feet=done), notes)


def _hold_legs(
    animation: Animation,
    skeleton: Skeleton,
    motion: Motion,
    feet: SlidingFeet,
    is_held: Bool[np.ndarray, "T F"],
    is_root_free: Bool[np.ndarray, " T"],
) -> tuple[Motion, Float[np.ndarray, "T F"], Bool[np.ndarray, "T F"]]:
    """Return the motion with feet that stand at one place each, how far each foot was moved, and whether its leg was.

    A reference pose before the motion is replaced by its first frame.
    """
    frames = np.maximum(np.arange(motion.frame_count), int(animation.has_reference_pose and animation.frame_count > 1))
    columns, rate = [skeleton.names.index(joint) for joint in CONTACT_JOINTS], animation.rate
    share = np.repeat(np.stack([smooth_share(each.astype(float), rate) for each in is_held[frames].T], axis=1), 2, axis=1)
    contacts = feet.contacts.select_feet(frames)
    contacts = contacts.change_contacts(contacts.is_contact & np.repeat(is_held[frames], 2, axis=1))
    positions, rotations = compute_world_poses(skeleton, motion.select_frames(frames))
    fitting = positions[:, columns] - feet.slide[frames, None]
    lock = GIVEN_LOCK if feet.is_given else ANIMATION_LOCK
    displacement = compute_foot_displacements(fitting, contacts, is_locked=True, lock=lock)
    displacement += compute_step_displacements(fitting, contacts, feet.slide[frames])
    displacement *= share[..., None]
    target = positions[:, columns] + displacement
    joints = [[skeleton.names.index(side.capitalize() + bone) for bone in LEG_BONES] for side in FOOT_JOINTS]
    legs = [LegPath.build(positions[:, leg], rotations[:, leg[0]]) for leg in joints]
    root = find_root_displacement(legs, [target[:, 0], target[:, 2]], is_root_free[frames], rate)
    local_rotations, foot_m, is_posed = motion.local_rotations.copy(), np.zeros(is_held.shape), np.zeros(is_held.shape, bool)
    for side, (leg, bones) in enumerate(zip(legs, joints, strict=True)):
        hip, ankle, toes = leg.hip + root, target[:, 2 * side], positions[:, columns[2 * side + 1]]
        posed, *turns = leg.pose(hip, ankle, reach_ankle(leg, hip, ankle, rate))
        turns.append(compute_shortest_rotations(toes - leg.ankle, target[:, 2 * side + 1] - posed.ankle))
        above = rotations[:, skeleton.parents[bones[0]]]
        for joint, turn in zip(bones, turns, strict=True):
            turned = turn @ rotations[:, joint]
            local_rotations[:, joint], above = above.swapaxes(1, 2) @ turned, turned
        posed_toes = posed.ankle + np.einsum("tij,tj->ti", turns[-1], toes - leg.ankle)
        moved_m = np.linalg.norm(np.subtract((*posed[:3], posed_toes), (*leg[:3], toes)), axis=-1)
        foot_m[:, side], is_posed[:, side] = moved_m[2:].max(0), moved_m.max(0) > MIN_LOCK_DISPLACEMENT_M
    is_motion = frames == np.arange(len(frames))  # not the reference pose
    root_position = motion.root_position + np.where(is_motion[:, None], root, 0.0)
    held = replace(motion, root_position=root_position, local_rotations=local_rotations)
    return held, foot_m, is_posed & is_motion[:, None]


def _find_leg(animation: Animation, alignment: SkeletonAlignment, side: str) -> _Leg | None:
    """Return a leg whose joints can take any rotation; None if the animation has none on this side."""
    model_joints = [alignment.skeleton.names.index(side.capitalize() + bone) for bone in LEG_BONES]
    file_joints = alignment.source_joints[model_joints].tolist()
    if min(file_joints) < 0:
        return None
    channel_counts = [len(set(animation.get_rotation_channels(joint)[1].tolist())) for joint in file_joints]
    return _Leg(side, model_joints, file_joints) if min(channel_counts) >= MIN_ROTATION_CHANNELS else None


def _find_held_frames(
    contacts: BodyContacts, legs: Sequence[_Leg], is_editable: Bool[np.ndarray, "T N"], reviewed: Sequence[ReviewedChange]
) -> Bool[np.ndarray, "T F"]:
    """Return when each foot may be held: where its leg can change, and not in a contact whose change was declined."""
    is_held = np.zeros((len(is_editable), len(FOOT_JOINTS)), bool)
    for leg in legs:
        side = list(FOOT_JOINTS).index(leg.side)
        is_held[:, side] = is_editable[:, leg.file_joints].all(1)
        declined = [each for each in reviewed if each.entry.kind == SLIDE_KIND and each.markers[0] == leg.file_joints[0]]
        for first, last in find_runs(contacts.find_foot_contact(leg.side)):
            if any(first <= each.last and each.first <= last for each in declined):
                is_held[first : last + 1, side] = False
    return is_held


def _turn_leg(animation: Animation, alignment: SkeletonAlignment, held: Motion, leg: _Leg, frames: np.ndarray) -> Animation:
    """Return the animation with a leg posed as in `held`, in some frames."""
    rotations = animation.compute_local_rotations()[frames]
    model_rotations = held.local_rotations[frames]
    for model_joint, file_joint in zip(leg.model_joints, leg.file_joints, strict=True):
        rotations[:, file_joint] = alignment.convert_rotation_back(model_joint, model_rotations, animation.parents, rotations)
    return animation.replace_rotations(np.array(leg.file_joints), frames, rotations[:, leg.file_joints])


def _move_root(animation: Animation, root: Float[np.ndarray, "T 3"], frames: np.ndarray) -> Animation:
    """Return the animation whose moving joint is displaced in the world, in metres, in some frames."""
    joint = animation.moving_joint
    local, moved, parent = animation.compute_local_positions()[frames, joint], root[frames], animation.parents[joint]
    if parent >= 0:
        moved = np.einsum("tji,tj->ti", animation.compute_world_poses()[1][frames, parent], moved)
    return animation.replace_positions(np.array([joint]), frames, (local + moved)[:, None])


def _list_slides(leg: _Leg, is_standing: Bool[np.ndarray, " T"], moved_m: Float[np.ndarray, " T"]) -> list[Fault]:
    """Return a fault for each contact of a foot that slides, over the frames in which it is moved for it."""
    runs, faults = find_runs(is_standing), list[Fault]()
    borders = [0, *((before[1] + after[0] + 1) // 2 for before, after in pairwise(runs)), len(moved_m)]
    for start, stop in pairwise(borders):
        if len(moved := start + np.flatnonzero(moved_m[start:stop])):
            largest_m = float(moved_m[start:stop].max(where=is_standing[start:stop], initial=0.0))
            reason = f"The {leg.side} foot slides by up to {largest_m * 1e3:.1f} mm from its place while it stands."
            others = tuple(leg.file_joints[1:])
            faults.append(Fault(SLIDE_KIND, leg.file_joints[0], int(moved[0]), int(moved[-1]), largest_m, reason, 1.0, others))
    return faults


def _record_changes(
    repaired: RepairedAnimation, animation: Animation, faults: Sequence[Fault], is_changed: Bool[np.ndarray, "T N"]
) -> RepairedAnimation:
    """Return the cleaned animation with its changed legs; their tips have the distance moved as their uncertainty."""
    if not faults:
        return repaired
    tips, before = build_tip_take(animation), repaired.tips_after
    was_known = before.visible
    sd = _combine_sd(
        before.sample_sd, np.where(is_changed & was_known, np.linalg.norm(tips.markers - before.markers, axis=-1), np.nan)
    )
    after = before.replace_markers(np.where(was_known[..., None], tips.markers, np.nan), sd)
    joints = build_joint_take(animation)
    joint_distance = np.linalg.norm(joints.markers - repaired.joint_take.markers, axis=-1)
    joint_sd = _combine_sd(repaired.joint_take.sample_sd, np.where(joint_distance > 0, joint_distance, np.nan))
    own_points = before.replace_markers(np.where(is_changed[..., None], after.markers, before.markers), sd)
    methods = np.where(is_changed, np.array(LOCK_METHOD, object), "")
    made = [change for change, _ in changes.build_changes(before, before, own_points, faults, None, methods)]
    return replace(
        repaired,
        animation=animation,
        tips_after=after,
        joint_take=replace(joints, sample_sd=joint_sd),
        faults=repaired.faults.add_faults(faults),
        changes=(*repaired.changes, *made),
    )


def _combine_sd(sd: Float[np.ndarray, "T N"] | None, distance_m: Float[np.ndarray, "T N"]) -> Float[np.ndarray, "T N"]:
    """Return standard deviations per axis: of the repair, and of a point that was moved by a distance; NaN where neither is."""
    known = np.zeros(distance_m.shape) if sd is None else np.nan_to_num(sd)
    squared = known**2 + np.nan_to_num(distance_m) ** 2 / 3
    return np.where(squared > 0, np.sqrt(squared), np.nan)
