"""The HTML report's part on contacts with the floor: strips of the time at which heels and toes are in contact, and a table.

Positions are shares of a strip's length, so that they scale with the page. Long takes have several strips.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Bool

from mocapfix.contacts.contacts import CONTACT_JOINTS, FOOT_JOINTS, BodyContacts
from mocapfix.errors import join_words
from mocapfix.files.option_choices import FEET_LOCK, FEET_OFF, FEET_SOFT
from mocapfix.report.contact_entries import ContactSection
from mocapfix.report.terms import PointTerms, format_number
from mocapfix.report.timeline import MAX_TIME_TICKS, TimeTick, compute_round_step
from mocapfix.stats.sequences import find_runs
from mocapfix.take import Take

MAX_STRIP_S = 30.0
"""Longest strip; shorter contacts than a hundredth of it are hard to see."""
MAX_STRIPS = 8
"""Number of strips above which they are longer."""
CONTACT_NAMES = {
    "LeftFoot": "left heel", "LeftToeBase": "left toes", "RightFoot": "right heel", "RightToeBase": "right toes",
    "LeftLeg": "left knee", "RightLeg": "right knee", "LeftHand": "left wrist", "RightHand": "right wrist",
}  # fmt: skip
"""Names of the joints in figures; the ball of the foot is called toes there."""
FEET_TEXTS = {
    FEET_OFF: "Feet in contact are as they were {solved}",
    FEET_SOFT: "Feet in contact are without the fast part of their motion; they were moved by at most {distance} mm",
    FEET_LOCK: "Feet in contact are held at one place; they were moved by at most {distance} mm",
}
EVENT_CLASSES = {"foot strike": "strike", "foot off": "off"}


@dataclass(frozen=True)
class EventMark:
    """An event of gait: its share of the strip's length, CSS class and text shown on hovering."""

    share: float
    css_class: str
    title: str


@dataclass(frozen=True)
class ContactLane:
    """The contacts of one joint, as SVG paths in the unit square: those seen, and those inferred; and the events of its foot."""

    label: str
    seen_path: str
    inferred_path: str
    marks: tuple[EventMark, ...]


@dataclass(frozen=True)
class ContactStrip:
    """The lanes of one interval of the take, and its time axis."""

    lanes: tuple[ContactLane, ...]
    ticks: tuple[TimeTick, ...]


@dataclass(frozen=True)
class ContactPart:
    """Contacts with the floor: a text, strips over time with their legend, and a table by joint."""

    text: str
    legend: tuple[tuple[str, str], ...]
    strips: list[ContactStrip]
    header: tuple[str, ...]
    rows: list[tuple[str, ...]]


def build_contact_part(
    section: ContactSection | None, contacts: BodyContacts | None, take: Take, terms: PointTerms
) -> ContactPart | None:
    """Return the part on contacts; None for a take whose feet are not seen."""
    if section is None or contacts is None or not contacts.has_feet:
        return None
    legend = [("contact", "in contact")]
    has_inferred = bool((contacts.is_contact & ~contacts.is_known).any())
    if has_inferred:
        legend.append(("contact inferred", f"inferred: too few {terms.points} show the joint"))
    kinds = {event.kind for event in contacts.events}
    legend += [(css_class, kind) for kind, css_class in EVENT_CLASSES.items() if kind in kinds]
    joints = [joint for joint in contacts.joints if joint in CONTACT_JOINTS or contacts.list_intervals(joint)]
    return ContactPart(
        text=describe_contact_section(section, terms),
        legend=tuple(legend),
        strips=[build_contact_strip(contacts, joints, *span, take) for span in divide_take(take)],
        header=("Joint", "Contacts", "Seconds", "Share", *(("Inferred", "Inferred, s") if has_inferred else ())),
        rows=[_build_joint_row(section, joint, has_inferred=has_inferred) for joint in joints],
    )


def _build_joint_row(section: ContactSection, joint: str, *, has_inferred: bool) -> tuple[str, ...]:
    entry = section["joints"][joint]
    row = (CONTACT_NAMES[joint], f"{entry['contacts']:,}", format_number(entry["seconds"]), f"{entry['share']:.0%}")
    return (*row, f"{entry['inferred']:,}", format_number(entry["inferred_s"], 2)) if has_inferred else row


