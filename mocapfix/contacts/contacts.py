"""The contacts of a body with the floor, as later stages, reports and files use them.

The floor on which a person stands: its height, its tilt, and further levels such as steps, from the places of the toes.
"""

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.model.body_fit import BodyFit
from mocapfix.model.motion import Motion
from mocapfix.options import FEET_OFF
from mocapfix.stats.sequences import find_runs

TOE_HEIGHT_M = 0.025  # height of the toe joint above the sole of a person of average size, standing flat
MAX_LEVEL_DEVIATION_M = 0.06  # largest height of a standing joint above its level; half a low step
MAX_SUPPORT_ABOVE_OTHER_M = 0.02  # height of a toe above that of the other standing foot up to which it may bear the weight
MIN_LEVEL_STEP_M = 0.1  # smallest height of a step between two levels
MIN_LEVEL_S = 0.3  # time for which feet stand on a level, all together, at least
BASE_PERCENTILE = 10.0  # the share of standing frames, in percent, that may be below a level: noise, and feet that roll
MIN_TILT_PLACES = 6
MIN_TILT_EXTENT_M = 1.5  # number of places, and their extent in a direction, from which a tilt is estimated
MIN_TILT_RAD = np.deg2rad(0.3)  # smallest tilt that is distinguished from a level floor
MIN_RAMP_RAD = np.deg2rad(1.5)  # the same where the places extend in one direction only: few of them then decide
MAX_TILT_RAD = np.deg2rad(17.0)  # largest tilt of a floor, beyond that of steep ramps; stairs rise by 20 degrees or more
MAX_TILT_RESIDUAL_M = 0.03  # largest deviation of nine of ten places from a tilted floor; otherwise it has levels


@dataclass(frozen=True)
class Floor:
    """The surfaces on which a person stands."""

    slope_x: float  # rise in metres per metre along X; 0 for a level floor
    slope_z: float  # the same along Z
    level_heights_m: tuple[float, ...]  # heights of the levels at the origin, rising; a flat floor has one

    @property
    def height_m(self) -> float:
        """The height of the lowest level at the origin, 0 if no floor was found."""
        return self.level_heights_m[0] if self.level_heights_m else 0.0

    @property
    def tilt_deg(self) -> float:
        """The angle between the floor and the horizontal."""
        return float(np.degrees(np.arctan(np.hypot(self.slope_x, self.slope_z))))

    def remove_slope(self, position: Float[np.ndarray, "*T 3"]) -> Float[np.ndarray, "*T"]:
        """Return the heights in metres that positions have after the floor is turned level about the origin."""
        return position[..., 1] - self.slope_x * position[..., 0] - self.slope_z * position[..., 2]

    def compute_height_above(self, position: Float[np.ndarray, "*T 3"]) -> Float[np.ndarray, "*T"]:
        """Return the height in metres above the highest level that is not more than MAX_LEVEL_DEVIATION_M above a position."""
        height = self.remove_slope(position)
        above = np.array(height - self.height_m)
        for level in self.level_heights_m[1:]:
            above = np.where(height - level > -MAX_LEVEL_DEVIATION_M, height - level, above)
        return above


NO_FLOOR = Floor(0.0, 0.0, ())


def estimate_floor(toe_position: Float[np.ndarray, "T N 3"], is_standing: Bool[np.ndarray, "T N"], rate: float) -> Floor:
    """Estimate the floor from the toes of a person's feet; NO_FLOOR if they never stand.

    A level that is higher than the lowest one counts if a foot stands on it while the other does not stand lower: a foot that is
    held still in the air, beside a foot on the floor, is on no level.
    """
    if not is_standing.any():
        return NO_FLOOR
    runs = [(n, run) for n in range(is_standing.shape[1]) for run in find_runs(is_standing[:, n])]
    slope_x, slope_z = _fit_slope(np.array([toe_position[first : last + 1, n].mean(0) for n, (first, last) in runs]))
    height = toe_position[..., 1] - slope_x * toe_position[..., 0] - slope_z * toe_position[..., 2]
    lowest_standing = np.where(is_standing, height, np.inf).min(1, keepdims=True)
    is_support = is_standing & (height <= lowest_standing + MAX_SUPPORT_ABOVE_OTHER_M)
    levels: list[float] = []
    remaining = np.sort(height[is_support])
    while len(remaining) >= (MIN_LEVEL_S * rate if levels else 1):
        near = remaining[remaining <= remaining[0] + 2 * MAX_LEVEL_DEVIATION_M]
        base = float(np.percentile(near, BASE_PERCENTILE))
        is_on_level = remaining <= base + MAX_LEVEL_DEVIATION_M
        if not levels or (base - TOE_HEIGHT_M - levels[-1] >= MIN_LEVEL_STEP_M and is_on_level.sum() >= MIN_LEVEL_S * rate):
            levels.append(base - TOE_HEIGHT_M)
        remaining = remaining[~is_on_level]
    return Floor(slope_x, slope_z, tuple(levels))


