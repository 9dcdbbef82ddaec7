"""Clean an animation: detect, repair, apply decisions, report.

    body      = find_body(animation, ...)              its joints that correspond to the 31-joint skeleton, by their names
    faults    = detect_animation_faults(animation)     lost values, pops, flips, jitter
    repair    = repair_animation(..., faults, ...)     by the method that suits each kind of fault
    repaired  = apply_repairs(animation, repair, ...)  only changes that are allowed, certain enough and not rejected
    contacts  = find_animation_contacts(...)           with the floor, and events of gait

All other values stay as they are. Faults and changes refer to the joint tips (see `build_tip_take`).
`MappedPriorConditioner` applies the trained models of poses and motion to the joints of the animation.
"""

import shutil
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from mocapfix.animations.detect import detect_animation_faults, list_rotation_orders
from mocapfix.animations.lock_feet import SlidingFeet, lock_feet
from mocapfix.animations.repair import apply_repairs, repair_animation
from mocapfix.characters.alignment import SIDE_PREFIXES, SkeletonAlignment, align_skeleton
from mocapfix.characters.bone_mapping import map_joints, map_joints_by_shape
from mocapfix.contacts.contacts import CONTACT_JOINTS, FOOT_JOINTS, OTHER_CONTACT_JOINTS
from mocapfix.contacts.find_contacts import estimate_slide, find_contacts, replace_contacts
from mocapfix.contacts.gait_events import build_foot_points, detect_gait_events
from mocapfix.errors import SceneError, TakeError, join_words
from mocapfix.io.changes_file import read_changes_files, reject_corrections
from mocapfix.io.contact_files import read_contacts
from mocapfix.io.conventions import estimate_height
from mocapfix.io.patches import patch_animation
from mocapfix.kernels import lie
from mocapfix.model.animation import Animation, build_joint_take, build_tip_take
from mocapfix.model.changes import serialize_changes
from mocapfix.model.faults import Fault, Faults, build_fault_mask
from mocapfix.model.motion import FrameStatus, Motion
from mocapfix.model.skeleton import compose_transforms, is_below
from mocapfix.model.stage_timer import StageTimer
from mocapfix.model.subject import Subject
from mocapfix.model.take import Take
from mocapfix.options import FEET_LOCK, OPTIONS, CleanOptions, check_take_options
from mocapfix.report import build_report, notes
from mocapfix.report.build_report import build_contact_section, describe_contacts
from mocapfix.report.report import InspectionReport, Report
from mocapfix.report.terms import JOINT_TERMS
from mocapfix.result import CleaningResult
from mocapfix.solve import kinematics
from mocapfix.solve.kinematics import compute_world_poses
from mocapfix.solve.motion_prior import GapContext, GapPrediction, predict_shipped_gap
from mocapfix.solve.pose_prior import PoseModel
from mocapfix.solve.prior_conditioner import PriorConditioner
from mocapfix.stats.sequences import find_runs, sample_evenly

if TYPE_CHECKING:
    from mocapfix.report.sample_states import CleaningComparison


MAX_MAPPING_POSES = 100  # frames in which a figure whose joint names are unknown may stand upright
JOINT_SOURCE = "joints"  # the source of events that follow from joints
MIN_FINGER_JOINTS = 6  # below a hand, two of each of three fingers
MAX_STILL_STEP_RAD = 1e-5  # from frame to frame: rounding to four decimals of a degree makes steps of up to 4e-6
MIN_STILL_S = 1.0  # for which all fingers are still, and of this the least for which the arm turns
MIN_ARM_TURN_RAD_PER_S, ARM_TURN_S = 0.2, 0.25  # the mean over this time, which noise does not reach


