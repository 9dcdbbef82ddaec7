"""Add events of gait to the EVENT group of a C3D file (C3D User Guide, "The EVENT Group"); all else keeps its bytes."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from mocapfix.contacts.contacts import GaitEvent
from mocapfix.files.output_files import replace_atomically
from mocapfix.write.c3d_head import BYTE_TYPE, FLOAT_TYPE, WORD_TYPE, C3dHead, NumberParameter

EVENT_GROUP = "EVENT"
MAX_EVENTS = 255
"""Events that one parameter can hold."""
MAX_REPEATED_EVENT_S = 0.1
"""Time from an event of the file up to which a detected one of the same foot and kind is the same."""
LABELS = {"foot strike": "Foot Strike", "foot off": "Foot Off"}
ICONS = {"foot strike": 1, "foot off": 2}
EVENT_TIME_UNIT_S = 60.0
"""The unit of the first of the two numbers of a time: a minute."""


class FileEvent(NamedTuple):
    """An event as a file has it; the time in seconds from the file's frame 1."""

    label: str
    context: str
    description: str
    subject: str
    time_s: float
    icon: float = 0
    flag: float = 0


def add_c3d_events(
    target: Path, data_start_byte: int, events_by_subject: Mapping[str, Sequence[GaitEvent]], first_frame: int, rate: float
) -> int:
    """Add events of gait to the C3D file `target`, and return how many.

    An event that the file has already is not added. The time in a file begins at its frame 1, wherever its first frame is.

    Args:
        target: The file.
        data_start_byte: Where its data begin.
        events_by_subject: The events of each person, by the name that the file has for that person; "" for none.
        first_frame: The file's number of its first frame.
        rate: Frames per second.

    Raises:
        WriteError: If the file is not writable.
    """
    data = target.read_bytes()
    head = C3dHead(data[:data_start_byte])
    known = read_c3d_events(head)
    start_s = (first_frame - 1) / rate
    detected = [_convert_event(event, subject, start_s) for subject, events in events_by_subject.items() for event in events]
    added = [event for event in detected if not any(_is_repeated(event, other) for other in known)][: MAX_EVENTS - len(known)]
    if added:
        with replace_atomically(target) as part:
            part.write_bytes(_replace_events(head, [*known, *added]) + data[data_start_byte:])
    return len(added)


def read_c3d_events(head: C3dHead) -> list[FileEvent]:
    """Return the events of a file."""
    labels = head.read_texts(EVENT_GROUP, "LABELS")
    texts = {name: head.read_texts(EVENT_GROUP, name) for name in ("CONTEXTS", "DESCRIPTIONS", "SUBJECTS")}
    numbers = {name: head.read_numbers(EVENT_GROUP, name) for name in ("TIMES", "ICON_IDS", "GENERIC_FLAGS")}
    count = min(len(labels), len(numbers["TIMES"]) // 2)
    contexts, descriptions, subjects = ((each + [""] * count)[:count] for each in texts.values())
    icons, flags = ((numbers[name] + [0.0] * count)[:count] for name in ("ICON_IDS", "GENERIC_FLAGS"))
    times = [EVENT_TIME_UNIT_S * numbers["TIMES"][2 * k] + numbers["TIMES"][2 * k + 1] for k in range(count)]
    return [FileEvent(*each) for each in zip(labels[:count], contexts, descriptions, subjects, times, icons, flags, strict=True)]


def _convert_event(event: GaitEvent, subject: str, start_s: float) -> FileEvent:
    source = "force plate" if "plate" in event.source else "markers"
    icon = ICONS[event.kind]
    return FileEvent(
        LABELS[event.kind], event.side.capitalize(), f"detected from {source}", subject, event.time_s + start_s, icon
    )


def _is_repeated(event: FileEvent, other: FileEvent) -> bool:
    is_same_kind = (event.label.upper(), event.context.upper()) == (other.label.upper(), other.context.upper())
    is_same_subject = not event.subject or not other.subject.strip() or event.subject.upper() == other.subject.strip().upper()
    return is_same_kind and is_same_subject and abs(event.time_s - other.time_s) < MAX_REPEATED_EVENT_S


def _replace_events(head: C3dHead, events: Sequence[FileEvent]) -> bytes:
    """Return the bytes before the data with these events."""
    count = len(events)
    times = [number for event in events for number in divmod(event.time_s, EVENT_TIME_UNIT_S)]
    return head.replace_parameters(
        EVENT_GROUP,
        {
            "CONTEXTS": [event.context for event in events],
            "LABELS": [event.label for event in events],
            "DESCRIPTIONS": [event.description for event in events],
            "SUBJECTS": [event.subject or " " for event in events],
        },
        {
            "USED": NumberParameter(WORD_TYPE, (), [count]),
            "TIMES": NumberParameter(FLOAT_TYPE, (2, count), times),
            "ICON_IDS": NumberParameter(WORD_TYPE, (count,), [event.icon for event in events]),
            "GENERIC_FLAGS": NumberParameter(BYTE_TYPE, (count,), [event.flag for event in events]),
        },
    )
