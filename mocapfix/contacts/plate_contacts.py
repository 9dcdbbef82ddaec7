"""The contacts of feet with force plates, which are more precise than those from markers and replace these.

A plate counts only for a foot that is on it with heel and toes, while the other foot is not: the force of a foot that is partly
beside its plate begins too late, and that of two feet ends too late.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from mocapfix.contacts.contacts import FILE_SOURCE, FOOT_JOINTS, PLATE_SOURCE, BodyContacts, EventDisagreement, Floor, GaitEvent
from mocapfix.contacts.gait_events import FootPoints, find_foot_near_floor
from mocapfix.io.force_plates import ForcePlate
from mocapfix.stats.sequences import find_runs

LOAD_N = 20.0  # vertical force from which a plate is loaded, as is usual in gait analysis
MIN_LOAD_S = 0.06  # shortest load that is a step
USUAL_STRIDE_S = 1.0  # time from one strike of a foot to its next in walking, for takes that show no two
MAX_EVENT_DISAGREEMENT_S = 0.05  # difference between the times of one event by two sources above which it is reported
MAX_FILE_EVENT_ERROR_S = 0.025  # difference from the load of a plate above which an event of the file is wrong


class PlateContact(NamedTuple):
    """The load of a plate by one foot; the times in seconds, NaN where the plate is loaded already or still."""

    side: str
    strike_s: float
    off_s: float


def find_plate_contacts(
    plates: Sequence[ForcePlate], feet: Mapping[str, FootPoints], floor: Floor, rate: float
) -> list[PlateContact]:
    """Return the contacts of single feet with plates; `rate` is that of the feet's points, in frames per second."""
    is_near = {side: find_foot_near_floor(points, floor, rate) for side, points in feet.items()}
    contacts: list[PlateContact] = []
    for plate in plates:
        on_plate = {side: _find_points_on_plate(points, plate) & is_near[side][:, None] for side, points in feet.items()}
        is_loaded = np.abs(plate.vertical_force_n) > LOAD_N
        for first, last in find_runs(is_loaded):
            if last + 1 - first < MIN_LOAD_S * plate.rate:
                continue
            side = _find_single_foot(on_plate, first / plate.rate * rate, last / plate.rate * rate)
            if side is not None:
                strike_s = first / plate.rate if first > 0 else np.nan
                off_s = (last + 1) / plate.rate if last < len(is_loaded) - 1 else np.nan
                contacts.append(PlateContact(side, strike_s, off_s))
    return contacts


def merge_events(
    detected: Sequence[GaitEvent], recorded: Sequence[GaitEvent], contacts: Sequence[PlateContact]
) -> tuple[tuple[GaitEvent, ...], tuple[EventDisagreement, ...]]:
    """Return events by time from all sources, each once, and the events of which two sources give different times.

    The events of force plates count before those that the file has, and these before those from markers. Events of one foot and
    kind are the same within half a step.

    Args:
        contacts: Contacts with force plates.
    """
    half_step_s = compute_half_step([*recorded, *detected])
    kept = [
        GaitEvent(contact.side, kind, time_s, PLATE_SOURCE)
        for contact in contacts
        for kind, time_s in (("foot strike", contact.strike_s), ("foot off", contact.off_s))
        if np.isfinite(time_s)
    ]
    disagreements: list[EventDisagreement] = []
    for events in (recorded, detected):
        added, found = list[GaitEvent](), dict[GaitEvent, EventDisagreement]()
        for event in events:
            same = [each for each in kept if (each.side, each.kind) == (event.side, event.kind)]
            nearest = min(same, key=lambda each: abs(each.time_s - event.time_s), default=None)
            if nearest is not None and abs(nearest.time_s - event.time_s) < half_step_s:
                each = EventDisagreement(nearest, event)
                found[nearest] = min(found.get(nearest, each), each, key=lambda pair: abs(pair.delay_s))
            elif events is recorded or not any(
                event.side == each.side and each.strike_s < event.time_s < each.off_s for each in contacts
            ):
                added.append(event)
        kept += added
        disagreements += found.values()
    large = [each for each in disagreements if abs(each.delay_s) > MAX_EVENT_DISAGREEMENT_S or is_file_event_wrong(each)]
    return tuple(sorted(kept, key=lambda event: event.time_s)), tuple(sorted(large, key=lambda each: each.event.time_s))


