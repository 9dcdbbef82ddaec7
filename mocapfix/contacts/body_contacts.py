"""The stage of contacts: find those of the solved body, and hold its feet in them.

The legs are solved so that feet in contact are where they shall be. The contacts are point terms on the ankles and the toes, in
all frames in which a foot is displaced, beside terms that keep the legs' rotations and the root as they were, and the visible
markers of thighs and shins. The weights do not depend on contacts, so that no knee jumps where one begins. The root yields by
MAX_ROOT_DISPLACEMENT_M at most: a place that a leg does not reach from there is not where its foot stands.

While no marker shows a held foot, it is as certain as where it stood before and after, up to its rolling. Two motions result:
that of the body, whose feet yield where visible markers contradict, and one with all feet held, from which lost markers are
filled.
"""

import mmap
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from operator import call
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.contacts.contacts import CONTACT_JOINTS, FOOT_JOINTS, BodyContacts, HeldFeet, StandingBody
from mocapfix.contacts.find_contacts import find_contacts
from mocapfix.contacts.foot_displacements import compute_foot_displacements
from mocapfix.contacts.gait_events import build_foot_points, detect_gait_events
from mocapfix.contacts.plate_contacts import align_contacts_with_plates, find_plate_contacts, merge_events
from mocapfix.io.c3d_events import read_gait_events
from mocapfix.io.force_plates import read_force_plates
from mocapfix.model.body_fit import BodyFit
from mocapfix.model.motion import Motion
from mocapfix.model.skeleton import Skeleton
from mocapfix.model.subject import Subject
from mocapfix.model.take import C3dLayout, Take
from mocapfix.options import FEET_LOCK, FEET_OFF
from mocapfix.solve import kinematics
from mocapfix.solve.kinematics import LegPath, Poses, measure_length, reach_ankle
from mocapfix.solve.measured_segments import (
    MAX_RESIDUAL_GROWTH_M,
    SHARE_SMOOTHING_S,
    compute_allowed_share,
    measure_residual_growth,
    smooth_share,
)
from mocapfix.solve.minimise import SolverSettings, minimise
from mocapfix.solve.parallel import map_in_threads
from mocapfix.solve.pose_problem import find_key_frames
from mocapfix.solve.terms import KinematicTree, PointTerm, TrackingTerm, build_no_joint_limits, build_no_pose_prior
from mocapfix.stats.sequences import find_runs, slide_windows, smooth_values

ROLLING_SD_M = 0.006  # standard deviation per axis of ankle or toes of a foot about where they stand when markers show them
SHINS = {"left": "LeftLeg", "right": "RightLeg"}


def reduce_held_uncertainty(subject: Subject, motion: Motion, contacts: BodyContacts) -> Motion:
    """Return the motion with the standard deviations of feet, and of the markers on feet and shins, while these are held."""
    joint_sd, marker_sd = motion.joint_sd.copy(), motion.marker_sd.copy()
    skeleton = subject.skeleton
    for side, joints in FOOT_JOINTS.items():
        feet = [skeleton.find_joint(joint) for joint in joints]
        columns = [contacts.joints.index(joint) for joint in joints]
        is_held = np.stack([_find_held_occlusions(contacts.is_contact[:, c], contacts.is_known[:, c]) for c in columns], axis=1)
        for joint, is_joint_held, column in zip(feet, is_held.T, columns, strict=True):
            usual = _compute_known_sd(motion.joint_sd[:, joint], contacts.is_known[:, column])
            joint_sd[is_joint_held, joint] = np.minimum(joint_sd[is_joint_held, joint], np.hypot(usual, ROLLING_SD_M))
        shin = skeleton.find_joint(SHINS[side])
        is_foot_held, is_ankle_known = np.all(is_held, axis=1), contacts.is_known[:, columns[0]]
        for k in np.flatnonzero(np.isin(subject.joints, [*feet, shin])) if marker_sd.size else []:
            usual = _compute_known_sd(motion.marker_sd[:, k], is_ankle_known)
            to_ankle = skeleton.offsets[feet[0]]
            along_shin = np.clip(subject.marker_offsets[k] @ to_ankle / (to_ankle @ to_ankle), 0, 1)  # 0 at the knee
            share = float(along_shin) if subject.joints[k] == shin else 1.0
            held = np.hypot(usual, share * ROLLING_SD_M + (1 - share) * motion.marker_sd[is_foot_held, k])
            marker_sd[is_foot_held, k] = np.minimum(marker_sd[is_foot_held, k], held)
    return replace(motion, joint_sd=joint_sd, marker_sd=marker_sd)


