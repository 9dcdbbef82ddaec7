"""Which changes are made to an animation: repairs that the options allow and that are certain enough, and feet that are held.

`--feet lock` holds the feet where they stand, by the animation's own thighs, shins and feet: the legs of the 31-joint skeleton
are solved and converted to the rotations of its joints. Every contact whose foot slides is a fault of its own, so that its change
can be rejected in review like any other. All other values stay as they are.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Shaped

from mocapfix.animations.repair import AnimationRepair
from mocapfix.animations.repair_methods import REPAIR_DESCRIPTIONS, RepairMethod
from mocapfix.characters.alignment import SkeletonAlignment
from mocapfix.contacts.body_contacts import compute_held_displacements, displace_feet
from mocapfix.contacts.contacts import FOOT_JOINTS, BodyContacts, HeldFeet
from mocapfix.fill.gap_filling import compute_gap_durations, explain_unfilled_samples
from mocapfix.io.changes_file import ReviewedChange
from mocapfix.model import changes
from mocapfix.model.animation import Animation, build_joint_take, build_tip_take, compute_joint_point_sd
from mocapfix.model.changes import Change, UnfilledRun, compute_editable_mask, find_unfilled_runs
from mocapfix.model.faults import Fault, Faults, build_fault_mask
from mocapfix.model.motion import Motion
from mocapfix.model.skeleton import Skeleton
from mocapfix.model.take import Take
from mocapfix.options import FEET_LOCK, CleanOptions, FillOptions
from mocapfix.solve import kinematics
from mocapfix.stats.sequences import find_runs

LOST_KINDS = ("gap", "stuck")  # fault kinds whose values carry no information
UNAPPLIED_CHANGE_REASON = "its change was not applied"  # not among the kinds to repair, or rejected by a reviewer


@dataclass(frozen=True)
class RepairedAnimation:
    """A cleaned animation, and its changes."""

    animation: Animation  # cleaned
    # tips_before, tips_after: takes of the joint tips of the input and of the cleaned animation, without values that are lost
    tips_before: Take
    tips_after: Take
    joint_take: Take  # joint positions of the cleaned animation, with standard deviations
    faults: Faults
    changes: tuple[Change, ...]
    unfilled: tuple[UnfilledRun, ...]


def apply_repairs(
    animation: Animation,
    repair: AnimationRepair,
    faults: Sequence[Fault],
    options: CleanOptions,
    reviewed: Sequence[ReviewedChange],
) -> RepairedAnimation:
    """Apply repairs of faults to an animation and leave all other values unchanged.

    Decides by the options of detection (the kinds to repair) and of filling, and by the reviewed changes of an earlier cleaning.
    """
    tips = build_tip_take(animation)
    is_absent = build_fault_mask([fault for fault in faults if fault.kind == "gap"], tips.visible.shape)
    before = tips.masked(~is_absent)
    selected = [fault for fault in faults if _is_selected(fault, options.detect.repair_kinds, reviewed)]
    editable = build_fault_mask(selected, is_absent.shape)
    editable &= _compute_editable_tracks(before, animation.moving_joint, options.fill)
    editable &= repair.method != RepairMethod.UNCHANGED
    rejection_reasons = _find_rejection_reasons(animation, before, repair, faults, editable, options.fill)
    is_repaired = editable & (rejection_reasons == "")
    repaired = insert_repairs(animation, repair, is_repaired)
    variance = np.where(is_repaired, repair.variance, 0.0)
    after = build_tip_take(repaired)
    after = _add_sd(repaired, after, variance, is_repaired | ~before.visible).masked(is_repaired | ~is_absent)
    joint_take = build_joint_take(repaired)
    joint_take = _add_sd(repaired, joint_take, variance, np.ones(joint_take.visible.shape, bool))
    applied = _list_changes(before, after, selected, repair, is_repaired)
    unfilled = find_unfilled_runs(after, np.where(rejection_reasons == "", UNAPPLIED_CHANGE_REASON, rejection_reasons))
    return RepairedAnimation(
        repaired,
        before,
        after,
        joint_take,
        Faults(tuple(faults)),
        (*applied, *(each.to_change() for each in reviewed)),
        unfilled,
    )


def insert_repairs(animation: Animation, repair: AnimationRepair, is_repaired: Bool[np.ndarray, "T N"]) -> Animation:
    """Return the animation with the repaired values of the N = J + 1 tracks where `is_repaired`."""
    for joint in np.flatnonzero(is_repaired[:, :-1].any(0)):
        frames = np.flatnonzero(is_repaired[:, joint])
        animation = animation.replace_rotations(np.array([joint]), frames, repair.local_rotations[frames, joint][:, None])
    frames = np.flatnonzero(is_repaired[:, -1])
    if not len(frames):
        return animation
    return animation.replace_positions(np.array([animation.moving_joint]), frames, repair.root_position[frames][:, None])


def _is_selected(fault: Fault, kinds: Sequence[str], reviewed: Sequence[ReviewedChange]) -> bool:
    """Return True if faults of this kind are repaired and this one's change was not rejected."""
    return (not kinds or fault.kind in kinds) and not any(each.rejects(fault) for each in reviewed)