def find_animation_contacts(
    animation: Animation,
    alignment: SkeletonAlignment,
    subject: Subject,
    motion: Motion,
    given: Mapping[str, Bool[np.ndarray, " T"]] | None = None,
) -> SlidingFeet:
    """Find the contacts and the events of gait of an animation, by the motion of the 31-joint skeleton in it.

    Where feet slide, they are those of the body whose path fits its steps, unless they are given by joint. A reference pose
    before the motion (the T-pose of CMU's BVH release) has no contacts.
    """
    skeleton = subject.skeleton
    start = int(animation.has_reference_pose and animation.frame_count > 1)
    moving = motion.select_frames(np.arange(start, motion.frame_count))
    position = kinematics.compute_world_poses(skeleton, moving)[0]
    position[:, ~find_placed_joints(animation, alignment)] = np.nan
    contacts, slide = find_contacts(skeleton, moving, position, animation.rate), np.zeros((len(position), 3))
    if contacts.has_feet:
        toes = position[:, [skeleton.names.index(joints[1]) for joints in FOOT_JOINTS.values()]]
        if given is not None:
            contacts = replace_contacts(contacts, {joint: each[start:] for joint, each in given.items()}, toes)
        slide, is_support = estimate_slide(position[:, 0], toes, contacts, is_given=given is not None)
        moving = replace(moving, root_position=moving.root_position - slide)
        if given is None and is_support.any():
            contacts = find_contacts(skeleton, moving, position - slide[:, None], animation.rate)
            standing = {joint: contacts.is_contact[:, column] for column, joint in enumerate(contacts.joints)}
            supports = {
                joints[1]: each | standing[joints[1]] for joints, each in zip(FOOT_JOINTS.values(), is_support.T, strict=True)
            }
            contacts = replace_contacts(contacts, standing | supports, toes - slide[:, None])
        no_markers = np.zeros((len(position), 0, 3))
        feet = build_foot_points(subject, moving, no_markers, no_markers, contacts.is_known)
        events = detect_gait_events(feet, contacts.floor, animation.rate)
        delay_s = start / animation.rate
        shifted = tuple(event._replace(time_s=event.time_s + delay_s, source=JOINT_SOURCE) for event in events)
        contacts = replace(contacts, events=shifted)
    padding = ((start, 0), (0, 0))
    is_contact, probability = (np.pad(each, padding) for each in (contacts.is_contact, contacts.probability))
    is_known = np.pad(contacts.is_known, padding, constant_values=contacts.has_feet)
    contacts = replace(contacts, is_contact=is_contact, probability=probability, is_known=is_known)
    return SlidingFeet(contacts, np.pad(slide, padding, mode="edge"), is_given=given is not None)


def find_placed_joints(animation: Animation, alignment: SkeletonAlignment) -> Bool[np.ndarray, " 31"]:
    """Return which of the 31 joints that can be in contact the animation places; True for all others.

    A ball of a foot without a joint is placed if the foot has an end site, which shows where the foot points.
    """
    names, is_known = alignment.skeleton.names, alignment.is_mapped
    is_placed = np.ones(len(names), bool)
    for joint in (*CONTACT_JOINTS, *OTHER_CONTACT_JOINTS):
        is_placed[names.index(joint)] = is_known[names.index(joint)]
    for foot, toe in (map(names.index, joints) for joints in FOOT_JOINTS.values()):
        if is_known[foot] and not is_known[toe]:
            end_sites = animation.end_sites[alignment.source_joints[foot]]
            is_placed[toe] = len(end_sites) > 0 and bool(np.any(end_sites[0]))
    return is_placed