def _find_held_occlusions(is_contact: Bool[np.ndarray, " T"], is_known: Bool[np.ndarray, " T"]) -> Bool[np.ndarray, " T"]:
    """Return the unknown frames of those runs throughout which a joint stands where a known frame beside the run shows it."""
    is_held, is_shown = np.zeros(len(is_contact), bool), is_contact & is_known
    for first, last in find_runs(~is_known):
        is_held[first : last + 1] = is_contact[first : last + 1].all() and is_shown[max(first - 1, 0) : last + 2].any()
    return is_held


def _compute_known_sd(sd: Float[np.ndarray, " T"], is_known: Bool[np.ndarray, " T"]) -> float:
    """Return the median of the standard deviations in known frames, 0 without any."""
    return float(np.median(sd[is_known])) if is_known.any() else 0.0


LEG_SEGMENTS = (("LeftUpLeg", "LeftLeg"), ("RightUpLeg", "RightLeg"))  # thigh and shin, in the order of FOOT_JOINTS
LEG_JOINTS = ("LeftUpLeg", "LeftLeg", "LeftFoot", "RightUpLeg", "RightLeg", "RightFoot")
CONTACT_SD_M = 0.0015  # standard deviation of a joint about its place in a contact: it yields where its leg is nearly straight
LEG_ROTATION_SD_RAD = 0.05  # standard deviation of a leg's joint about its rotation before
ROOT_ROTATION_SD_RAD = 0.0005
ROOT_SD_M = 0.01  # of the root: a straight leg bends far for a foot that comes nearer by a few millimetres
MAX_ROOT_DISPLACEMENT_M = 0.0015  # largest displacement of the root, which carries pelvis, trunk, head and arms along
ROOT_LIMIT_EXPONENT = 4  # exponent with which the displacement approaches its limit; smaller ones change those below it more
FIXED_ROOT_SHARE = 1e-3  # share of these deviations by which a root that is fixed may move during the solve
LEG_MARKER_SD_M = 0.003  # standard deviation of thighs' and shins' markers about their places, while their foot is displaced
MARKER_DISPLACEMENT_M = 0.005  # displacement of a foot at which the markers of its leg have half their weight
MIN_KERNEL_WEIGHT = 1e-6  # share of a kernel within visible frames below which a residual is not known
MIN_DISPLACEMENT_M = 2e-5  # displacement below which a frame is not solved
MIN_HELD_PROBABILITY = 0.3  # of the contact of a hidden foot, above which it is held: its joints are then nearer to the truth


def compute_held_displacements(
    skeleton: Skeleton,
    joint_position: Float[np.ndarray, "T J 3"],
    contacts: BodyContacts,
    *,
    is_locked: bool,
    joint_sd: Float[np.ndarray, "T J"] | None = None,
) -> Float[np.ndarray, "T C 3"]:
    """Return the displacement in metres of each joint of the feet that holds them, where legs reach, in every frame."""
    feet = [skeleton.names.index(joint) for joint in CONTACT_JOINTS]
    position, position_sd = joint_position[:, feet], None if joint_sd is None else joint_sd[:, feet]
    of_feet = contacts.select_feet()
    is_held = of_feet.is_contact | ~of_feet.is_known & (of_feet.probability > MIN_HELD_PROBABILITY)
    of_feet = replace(of_feet, is_contact=is_held)
    displacement = compute_foot_displacements(position, of_feet, is_locked=is_locked, position_sd=position_sd)
    for ankle, chain in zip(range(0, len(feet), 2), LEGS, strict=True):
        hip, knee, own = (joint_position[:, skeleton.names.index(joint)] for joint in chain[:3])
        wanted = own + displacement[:, ankle]
        reach = reach_ankle(LegPath(hip, knee, own, knee - hip), hip, wanted, contacts.rate)
        yielded = hip + (reach / measure_length(wanted - hip))[:, None] * (wanted - hip) - wanted
        displacement[:, ankle : ankle + 2] += yielded[:, None]
    return displacement


