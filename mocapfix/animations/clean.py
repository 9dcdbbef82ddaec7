"""Whose joints an animation's are: people's, where their names say so, so that what is known of people can be asked of them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mocapfix.animation import Animation
from mocapfix.animations import apply_repairs, joint_mapping, joint_points
from mocapfix.animations import detect as detected
from mocapfix.animations import repair as solved
from mocapfix.animations.joint_mapping import find_ancestor
from mocapfix.animations.repair import MappedPriorConditioner
from mocapfix.animations.retarget import SkeletonAlignment, align_skeleton, convert_to_cmu31
from mocapfix.errors import SceneError, TakeError
from mocapfix.faults import Fault, Faults
from mocapfix.motion import FrameStatus, Motion
from mocapfix.options import FillOptions
from mocapfix.report import notes, report_data, review_file
from mocapfix.report.stage_timer import StageTimer
from mocapfix.result import CleaningResult
from mocapfix.solve.body_fit import FitSettings
from mocapfix.subject import Subject
from mocapfix.take import Take


# MERGED: mocapfix.animated_body
@dataclass(frozen=True)
class AnimationBody:
    """The 31 joints in an animation: its tree parents (J,), and how they lie in it."""

    parents: np.ndarray
    alignment: SkeletonAlignment

    def build_pose_conditioner(self, fit_settings: FitSettings) -> MappedPriorConditioner | None:
        """-> whom to ask of lost joints; None where nobody is to be asked."""
        return (
            MappedPriorConditioner(
                fit_settings.load_pose_model, fit_settings.solve_options.prior_scale, self.parents, self.alignment
            )
            if fit_settings.load_pose_model
            else None
        )

    def compute_motion(self, joint_take: Take) -> tuple[Subject | None, Motion | None]:
        """-> the body and its motion, of the places of an animation's joints; None where some number of it is not there."""
        root, local = convert_to_cmu31(joint_points.get_animation(joint_take), self.alignment)
        if not (np.isfinite(root).all() and np.isfinite(local).all()):
            return None, None
        known, ours = self.alignment.file_joints >= 0, self.alignment.skeleton
        told = [joint if known[joint] else find_ancestor(joint, ours.parents, known) for joint in range(len(known))]
        none, unsure = np.zeros(joint_take.frame_count, int), np.zeros(joint_take.visible.shape)
        if joint_take.sample_sd is not None:
            unsure = np.nan_to_num(joint_take.sample_sd)
        motion = Motion(
            root,
            local,
            none + FrameStatus.PLACED,
            none,
            np.zeros((joint_take.frame_count, 0)),
            unsure[:, self.alignment.file_joints[told]],
        )
        return Subject(ours, "", (), np.zeros(0, int), np.zeros((0, 3)), np.zeros(0)), motion


def find_body(animation: Animation, hierarchy: str | Path | None = None) -> tuple[AnimationBody | None, str]:
    """-> the body of an animation, None where it is nobody's, and a sentence that says why.

    hierarchy  a style of joints' names or its YAML file; None: the one that finds most of the 31
    Raises SceneError where there is no such style, or where the given one finds no body.
    """
    choice = joint_mapping.map_joints(animation.names, animation.parents, hierarchy)
    if choice.mapping is None:
        if hierarchy is not None:
            raise SceneError(f"{hierarchy}: does not fit {animation.name}. {choice.reason}")
        return None, choice.reason
    fit = align_skeleton(animation, choice.mapping)
    if fit is None:
        return None, "The figure stands neither in its rest pose nor ever, so that its joints cannot be compared with people's."
    return AnimationBody(animation.parents, fit), choice.reason