def _fit_slope(places: Float[np.ndarray, "P 3"]) -> tuple[float, float]:
    """Return the rise of the floor along X and Z, robust against a few places elsewhere; 0 if the places show no tilt.

    Across a straight walk the floor is level: it shows the tilt along the walk alone.
    """
    if len(places) < MIN_TILT_PLACES:
        return 0.0, 0.0
    flat = places[:, [0, 2]] - places[:, [0, 2]].mean(0)
    _, _, directions = np.linalg.svd(flat, full_matrices=False)
    directions = directions[np.ptp(flat @ directions.T, axis=0) >= MIN_TILT_EXTENT_M]
    design = np.column_stack([flat @ directions.T, np.ones(len(places))])
    weight = np.ones(len(places))
    solution = np.zeros(design.shape[1])
    for _ in range(10):  # iteratively reweighted least squares of absolute deviations
        solution = np.linalg.lstsq(design * weight[:, None], places[:, 1] * weight, rcond=None)[0]
        weight = np.sqrt(1 / np.maximum(np.abs(places[:, 1] - design @ solution), 1e-3))
    residual = np.abs(places[:, 1] - design @ solution)
    slope = solution[:-1] @ directions
    smallest = MIN_TILT_RAD if len(directions) == len(slope) else MIN_RAMP_RAD
    is_tilted = np.tan(smallest) < np.hypot(*slope) < np.tan(MAX_TILT_RAD)
    if not is_tilted or np.percentile(residual, 90) > MAX_TILT_RESIDUAL_M:
        return 0.0, 0.0
    return float(slope[0]), float(slope[1])


FOOT_JOINTS = {"left": ("LeftFoot", "LeftToeBase"), "right": ("RightFoot", "RightToeBase")}
"""the joints of each foot that can be in contact: the ankle stands for the heel, the toe base for the ball of the foot"""
CONTACT_JOINTS = tuple(joint for joints in FOOT_JOINTS.values() for joint in joints)
OTHER_CONTACT_JOINTS = ("LeftLeg", "RightLeg", "LeftFingerBase", "RightFingerBase", "Hips", "Spine1")
"""knees, wrists, seat and back: in falls, rolls, crawls and where a person sits or lies on the floor"""
PLATE_SOURCE, FILE_SOURCE = "force plate", "file"


class GaitEvent(NamedTuple):
    """One event of gait: the first or the last instant of a foot's contact."""

    side: str  # "left" or "right"
    kind: str  # "foot strike" or "foot off"
    time_s: float  # seconds after the first frame, between frames where the source is finer than these
    source: str  # "markers", "joints" of an animation, "file" if the file has it already, or "force plate"


class EventDisagreement(NamedTuple):
    """An event of gait, and the same by another source that gives another time and counts less."""

    event: GaitEvent
    other: GaitEvent

    @property
    def delay_s(self) -> float:
        """How much later the event is by the other source, in seconds."""
        return self.other.time_s - self.event.time_s


class HeldFeet(NamedTuple):
    """What was done to the feet of a motion that stand."""

    mode: str  # "soft", "lock", or "off" if they are as they were solved: as asked, or since none stands
    largest_displacement_m: float  # the farthest that a heel or a ball of a foot was moved
    yielded_s: float = 0.0  # time for which a foot in contact was not held, since that would have moved visible markers


NOT_HELD = HeldFeet(FEET_OFF, 0.0)