class LegMarkers(NamedTuple):
    """The markers of thighs and shins, near which a leg stays whose foot is displaced."""

    joints: Int[np.ndarray, " K"]  # the joint that carries each marker
    offsets: Float[np.ndarray, "K 3"]  # m: in the joint's axes
    position: Float[np.ndarray, "T K 3"]  # m: where the marker is, without noise
    share: Float[np.ndarray, "T K"]  # of its weight: 0 where it is not visible, 1 within the time that it is

    def select_frames(self, frames: Int[np.ndarray, " N"]) -> "LegMarkers":
        return self._replace(position=self.position[frames], share=self.share[frames])


def build_leg_markers(
    subject: Subject, markers: Float[np.ndarray, "T K 3"], body_markers: Float[np.ndarray, "T K 3"], rate: float
) -> LegMarkers:
    """Return the markers of thighs and shins of a body, by the smooth part of their distance from where it places them.

    Args:
        markers: Metres: measured, NaN if missing or faulty.
        body_markers: Metres: where the body places them.
    """
    joints = [subject.skeleton.names.index(joint) for thigh_and_shin in LEG_SEGMENTS for joint in thigh_and_shin]
    columns = np.flatnonzero(np.isin(subject.joints, joints))
    residual = markers[:, columns] - body_markers[:, columns]
    visible, sd = ~np.isnan(residual[..., 0]), SHARE_SMOOTHING_S * rate
    weight, total = smooth_values(visible.astype(float), sd), smooth_values(np.where(visible[..., None], residual, 0.0), sd)
    position = body_markers[:, columns] + total / np.maximum(weight, MIN_KERNEL_WEIGHT)[..., None]
    share = np.stack([smooth_share(each.astype(float), rate) for each in visible.T], axis=1) if len(columns) else weight
    return LegMarkers(subject.joints[columns], subject.marker_offsets[columns], position, share)


def displace_feet(
    skeleton: Skeleton,
    motion: Motion,
    joint_position: Float[np.ndarray, "T J 3"],
    displacement: Float[np.ndarray, "T C 3"],
    rate: float,
    markers: LegMarkers | None = None,
) -> Motion:
    """Return the motion with the feet displaced, in metres, each frame by itself; thighs and shins stay near any `markers`.

    How the root yields is solved at POSE_RATE_HZ and interpolated: displacements are smooth.
    """
    feet = np.array([skeleton.names.index(joint) for joint in CONTACT_JOINTS])
    frames = np.flatnonzero((np.linalg.norm(displacement, axis=-1) > MIN_DISPLACEMENT_M).any(1))
    if not len(frames):
        return motion
    points = build_foot_targets(feet, joint_position[frames[:, None], feet] + displacement[frames])
    if markers is not None:
        points = add_leg_markers(points, skeleton, markers.select_frames(frames), displacement[frames])
    count = int(points.joints.max()) + 1  # joints after the legs' only follow the root
    root, legs = motion.root_position[frames], motion.local_rotations[frames, :count]
    is_solved = find_key_frames(frames, np.zeros((len(frames), 0), bool), rate)
    solved, known = np.flatnonzero(is_solved), (root[is_solved], legs[is_solved])
    targets = points._replace(measured=points.measured[is_solved], weight=points.weight[is_solved])
    free = solve_legs(skeleton, known, targets, known)
    changes = free[0] - known[0], known[1].swapaxes(-1, -2) @ free[1]
    step, turn = kinematics.interpolate_poses(changes, solved, len(frames))
    ratio = np.linalg.norm(step, axis=1, keepdims=True) / MAX_ROOT_DISPLACEMENT_M
    root = root + step / (1 + ratio**ROOT_LIMIT_EXPONENT) ** (1 / ROOT_LIMIT_EXPONENT)
    legs = solve_legs(skeleton, (root, legs), points, (root, legs @ turn), root_share=FIXED_ROOT_SHARE)[1]
    root_position, local_rotations = motion.root_position.copy(), motion.local_rotations.copy()
    root_position[frames], local_rotations[frames, 1:count] = root, legs[:, 1:]
    return replace(motion, root_position=root_position, local_rotations=local_rotations)