def compute_half_step(events: Sequence[GaitEvent]) -> float:
    """Return half the duration of a step in seconds: a quarter of the median time between strikes of one foot by one source."""
    strides_s: list[float] = []
    for group in {(event.side, event.source) for event in events}:
        times = [event.time_s for event in events if (event.side, event.source) == group and event.kind == "foot strike"]
        strides_s += list(np.diff(sorted(times)))
    return 0.25 * (float(np.median(strides_s)) if strides_s else USUAL_STRIDE_S)


def is_file_event_wrong(disagreement: EventDisagreement) -> bool:
    """Return whether a force plate shows that an event of the file is at another time."""
    event, other = disagreement
    return (event.source, other.source) == (PLATE_SOURCE, FILE_SOURCE) and abs(disagreement.delay_s) > MAX_FILE_EVENT_ERROR_S


def align_contacts_with_plates(contacts: BodyContacts, plate_contacts: Sequence[PlateContact]) -> BodyContacts:
    """Return contacts in which each foot on a plate begins and ends with the load: the heel begins, the ball of the foot ends."""
    is_contact = contacts.is_contact.copy()
    for side, strike_s, off_s in plate_contacts:
        first = 0 if np.isnan(strike_s) else int(np.ceil(strike_s * contacts.rate))
        last = len(is_contact) - 1 if np.isnan(off_s) else min(int(off_s * contacts.rate), len(is_contact) - 1)
        heel, ball = (is_contact[:, contacts.joints.index(joint)] for joint in FOOT_JOINTS[side])
        is_down = np.flatnonzero(heel[first : last + 1] | ball[first : last + 1])
        begin, end = (first + is_down[0], first + is_down[-1]) if len(is_down) else (last + 1, last)
        heel[first:begin] = True
        ball[end + 1 : last + 1] = True
        ball[first : last + 1] |= ~heel[first : last + 1]
        for part in (each for column in (heel, ball) for each in (column[:first][::-1], column[last + 1 :])):
            part[: int(np.argmin(part)) if not part.all() else len(part)] = False  # the run of a contact beside the load
    return contacts.change_contacts(is_contact)


def _find_single_foot(on_plate: Mapping[str, Bool[np.ndarray, "T 2"]], start_frame: float, stop_frame: float) -> str | None:
    """Return the side of the foot that loads a plate between two frames, alone and with heel and toes; None without one.

    Args:
        on_plate: By side, whether heel and toes are above the plate while the foot is near the floor.
    """
    span = slice(int(np.ceil(start_frame)), int(stop_frame) + 1)
    third = (stop_frame - start_frame) / 3
    middle = slice(round(start_frame + third), round(stop_frame - third) + 1)
    sides = [side for side, points in on_plate.items() if points[span].any()]
    if len(sides) != 1 or not len(on_plate[sides[0]][middle]) or not on_plate[sides[0]][middle].all():
        return None
    return sides[0]


def _find_points_on_plate(points: FootPoints, plate: ForcePlate) -> Bool[np.ndarray, "T 2"]:
    """Return whether each point of a foot is above a plate, a convex polygon."""
    corners = plate.corners[:, [0, 2]]
    edges = np.roll(corners, -1, axis=0) - corners
    inside: list[Bool[np.ndarray, " T"]] = []
    for path in points.paths:
        offsets = path[:, None, [0, 2]] - corners
        cross = edges[:, 0] * offsets[..., 1] - edges[:, 1] * offsets[..., 0]
        inside.append(np.all(cross >= 0, axis=1) | np.all(cross <= 0, axis=1))
    return np.stack(inside, axis=1)
