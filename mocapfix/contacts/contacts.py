"""The contacts of a body with the floor, as later stages, reports and files use them."""

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from mocapfix.contacts.floor import NO_FLOOR, Floor
from mocapfix.files.option_choices import FEET_OFF
from mocapfix.stats.sequences import find_runs

FOOT_JOINTS = {"left": ("LeftFoot", "LeftToeBase"), "right": ("RightFoot", "RightToeBase")}
"""the joints of each foot that can be in contact: the ankle stands for the heel, the toe base for the ball of the foot"""
CONTACT_JOINTS = tuple(joint for joints in FOOT_JOINTS.values() for joint in joints)
OTHER_CONTACT_JOINTS = ("LeftLeg", "RightLeg", "LeftHand", "RightHand")
"""knees and wrists, which are in contact in falls, rolls and crawls"""
PLATE_SOURCE, FILE_SOURCE = "force plate", "file"


class GaitEvent(NamedTuple):
    """One event of gait: the first or the last instant of a foot's contact.

    side    "left" or "right"
    kind    "foot strike" or "foot off"
    time_s  seconds after the first frame, between frames where the source is finer than these
    source  "markers", "joints" of an animation, "file" if the file has it already, or "force plate"
    """

    side: str
    kind: str
    time_s: float
    source: str


class EventDisagreement(NamedTuple):
    """An event of gait, and the same by another source that gives another time and counts less."""

    event: GaitEvent
    other: GaitEvent

    @property
    def delay_s(self) -> float:
        """How much later the event is by the other source, in seconds."""
        return self.other.time_s - self.event.time_s


class HeldFeet(NamedTuple):
    """What was done to the feet of a motion that stand.

    mode                    "soft", "lock", or "off" if they are as they were solved
    largest_displacement_m  the farthest that a heel or a ball of a foot was moved
    yielded_s               time for which a foot in contact was not held, since that would have moved visible markers
    """

    mode: str
    largest_displacement_m: float
    yielded_s: float = 0.0


NOT_HELD = HeldFeet(FEET_OFF, 0.0)


@dataclass(frozen=True)
class BodyContacts:
    """When joints of a body are in contact.

    joints      C names of joints of the skeleton
    is_contact  (T, C): whether the joint stands on the floor or another surface
    is_known    (T, C): whether markers show the position of the joint; otherwise the contact is inferred
    floor       the floor on which they stand
    rate        frames per second
    events      events of gait, by time
    held_feet   what was done to the feet in contact
    event_disagreements  events of which two sources give different times
    """

    joints: tuple[str, ...]
    is_contact: Bool[np.ndarray, "T C"]
    is_known: Bool[np.ndarray, "T C"]
    floor: Floor
    rate: float
    events: tuple[GaitEvent, ...] = field(default=())
    held_feet: HeldFeet = NOT_HELD
    event_disagreements: tuple[EventDisagreement, ...] = field(default=())

    @property
    def has_feet(self) -> bool:
        """Whether markers show both feet at any time; otherwise there are no contacts and no floor."""
        return bool(self.is_known[:, : len(CONTACT_JOINTS)].any())

    def lower_floor(self, height_m: float) -> "BodyContacts":
        """Return the contacts of a body that is lowered by a height in metres."""
        levels = tuple(level - height_m for level in self.floor.level_heights_m)
        return replace(self, floor=replace(self.floor, level_heights_m=levels)) if levels else self

    def list_intervals(self, joint: str) -> list[tuple[int, int]]:
        """Return the contacts of a joint as (first, last) frames."""
        return find_runs(self.is_contact[:, self.joints.index(joint)])

    def find_foot_contact(self, side: str) -> Bool[np.ndarray, " T"]:
        """Return whether any part of a foot is in contact (T,)."""
        return np.any(self.is_contact[:, [self.joints.index(joint) for joint in FOOT_JOINTS[side]]], axis=1)


def build_no_contacts(frame_count: int, rate: float) -> BodyContacts:
    """Return the contacts of a body whose feet no marker shows."""
    nothing = np.zeros((frame_count, len(CONTACT_JOINTS)), bool)
    return BodyContacts(CONTACT_JOINTS, nothing, nothing, NO_FLOOR, rate)


class ContactPositions(NamedTuple):
    """The positions from which contacts are detected.

    position  (T, C, 3) m: joints, Y up
    sd        (T, C) m: their standard deviation per axis
    rate      frames per second
    """

    position: Float[np.ndarray, "T C 3"]
    sd: Float[np.ndarray, "T C"]
    rate: float