def build_foot_targets(feet: Int[np.ndarray, " C"], target: Float[np.ndarray, "N C 3"]) -> PointTerm:
    """Return the term that places the joints `feet` at their targets, in metres."""
    return PointTerm(feet, np.zeros((len(feet), 3)), np.ascontiguousarray(target), np.full(target.shape[:2], CONTACT_SD_M**-2))


def add_leg_markers(
    points: PointTerm, skeleton: Skeleton, markers: LegMarkers, displacement: Float[np.ndarray, "N C 3"]
) -> PointTerm:
    """Return the points with the markers of each leg, which count the more the farther its foot is displaced, in metres."""
    square = (displacement**2).sum(-1).reshape(len(displacement), len(LEG_SEGMENTS), -1).max(-1)
    leg_share = square / (square + MARKER_DISPLACEMENT_M**2)
    carriers = [skeleton.names[joint] for joint in markers.joints]
    leg_of_marker = [next(n for n, segments in enumerate(LEG_SEGMENTS) if name in segments) for name in carriers]
    weight = markers.share * leg_share[:, leg_of_marker] / LEG_MARKER_SD_M**2
    joints, offsets = np.r_[points.joints, markers.joints], np.r_[points.offsets, markers.offsets]
    measured, weights = np.hstack([points.measured, markers.position]), np.hstack([points.weight, weight])
    return PointTerm(joints, offsets, np.ascontiguousarray(measured), np.ascontiguousarray(weights))


def solve_legs(skeleton: Skeleton, poses: Poses, points: PointTerm, start: Poses, *, root_share: float = 1.0) -> Poses:
    """Return poses near others, of the joints up to the last of the points, that place these where they shall be."""
    frame_count, count = poses[1].shape[:2]
    is_free = np.isin(np.arange(count), [0, *(skeleton.names.index(joint) for joint in LEG_JOINTS)])
    weight = np.full((frame_count, count), LEG_ROTATION_SD_RAD**-2)
    weight[:, 0] = (root_share * ROOT_ROTATION_SD_RAD) ** -2
    tracking = TrackingTerm(poses[1], weight, poses[0], np.full(frame_count, (root_share * ROOT_SD_M) ** -2))
    tree = KinematicTree(skeleton.parents[:count], skeleton.offsets[:count], is_free)
    settings = SolverSettings(damping_ratio=SolverSettings.damping_ratio * root_share**2)  # it is relative to the root's weight
    terms = points, tracking, build_no_pose_prior(count), build_no_joint_limits(count)  # others would compile the solver again
    return minimise(tree, terms, start, settings).poses


LEGS = tuple((*segments, *joints) for segments, joints in zip(LEG_SEGMENTS, FOOT_JOINTS.values(), strict=True))
"""The segments that a held foot moves, from the thigh on, in the order of FOOT_JOINTS."""
MIN_JUMP_FRAMES = 3
MIN_JUMP_M_S2 = 40.0  # acceleration of a knee below which it does not jump; that of a calm motion is 10 to 40 m/s^2
MAX_JUMP_RATIO = 1.5  # acceleration above which it does, relative to the largest before within JUMP_REACH_S
JUMP_REACH_S = 0.1
JUMP_SHARE = 0.5  # share of its displacement to which a foot is reduced where its knee jumps
MIN_HOLDING_SHARE = 0.5  # share of its displacement below which a foot is not held
SHOWN_REACH_S = 0.3  # time beside a contact that markers show for which a lock moves the visible markers of its foot too
PARTIAL_ROUNDS = 3  # rounds in which a foot is held in part where it moved visible markers too far; then it is not held there
MAX_YIELD_ROUNDS = 8


