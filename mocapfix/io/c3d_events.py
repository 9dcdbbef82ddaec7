"""Read events of gait from the header and the EVENT group of a C3D file, and add them to the group; all else keeps its bytes.

C3D User Guide, "The EVENT Group" and "The Header Section". A label names foot and kind by words ("Foot Strike" with the context
"Left") or by initials ("LHS", "RTO").
"""

import re
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from mocapfix.contacts.contacts import FILE_SOURCE, PLATE_SOURCE, GaitEvent
from mocapfix.contacts.plate_contacts import MAX_FILE_EVENT_ERROR_S
from mocapfix.io.c3d_parameters import (
    BYTE_TYPE,
    FLOAT_TYPE,
    WORD_TYPE,
    C3dHead,
    ParameterRecord,
    build_list_records,
    build_number_record,
)
from mocapfix.io.files import replace_atomically
from mocapfix.io.patches import check_copy_with_events

EVENT_GROUP = "EVENT"
MAX_EVENTS = 255  # events that one parameter can hold
MAX_REPEATED_EVENT_S = 0.25  # within which events of one foot and kind are one: half a step in walking
LABELS = {"foot strike": "Foot Strike", "foot off": "Foot Off"}
ICONS = {"foot strike": 1, "foot off": 2}
EVENT_TIME_UNIT_S = 60.0  # the unit of the first of the two numbers of a time: a minute
SIDE_PATTERN = re.compile(
    r"^(L(?:EFT)?|R(?:IGHT)?)(?=[ _.-]|HS|TO$|FS|FO$|IC|ON$|OFF$|HEEL|TOE|FOOT|INITIAL)[ _.-]*|[ _.-]+(LEFT|RIGHT|L|R)$"
)
KIND_PATTERNS = {
    "foot strike": re.compile(r"^((FOOT|HEEL|TOE)[ _.-]*(STRIKE|CONTACT|ON|DOWN)|INITIAL[ _.-]*CONTACT|HS|FS|FC|IC|ON)$"),
    "foot off": re.compile(r"^((FOOT|TOE)[ _.-]*(OFF|UP)|TO|FO|OFF)$"),
}
"""words and initials of laboratories' programs"""
HEADER_EVENT_COUNT, HEADER_EVENT_TIMES, HEADER_EVENT_LABELS = 300, 304, 396  # offsets in the header
MAX_HEADER_EVENTS, HEADER_LABEL_BYTES = 18, 4


class FileEvent(NamedTuple):
    """An event as a file has it; the time from the file's frame 1 is the sum of minutes and seconds."""

    label: str
    context: str
    description: str
    subject: str
    minutes: float
    seconds: float
    icon: float = 0
    flag: float = 0

    @property
    def time_s(self) -> float:
        """Seconds from the file's frame 1."""
        return EVENT_TIME_UNIT_S * self.minutes + self.seconds

    @property
    def foot_and_kind(self) -> tuple[str, str] | None:
        """The side ("left", "right") and the kind ("foot strike", "foot off"); None for other events."""
        label, context = self.label.strip().upper(), self.context.strip().upper()
        found = SIDE_PATTERN.search(label)
        side = context if context in ("LEFT", "RIGHT") else (found[1] or found[2] if found else "")
        word = SIDE_PATTERN.sub("", label)
        kind = next((kind for kind, pattern in KIND_PATTERNS.items() if pattern.match(word) or pattern.match(label)), None)
        return ("left" if side.startswith("L") else "right", kind) if side and kind else None

    def is_of(self, subject: str) -> bool:
        """Return whether the event may be of a person, by name; names that are missing fit everybody."""
        return not subject or not self.subject.strip() or subject.upper() == self.subject.strip().upper()


def read_gait_events(
    head_data: bytes, subject: str, first_frame_and_rate: tuple[int, float], last_s: float
) -> tuple[GaitEvent, ...]:
    """Return the events of gait of one person that a C3D file has, by time; those of its header if it has no other.

    Args:
        head_data: The bytes of the file before its data.
        subject: The person's name, "" for any.
        first_frame_and_rate: The file's number of its first frame, and its frames per second.
        last_s: Time of the last frame after the first, in seconds; later events are of another part of the recording.
    """
    head, (first_frame, rate) = C3dHead(head_data), first_frame_and_rate
    try:
        found = read_c3d_events(head) or read_header_events(head)
    except (struct.error, IndexError, ValueError):  # of damaged parameters, which the reader of markers has accepted
        return ()
    start_s = (first_frame - 1) / rate
    events = [
        GaitEvent(*event.foot_and_kind, event.time_s - start_s, FILE_SOURCE)
        for event in found
        if event.foot_and_kind is not None and event.is_of(subject)
    ]
    return tuple(sorted((event for event in events if 0 <= event.time_s <= last_s + 1 / rate), key=lambda event: event.time_s))


EVENT_SOURCES = {PLATE_SOURCE: "detected from force plate", FILE_SOURCE: "from the header of the file"}


