"""What of a mended animation is put into it: what may be touched, is sure enough, and was not decided against."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mocapfix import changes
from mocapfix.animation import Animation
from mocapfix.animations import joint_points
from mocapfix.animations.repair import AnimationRepair, RepairMethod
from mocapfix.changes import Change, UnfilledRun, find_unfilled_runs
from mocapfix.faults import Fault, Faults, build_fault_mask
from mocapfix.fill.gap_filling import compute_editable_mask, compute_gap_durations, explain_rejections
from mocapfix.options import FillOptions
from mocapfix.report.review_file import ReviewedChange
from mocapfix.take import Take

LOST_KINDS = ("gap", "stuck")


@dataclass(frozen=True)
class RepairedAnimation:
    """A cleaned animation, and what there is to tell of it.

    animation      as it is now
    before, after  takes of the joints' tips, without what is not there; centres  the joints' places as they are now
    """

    animation: Animation
    tips_before: Take
    tips_after: Take
    joint_take: Take
    faults: Faults
    changes: tuple[Change, ...]
    unfilled: tuple[UnfilledRun, ...]


def apply_repairs(
    tips: Take,
    repair: AnimationRepair,
    faults: Sequence[Fault],
    fill_options: FillOptions,
    kinds: Sequence[str],
    reviewed: Sequence[ReviewedChange],
) -> RepairedAnimation:
    """-> an animation with what is to be put into it, all else as it was.

    tips  of the animation as it was read, its layout;  mended  everything, for all `faults`
    only  the kinds that are mended; none: all
    """
    lost = build_fault_mask([fault for fault in faults if fault.kind == "gap"], tips.visible.shape)
    before = tips.masked(~lost)
    made = [f for f in faults if (not kinds or f.kind in kinds) and not any(each.rejects(f) for each in reviewed)]
    touch = (
        build_fault_mask(made, lost.shape)
        & _compute_editable_mask(before, fill_options)
        & (repair.method != RepairMethod.UNCHANGED)
    )
    refused = _find_rejection_reasons(before, repair, faults, touch, fill_options)
    touched = touch & (refused == "")
    now = insert_repairs(joint_points.get_animation(tips), repair, touched)
    unsure = np.where(touched, repair.variance, 0.0)
    after = _add_deviation(joint_points.build_tip_take(now), unsure, touched | ~before.visible).masked(touched | ~lost)
    centres = joint_points.build_joint_take(now)
    centres = _add_deviation(centres, unsure, np.ones(centres.visible.shape, bool))
    told = (*_list_changes(before, after, made, repair, touched), *(each.to_change() for each in reviewed))
    left = find_unfilled_runs(after, np.where(refused == "", "its change was not to be made", refused))
    return RepairedAnimation(now, before, after, centres, Faults(tuple(faults)), told, left)


def insert_repairs(animation: Animation, repair: AnimationRepair, is_repaired: np.ndarray) -> Animation:
    """-> the animation with the courses `touched` (T, J + 1) as they are mended, and all others as they were."""
    now = animation
    for j in np.flatnonzero(is_repaired[:, :-1].any(0)):
        frames = np.flatnonzero(is_repaired[:, j])
        now = now.replace_values(now.replace_rotations(np.array([j]), frames, repair.local_rotations[frames, j][:, None]))
    frames = np.flatnonzero(is_repaired[:, -1])
    return (
        now.replace_values(now.replace_positions(np.array([0]), frames, repair.root_position[frames][:, None]))
        if len(frames)
        else now
    )


def _compute_editable_mask(before: Take, fill_options: FillOptions) -> np.ndarray:
    """-> (T, J + 1) bool: what the options allow to change; of the root that is kept also its place."""
    touch = compute_editable_mask(before, fill_options)
    touch[:, -1] &= touch[:, 0]
    return touch


def _find_rejection_reasons(
    before: Take, repair: AnimationRepair, faults: Sequence[Fault], editable: np.ndarray, fill_options: FillOptions
) -> np.ndarray:
    """-> (T, J + 1) object: why what is lost is not filled, "" elsewhere. A figure is not left half-way into a gap: where one
    sample of it is refused, all are."""
    lost = [fault for fault in faults if fault.kind in LOST_KINDS]
    gone = build_fault_mask(lost, editable.shape)
    whole = joint_points.build_tip_take(
        insert_repairs(joint_points.get_animation(before), repair, repair.method != RepairMethod.UNCHANGED)
    )
    unsure = np.where(
        repair.method == RepairMethod.UNCHANGED, np.nan, joint_points.compute_point_deviation(whole, repair.variance)
    )
    reasons = explain_rejections(before, gone & editable, compute_gap_durations(~gone, before.rate), unsure, fill_options)
    for fault in lost:
        if why := [reason for reason in reasons[fault.frame_slice][:, list(fault.markers)].ravel() if reason]:
            reasons[fault.frame_slice, list(fault.markers)] = why[0]
    return reasons


def _add_deviation(points: Take, variance: np.ndarray, is_estimated: np.ndarray) -> Take:
    """-> the take with how unsure its points are, which are the tips of its joints or their places, where they are `estimated`
    (T, M) and courses have a variance (T, J + 1)."""
    unsure = joint_points.compute_point_deviation(points, variance)
    return replace(points, sample_sd=np.where(is_estimated & (unsure > 0), unsure, np.nan))


def _list_changes(
    before: Take, after: Take, repaired_faults: Sequence[Fault], repair: AnimationRepair, is_repaired: np.ndarray
) -> list[Change]:
    """-> an entry for every fault of which something was put in: of its own joints, not of what hangs on them."""
    mine = before.replace_markers(np.where(is_repaired[..., None], after.markers, before.markers), after.sample_sd)
    about = [fault for fault in repaired_faults if is_repaired[fault.frame_slice][:, list(fault.markers)].any()]
    ways = np.where(is_repaired, np.array([method.description for method in RepairMethod], object)[repair.method], "")
    return [change for change, _ in changes.build_changes(before, before, mine, about, None, ways)]