@dataclass(frozen=True)
class BodyContacts:
    """When joints of a body are in contact."""

    joints: tuple[str, ...]  # C names of joints of the skeleton
    is_contact: Bool[np.ndarray, "T C"]  # (T, C): whether the joint stands on the floor or another surface
    probability: Float[np.ndarray, "T C"]  # (T, C): that it does; 1 or 0 where a force plate or a file of contacts decides
    is_known: Bool[np.ndarray, "T C"]  # (T, C): whether markers show the position of the joint; otherwise the contact is inferred
    floor: Floor  # the floor on which they stand
    rate: float  # frames per second
    events: tuple[GaitEvent, ...] = field(default=())  # events of gait, by time
    held_feet: HeldFeet = NOT_HELD  # what was done to the feet in contact
    event_disagreements: tuple[EventDisagreement, ...] = field(default=())  # events of which two sources give different times

    @property
    def has_feet(self) -> bool:
        """Whether markers show both feet at any time; otherwise there are no contacts and no floor."""
        return bool(self.is_known[:, : len(CONTACT_JOINTS)].any())

    def lower_floor(self, height_m: float) -> "BodyContacts":
        """Return the contacts of a body that is lowered by a height in metres."""
        levels = tuple(level - height_m for level in self.floor.level_heights_m)
        return replace(self, floor=replace(self.floor, level_heights_m=levels)) if levels else self

    def add_other_joints(self) -> "BodyContacts":
        """Return the contacts of all joints that can be in contact, with none of those that were not looked for."""
        others = OTHER_CONTACT_JOINTS if len(self.joints) == len(CONTACT_JOINTS) else ()
        nothing = np.zeros((len(self.is_contact), len(others)), bool)
        is_contact, probability = (np.hstack([each, nothing]) for each in (self.is_contact, self.probability))
        is_known = np.hstack([self.is_known, ~nothing])
        return replace(self, joints=(*self.joints, *others), is_contact=is_contact, probability=probability, is_known=is_known)

    def change_contacts(self, is_contact: Bool[np.ndarray, "T C"]) -> "BodyContacts":
        """Return others that are certain: they have a probability of 1 or 0 where they differ."""
        probability = np.where(is_contact == self.is_contact, self.probability, is_contact)
        return replace(self, is_contact=is_contact, probability=probability)

    def select_feet(self, frames: Int[np.ndarray, " N"] | slice = slice(None)) -> "BodyContacts":
        """Return the contacts of heels and balls of the feet in some frames."""
        feet = (each[frames, : len(CONTACT_JOINTS)] for each in (self.is_contact, self.probability, self.is_known))
        is_contact, probability, is_known = feet
        return replace(self, joints=CONTACT_JOINTS, is_contact=is_contact, probability=probability, is_known=is_known)

    def move_events(self, delay_s: float, duration_s: float) -> "BodyContacts":
        """Return the contacts with the events at a later time, those within a duration from the first frame on."""
        start_s, stop_s = -0.5 / self.rate, duration_s - 0.5 / self.rate
        pairs = [EventDisagreement(*(x._replace(time_s=x.time_s + delay_s) for x in each)) for each in self.event_disagreements]
        events = [each._replace(time_s=each.time_s + delay_s) for each in self.events]
        kept = tuple(each for each in pairs if start_s <= each.event.time_s < stop_s)
        return replace(self, events=tuple(each for each in events if start_s <= each.time_s < stop_s), event_disagreements=kept)

    def list_intervals(self, joint: str) -> list[tuple[int, int]]:
        """Return the contacts of a joint as (first, last) frames."""
        return find_runs(self.is_contact[:, self.joints.index(joint)])

    def find_foot_contact(self, side: str) -> Bool[np.ndarray, " T"]:
        """Return whether any part of a foot is in contact (T,)."""
        return np.any(self.is_contact[:, [self.joints.index(joint) for joint in FOOT_JOINTS[side]]], axis=1)


def build_no_contacts(frame_count: int, rate: float) -> BodyContacts:
    """Return the contacts of a body whose feet no marker shows."""
    nothing = np.zeros((frame_count, len(CONTACT_JOINTS)), bool)
    return BodyContacts(CONTACT_JOINTS, nothing, nothing * 0.0, nothing, NO_FLOOR, rate)


@dataclass(frozen=True)
class StandingBody:
    """A body with its contacts, whose standing feet are held.

    Attributes:
        fit: The body.
        contacts: When its joints are in contact with the floor, and the events of gait.
        filling_motion: The motion from which lost markers are filled: its standing feet are held also where those of the body
            yield to visible markers.
    """

    fit: BodyFit
    contacts: BodyContacts
    filling_motion: Motion
