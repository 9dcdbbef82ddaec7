"""Hold the feet of a character in the contacts of the source: at one place in the horizontal plane while a foot stands.

Where the source's feet are held, ankle and ball stand still; the ankle of a foot of another shape moves when the foot rolls about
the line from one to the other. So the
character's own ankles and balls are held, as those of the source are (`contacts/foot_displacements.py`), and its feet turn.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from mocapfix.characters.character import SIDES
from mocapfix.contacts.contacts import CONTACT_JOINTS, FOOT_JOINTS, BodyContacts
from mocapfix.contacts.foot_displacements import compute_foot_displacements
from mocapfix.retarget.body_frames import BodyFrame
from mocapfix.retarget.segment_motion import compute_shortest_rotations


def hold_kept_feet(
    target: BodyFrame,
    ankles: dict[str, Float[np.ndarray, "T 3"]],
    feet: dict[str, Float[np.ndarray, "T 3 3"]],
    contacts: BodyContacts,
) -> tuple[dict[str, Float[np.ndarray, "T 3"]], dict[str, Float[np.ndarray, "T 3 3"]]]:
    """Return ankles (T, 3) in metres and rotations S (T, 3, 3) of the feet, by side, with the feet held in contacts.

    ankles, feet  by side, before
    contacts      of the source's feet, at the rate of the motion
    """
    balls = {side: ankles[side] + feet[side] @ target.compute_ball(side) for side in SIDES}
    position = np.stack([place[side] for side in FOOT_JOINTS for place in (ankles, balls)], axis=1)
    held = position + compute_foot_displacements(position, contacts, is_locked=True)
    held_ankles: dict[str, Float[np.ndarray, "T 3"]] = {}
    held_feet: dict[str, Float[np.ndarray, "T 3 3"]] = {}
    for k, side in enumerate(FOOT_JOINTS):
        ankle, ball = held[:, 2 * k], held[:, 2 * k + 1]
        held_ankles[side] = ankle
        held_feet[side] = compute_shortest_rotations(balls[side] - ankles[side], ball - ankle) @ feet[side]
    return held_ankles, held_feet


def resample_foot_contacts(contacts: BodyContacts, frame_count: int, rate: float) -> BodyContacts:
    """Return the contacts of heels and balls of the feet at another rate: those of the nearest frames."""
    frames = np.rint(np.arange(frame_count) * contacts.rate / rate).astype(int)
    frames = np.minimum(frames, max(len(contacts.is_contact) - 1, 0))
    columns = [contacts.joints.index(joint) for joint in CONTACT_JOINTS]
    is_contact, is_known = (mask[frames][:, columns] for mask in (contacts.is_contact, contacts.is_known))
    return replace(contacts, joints=CONTACT_JOINTS, is_contact=is_contact, is_known=is_known, rate=rate)