def describe_contact_section(section: ContactSection, terms: PointTerms) -> str:
    """Return sentences on the floor, on what was done to the feet, and on the events of gait."""
    sentences: list[str] = []
    if floor := section["floor"]:
        heights = join_words([f"{height * 1e3:,.0f}" for height in floor["level_heights_m"]])
        tilt = f", tilted by {floor['tilt_deg']:.1f} degrees" if floor["tilt_deg"] else ""
        levels = "levels at heights of" if len(floor["level_heights_m"]) > 1 else "at a height of"
        sentences.append(f"Floor {levels} {heights} mm{tilt}.")
    feet, solved = section["feet"], "in the file" if terms.point == "joint" else "solved"
    distance = format_number(feet["largest_displacement_mm"])
    sentences.append(FEET_TEXTS[feet["mode"]].format(solved=solved, distance=distance) + ".")
    if feet["yielded_s"]:
        seconds = format_number(feet["yielded_s"], 2)
        sentences.append(f"For {seconds} s a foot was not held, since that would have moved what visible markers show.")
    if events := section["events"]:
        plate_count = sum(event["source"] == "force plate" for event in events)
        source = f", {plate_count:,} of them from force plates" if plate_count else ""
        sentences.append(f"{len(events):,} events of gait{source}.")
    if cadence := section["gait"]["cadence_steps_per_min"]:
        sentences.append(f"{section['gait']['steps']:,} steps, {cadence:.0f} a minute.")
    return " ".join(sentences)


def divide_take(take: Take) -> list[tuple[int, int]]:
    """Return the intervals (first, stop) of frames of the strips, of about equal length."""
    count = int(np.clip(np.ceil(take.frame_count / take.rate / MAX_STRIP_S), 1, MAX_STRIPS))
    edges = np.linspace(0, take.frame_count, count + 1).round().astype(int).tolist()
    return list(pairwise(edges))


def build_contact_strip(contacts: BodyContacts, joints: list[str], first: int, stop: int, take: Take) -> ContactStrip:
    """Return the lanes of joints over the frames first..stop - 1."""
    lanes: list[ContactLane] = []
    for joint in joints:
        column = contacts.joints.index(joint)
        is_contact, is_known = (each[first:stop, column] for each in (contacts.is_contact, contacts.is_known))
        side = next((side for side, names in FOOT_JOINTS.items() if joint in names), None)
        marks = [
            EventMark(
                (event.time_s * contacts.rate - first) / (stop - first),
                EVENT_CLASSES[event.kind],
                f"{event.side} {event.kind}, {event.time_s:.3f} s, from {event.source}",
            )
            for event in contacts.events
            if event.side == side and first <= event.time_s * contacts.rate < stop
        ]
        lanes.append(
            ContactLane(CONTACT_NAMES[joint], _draw_runs(is_contact & is_known), _draw_runs(is_contact & ~is_known), tuple(marks))
        )
    return ContactStrip(tuple(lanes), tuple(_build_ticks(first, stop, take)))


def _draw_runs(mask: Bool[np.ndarray, " N"]) -> str:
    """Return the SVG path of one rectangle for each run, in the unit square."""
    count = len(mask)
    return "".join(f"M{a / count:.5f} 0H{(b + 1) / count:.5f}V1H{a / count:.5f}Z" for a, b in find_runs(mask))


def _build_ticks(first: int, stop: int, take: Take) -> list[TimeTick]:
    """Return the marks of the time axis of the frames first..stop - 1."""
    start_s, duration_s = first / take.rate, (stop - first) / take.rate
    step_s = compute_round_step(duration_s / MAX_TIME_TICKS)
    times = np.arange(int(np.ceil(start_s / step_s - 1e-9)), (start_s + duration_s) / step_s - 1e-9) * step_s
    return [
        TimeTick((time - start_s) / duration_s, take.get_frame_number(round(time * take.rate)), round(float(time), 6))
        for time in times
    ]
