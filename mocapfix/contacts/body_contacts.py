"""The stage of contacts: find those of the solved body, and hold its feet in them."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from mocapfix.contacts.contacts import CONTACT_JOINTS, BodyContacts, HeldFeet
from mocapfix.contacts.find_contacts import find_contacts
from mocapfix.contacts.foot_points import build_foot_points
from mocapfix.contacts.gait_events import detect_gait_events
from mocapfix.contacts.hold_feet import hold_feet
from mocapfix.contacts.plate_contacts import find_plate_contacts, replace_marker_events
from mocapfix.files.layouts import C3dLayout
from mocapfix.files.option_choices import FEET_LOCK, FEET_OFF
from mocapfix.motion import Motion
from mocapfix.options import CleanOptions
from mocapfix.read.force_plates import read_force_plates
from mocapfix.skeleton import Skeleton
from mocapfix.solve import kinematics
from mocapfix.state import BodyFit, CleaningState
from mocapfix.take import Take


def hold_standing_feet(state: CleaningState, options: CleanOptions) -> CleaningState:
    """Find the contacts and the events of gait of the solved body, and hold its feet. Advances `body` of the state."""
    body = state.body
    if body is None:
        return state
    rate = state.original_take.rate
    contacts = find_contacts(body.subject.skeleton, body.motion, body.solved_joint_positions, rate)
    if are_feet_solved(body):
        contacts = add_gait_events(contacts, body, state.solver_take.markers, state.original_take)
    body = replace(body, contacts=contacts)
    if options.contacts.feet == FEET_OFF or not contacts.is_contact.any():
        return replace(state, body=body)
    is_locked = options.contacts.feet == FEET_LOCK
    motion = hold_feet(body.subject.skeleton, body.motion, body.joint_positions, contacts, is_locked=is_locked)
    moved = move_body(body, motion)
    held = describe_held_feet(body.subject.skeleton, body.joint_positions, moved.joint_positions, options.contacts.feet)
    return replace(state, body=replace(moved, contacts=replace(contacts, held_feet=held)))


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
    """Return the contacts with the events of gait, from markers (T, K, 3) in the body's order and the take's force plates."""
    feet = build_foot_points(body.extended_subject, body.motion, markers, body.marker_positions)
    events = detect_gait_events(feet, contacts.rate)
    if isinstance(take.layout, C3dLayout) and take.path is not None:
        plates = read_force_plates(take.labelled_file or take.path.read_bytes(), take.layout)
        events = replace_marker_events(events, find_plate_contacts(plates, feet, contacts.rate))
    return replace(contacts, events=events)


def move_body(body: BodyFit, motion: Motion) -> BodyFit:
    """Return the body with another motion, and its joints and markers where that has them."""
    joints, markers = kinematics.compute_joint_and_marker_positions(body.extended_subject, motion)
    return replace(body, motion=motion, joint_positions=joints, marker_positions=markers)
