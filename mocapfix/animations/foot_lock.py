"""Hold the feet of an animation where they stand (`--feet lock`), by its own thighs, shins and feet.

The legs of the 31-joint skeleton are solved and converted to the rotations of the animation's joints. Every contact whose foot
slides is a fault of its own, so that its change can be rejected in review like any other. All other joints, the root and all
frames without displacement keep their values.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from mocapfix.animations import joint_mapping
from mocapfix.animations.apply_repairs import RepairedAnimation
from mocapfix.animations.retarget import SkeletonAlignment, compute_file_rotation
from mocapfix.contacts.body_contacts import hold_feet
from mocapfix.contacts.contacts import FOOT_JOINTS, BodyContacts, HeldFeet
from mocapfix.fill.gap_filling import compute_editable_mask
from mocapfix.model import changes
from mocapfix.model.animation import Animation
from mocapfix.model.faults import Fault
from mocapfix.model.motion import Motion
from mocapfix.model.skeleton import Skeleton
from mocapfix.options import FEET_LOCK, FillOptions
from mocapfix.review.changes_file import ReviewedChange
from mocapfix.solve import kinematics
from mocapfix.stats.sequences import find_runs

LEG_BONES = ("UpLeg", "Leg", "Foot")
MIN_LOCK_DISPLACEMENT_M = 1e-4
"""Displacement of a heel or a ball of a foot below which a frame keeps its values."""
MIN_ROTATION_CHANNELS = 3
LOCK_METHOD = "the place at which the foot stands"


class LockedFeet(NamedTuple):
    """An animation whose feet are held.

    repaired  the animation with the changes to its legs
    contacts  the contacts, with what was done to the feet
    notes     sentences on legs that cannot be held
    """

    repaired: RepairedAnimation
    contacts: BodyContacts
    notes: list[str]


class _Leg(NamedTuple):
    """A leg: its side, and its joints of the 31-joint skeleton and of the file, thigh, shin and foot."""

    side: str
    model_joints: list[int]
    file_joints: list[int]

    @property
    def thigh_track(self) -> int:
        """The track of the thigh, by which changes to the leg are named."""
        return self.file_joints[0]


def lock_feet(
    repaired: RepairedAnimation,
    alignment: SkeletonAlignment,
    motion: Motion,
    contacts: BodyContacts,
    options: FillOptions,
    reviewed: Sequence[ReviewedChange] = (),
) -> LockedFeet:
    """Hold standing feet at one place each, by the rotations of the animation's legs.

    motion    of the skeleton of the alignment, converted from the repaired animation
    options   `keep` and `frames` limit what is changed
    reviewed  changes of an earlier cleaning that were declined: these contacts are not held
    """
    animation = repaired.animation
    is_editable = compute_editable_mask(repaired.tips_before, options)
    legs, notes, used = list[_Leg](), list[str](), contacts
    for side in FOOT_JOINTS:
        leg = _find_leg(animation, alignment, side)
        if leg is None:
            notes.append(
                f"The {side} foot is not held: in {animation.name} its thigh, shin or foot turns about fewer than three axes."
            )
        else:
            legs.append(leg)
        used = _drop_contacts(used, side, leg, [each for each in reviewed if each.entry.kind == "foot slide"])
    before = kinematics.compute_world_poses(alignment.skeleton, motion)[0]
    held = hold_feet(alignment.skeleton, motion, before, used, is_locked=True, is_root_fixed=True)
    displacement = np.linalg.norm(kinematics.compute_world_poses(alignment.skeleton, held)[0] - before, axis=-1)
    faults, is_changed, largest_m = list[Fault](), np.zeros(is_editable.shape, bool), 0.0
    for leg in legs:
        moved_m = displacement[:, _find_feet(alignment.skeleton, leg.side)].max(1)
        is_moved = (moved_m > MIN_LOCK_DISPLACEMENT_M) & is_editable[:, leg.file_joints].all(1)
        if is_moved.any():
            animation = _turn_leg(animation, alignment, held, leg, np.flatnonzero(is_moved))
            is_changed[:, leg.file_joints] |= is_moved[:, None]
            largest_m = max(largest_m, float(moved_m[is_moved].max()))
            faults += _list_slides(leg, used.find_foot_contact(leg.side), np.where(is_moved, moved_m, 0.0))
    result = _record_changes(repaired, animation, faults, is_changed)
    return LockedFeet(result, replace(contacts, held_feet=HeldFeet(FEET_LOCK, largest_m)), notes)


def _find_leg(animation: Animation, alignment: SkeletonAlignment, side: str) -> _Leg | None:
    """Return a leg whose joints can take any rotation; None if the animation has none on this side."""
    model_joints = [alignment.skeleton.names.index(side.capitalize() + bone) for bone in LEG_BONES]
    file_joints = alignment.file_joints[model_joints].tolist()
    if min(file_joints) < 0:
        return None
    channel_counts = [len(set(animation.get_rotation_channels(joint)[1].tolist())) for joint in file_joints]
    return _Leg(side, model_joints, file_joints) if min(channel_counts) >= MIN_ROTATION_CHANNELS else None


def _find_feet(skeleton: Skeleton, side: str) -> list[int]:
    return [skeleton.names.index(joint) for joint in FOOT_JOINTS[side]]


def _drop_contacts(contacts: BodyContacts, side: str, leg: _Leg | None, declined: Sequence[ReviewedChange]) -> BodyContacts:
    """Return the contacts without those of a side that has no leg or whose changes were declined."""
    columns = [contacts.joints.index(joint) for joint in FOOT_JOINTS[side]]
    is_contact = contacts.is_contact.copy()
    if leg is None:
        is_contact[:, columns] = False
        return replace(contacts, is_contact=is_contact)
    ranges = [(each.first, each.last) for each in declined if each.markers[0] == leg.thigh_track]
    for first, last in find_runs(contacts.find_foot_contact(side)):
        if any(first <= declined_last and declined_first <= last for declined_first, declined_last in ranges):
            is_contact[first : last + 1, columns] = False
    return replace(contacts, is_contact=is_contact)


def _turn_leg(animation: Animation, alignment: SkeletonAlignment, held: Motion, leg: _Leg, frames: np.ndarray) -> Animation:
    """Return the animation with a leg posed as in `held`, in some frames."""
    rotations = animation.compute_local_rotations()[frames]
    model_rotations = held.local_rotations[frames]
    for model_joint, file_joint in zip(leg.model_joints, leg.file_joints, strict=True):
        rotations[:, file_joint] = compute_file_rotation(animation.parents, rotations, alignment, model_joint, model_rotations)
    return animation.replace_rotations(np.array(leg.file_joints), frames, rotations[:, leg.file_joints])


def _list_slides(leg: _Leg, is_standing: Bool[np.ndarray, " T"], moved_m: Float[np.ndarray, " T"]) -> list[Fault]:
    """Return a fault for each contact of a foot that slides, over the frames in which the leg is changed for it.

    is_standing  (T,) when the foot stands
    moved_m      (T,) how far it is moved
    """
    runs = find_runs(is_standing)
    borders = [0, *((before[1] + after[0] + 1) // 2 for before, after in pairwise(runs)), len(moved_m)]
    faults: list[Fault] = []
    for start, stop in pairwise(borders):
        if len(moved := start + np.flatnonzero(moved_m[start:stop])):
            largest_m = float(moved_m[start:stop].max())
            reason = f"The {leg.side} foot slides by up to {largest_m * 1e3:.1f} mm from its place while it stands."
            others = tuple(leg.file_joints[1:])
            faults.append(Fault("foot slide", leg.thigh_track, int(moved[0]), int(moved[-1]), largest_m, reason, 1.0, others))
    return faults


def _record_changes(
    repaired: RepairedAnimation, animation: Animation, faults: Sequence[Fault], is_changed: Bool[np.ndarray, "T N"]
) -> RepairedAnimation:
    """Return the cleaned animation with its changed legs; their tips have the distance moved as their uncertainty."""
    if not faults:
        return repaired
    tips, before = joint_mapping.build_tip_take(animation), repaired.tips_after
    was_known = before.visible
    sd = _combine_sd(before.sample_sd, np.where(is_changed & was_known, _measure_distance(tips.markers, before.markers), np.nan))
    after = before.replace_markers(np.where(was_known[..., None], tips.markers, np.nan), sd)
    joints = joint_mapping.build_joint_take(animation)
    joint_distance = _measure_distance(joints.markers, repaired.joint_take.markers)
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


def _measure_distance(one: Float[np.ndarray, "T N 3"], other: Float[np.ndarray, "T N 3"]) -> Float[np.ndarray, "T N"]:
    return np.linalg.norm(one - other, axis=-1)


def _combine_sd(sd: Float[np.ndarray, "T N"] | None, distance_m: Float[np.ndarray, "T N"]) -> Float[np.ndarray, "T N"]:
    """Return standard deviations per axis: of the repair, and of a point that was moved by a distance; NaN where neither is."""
    known = np.zeros(distance_m.shape) if sd is None else np.nan_to_num(sd)
    squared = known**2 + np.nan_to_num(distance_m) ** 2 / 3
    return np.where(squared > 0, np.sqrt(squared), np.nan)