def add_c3d_events(
    target: Path, data_start_byte: int, events_by_subject: Mapping[str, Sequence[GaitEvent]], first_frame: int, rate: float
) -> int:
    """Add events of gait to the C3D file `target`, and return how many.

    An event that the EVENT group has already is not added; one that is wrong by a force plate gets the plate's time, and its
    description the time that it had. The time in a file begins at its frame 1, wherever its first frame is.

    Args:
        data_start_byte: Where its data begin.
        events_by_subject: The events of each person, by the name that the file has for that person; "" for none.
        first_frame: The file's number of its first frame.
        rate: Frames per second.
    """
    data = target.read_bytes()
    head = C3dHead(data[:data_start_byte])
    known = read_c3d_events(head)
    events, start_s, names = list(known), (first_frame - 1) / rate, {event.subject for event in known if event.subject.strip()}
    only_name = names.pop() if len(names) == 1 else ""
    for subject, event in ((subject, event) for subject, events_of in events_by_subject.items() for event in events_of):
        time_s = event.time_s + start_s
        same = [k for k, other in enumerate(known) if other.foot_and_kind == (event.side, event.kind) and other.is_of(subject)]
        nearest = min(same, key=lambda k: abs(known[k].time_s - time_s), default=None)
        clock = divmod(time_s, EVENT_TIME_UNIT_S)
        if nearest is None or abs(known[nearest].time_s - time_s) > MAX_REPEATED_EVENT_S:
            description = EVENT_SOURCES.get(event.source, "detected from markers")
            names = LABELS[event.kind], event.side.capitalize(), description, subject or only_name
            events.append(FileEvent(*names, *clock, ICONS[event.kind]))
        elif event.source == PLATE_SOURCE and abs(known[nearest].time_s - time_s) > MAX_FILE_EVENT_ERROR_S:
            description = f"{EVENT_SOURCES[PLATE_SOURCE]}; was at {known[nearest].time_s:.3f} s"
            events[nearest] = known[nearest]._replace(minutes=clock[0], seconds=clock[1], description=description)
    if events != known:
        with replace_atomically(target) as part:
            part.write_bytes(_replace_events(head, events[: max(MAX_EVENTS, len(known))]) + data[data_start_byte:])
            check_copy_with_events(target, part, data, data_start_byte, EVENT_GROUP)
    return min(len(events), max(MAX_EVENTS, len(known))) - len(known)


def read_c3d_events(head: C3dHead) -> list[FileEvent]:
    labels = head.read_text_series(f"{EVENT_GROUP}:LABELS")
    texts = {name: head.read_text_series(f"{EVENT_GROUP}:{name}") for name in ("CONTEXTS", "DESCRIPTIONS", "SUBJECTS")}
    numbers = {name: list(head.read_numbers(f"{EVENT_GROUP}:{name}")) for name in ("USED", "TIMES", "ICON_IDS", "GENERIC_FLAGS")}
    count = min(len(labels), len(numbers["TIMES"]) // 2, *(int(used) for used in numbers["USED"][:1]))
    contexts, descriptions, subjects = ((each + [""] * count)[:count] for each in texts.values())
    icons, flags = ((numbers[name] + [0.0] * count)[:count] for name in ("ICON_IDS", "GENERIC_FLAGS"))
    minutes, seconds = numbers["TIMES"][: 2 * count : 2], numbers["TIMES"][1 : 2 * count : 2]
    columns = (labels[:count], contexts, descriptions, subjects, minutes, seconds, icons, flags)
    return [FileEvent(*each) for each in zip(*columns, strict=True)]


def read_header_events(head: C3dHead) -> list[FileEvent]:
    """Return the events in the header of a file."""
    count = min(head.read_word(HEADER_EVENT_COUNT), MAX_HEADER_EVENTS)
    times_s = head.read_floats(HEADER_EVENT_TIMES, count)
    starts = [HEADER_EVENT_LABELS + HEADER_LABEL_BYTES * k for k in range(count)]
    labels = [head.data[start : start + HEADER_LABEL_BYTES].decode("ascii", "replace").strip(" \0") for start in starts]
    return [FileEvent(label, "", "", "", 0.0, time_s) for label, time_s in zip(labels, times_s, strict=True)]


def _replace_events(head: C3dHead, events: Sequence[FileEvent]) -> bytes:
    """Return the bytes before the data with these events."""
    count = len(events)
    texts = {
        "CONTEXTS": [event.context for event in events],
        "LABELS": [event.label for event in events],
        "DESCRIPTIONS": [event.description for event in events],
        "SUBJECTS": [event.subject or " " for event in events],
    }
    numbers = {
        "USED": (WORD_TYPE, (), [count]),
        "TIMES": (FLOAT_TYPE, (2, count), [number for event in events for number in (event.minutes, event.seconds)]),
        "ICON_IDS": (WORD_TYPE, (count,), [event.icon for event in events]),
        "GENERIC_FLAGS": (BYTE_TYPE, (count,), [event.flag for event in events]),
    }

    def build(group: int) -> list[ParameterRecord]:
        lists = [build_list_records(name, group, [text.encode() for text in each]) for name, each in texts.items()]
        arrays = [build_number_record(name, group, *each, head.processor_type) for name, each in numbers.items()]
        return [*(record for each in lists for record in each), *arrays]

    return head.replace_parameters(EVENT_GROUP, build)
