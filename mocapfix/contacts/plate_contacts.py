"""The contacts of feet with force plates, which are more precise than those from markers.

A plate counts only for a foot that is on it with heel and toes, while the other foot is not: the force of a foot that is partly
beside its plate begins too late, and that of two feet ends too late.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from mocapfix.contacts.contacts import GaitEvent
from mocapfix.contacts.foot_points import FootPoints
from mocapfix.read.force_plates import ForcePlate
from mocapfix.stats.sequences import find_runs

LOAD_N = 20.0
"""Vertical force from which a plate is loaded, as is usual in gait analysis."""
MIN_LOAD_S = 0.06
"""Shortest load that is a step."""
MAX_EVENT_DISTANCE_S = 0.15
"""Time between the events of a plate and of markers that are one event."""
PLATE_SOURCE = "force plate"


class PlateContact(NamedTuple):
    """The load of a plate by one foot; the times in seconds, NaN where the plate is loaded already or still."""

    side: str
    strike_s: float
    off_s: float


def find_plate_contacts(plates: Sequence[ForcePlate], feet: Mapping[str, FootPoints], rate: float) -> list[PlateContact]:
    """Return the contacts of single feet with plates; `rate` is that of the feet's points, in frames per second."""
    contacts: list[PlateContact] = []
    for plate in plates:
        is_loaded = np.abs(plate.vertical_force_n) > LOAD_N
        for first, last in find_runs(is_loaded):
            if last + 1 - first < MIN_LOAD_S * plate.rate:
                continue
            middle = (first + last) / 2 / plate.rate * rate
            on_plate = {side: _count_points_on_plate(points, plate, round(middle)) for side, points in feet.items()}
            sides = [side for side, count in on_plate.items() if count == len(FootPoints._fields)]
            if len(sides) == 1 and sum(on_plate.values()) == len(FootPoints._fields):
                strike_s = first / plate.rate if first > 0 else np.nan
                off_s = (last + 1) / plate.rate if last < len(is_loaded) - 1 else np.nan
                contacts.append(PlateContact(sides[0], strike_s, off_s))
    return contacts


def replace_marker_events(events: Sequence[GaitEvent], contacts: Sequence[PlateContact]) -> tuple[GaitEvent, ...]:
    """Return events by time, with those of force plates in place of the events of markers about the same time."""
    measured = [
        GaitEvent(contact.side, kind, time_s, PLATE_SOURCE)
        for contact in contacts
        for kind, time_s in (("foot strike", contact.strike_s), ("foot off", contact.off_s))
        if np.isfinite(time_s)
    ]
    kept = [
        event
        for event in events
        if not any(_is_same(event, other) for other in measured) and not any(_is_within(event, each) for each in contacts)
    ]
    return tuple(sorted([*kept, *measured], key=lambda event: event.time_s))


def _is_same(event: GaitEvent, other: GaitEvent) -> bool:
    is_near = abs(event.time_s - other.time_s) < MAX_EVENT_DISTANCE_S
    return is_near and (event.side, event.kind) == (other.side, other.kind)


def _is_within(event: GaitEvent, contact: PlateContact) -> bool:
    """Return whether an event lies within the time in which its foot stands on a plate."""
    return event.side == contact.side and contact.strike_s < event.time_s < contact.off_s


def _count_points_on_plate(points: FootPoints, plate: ForcePlate, frame: int) -> int:
    """Return how many points of a foot are above a plate in a frame."""
    if not 0 <= frame < len(points.heel):
        return 0
    return sum(_is_inside(path[frame, [0, 2]], plate.corners[:, [0, 2]]) for path in points)


def _is_inside(point: Float[np.ndarray, " 2"], corners: Float[np.ndarray, "4 2"]) -> bool:
    """Return whether a point is inside a convex polygon."""
    edges = np.roll(corners, -1, axis=0) - corners
    offsets = point - corners
    cross = edges[:, 0] * offsets[:, 1] - edges[:, 1] * offsets[:, 0]
    return bool((cross >= 0).all() or (cross <= 0).all())