@dataclass(frozen=True, kw_only=True)
class MappedPriorConditioner(PriorConditioner):
    """Trained models of poses and motion, applied to the joints of a file, which are mapped to the model's 31 joints."""

    parents: Int[np.ndarray, " J"]  # the tree of the file
    alignment: SkeletonAlignment  # the model's joints in the file

    def predict_gap(self, context: GapContext, joints: Int[np.ndarray, " L"]) -> GapPrediction | None:
        """As `PriorConditioner.predict_gap`, for joints of the file."""
        if self.predict_motion is None or self.alignment.source_joints[0] != 0:  # the root's position is that of the hips
            return None
        context, file_joints = context.crop(), self.alignment.source_joints
        _, world = compose_transforms(self.parents, np.zeros(context.local_rotations.shape[:3]), context.local_rotations)
        is_known = context.is_known[:, self.alignment.carriers]
        model = context._replace(local_rotations=self.alignment.convert_rotations(world), is_known=is_known)
        predicted = self.predict_motion(model, self.alignment.skeleton.size_ratio)
        if predicted is None:
            return None
        file_rotations = context.local_rotations[context.frames].copy()
        variance = np.full(file_rotations.shape[:2], np.inf)
        for joint in np.flatnonzero((file_joints >= 0) & np.isin(file_joints, joints)).tolist():
            if np.isfinite(predicted.variance[:, joint]).all():
                file_rotations[:, file_joints[joint]] = self.alignment.convert_rotation_back(
                    joint, predicted.rotations, self.parents, file_rotations
                )
                variance[:, file_joints[joint]] = predicted.variance[:, joint]
        return predicted._replace(rotations=file_rotations, variance=variance).select_joints(joints)

    def predict_rotations(
        self,
        local_rotations: Float[np.ndarray, "T J 3 3"],
        observed_joints: Int[np.ndarray, " O"],
        occluded_joints: Int[np.ndarray, " L"],
        frames: Int[np.ndarray, " N"],
        reference: Float[np.ndarray, "N Q"],
    ) -> Float[np.ndarray, "N Q"]:
        """As `PriorConditioner.predict_rotations`, for joints of the file; `reference` for joints without a counterpart."""
        file_joints = self.alignment.source_joints[1:]
        observed, occluded = (1 + np.flatnonzero(np.isin(file_joints, joints)) for joints in (observed_joints, occluded_joints))
        if not len(observed) or not len(occluded):
            return reference
        file_rotations = local_rotations[frames]
        _, world_rotations = compose_transforms(self.parents, np.zeros(file_rotations.shape[:3]), file_rotations)
        model_rotations = self.alignment.convert_rotations(world_rotations)
        any_sign = np.ones((len(frames), 4 * len(occluded)))
        predicted = super().predict_rotations(model_rotations, observed, occluded, np.arange(len(frames)), any_sign)
        for i, joint in enumerate(occluded):
            model_rotations[:, joint] = Rotation.from_quat(predicted[:, 4 * i : 4 * i + 4]).as_matrix()
            file_rotations[:, self.alignment.source_joints[joint]] = self.alignment.convert_rotation_back(
                int(joint), model_rotations, self.parents, file_rotations
            )
        result = reference.reshape(len(frames), len(occluded_joints), 4).copy()
        for i, joint in enumerate(occluded_joints):
            if joint in self.alignment.source_joints[occluded]:
                all_frames = np.ones(len(frames), bool)
                joint_quaternions = 2 * lie.extract_joint_quaternions(file_rotations, int(joint), all_frames)
                is_opposite = (joint_quaternions * result[:, i]).sum(1, keepdims=True) < 0
                result[:, i] = np.where(is_opposite, -joint_quaternions, joint_quaternions)
        return result.reshape(reference.shape)


