"""Which changes are made to an animation: repairs that the options allow and that are certain enough; all else is unchanged."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Shaped

from mocapfix.animations.repair import AnimationRepair
from mocapfix.animations.repair_methods import REPAIR_DESCRIPTIONS, RepairMethod
from mocapfix.fill.gap_filling import compute_gap_durations, explain_unfilled_samples
from mocapfix.io.changes_file import ReviewedChange
from mocapfix.model import changes
from mocapfix.model.animation import Animation, build_joint_take, build_tip_take, compute_joint_point_sd
from mocapfix.model.changes import Change, UnfilledRun, compute_editable_mask, find_unfilled_runs
from mocapfix.model.faults import Fault, Faults, build_fault_mask
from mocapfix.model.take import Take
from mocapfix.options import CleanOptions, FillOptions

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
    is_rejected = [any(each.rejects(fault) for each in reviewed) for fault in faults]
    kinds = options.detect.repair_kinds or {fault.kind for fault in faults}
    selected = [fault for fault, rejected in zip(faults, is_rejected, strict=True) if fault.kind in kinds and not rejected]
    editable = compute_editable_mask(before, options.fill)
    editable[:, -1] &= editable[:, animation.moving_joint]  # to keep the joint that moves the figure also keeps its position
    editable &= build_fault_mask(selected, is_absent.shape) & (repair.method != RepairMethod.UNCHANGED)
    rejection_reasons = _find_rejection_reasons(animation, before, repair, faults, editable, options.fill)
    is_repaired = editable & (rejection_reasons == "")
    repaired = insert_repairs(animation, repair, is_repaired)
    variance = np.where(is_repaired, repair.variance, 0.0)
    after = build_tip_take(repaired)
    after = _add_sd(repaired, after, variance, is_repaired | ~before.visible).masked(is_repaired | ~is_absent)
    joint_take = build_joint_take(repaired)
    joint_take = _add_sd(repaired, joint_take, variance, np.ones(joint_take.visible.shape, bool))
    # a change covers the joints of its fault and not those below them
    own_points = before.replace_markers(np.where(is_repaired[..., None], after.markers, before.markers), after.sample_sd)
    repaired_faults = [fault for fault in selected if is_repaired[fault.frame_slice][:, list(fault.markers)].any()]
    methods = np.where(is_repaired, np.array([REPAIR_DESCRIPTIONS[method] for method in RepairMethod], object)[repair.method], "")
    applied = [each for each, _ in changes.build_changes(before, before, own_points, repaired_faults, None, methods)]
    unfilled = find_unfilled_runs(after, np.where(rejection_reasons == "", UNAPPLIED_CHANGE_REASON, rejection_reasons))
    return RepairedAnimation(
        repaired, before, after, joint_take, Faults(tuple(faults)), (*applied, *(each.to_change() for each in reviewed)), unfilled
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
