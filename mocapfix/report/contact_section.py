"""The report's section on contacts with the floor, and the notes on what a technician must know of them."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from mocapfix.contacts.contacts import FOOT_JOINTS, BodyContacts, GaitEvent
from mocapfix.errors import join_words
from mocapfix.files.option_choices import FEET_OFF
from mocapfix.report.contact_entries import ContactSection, GaitEntry, GaitEventEntry, JointContactEntry
from mocapfix.report.terms import PointTerms
from mocapfix.take import Take

STEP_TIME_RANGE_S = (0.2, 1.2)
"""Time between the strikes of the two feet that make a step; a longer one is a pause."""
MIN_CADENCE_STEPS = 4
"""Steps from which a cadence is computed."""
SOURCE_NAMES = {"force plate": "its force plate", "file": "the file", "markers": "the markers"}
MAX_FLOOR_ERROR_M = 0.03
"""Difference between the floor's height and the one that motion files assume above which a note names it."""


def build_contact_section(contacts: BodyContacts, take: Take) -> ContactSection:
    """Return the section on the contacts in a take, whose frame numbers it has."""
    floor = contacts.floor
    return {
        "floor": {
            "height_m": round(floor.height_m, 4),
            "tilt_deg": round(floor.tilt_deg, 2),
            "level_heights_m": [round(height, 4) for height in floor.level_heights_m],
        }
        if floor.level_heights_m
        else None,
        "joints": {joint: _build_joint_entry(contacts, joint) for joint in contacts.joints} if contacts.has_feet else {},
        "feet": {
            "mode": contacts.held_feet.mode,
            "largest_displacement_mm": round(contacts.held_feet.largest_displacement_m * 1e3, 2),
            "yielded_s": round(contacts.held_feet.yielded_s, 3),
        },
        "gait": build_gait_entry(contacts.events),
        "events": [_build_event_entry(event, contacts.rate, take) for event in contacts.events],
        "event_disagreements": [
            {
                **_build_event_entry(each.event, contacts.rate, take),
                "other_source": each.other.source,
                "delay_ms": round(1e3 * float(each.delay_s), 1),
            }
            for each in contacts.event_disagreements
        ],
    }


def _build_event_entry(event: GaitEvent, rate: float, take: Take) -> GaitEventEntry:
    return {
        "side": event.side,
        "event": event.kind,
        "time_s": round(float(event.time_s), 4),
        "frame": round(float(take.first_frame + event.time_s * rate), 2),
        "source": event.source,
    }


def _build_joint_entry(contacts: BodyContacts, joint: str) -> JointContactEntry:
    column = contacts.joints.index(joint)
    is_contact, is_known = contacts.is_contact[:, column], contacts.is_known[:, column]
    intervals, count = contacts.list_intervals(joint), int(is_contact.sum())
    return {
        "contacts": len(intervals),
        "seconds": round(count / contacts.rate, 3),
        "share": round(count / max(1, len(is_contact)), 4),
        "inferred": sum(not is_known[first : last + 1].all() for first, last in intervals),
        "inferred_s": round(int((is_contact & ~is_known).sum()) / contacts.rate, 3),
    }


def build_gait_entry(events: Sequence[GaitEvent]) -> GaitEntry:
    """Return the number of strikes and steps, and the cadence."""
    strikes = sorted((event for event in events if event.kind == "foot strike"), key=lambda event: event.time_s)
    shortest_s, longest_s = STEP_TIME_RANGE_S
    steps_s = [
        after.time_s - before.time_s
        for before, after in pairwise(strikes)
        if after.side != before.side and shortest_s <= after.time_s - before.time_s <= longest_s
    ]
    has_cadence = len(steps_s) >= MIN_CADENCE_STEPS
    return {
        "strikes": {side: sum(event.side == side for event in strikes) for side in FOOT_JOINTS},
        "steps": len(steps_s),
        "cadence_steps_per_min": round(60.0 / float(np.median(steps_s)), 1) if has_cadence else None,
    }


def describe_contacts(contacts: BodyContacts, requested_mode: str, floor_height_m: float, terms: PointTerms) -> list[str]:
    """Return notes on a floor that is not where it is assumed, is tilted or has levels, and on feet that are not seen.

    requested_mode  what to do with standing feet: the option --feet
    floor_height_m  height that motion files assume: the option --floor
    """
    if not contacts.has_feet:
        held = "" if requested_mode == FEET_OFF else f", and --feet {requested_mode} has no effect"
        return [f"The {terms.points} do not show both feet, so no contacts with the floor are detected{held}."]
    floor = contacts.floor
    if not floor.level_heights_m:
        return ["No foot stands still in this take, so no floor is detected."]
    notes: list[str] = []
    offset_m = floor.height_m - floor_height_m
    if abs(offset_m) > MAX_FLOOR_ERROR_M:
        place = f"{abs(offset_m) * 1e3:.0f} mm {'above' if offset_m > 0 else 'below'} height {floor_height_m:g} m"
        notes.append(f"The feet stand {place}; --floor {floor.height_m:.3f} writes motion files with the floor at height 0.")
    if floor.tilt_deg > 0:
        notes.append(f"The floor is tilted by {floor.tilt_deg:.1f} degrees; motion files have the same tilt.")
    if len(floor.level_heights_m) > 1:
        heights = join_words([f"{height:.2f}" for height in floor.level_heights_m])
        notes.append(f"The feet stand on {len(floor.level_heights_m)} levels, at heights of {heights} m, such as steps or boxes.")
    return notes + _describe_inferred_contacts(contacts, terms) + _describe_event_disagreements(contacts)


def _describe_inferred_contacts(contacts: BodyContacts, terms: PointTerms) -> list[str]:
    """Return a note on the contacts of feet that are inferred; no note without any."""
    joints = [joint for names in FOOT_JOINTS.values() for joint in names]
    entries = [_build_joint_entry(contacts, joint) for joint in joints]
    count, seconds = sum(entry["inferred"] for entry in entries), sum(entry["inferred_s"] for entry in entries)
    if not count:
        return []
    what = "1 contact of a heel or a ball of a foot is" if count == 1 else f"{count} contacts of heels and balls of feet are"
    return [f"{what} partly inferred: for {seconds:.1f} s in all, too few {terms.points} show the foot."]


def _describe_event_disagreements(contacts: BodyContacts) -> list[str]:
    """Return a note on the events of which two sources give different times; no note without any."""
    if not contacts.event_disagreements:
        return []
    (side, kind, time_s, source), other = max(contacts.event_disagreements, key=lambda each: abs(each.delay_s))
    delay_ms, count = 1e3 * (other.time_s - time_s), len(contacts.event_disagreements)
    more = f" (and {count - 1} more in the report)" if count > 1 else ""
    when = f"{abs(delay_ms):.0f} ms {'later' if delay_ms > 0 else 'earlier'} by {SOURCE_NAMES.get(other.source, other.source)}"
    return [
        f"The {side} {kind} at {time_s:.3f} s by {SOURCE_NAMES.get(source, source)} is {when}{more}; "
        "force plates count before the file, and the file before markers."
    ]