def _compute_editable_tracks(before: Take, moving_joint: int, fill_options: FillOptions) -> Bool[np.ndarray, "T N"]:
    """Return the values that the options allow to change. To keep the joint that moves the figure also keeps its position."""
    editable = compute_editable_mask(before, fill_options)
    editable[:, -1] &= editable[:, moving_joint]
    return editable


def _find_rejection_reasons(
    animation: Animation,
    before: Take,
    repair: AnimationRepair,
    faults: Sequence[Fault],
    editable: Bool[np.ndarray, "T N"],
    fill_options: FillOptions,
) -> Shaped[np.ndarray, "T N"]:
    """Return why lost values are not filled, "" elsewhere. If one value of a gap is rejected, the whole gap is."""
    lost_faults = [fault for fault in faults if fault.kind in LOST_KINDS]
    is_lost = build_fault_mask(lost_faults, editable.shape)
    fully_repaired = insert_repairs(animation, repair, repair.method != RepairMethod.UNCHANGED)
    sd = compute_joint_point_sd(fully_repaired, build_tip_take(fully_repaired), repair.variance)
    sd = np.where(repair.method == RepairMethod.UNCHANGED, np.nan, sd)
    reasons = explain_unfilled_samples(before, is_lost & editable, compute_gap_durations(~is_lost, before.rate), sd, fill_options)
    for fault in lost_faults:
        if found := [reason for reason in reasons[fault.frame_slice][:, list(fault.markers)].ravel() if reason]:
            reasons[fault.frame_slice, list(fault.markers)] = found[0]
    return reasons


def _add_sd(
    animation: Animation, points: Take, variance: Float[np.ndarray, "T N"], is_estimated: Bool[np.ndarray, "T M"]
) -> Take:
    """Return the take of joints or tips with the standard deviations of the estimated points (variances of N tracks)."""
    sd = compute_joint_point_sd(animation, points, variance)
    return replace(points, sample_sd=np.where(is_estimated & (sd > 0), sd, np.nan))


def _list_changes(
    before: Take, after: Take, faults: Sequence[Fault], repair: AnimationRepair, is_repaired: Bool[np.ndarray, "T N"]
) -> list[Change]:
    """Return a change for every fault that was repaired. It covers the fault's joints and not the joints below them."""
    own_points = before.replace_markers(np.where(is_repaired[..., None], after.markers, before.markers), after.sample_sd)
    repaired_faults = [fault for fault in faults if is_repaired[fault.frame_slice][:, list(fault.markers)].any()]
    methods = np.where(is_repaired, np.array([REPAIR_DESCRIPTIONS[method] for method in RepairMethod], object)[repair.method], "")
    return [change for change, _ in changes.build_changes(before, before, own_points, repaired_faults, None, methods)]


LEG_BONES = ("UpLeg", "Leg", "Foot")
MIN_LOCK_DISPLACEMENT_M = 1e-4  # displacement of a heel or a ball of a foot below which a frame keeps its values
MIN_ROTATION_CHANNELS = 3
LOCK_METHOD = "the place at which the foot stands"


class LockedFeet(NamedTuple):
    """An animation whose feet are held."""

    repaired: RepairedAnimation  # the animation with the changes to its legs
    contacts: BodyContacts  # the contacts, with what was done to the feet
    notes: list[str]  # sentences on legs that cannot be held


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

    Args:
        repaired: The animation.
        alignment: The 31-joint skeleton in it.
        motion: That of this skeleton.
        contacts: Of the feet.
        options: `keep` and `frames` limit what is changed.
        reviewed: Changes of an earlier cleaning that were declined: these contacts are not held.
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
    places = compute_held_displacements(alignment.skeleton, before, used, is_locked=True)
    held = displace_feet(alignment.skeleton, motion, before, places, is_root_fixed=True)
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
    file_joints = alignment.source_joints[model_joints].tolist()
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
        rotations[:, file_joint] = alignment.convert_rotation_back(model_joint, model_rotations, animation.parents, rotations)
    return animation.replace_rotations(np.array(leg.file_joints), frames, rotations[:, leg.file_joints])


def _list_slides(leg: _Leg, is_standing: Bool[np.ndarray, " T"], moved_m: Float[np.ndarray, " T"]) -> list[Fault]:
    """Return a fault for each contact of a foot that slides, over the frames in which it is moved for it."""
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
    tips, before = build_tip_take(animation), repaired.tips_after
    was_known = before.visible
    sd = _combine_sd(before.sample_sd, np.where(is_changed & was_known, _measure_distance(tips.markers, before.markers), np.nan))
    after = before.replace_markers(np.where(was_known[..., None], tips.markers, np.nan), sd)
    joints = build_joint_take(animation)
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
