"""Find the contacts of a body with the floor, from the positions of its joints.

A joint is in contact while it stands still, near the floor or another level on which the person stands.
"""

import numpy as np
from jaxtyping import Bool, Float

from mocapfix.contacts.contacts import (
    CONTACT_JOINTS,
    FOOT_JOINTS,
    OTHER_CONTACT_JOINTS,
    BodyContacts,
    ContactPositions,
    build_no_contacts,
)
from mocapfix.contacts.floor import BASE_PERCENTILE, MAX_LEVEL_DEVIATION_M, NO_FLOOR, TOE_HEIGHT_M, Floor, estimate_floor
from mocapfix.contacts.occluded_contacts import find_certain_occlusions, find_known_frames
from mocapfix.contacts.standing import compute_speed, detect_standing, remove_short_runs
from mocapfix.motion import Motion
from mocapfix.skeleton import Skeleton

MAX_OTHER_HEIGHT_M = 0.13
"""Height above the floor up to which a knee or a wrist that stands still is in contact."""


def find_contacts(skeleton: Skeleton, motion: Motion, joint_position: Float[np.ndarray, "T J 3"], rate: float) -> BodyContacts:
    """Find the contacts of feet, knees and hands.

    skeleton        the 31-joint skeleton
    motion          its motion, of which `joint_sd` is used: where a foot lacks its markers, its contact is inferred
    joint_position  (T, J, 3) m, Y up; NaN for joints that the markers do not show
    """
    feet = [skeleton.names.index(joint) for joint in CONTACT_JOINTS]
    if not len(joint_position) or not np.isfinite(joint_position[:, feet]).all():
        return build_no_contacts(len(joint_position), rate)
    positions = ContactPositions(joint_position[:, feet], motion.joint_sd[:, feet], rate)
    contacts = find_foot_contacts(positions)
    others = [skeleton.names.index(joint) for joint in OTHER_CONTACT_JOINTS]
    if contacts.floor is NO_FLOOR or not np.isfinite(joint_position[:, others]).all():
        return contacts
    added = find_other_contacts(joint_position[:, others], contacts.floor, rate)
    is_known = np.stack([find_known_frames(motion.joint_sd[:, joint], rate) for joint in others], axis=1)
    return BodyContacts(
        (*CONTACT_JOINTS, *OTHER_CONTACT_JOINTS),
        np.hstack([contacts.is_contact, added]),
        np.hstack([contacts.is_known, is_known]),
        contacts.floor,
        rate,
    )


def find_foot_contacts(positions: ContactPositions) -> BodyContacts:
    """Find the contacts of the joints of both feet, in the order of CONTACT_JOINTS."""
    columns = {side: [CONTACT_JOINTS.index(joint) for joint in joints] for side, joints in FOOT_JOINTS.items()}
    position, rate = positions.position, positions.rate
    is_known = np.stack([find_known_frames(positions.sd[:, c], rate) for c in range(len(CONTACT_JOINTS))], axis=1)
    for ankle, toe in columns.values():  # where the ankle is unknown, so is where the toes are
        is_known[:, toe] &= is_known[:, ankle]
    speed = np.stack([compute_speed(position[:, c], rate) for c in range(len(CONTACT_JOINTS))], axis=1)
    is_standing = np.stack([detect_standing(speed[:, c], rate, ~is_known[:, c]) for c in range(len(CONTACT_JOINTS))], axis=1)
    joined = is_standing.copy()
    for side, other in (("left", "right"), ("right", "left")):
        other_standing = np.any(is_standing[:, columns[other]], axis=1)
        is_other_known = np.all(is_known[:, columns[other]], axis=1)
        for c in columns[side]:
            is_certain = find_certain_occlusions(
                is_standing[:, c], position[:, c], is_known[:, c], other_standing, is_other_known, rate
            )
            joined[:, c] = detect_standing(speed[:, c], rate, is_certain) | is_certain
    toes = [c for c, joint in enumerate(CONTACT_JOINTS) if "Toe" in joint]
    floor = estimate_floor(position[:, toes], joined[:, toes], rate)
    for c in range(len(CONTACT_JOINTS)):
        is_near = find_frames_near_floor(position[:, c], joined[:, c], floor)
        joined[:, c] = remove_short_runs(joined[:, c] & (is_near | ~is_known[:, c]), rate)
    return BodyContacts(CONTACT_JOINTS, joined, is_known, floor, rate)


def find_frames_near_floor(
    position: Float[np.ndarray, "T 3"], is_standing: Bool[np.ndarray, " T"], floor: Floor
) -> Bool[np.ndarray, " T"]:
    """Return the frames in which a joint is about as high above a level of the floor as it is where it stands lowest.

    Each joint is compared with itself: an ankle is higher where a person stands on the toes of that foot alone.
    """
    if not is_standing.any() or not floor.level_heights_m:
        return np.zeros(len(position), bool)
    height = floor.compute_height_above(position)
    low = height[is_standing & (height > -TOE_HEIGHT_M)]
    base = float(np.percentile(low, BASE_PERCENTILE)) if len(low) else 0.0
    return height < base + MAX_LEVEL_DEVIATION_M


def find_other_contacts(position: Float[np.ndarray, "T N 3"], floor: Floor, rate: float) -> Bool[np.ndarray, "T N"]:
    """Return when joints other than the feet's stand still near the floor."""
    contacts = np.zeros(position.shape[:2], bool)
    for n in range(position.shape[1]):
        is_low = floor.compute_height_above(position[:, n]) < MAX_OTHER_HEIGHT_M
        if is_low.any():
            is_standing = detect_standing(compute_speed(position[:, n], rate), rate)
            contacts[:, n] = remove_short_runs(is_standing & is_low, rate)
    return contacts
