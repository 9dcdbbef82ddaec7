"""The stage of contacts: find those of the solved body, and hold its feet in them."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from mocapfix.contacts.contacts import CONTACT_JOINTS, BodyContacts, HeldFeet
from mocapfix.contacts.find_contacts import find_contacts
from mocapfix.contacts.foot_points import build_foot_points
from mocapfix.contacts.gait_events import detect_gait_events
from mocapfix.contacts.held_uncertainty import reduce_held_uncertainty
from mocapfix.contacts.hold_feet import hold_feet
from mocapfix.contacts.plate_contacts import align_contacts_with_plates, find_plate_contacts, merge_events
from mocapfix.files.layouts import C3dLayout
from mocapfix.files.option_choices import FEET_LOCK, FEET_OFF
from mocapfix.motion import Motion
from mocapfix.options import CleanOptions
from mocapfix.read.force_plates import read_force_plates
from mocapfix.skeleton import Skeleton
from mocapfix.solve import kinematics
from mocapfix.state import BodyFit, CleaningState
from mocapfix.take import Take
from mocapfix.write.c3d_events import read_gait_events


def hold_standing_feet(state: CleaningState, options: CleanOptions) -> CleaningState:
    """Find the contacts and the events of gait of the solved body, and hold its feet. Advances `body` of the state."""
    body = state.body
    if body is None:
        return state
    skeleton, standing = body.subject.skeleton, find_body_contacts(body, state.original_take.rate)
    contacts = add_gait_events(standing, body, state.solver_take.markers, state.original_take)
    if options.contacts.feet == FEET_OFF or not standing.is_contact.any():
        return replace(state, body=replace(body, contacts=contacts))
    is_locked = options.contacts.feet == FEET_LOCK
    motion = hold_feet(skeleton, body.motion, body.joint_positions, standing, is_locked=is_locked)
    moved = move_body(body, reduce_held_uncertainty(body.extended_subject, motion, standing))
    held = describe_held_feet(skeleton, body.joint_positions, moved.joint_positions, options.contacts.feet)
    return replace(state, body=replace(moved, contacts=replace(contacts, held_feet=held)))


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
        plates = read_force_plates(data, take.layout)
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