def hold_standing_feet(body: BodyFit, take: Take, mode: str, *, has_events: bool = True) -> StandingBody:
    """Find the contacts and the events of gait of the solved body, and hold its feet.

    Args:
        take: The take as it was read, whose file may have force plates and events.
        mode: One of FEET_MODES.
        has_events: Whether the events are needed, also those of the file and of force plates.
    """
    skeleton = body.subject.skeleton
    standing = find_contacts(skeleton, body.motion, body.solved_joint_positions, take.rate)
    find_events = partial(add_gait_events, standing, body, body.take.markers, take)
    if mode == FEET_OFF or not standing.is_contact.any():
        return StandingBody(body, find_events() if has_events else standing, body.motion)
    hold_feet = partial(hold_measured_feet, body, body.take.markers, standing, is_locked=mode == FEET_LOCK)
    tasks: list[Callable[[], Any]] = [hold_feet, find_events]
    held, contacts = map_in_threads(call, tasks)
    subject = body.extended_subject
    motion = reduce_held_uncertainty(subject, held.body.motion, select_held_contacts(standing, held.share))
    filling = reduce_held_uncertainty(subject, held.filling_motion, standing)
    feet = [skeleton.names.index(joint) for joint in CONTACT_JOINTS]
    moved_m = np.linalg.norm((held.body.joint_positions - body.joint_positions)[:, feet], axis=-1)
    done = HeldFeet(mode, float(moved_m.max(initial=0.0)), float((held.share < MIN_HOLDING_SHARE).any(1).sum() / contacts.rate))
    return StandingBody(replace(held.body, motion=motion), replace(contacts, held_feet=done), filling)


class HeldBody(NamedTuple):
    """A body whose standing feet are held."""

    body: BodyFit  # held as far as visible markers allow
    share: Float[np.ndarray, "T F"]  # of that for each foot, in the order of FOOT_JOINTS
    filling_motion: Motion  # held in full: where the lost markers of its feet are


def hold_measured_feet(
    body: BodyFit, markers: Float[np.ndarray, "T K 3"], contacts: BodyContacts, *, is_locked: bool
) -> HeldBody:
    """Return the body with its standing feet held.

    Args:
        body: Without held feet.
        markers: Metres, in the body's order, NaN if missing or faulty.
        is_locked: Hold feet at one place. The limit for visible markers then counts neither for shins nor for feet within
            SHOWN_REACH_S of a contact that markers show.
    """
    subject, names = body.extended_subject, body.subject.skeleton.names
    displacement = compute_held_displacements(
        subject.skeleton, body.joint_positions, contacts, is_locked=is_locked, joint_sd=body.motion.joint_sd
    )
    leg_markers = build_leg_markers(subject, markers, body.marker_positions, contacts.rate)
    foot_of_joint = [n for n, joints in enumerate(FOOT_JOINTS.values()) for _ in joints]
    shown = contacts.select_feet().is_contact & contacts.select_feet().is_known
    reach = 2 * round(SHOWN_REACH_S * contacts.rate) + 1
    is_shown = slide_windows(shown.reshape(len(shown), len(LEGS), 2).max(2), reach).max(2)
    limit = np.ones((body.motion.frame_count, len(LEGS)))
    share, moved, filling_motion = np.zeros_like(limit), body, body.motion
    for yield_round in range(MAX_YIELD_ROUNDS):
        before, share = share, np.stack([smooth_share(each, contacts.rate) for each in limit.T], axis=1)
        is_kept = (share == before).all(1)
        wanted = np.where(is_kept[:, None, None], 0.0, displacement * share[:, foot_of_joint, None])
        part = displace_feet(subject.skeleton, body.motion, body.joint_positions, wanted, contacts.rate, leg_markers)
        root_position = np.where(is_kept[:, None], moved.motion.root_position, part.root_position)
        local_rotations = np.where(is_kept[:, None, None, None], moved.motion.local_rotations, part.local_rotations)
        moved = move_body(body, replace(body.motion, root_position=root_position, local_rotations=local_rotations))
        if yield_round == 0:
            filling_motion = moved.motion
        growth = measure_residual_growth(subject.joints, markers, body.marker_positions, moved.marker_positions, contacts.rate)
        allowed = np.ones(limit.shape)
        for joint, windows in growth.items():
            legs = [foot for foot, chain in enumerate(LEGS) if names[joint] in chain]
            if is_locked and any(names[joint] in chain[1:] for chain in LEGS):
                is_exempt = is_shown[:, legs[0]] | (names[joint] in SHINS.values())
                exempt = np.lib.stride_tricks.sliding_window_view(is_exempt, len(limit) + 1 - len(windows)).any(1)
                windows = np.where(exempt, 0.0, windows)
            if (windows > MAX_RESIDUAL_GROWTH_M).any():
                if not legs or yield_round >= PARTIAL_ROUNDS:  # the root carries the other leg along, too
                    legs = list(range(len(LEGS)))
                allowed[:, legs] = np.minimum(allowed[:, legs], compute_allowed_share(windows, len(limit))[:, None])
        for foot, chain in enumerate(LEGS):
            knee = names.index(chain[1])
            jump = find_jumps(body.joint_positions[:, knee], moved.joint_positions[:, knee], contacts.rate)
            allowed[:, foot] = np.where(jump, np.minimum(allowed[:, foot], JUMP_SHARE), allowed[:, foot])
        if (allowed == 1).all():
            break
        limit = limit * np.where(allowed < 1, allowed if yield_round < PARTIAL_ROUNDS else 0.0, 1.0)
    return HeldBody(moved, share, filling_motion)