@dataclass(frozen=True, kw_only=True)
class AnimationResult(CleaningResult):
    """A cleaned animation.

    The takes `input_take`, `relabelled_take` and `take` hold the joint tips (see `build_tip_take`). Subject and
    motion are those of the 31-joint skeleton, None if the joint names are not those of a body.
    """

    input_animation: Animation  # input_animation, animation: as read, and cleaned
    animation: Animation
    joint_take: Take  # joint positions of the cleaned animation

    @property
    def output_take(self) -> Take:
        """The points that files of points hold: the joint positions of the cleaned animation."""
        return self.joint_take

    def write_source_copy(self, target: Path) -> list[tuple[int, int]]:
        """Write a copy of the input file with the changed values replaced; for an AMC also a copy of its ASF.

        Returns an empty list: the file stores every value, or WriteError is raised.
        """
        patch_animation(target, self.input_animation, self.animation.values)
        if self.input_animation.skeleton_path:
            shutil.copyfile(self.input_animation.skeleton_path, target.with_suffix(".asf"))
        return []

    @cached_property
    def comparison(self) -> "CleaningComparison":
        """The animation before and after cleaning, for the report and the recording."""
        positions = self.animation.compute_world_poses()[0]
        comparison = replace(super().comparison, skeleton=self.animation.skeleton, joint_position_world=positions)
        if self.contacts is None or self.subject is None or self.motion is None:
            return comparison
        model, columns = self.subject.skeleton, [self.subject.skeleton.names.index(joint) for joint in self.contacts.joints]
        return replace(comparison, contact_position_world=compute_world_poses(model, self.motion)[0][:, columns])


@dataclass(frozen=True)
class AnimationBody:
    """The 31-joint skeleton in an animation: the tree of the animation's joints, parents (J,), and the alignment with it."""

    parents: np.ndarray
    alignment: SkeletonAlignment

    def compute_motion(self, animation: Animation, joint_take: Take) -> tuple[Subject, Motion] | None:
        """Compute the motion of the 31-joint skeleton; None if the animation lacks values that it needs.

        The standard deviations are those of the joints in `joint_take`.
        """
        root_position, local_rotations = self.alignment.convert_poses(*animation.compute_world_poses())
        if not (np.isfinite(root_position).all() and np.isfinite(local_rotations).all()):
            return None
        sd = np.zeros(joint_take.visible.shape)
        if joint_take.sample_sd is not None:
            sd = np.nan_to_num(joint_take.sample_sd)
        zeros = np.zeros(joint_take.frame_count, int)
        motion = Motion(
            root_position,
            local_rotations,
            zeros + FrameStatus.PLACED,
            zeros,
            np.zeros((joint_take.frame_count, 0)),
            sd[:, self.alignment.carriers],
        )
        return Subject(self.alignment.body, "", (), np.zeros(0, int), np.zeros((0, 3)), np.zeros(0)), motion


def find_body(animation: Animation, hierarchy: str | Path | None = None) -> tuple[AnimationBody | None, str]:
    """Find the 31-joint skeleton in an animation by its joint names, or else by the shape of the skeleton.

    The naming convention `hierarchy`, or a YAML file, is used, by default the one that matches the most joints.

    Returns:
        The body, None if the animation is not of a whole body, and a sentence: what was found, or why nothing.

    Raises:
        SceneError: If there is no such convention or if the given one does not match.
    """
    mapping = map_joints(animation.names, animation.parents, hierarchy)
    if mapping.file_joints is None and hierarchy is None:
        frames = sample_evenly(animation.frame_count, MAX_MAPPING_POSES)
        posed = animation.replace_values(animation.values[frames]).compute_world_poses()[0]
        poses = (each for each in (animation.skeleton.rest_positions, *posed) if np.isfinite(each).all())
        mapping = map_joints_by_shape(animation.names, animation.parents, poses) or mapping
    if mapping.file_joints is None:
        if hierarchy is not None:
            raise SceneError(f"{hierarchy}: does not fit {animation.name}. {mapping.reason}")
        return None, mapping.reason
    alignment = align_skeleton(animation, mapping.file_joints)
    if alignment is None:
        return (
            None,
            "The figure is upright neither in its rest pose nor in any frame, so it cannot be aligned with the body model; "
            "if another axis of the file is vertical, give it with --up.",
        )
    frame = f"in frame {animation.first_frame + alignment.upright_frame}" if alignment.upright_frame >= 0 else "in the rest pose"
    scale = f"{estimate_height(animation):.2f} m tall with {animation.unit_m * 1e3:.4g} mm a unit"
    return AnimationBody(animation.parents, alignment), f"{mapping.reason.rstrip('.')}; {scale}, upright {frame}."


