"""The stage of contacts: find those of the solved body, and hold its feet in them."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import maximum_filter1d

from mocapfix.contacts.contacts import CONTACT_JOINTS, FOOT_JOINTS, BodyContacts, HeldFeet
from mocapfix.contacts.find_contacts import find_contacts
from mocapfix.contacts.foot_points import build_foot_points
from mocapfix.contacts.gait_events import detect_gait_events
from mocapfix.contacts.held_uncertainty import reduce_held_uncertainty
from mocapfix.contacts.hold_feet import LEG_SEGMENTS, build_leg_markers, compute_held_displacements, displace_feet
from mocapfix.contacts.plate_contacts import align_contacts_with_plates, find_plate_contacts, merge_events
from mocapfix.files.layouts import C3dLayout
from mocapfix.files.option_choices import FEET_LOCK, FEET_OFF
from mocapfix.motion import Motion
from mocapfix.options import CleanOptions
from mocapfix.read.force_plates import read_force_plates
from mocapfix.skeleton import Skeleton
from mocapfix.solve import kinematics
from mocapfix.solve.measured_segments import (
    compute_allowed_share,
    find_excess_windows,
    measure_residual_growth,
    smooth_share,
)
from mocapfix.state import BodyFit, CleaningState
from mocapfix.take import Take
from mocapfix.write.c3d_events import read_gait_events

LEGS = tuple((*segments, *joints) for segments, joints in zip(LEG_SEGMENTS, FOOT_JOINTS.values(), strict=True))
"""The segments that a held foot moves, from the thigh on, in the order of FOOT_JOINTS."""
MIN_JUMP_FRAMES = 3
MIN_JUMP_M_S2 = 40.0
"""Acceleration of a knee below which it does not jump; that of a calm motion is 10 to 40 m/s^2."""
MAX_JUMP_RATIO = 1.5
"""Acceleration above which it does, relative to the largest before within JUMP_REACH_S."""
JUMP_REACH_S = 0.1
JUMP_SHARE = 0.5
"""Share of its displacement to which a foot is reduced where its knee jumps."""
MIN_HOLDING_SHARE = 0.5
"""Share of its displacement below which a foot is not held."""
PARTIAL_ROUNDS = 3
"""Rounds in which a foot is held in part where it moved visible markers too far; afterwards it is not held there."""
MAX_YIELD_ROUNDS = 8


def hold_standing_feet(state: CleaningState, options: CleanOptions) -> CleaningState:
    """Find the contacts and the events of gait of the solved body, and hold its feet. Advances `body` of the state."""
    body = state.body
    if body is None:
        return state
    skeleton, standing = body.subject.skeleton, find_body_contacts(body, state.original_take.rate)
    contacts = add_gait_events(standing, body, state.solver_take.markers, state.original_take)
    if options.contacts.feet == FEET_OFF or not standing.is_contact.any():
        return replace(state, body=replace(body, contacts=contacts))
    held = hold_measured_feet(body, state.solver_take.markers, standing, is_locked=options.contacts.feet == FEET_LOCK)
    subject = body.extended_subject
    motion = reduce_held_uncertainty(subject, held.body.motion, select_held_contacts(standing, held.share))
    filling = reduce_held_uncertainty(subject, held.filling_motion, standing)
    done = describe_held_feet(skeleton, body.joint_positions, held.body.joint_positions, options.contacts.feet)
    done = done._replace(yielded_s=float((held.share < MIN_HOLDING_SHARE).any(1).sum() / contacts.rate))
    moved = replace(held.body, motion=motion, filling_motion=filling, contacts=replace(contacts, held_feet=done))
    return replace(state, body=moved)


class HeldBody(NamedTuple):
    """A body whose standing feet are held.

    body            held as far as visible markers allow
    share           (T, F) of that for each foot, in the order of FOOT_JOINTS
    filling_motion  held in full: where the lost markers of its feet are
    """

    body: BodyFit
    share: Float[np.ndarray, "T F"]
    filling_motion: Motion


def hold_measured_feet(
    body: BodyFit, markers: Float[np.ndarray, "T K 3"], contacts: BodyContacts, *, is_locked: bool
) -> HeldBody:
    """Return the body with its standing feet held.

    body       without held feet
    markers    (T, K, 3) m, in the body's order, NaN if missing or faulty
    is_locked  hold feet at one place; the markers of feet and shins are then not where the body has them
    """
    subject, names = body.extended_subject, body.subject.skeleton.names
    displacement = compute_held_displacements(subject.skeleton, body.joint_positions, contacts, is_locked=is_locked)
    leg_markers = build_leg_markers(subject, markers, body.marker_positions, contacts.rate)
    foot_of_joint = [n for n, joints in enumerate(FOOT_JOINTS.values()) for _ in joints]
    limit = np.ones((body.motion.frame_count, len(LEGS)))
    share, moved, filling_motion = np.zeros_like(limit), body, body.motion
    for yield_round in range(MAX_YIELD_ROUNDS):
        before, share = share, np.stack([smooth_share(each, contacts.rate) for each in limit.T], axis=1)
        changed = np.flatnonzero((share != before).any(1))
        part = displace_feet(
            subject.skeleton,
            body.motion.select_frames(changed),
            body.joint_positions[changed],
            displacement[changed] * share[changed][:, foot_of_joint, None],
            markers=leg_markers.select_frames(changed),
        )
        root_position, local_rotations = moved.motion.root_position.copy(), moved.motion.local_rotations.copy()
        root_position[changed], local_rotations[changed] = part.root_position, part.local_rotations
        moved = move_body(body, replace(body.motion, root_position=root_position, local_rotations=local_rotations))
        if yield_round == 0:
            filling_motion = moved.motion
        growth = measure_residual_growth(subject.joints, markers, body.marker_positions, moved.marker_positions, contacts.rate)
        allowed = np.ones(limit.shape)
        for joint, windows in growth.items():
            legs = [foot for foot, chain in enumerate(LEGS) if names[joint] in chain]
            is_exempt = is_locked and bool(legs) and names[joint] != LEGS[legs[0]][0]
            if not is_exempt and find_excess_windows(windows).any():
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
    usual = np.maximum(MAX_JUMP_RATIO * maximum_filter1d(acceleration[0], reach), MIN_JUMP_M_S2)
    return maximum_filter1d(acceleration[1] > usual, 3)


def select_held_contacts(contacts: BodyContacts, share: Float[np.ndarray, "T F"]) -> BodyContacts:
    """Return the contacts of feet that are held, without those that yield to visible markers."""
    is_contact = contacts.is_contact.copy()
    for foot, joints in enumerate(FOOT_JOINTS.values()):
        columns = [contacts.joints.index(joint) for joint in joints]
        is_contact[:, columns] &= share[:, [foot]] >= MIN_HOLDING_SHARE
    return replace(contacts, is_contact=is_contact)


def find_body_contacts(body: BodyFit, rate: float) -> BodyContacts:
    """Return when joints of a solved body stand, by its motion alone; `rate` in frames per second."""
    return find_contacts(body.subject.skeleton, body.motion, body.solved_joint_positions, rate)


def describe_held_feet(
    skeleton: Skeleton, before: Float[np.ndarray, "T J 3"], after: Float[np.ndarray, "T J 3"], mode: str
) -> HeldFeet:
    """Return what was done to the feet, from the positions (T, J, 3) in metres of the joints before and after."""
    feet = [skeleton.names.index(joint) for joint in CONTACT_JOINTS]
    return HeldFeet(mode, float(np.linalg.norm(after[:, feet] - before[:, feet], axis=-1).max(initial=0.0)))


def are_feet_solved(body: BodyFit) -> bool:
    """Return whether the markers show both feet."""
    return all(body.subject.solved_joints[body.subject.skeleton.names.index(joint)] for joint in CONTACT_JOINTS)


def add_gait_events(contacts: BodyContacts, body: BodyFit, markers: Float[np.ndarray, "T K 3"], take: Take) -> BodyContacts:
    """Return the contacts with the events of gait, and both as force plates show them where a foot stands on one.

    markers  (T, K, 3) m, in the body's order, NaN if missing or faulty
    take     whose file may have force plates

    A body without both feet has no events but those of the file.
    """
    recorded, plates = (), []
    if isinstance(take.layout, C3dLayout) and take.path is not None:
        data = take.labelled_file or take.path.read_bytes()
        plates = read_force_plates(data, take.layout, take.rate)
        last_s = (take.frame_count - 1) / take.rate
        recorded = read_gait_events(data[: take.layout.data_start_byte], take.main_subject, (take.first_frame, take.rate), last_s)
    if not are_feet_solved(body):
        return replace(contacts, events=recorded)
    feet = build_foot_points(body.extended_subject, body.motion, markers, body.marker_positions, contacts.is_known)
    detected = detect_gait_events(feet, contacts.floor, contacts.rate)
    on_plates = find_plate_contacts(plates, feet, contacts.floor, contacts.rate)
    events, disagreements = merge_events(detected, recorded, on_plates)
    return replace(align_contacts_with_plates(contacts, on_plates), events=events, event_disagreements=disagreements)


def move_body(body: BodyFit, motion: Motion) -> BodyFit:
    """Return the body with another motion, and its joints and markers where that has them."""
    joints, markers = kinematics.compute_joint_and_marker_positions(body.extended_subject, motion)
    return replace(body, motion=motion, joint_positions=joints, marker_positions=markers)