def find_jumps(before: Float[np.ndarray, "T 3"], after: Float[np.ndarray, "T 3"], rate: float) -> Bool[np.ndarray, " T"]:
    """Return the frames (T,) about which a joint jumps after its leg was moved, and did not before; positions in metres."""
    if len(before) < MIN_JUMP_FRAMES:
        return np.zeros(len(before), bool)
    acceleration = [np.pad(np.linalg.norm(np.diff(each, 2, axis=0), axis=1) * rate**2, 1) for each in (before, after)]
    reach = 2 * round(JUMP_REACH_S * rate) + 1
    usual = np.maximum(MAX_JUMP_RATIO * slide_windows(acceleration[0], reach).max(1), MIN_JUMP_M_S2)
    return slide_windows(acceleration[1] > usual, 3).max(1)


def select_held_contacts(contacts: BodyContacts, share: Float[np.ndarray, "T F"]) -> BodyContacts:
    """Return the contacts of feet that are held, without those that yield to visible markers."""
    is_contact = contacts.is_contact.copy()
    for foot, joints in enumerate(FOOT_JOINTS.values()):
        is_contact[:, [contacts.joints.index(joint) for joint in joints]] &= share[:, [foot]] >= MIN_HOLDING_SHARE
    return replace(contacts, is_contact=is_contact)


def add_gait_events(contacts: BodyContacts, body: BodyFit, markers: Float[np.ndarray, "T K 3"], take: Take) -> BodyContacts:
    """Return the contacts with the events of gait, and both as force plates show them where a foot stands on one.

    A body without both feet has no events but those of the file.

    Args:
        markers: Metres, in the body's order, NaN if missing or faulty.
        take: Whose file may have force plates.
    """
    recorded, plates = (), []
    if isinstance(take.layout, C3dLayout) and take.path is not None:
        with take.path.open("rb") as file:  # mapped: it may be larger than what is needed of it
            data = take.labelled_file or mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        first_s = take.part.first / take.rate if take.part else 0.0
        whole = read_force_plates(data, take.layout, take.rate)
        plates = [each.select_interval(first_s, take.frame_count / take.rate) for each in whole]
        last_s = (take.frame_count - 1) / take.rate
        recorded = read_gait_events(data[: take.layout.data_start_byte], take.main_subject, (take.first_frame, take.rate), last_s)
    if not all(body.subject.solved_joints[body.subject.skeleton.names.index(joint)] for joint in CONTACT_JOINTS):
        return replace(contacts, events=recorded)
    feet = build_foot_points(body.extended_subject, body.motion, markers, body.marker_positions, contacts.is_known)
    on_plates = find_plate_contacts(plates, feet, contacts.floor, contacts.rate)
    events, disagreements = merge_events(detect_gait_events(feet, contacts.floor, contacts.rate), recorded, on_plates)
    return replace(align_contacts_with_plates(contacts, on_plates), events=events, event_disagreements=disagreements)


def move_body(body: BodyFit, motion: Motion) -> BodyFit:
    """Return the body with another motion, and its joints and markers where that has them."""
    joints, markers = kinematics.compute_joint_and_marker_positions(body.extended_subject, motion)
    return replace(body, motion=motion, joint_positions=joints, marker_positions=markers)