def describe_still_fingers(animation: Animation, body: AnimationBody | None, faults: Iterable[Fault]) -> list[str]:
    """Return a note for hands whose fingers never move, or stop for MIN_STILL_S, while the arm turns.

    Frames with a fault of the arm or a finger do not count, nor does a reference pose. A joint that carries several
    fingers is a palm.
    """
    start, parents = int(animation.has_reference_pose), animation.parents
    rotations, lag = animation.compute_local_rotations()[start:], max(1, round(ARM_TURN_S * animation.rate))
    min_frames, last_frame = max(1, round(MIN_STILL_S * animation.rate)), len(rotations) - 1
    if body is None or last_frame < max(lag, min_frames):
        return []
    is_step, is_turn = (
        np.linalg.norm(rotations[step:] - rotations[:-step], axis=(2, 3)) > np.sqrt(2) * angle
        for step, angle in ((1, MAX_STILL_STEP_RAD), (lag, MIN_ARM_TURN_RAD_PER_S * lag / animation.rate))
    )
    is_turn = np.pad(is_turn, ((lag // 2, lag - 1 - lag // 2), (0, 0)))
    is_sound = ~build_fault_mask(faults, (animation.frame_count, len(parents) + 1))[start:]
    sides: dict[str, list[str]] = {}  # by what is wrong
    for side in SIDE_PREFIXES:
        names = [body.alignment.skeleton.names.index(side + name) for name in ("Arm", "ForeArm", "Hand", "FingerBase")]
        *arm, hand, wrist = body.alignment.source_joints[names].tolist()
        below = [joint for joint in range(len(parents)) if joint != wrist and is_below(joint, hand, parents)]
        fingers = [joint for joint in below if np.sum(parents == joint) <= 1]
        if min(*arm, hand) < 0 or len(fingers) < MIN_FINGER_JOINTS:
            continue
        is_known = np.all(is_sound[:, fingers + arm], axis=1)
        is_known = is_known[1:] & is_known[:-1]
        moves, turns = is_step[:, fingers] & is_known[:, None], is_turn[:, arm].any(1) & is_known
        runs = find_runs(~moves.any(1) & is_known) if moves.any(0).sum() >= MIN_FINGER_JOINTS else []
        runs = runs if moves.any() else [(0, last_frame - 1)]
        runs = [(a, b + 1) for a, b in runs if b - a + 1 >= min_frames and turns[a : b + 1].sum() >= min_frames]
        if runs:
            count = sum(b - a + 1 for a, b in runs)
            ranges = f"do not move in frames {notes.list_frame_ranges(runs, animation.first_frame + start)} ({count:,} frames)"
            sides.setdefault(ranges if moves.any() else "never move", []).append(side.lower())
    return [
        f"The fingers of the {join_words(hands)} hand {stillness} while the arm does, and are left so: "
        "if they should move, export the fingers again."
        for stillness, hands in sides.items()
    ]


def clean_animation(
    animation: Animation, options: CleanOptions, load_pose_model: Callable[[], PoseModel] | None, timer: StageTimer
) -> AnimationResult:
    """Clean an animation: detect and repair faults in its joint rotations and in its root's position.

    The pose prior is loaded when lost joints are predicted, if there is one. Raises as `pipeline.clean`.
    """
    reject_marker_options(animation, options)
    check_take_options(build_joint_take(animation), options, "joint")
    review = read_changes_files(options.review.review_files, [build_tip_take(animation)])[0]
    contacts_file = options.contacts.contacts_file
    given = None if contacts_file is None else read_contacts(Path(contacts_file), animation.frame_count)
    reject_corrections(review, animation.name, "this is an animation")
    with timer("detect"):
        body, mapping_note = find_body(animation, options.subject.hierarchy)
        faults = [fault for fault in detect_animation_faults(animation) if not any(each.keeps(fault) for each in review.declined)]
    with timer("solve"):
        conditioner = None  # the pose prior that predicts lost joints
        if body and load_pose_model:
            model = load_pose_model, options.solve.prior_scale, predict_shipped_gap
            conditioner = MappedPriorConditioner(*model, parents=body.parents, alignment=body.alignment)
        repair = repair_animation(
            animation.parents,
            animation.compute_local_positions()[:, animation.moving_joint],
            animation.compute_local_rotations(),
            list_rotation_orders(animation),
            faults,
            animation.rate,
            conditioner,
        )
    with timer("fill"):
        repaired = apply_repairs(animation, repair, faults, options, review.declined)
        body_motion = body.compute_motion(repaired.animation, repaired.joint_take) if body else None
    with timer("solve"):
        contacts, contact_notes = None, notes.describe_uncertain_fills(repaired.tips_after, JOINT_TERMS)
        if body and body_motion:
            feet = find_animation_contacts(repaired.animation, body.alignment, *body_motion, given)
            contacts = feet.contacts
            if options.contacts.feet == FEET_LOCK and contacts.has_feet:
                held = lock_feet(repaired, body.alignment, body_motion[1], feet, options.fill, review.declined)
                repaired, contacts, contact_notes = held.repaired, held.contacts, contact_notes + held.notes
                body_motion = body.compute_motion(repaired.animation, repaired.joint_take)
            contact_notes += describe_contacts(contacts, contacts.held_feet.mode, options.output.floor_height_m, JOINT_TERMS)
    before, after = repaired.tips_before, repaired.tips_after
    is_moving = np.arange(animation.frame_count)[:, None] >= int(animation.has_reference_pose)
    contact_notes += notes.describe_frame_steps(repaired.joint_take.masked(is_moving))
    report: Report = {
        "take": build_report.build_take_section(repaired.joint_take, None),
        "faults": build_report.build_fault_entries(before, repaired.faults),
        "changes": serialize_changes(repaired.changes),
        "subject": None,
        "solve": None,
        "fill": build_report.build_fill_section(before, before, after, repaired.unfilled),
        "seconds": timer.stage_seconds,
        "times": timer.part_times,
        "notes": [*animation.notes, mapping_note, *describe_still_fingers(animation, body, faults), *contact_notes],
    }
    if contacts:
        report["contacts"] = build_contact_section(contacts, before)
    if body and body_motion is None:
        report["notes"].append("Some values are missing and could not be estimated, so there is no motion of the body model.")
    subject, motion = body_motion or (None, None)
    return AnimationResult(
        input_take=before,
        relabelled_take=before,
        take=after,
        faults=repaired.faults,
        changes=repaired.changes,
        unfilled_runs=repaired.unfilled,
        subject=subject,
        motion=motion,
        contacts=contacts,
        report=report,
        review=review,
        input_animation=animation,
        animation=repaired.animation,
        joint_take=repaired.joint_take,
    )


def inspect_animation(animation: Animation, options: CleanOptions) -> InspectionReport:
    """Return the report of the faults that `clean_animation` would detect, without repairing them."""
    reject_marker_options(animation, options)
    body, mapping_note = find_body(animation, options.subject.hierarchy)
    tips, faults = build_tip_take(animation), Faults(tuple(detect_animation_faults(animation)))
    joint_take = build_joint_take(animation)
    found = [*animation.notes, mapping_note, *describe_still_fingers(animation, body, faults.items)]
    return build_report.build_inspection_report(joint_take, None, tips, faults, found)


def reject_marker_options(animation: Animation, options: CleanOptions) -> None:
    """Raise TakeError if options are given that apply to markers only."""
    given = [option.flag for option in OPTIONS if option.for_markers and option.get_value(options) != option.default]
    if given:
        raise TakeError(f"{animation.name}: is an animation, which has no markers; clean it without {' and '.join(given)}.")
