"""Contacts of an animation's body with the floor, and events of gait, from its joints."""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool

from mocapfix.animation import Animation
from mocapfix.animations.retarget import SkeletonAlignment
from mocapfix.contacts.contacts import CONTACT_JOINTS, FOOT_JOINTS, OTHER_CONTACT_JOINTS, BodyContacts
from mocapfix.contacts.find_contacts import find_contacts
from mocapfix.contacts.foot_points import build_foot_points
from mocapfix.contacts.gait_events import detect_gait_events
from mocapfix.motion import Motion
from mocapfix.solve import kinematics
from mocapfix.subject import Subject

JOINT_SOURCE = "joints"
"""The source of events that follow from joints."""


def find_animation_contacts(animation: Animation, alignment: SkeletonAlignment, subject: Subject, motion: Motion) -> BodyContacts:
    """Find the contacts and the events of gait of an animation.

    A reference pose before the motion (the T-pose of CMU's BVH release) has no contacts.

    animation        as the motion was converted from it
    alignment        the 31-joint skeleton in the animation
    subject, motion  of the 31-joint skeleton
    """
    skeleton = subject.skeleton
    start = int(animation.has_reference_pose and animation.frame_count > 1)
    moving = motion.select_frames(np.arange(start, motion.frame_count))
    position = kinematics.compute_world_poses(skeleton, moving)[0]
    position[:, ~find_placed_joints(animation, alignment)] = np.nan
    contacts = find_contacts(skeleton, moving, position, animation.rate)
    if contacts.has_feet:
        no_markers = np.zeros((len(position), 0, 3))
        feet = build_foot_points(subject, moving, no_markers, no_markers, contacts.is_known)
        events = detect_gait_events(feet, contacts.floor, animation.rate)
        delay_s = start / animation.rate
        shifted = tuple(event._replace(time_s=event.time_s + delay_s, source=JOINT_SOURCE) for event in events)
        contacts = replace(contacts, events=shifted)
    padding = ((start, 0), (0, 0))
    is_contact, is_known = (
        np.pad(contacts.is_contact, padding),
        np.pad(contacts.is_known, padding, constant_values=contacts.has_feet),
    )
    return replace(contacts, is_contact=is_contact, is_known=is_known)


def find_placed_joints(animation: Animation, alignment: SkeletonAlignment) -> Bool[np.ndarray, " 31"]:
    """Return which of the 31 joints that can be in contact the animation places; True for all others.

    A ball of a foot without a joint is placed if the foot has an end site, which shows where the foot points.
    """
    names, is_known = alignment.skeleton.names, alignment.file_joints >= 0
    is_placed = np.ones(len(names), bool)
    for joint in (*CONTACT_JOINTS, *OTHER_CONTACT_JOINTS):
        is_placed[names.index(joint)] = is_known[names.index(joint)]
    for foot, toe in (map(names.index, joints) for joints in FOOT_JOINTS.values()):
        if is_known[foot] and not is_known[toe]:
            end_sites = animation.end_sites[alignment.file_joints[foot]]
            is_placed[toe] = len(end_sites) > 0 and bool(np.any(end_sites[0]))
    return is_placed