# MERGED: mocapfix.animated
# The stages in order for an animation: what a solver, a suit or a film made of somebody's joints, cleaned.
#
#     animation = take.layout                       its own numbers, and what they mean: turns of joints, a place of the root
#     body      = animated_body.of(...)             the joints of people among its own, where their names tell
#     faults    = found(...)                        what is lost, pops and flips, trembles
#     mended    = solve.turns.mended(...)           each as its kind allows
#     put       = animated_changes.put(...)         what may be touched, is sure enough and was not decided against
#
# Every other number stays as it was. The takes are of the joints' tips, so that a joint which turns wrongly is a point in the
# wrong place.
def clean_animation(
    animation: Animation,
    fit_settings: FitSettings,
    hierarchy: str | Path | None,
    fill_options: FillOptions,
    kinds: Sequence[str],
    review_files: Sequence[str | Path],
    timer: StageTimer,
) -> CleaningResult:
    """-> an animation cleaned: what is wrong with its joints' turns and its root's place found and mended, all else as it was.

    hierarchy  a style of joints' names or its YAML file; None: the one that finds most of people's joints
    files      the changes file of an earlier cleaning of this animation, with somebody's decisions
    Else as `pipeline.clean`, also in what it raises.
    """
    tips = joint_points.build_tip_take(animation)
    decided = review_file.read_review_files(review_files, [tips])[0]
    with timer("detect"):
        body, whose = find_body(animation, hierarchy)
        faults = [fault for fault in detect_animation_faults(animation) if not any(each.keeps(fault) for each in decided)]
    with timer("solve"):
        people = body.build_pose_conditioner(fit_settings) if body else None
        given = (
            animation.parents,
            animation.compute_local_positions()[:, 0],
            animation.compute_local_rotations(),
            list_rotation_orders(animation),
        )
        mended = solved.repair_animation(*given, faults, animation.rate, people)
    with timer("fill"):
        put = apply_repairs.apply_repairs(tips, mended, faults, fill_options, kinds, decided)
        centres = put.joint_take
        subject, motion = body.compute_motion(centres) if body else (None, None)
    report = {
        "take": report_data.build_take_section(centres, None),
        "faults": report_data.build_fault_entries(put.tips_before, put.faults),
        "changes": review_file.serialize_changes(put.changes),
        "subject": None,
        "solve": None,
        "fill": report_data.build_fill_section(put.tips_before, put.tips_before, put.tips_after, put.unfilled),
        "seconds": timer.stage_seconds,
        "notes": [*animation.notes, whose, *notes.describe_uncertain_fills(put.tips_after)],
    }
    if body and motion is None:
        report["notes"].append("Numbers are missing that nothing could tell, so that there is no motion of the 31 joints.")
    takes = put.tips_before, put.tips_before, put.tips_after
    return CleaningResult(
        *takes, put.faults, put.changes, put.unfilled, (), subject, motion, None, None, report, joint_centres=centres
    )


def inspect_animation(animation: Animation, hierarchy: str | Path | None = None) -> dict:
    """-> the record's take, faults and notes of what `clean` would find."""
    _, whose = find_body(animation, hierarchy)
    take, faults = joint_points.build_joint_take(animation), Faults(tuple(detect_animation_faults(animation)))
    return report_data.build_inspection_report(
        take, None, joint_points.build_tip_take(animation), faults, [*animation.notes, whose]
    )


def detect_animation_faults(animation: Animation) -> list[Fault]:
    """-> what is wrong with an animation, by joint and first frame; its markers are indices into `joint_points.tips`."""
    local, root = animation.compute_local_rotations(), animation.compute_local_positions()[:, 0]
    faults = detected.detect_pose_faults(animation.names, root, local, list_rotation_orders(animation), animation.rate)
    told = [replace(each, severity_unit="rad") if each.marker < len(animation.names) else each for each in faults]
    return sorted(told, key=lambda fault: (fault.marker, fault.first))


def list_rotation_orders(animation: Animation) -> list[str]:
    """-> each joint's axes of rotation, the outermost first, as "ZYX"; "" where it has none of its own."""
    return ["".join("XYZ"[axis] for axis in animation.get_rotation_channels(j)[1]) for j in range(len(animation.names))]


def check_animation_options(take: Take, marker_options: Mapping[str, object], hierarchy: object) -> None:
    """Raise TakeError where an option is given that is about what the take has not: markers or joints."""
    if not isinstance(take.layout, Animation):
        if hierarchy is not None:
            raise TakeError(f"{take.name}: has markers and no joints, of which --hierarchy tells; clean it without.")
    elif given := [option for option, value in marker_options.items() if value]:
        raise TakeError(f"{take.name}: has joints and no markers, of which {' and '.join(given)} tells; clean it without.")
