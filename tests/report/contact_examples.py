"""Contacts whose every figure is known: 10 s at 100 Hz, in a take whose first frame is 101."""

import numpy as np

from mocapfix.contacts.contacts import CONTACT_JOINTS, OTHER_CONTACT_JOINTS, BodyContacts, Floor, GaitEvent, HeldFeet
from mocapfix.model.take import Take

FRAMES, RATE, FIRST_FRAME = 1000, 100.0, 101
LEVEL_FLOOR = Floor(0.0, 0.0, (0.002,))
SOFT_FEET = HeldFeet("soft", 0.0034)
JOINTS = (*CONTACT_JOINTS, *OTHER_CONTACT_JOINTS)


def build_contacts(
    floor: Floor = LEVEL_FLOOR,
    events: tuple[GaitEvent, ...] = (),
    held: HeldFeet = SOFT_FEET,
    frames: int = FRAMES,
) -> BodyContacts:
    """Return contacts of the left heel in frames 0 to 199 and 400 to 499 and of the right wrist in 10 to 19.

    The left heel is not seen in frames 190 to 199 and 600 to 650.
    """
    is_contact, is_known = np.zeros((frames, len(JOINTS)), bool), np.ones((frames, len(JOINTS)), bool)
    is_contact[:200, 0] = is_contact[400:500, 0] = True
    is_contact[10:20, JOINTS.index("RightFingerBase")] = True
    is_known[190:200, 0] = is_known[600:651, 0] = False
    return BodyContacts(JOINTS, is_contact, is_contact * 0.9, is_known, floor, RATE, events, held)


def build_walk(step_s: float, count: int) -> tuple[GaitEvent, ...]:
    """Return the strikes of alternating feet, from markers, in equal times."""
    return tuple(GaitEvent(("left", "right")[n % 2], "foot strike", 1.0 + n * step_s, "markers") for n in range(count))


def build_empty_take(frames: int = FRAMES) -> Take:
    """Return a take of one marker."""
    return Take(np.zeros((frames, 1, 3)), ("A",), RATE, FIRST_FRAME)
