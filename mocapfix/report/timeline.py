"""Time lines of the HTML report: faults by marker, the distance of the markers from the body, and contacts with the floor.

Positions and widths are shares of the length of the take or of its strip, so that they scale with the page.
"""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.contacts.contacts import CONTACT_JOINTS, FOOT_JOINTS, BodyContacts
from mocapfix.errors import join_words
from mocapfix.model.faults import Fault
from mocapfix.model.take import Take
from mocapfix.options import FEET_LOCK, FEET_OFF, FEET_SOFT
from mocapfix.report.report import ContactSection
from mocapfix.report.sample_states import CleaningComparison, SampleOutcome, find_estimated_samples
from mocapfix.report.terms import PointTerms, format_number, get_fault_group
from mocapfix.stats.sequences import find_runs

MAX_TIME_TICKS = 6
MAX_RESIDUAL_BINS = 500
TIMELINE_RESOLUTION = 300  # bars closer than the take's length divided by this are drawn as one


@dataclass(frozen=True)
class TimelineBar:
    """A bar over the frame indices first..last."""

    css_class: str  # group of the fault, with "left" if the samples were not changed
    first: int
    last: int
    title: str  # text shown on hovering


@dataclass(frozen=True)
class TimelineRow:
    """The bars of one marker."""

    label: str
    bars: tuple[TimelineBar, ...]


@dataclass(frozen=True)
class TimeTick:
    """A mark on the time axis: its share of the take's length, the file's frame number and the time in seconds."""

    share: float
    frame_number: int
    time_s: float


@dataclass(frozen=True)
class ResidualPlot:
    """Median and 95th percentile of the residuals over time, as SVG paths in the unit square."""

    limit_mm: float  # value at the upper edge
    median_path: str
    percentile_path: str


def build_fault_rows(comparison: CleaningComparison) -> list[TimelineRow]:
    """Return the rows of trajectories with faults, and of donors of joined fragments; fragments of no marker have none."""
    take, applied = comparison.input_take, {id(fault) for _, fault in comparison.applied_changes}
    unused = {id(fault) for fault in comparison.unchanged_faults if fault.kind == "fragment"}
    states, bars = comparison.sample_states, defaultdict[int, list[TimelineBar]](list)
    for fault in (fault for fault in comparison.faults.items if id(fault) not in unused):
        for m in (m for m in fault.markers if m < len(take.labels)):
            bars[m] += _build_bars(fault, states[fault.frame_slice, m], id(fault) in applied)
    for donor, fragments in comparison.fragments_by_donor.items():
        for each in fragments:
            bars[donor].append(TimelineBar("label", each.first, each.last, f"Joined to {take.get_label(each.marker)}."))
    return [TimelineRow(take.get_label(m), tuple(_merge_near_bars(bars[m], take.frame_count))) for m in sorted(bars)]


def _build_bars(fault: Fault, states: Int[np.ndarray, " N"], is_applied: bool) -> Iterator[TimelineBar]:
    """Yield one bar for each corrected or unchanged interval of a fault.

    What became of missing and faulty samples follows from their N states, not from the fault: the fault of a segment is that of
    gaps which are filled, and has no change of its own.
    """
    group = get_fault_group(fault.kind)
    if group not in ("missing", "faulty"):
        yield TimelineBar(group if is_applied else f"{group} left", fault.first, fault.last, fault.reason)
        return
    is_left = np.isin(states, (SampleOutcome.EMPTY, SampleOutcome.SUSPECT, SampleOutcome.REASSIGNED))
    is_corrected = find_estimated_samples(states) | (is_applied & ~is_left)
    if group == "faulty":
        is_left = ~is_corrected
    for css_class, mask in ((group, is_corrected), (f"{group} left", is_left)):
        for first, last in find_runs(mask):
            yield TimelineBar(css_class, fault.first + first, fault.first + last, fault.reason)


def _merge_near_bars(bars: Sequence[TimelineBar], frame_count: int) -> Iterator[TimelineBar]:
    """Yield the bars with near bars of one class merged; the class of the longest bar comes first, below the others."""
    by_class: defaultdict[str, list[TimelineBar]] = defaultdict(list)
    for bar in sorted(bars, key=lambda bar: bar.first):
        by_class[bar.css_class].append(bar)
    for css_class, each in sorted(by_class.items(), key=lambda item: -max(bar.last - bar.first for bar in item[1])):
        max_gap = frame_count / TIMELINE_RESOLUTION
        starts = [n for n, bar in enumerate(each) if n == 0 or bar.first - each[n - 1].last - 1 > max_gap]
        for start, end in zip(starts, [*starts[1:], len(each)], strict=True):
            more = f" And {end - start - 1} more nearby." if end - start > 1 else ""
            yield TimelineBar(css_class, each[start].first, max(bar.last for bar in each[start:end]), each[start].title + more)


def build_time_ticks(take: Take, first: int = 0, stop: int | None = None) -> list[TimeTick]:
    """Return the marks of the time axis of the frames first..stop - 1, by default of all; times start at the first frame."""
    start_s, duration_s = first / take.rate, ((take.frame_count if stop is None else stop) - first) / take.rate
    step_s = compute_round_step(duration_s / MAX_TIME_TICKS)
    return [
        TimeTick((time - start_s) / duration_s, take.get_frame_number(round(time * take.rate)), round(float(time), 6))
        for time in np.arange(int(np.ceil(start_s / step_s - 1e-9)), (start_s + duration_s) / step_s - 1e-9) * step_s
    ]


def compute_round_step(minimum: float) -> float:
    """Return the smallest number 1, 2 or 5 times a power of ten that is at least `minimum`."""
    power = 10.0 ** np.floor(np.log10(minimum))
    return next(float(f"{step * power:.3g}") for step in (1, 2, 5, 10) if step * power >= minimum * (1 - 1e-9))


def build_residual_plot(residual_m: Float[np.ndarray, "T M"]) -> ResidualPlot | None:
    """Return the median and the 95th percentile of the residuals over the markers; None if all are NaN."""
    parts = np.array_split(residual_m, min(MAX_RESIDUAL_BINS, len(residual_m)))
    bins = (np.sort(1e3 * part[np.isfinite(part)]) if np.isfinite(part).any() else np.array([np.nan]) for part in parts)
    median_mm, percentile_mm = np.array([np.interp((0.5, 0.95), np.linspace(0, 1, len(each)), each) for each in bins]).T
    if np.isnan(median_mm).all():
        return None
    limit_mm = compute_round_step(float(np.nanmax(percentile_mm)) or 1.0)
    return ResidualPlot(limit_mm, _draw_line(median_mm / limit_mm), _draw_line(percentile_mm / limit_mm))


def _draw_line(values: Float[np.ndarray, " N"]) -> str:
    """Return the SVG path of values between 0 and 1 at the centres of their bins, interrupted at NaN."""
    x = (np.arange(len(values)) + 0.5) / len(values)
    intervals = find_runs(np.isfinite(values))
    return "".join("M" + "L".join(f"{x[i]:.4f} {1 - values[i]:.3f}" for i in range(a, b + 1)) for a, b in intervals)


MAX_STRIP_S = 30.0  # longest strip; shorter contacts than a hundredth of it are hard to see
MAX_STRIPS = 8  # number of strips above which they are longer
CONTACT_NAMES = {
    "LeftFoot": "left heel", "LeftToeBase": "left toes", "RightFoot": "right heel", "RightToeBase": "right toes",
    "LeftLeg": "left knee", "RightLeg": "right knee", "LeftFingerBase": "left wrist", "RightFingerBase": "right wrist",
    "Hips": "seat", "Spine1": "back",
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
    return list(pairwise(np.linspace(0, take.frame_count, count + 1).round().astype(int).tolist()))


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
        seen, inferred = (_draw_runs(is_contact & each) for each in (is_known, ~is_known))
        lanes.append(ContactLane(CONTACT_NAMES[joint], seen, inferred, tuple(marks)))
    return ContactStrip(tuple(lanes), tuple(build_time_ticks(take, first, stop)))


def _draw_runs(mask: Bool[np.ndarray, " N"]) -> str:
    """Return the SVG path of one rectangle for each run, in the unit square."""
    count = len(mask)
    return "".join(f"M{a / count:.5f} 0H{(b + 1) / count:.5f}V1H{a / count:.5f}Z" for a, b in find_runs(mask))
