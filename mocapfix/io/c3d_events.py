"""Read events of gait from the header and the EVENT group of a C3D file, and add them to the group; all else keeps its bytes.

C3D User Guide, "The EVENT Group" and "The Header Section". A label names foot and kind by words ("Foot Strike" with the context
"Left") or by initials ("LHS", "RTO").

The head of a C3D file, which is everything before its data: parameters read, and replaced in one group.
"""

import re
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

from mocapfix.contacts.contacts import FILE_SOURCE, PLATE_SOURCE, GaitEvent
from mocapfix.contacts.plate_contacts import MAX_FILE_EVENT_ERROR_S
from mocapfix.io.c3d_writer import (
    LARGEST_GROUP,
    ParameterRecord,
    build_group_record,
    build_record,
    build_text_record,
    find_point_group,
    join_head,
    read_parameter_records,
)
from mocapfix.io.files import replace_atomically
from mocapfix.io.patches import check_copy_with_events
from mocapfix.model.take import C3D_BLOCK_BYTES, DEC_PROCESSOR, SGI_PROCESSOR

TEXT_TYPE, BYTE_TYPE, WORD_TYPE, FLOAT_TYPE = -1, 1, 2, 4
"""types of a parameter, which are the bytes of an element"""
CODES = {BYTE_TYPE: "b", WORD_TYPE: "h", FLOAT_TYPE: "f"}
PROCESSOR_BYTE = 3
"""offset of the processor type in the parameter section"""


@dataclass(frozen=True)
class NumberParameter:
    """The numbers of a parameter: their type, the dimensions, and the values in the order of the file."""

    kind: int
    dimensions: tuple[int, ...]
    values: Sequence[float]


@dataclass(frozen=True)
class C3dHead:
    """The bytes of a C3D file before its data."""

    data: bytes

    @property
    def processor_type(self) -> int:
        """The processor type, which gives the order of bytes and the format of floats."""
        return self.data[C3D_BLOCK_BYTES * (self.data[0] - 1) + PROCESSOR_BYTE]

    @cached_property
    def records(self) -> list[ParameterRecord]:
        """All groups and parameters."""
        return read_parameter_records(self.data)

    def read_word(self, offset: int) -> int:
        """Return the unsigned word at an offset of the header."""
        return struct.unpack_from(f"{self._get_byte_order()}H", self.data, offset)[0]

    def read_floats(self, offset: int, count: int) -> tuple[float, ...]:
        """Return numbers from an offset of the header on."""
        return self._decode_numbers(self.data[offset : offset + FLOAT_TYPE * count], FLOAT_TYPE)

    def find_group(self, name: str) -> int | None:
        """Return the number of a group; None if there is none."""
        return next((-each.group for each in self.records if each.group < 0 and each.name == name), None)

    def read_texts(self, group: str, name: str) -> list[str]:
        """Return the texts of a parameter, without blanks at their ends; none if it is missing."""
        content = self._find_content(group, name)
        if content is None or content[1] not in (1, 2):
            return []
        width, count, first = content[2], (content[3] if content[1] == 2 else 1), 2 + content[1]
        return [
            content[first + k * width : first + (k + 1) * width].decode("utf-8", "replace").rstrip(" \0") for k in range(count)
        ]

    def read_numbers(self, group: str, name: str) -> list[float]:
        """Return the numbers of a parameter in the order of the file; none if it is missing."""
        content = self._find_content(group, name)
        if content is None or content[0] not in CODES:
            return []
        kind, first, count = content[0], 2 + content[1], 1
        for size in content[2:first]:
            count *= size
        return list(self._decode_numbers(content[first : first + count * kind], kind))

    def replace_parameters(self, group: str, texts: Mapping[str, Sequence[str]], numbers: Mapping[str, NumberParameter]) -> bytes:
        """Return the bytes before the data with these parameters of a group, which is added if it is missing."""
        point_group, added = find_point_group(self.records)
        number = self.find_group(group)
        if number is None:
            used = {abs(each.group) for each in (*self.records, *added)}
            number = next(k for k in range(1, LARGEST_GROUP) if k not in used)
            added.append(build_group_record(group, number))
        added += [build_text_record(name, number, [text.encode() for text in each]) for name, each in texts.items()]
        added += [build_record(name, number, self._encode_parameter(each)) for name, each in numbers.items()]
        names = {each.name for each in added}
        kept = [
            each
            for each in self.records
            if not (each.group == number and each.name in names) and (each.group, each.name) != (point_group, "DATA_START")
        ]
        return join_head(self.data, kept, added, point_group)

    def _find_content(self, group: str, name: str) -> bytes | None:
        number = self.find_group(group)
        return next((each.content for each in self.records if each.group == number and each.name == name), None)

    def _get_byte_order(self) -> str:
        return ">" if self.processor_type == SGI_PROCESSOR else "<"

    def _decode_numbers(self, data: bytes, kind: int) -> tuple[float, ...]:
        if kind == FLOAT_TYPE and self.processor_type == DEC_PROCESSOR:
            return tuple(value / 4 for value in struct.unpack(f"<{len(data) // 4}f", _swap_words(data)))
        return struct.unpack(f"{self._get_byte_order()}{len(data) // kind}{CODES[kind]}", data)

    def _encode_parameter(self, parameter: NumberParameter) -> bytes:
        start = struct.pack("bB", parameter.kind, len(parameter.dimensions)) + bytes(parameter.dimensions)
        if parameter.kind == FLOAT_TYPE and self.processor_type == DEC_PROCESSOR:  # a VAX float is four times an IEEE one
            data = _swap_words(struct.pack(f"<{len(parameter.values)}f", *(4 * value for value in parameter.values)))
        else:
            values = parameter.values if parameter.kind == FLOAT_TYPE else [int(value) for value in parameter.values]
            data = struct.pack(f"{self._get_byte_order()}{len(values)}{CODES[parameter.kind]}", *values)
        return start + data + b"\0"


def _swap_words(data: bytes) -> bytes:
    """Return 32-bit numbers with their two words exchanged."""
    return b"".join(data[k + 2 : k + 4] + data[k : k + 2] for k in range(0, len(data), 4))


EVENT_GROUP = "EVENT"
MAX_EVENTS = 255
"""Events that one parameter can hold."""
MAX_REPEATED_EVENT_S = 0.25
"""Time from an event of the file up to which another of the same foot and kind is the same: half a step in walking."""
LABELS = {"foot strike": "Foot Strike", "foot off": "Foot Off"}
ICONS = {"foot strike": 1, "foot off": 2}
EVENT_TIME_UNIT_S = 60.0
"""The unit of the first of the two numbers of a time: a minute."""
SIDE_PATTERN = re.compile(
    r"^(L(?:EFT)?|R(?:IGHT)?)(?=[ _.-]|HS|TO$|FS|FO$|IC|ON$|OFF$|HEEL|TOE|FOOT|INITIAL)[ _.-]*|[ _.-]+(LEFT|RIGHT|L|R)$"
)
KIND_PATTERNS = {
    "foot strike": re.compile(r"^((FOOT|HEEL|TOE)[ _.-]*(STRIKE|CONTACT|ON|DOWN)|INITIAL[ _.-]*CONTACT|HS|FS|FC|IC|ON)$"),
    "foot off": re.compile(r"^((FOOT|TOE)[ _.-]*(OFF|UP)|TO|FO|OFF)$"),
}
"""words and initials of laboratories' programs"""
HEADER_EVENT_COUNT, HEADER_EVENT_TIMES, HEADER_EVENT_LABELS = 300, 304, 396
"""offsets of the number of events in the header, of their times, and of their labels"""
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


def add_c3d_events(
    target: Path, data_start_byte: int, events_by_subject: Mapping[str, Sequence[GaitEvent]], first_frame: int, rate: float
) -> int:
    """Add events of gait to the C3D file `target`, and return how many.

    An event that the EVENT group has already is not added; one that is wrong by a force plate gets the plate's time, and its
    description the time that it had. The time in a file begins at its frame 1, wherever its first frame is.

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
    events, start_s, names = list(known), (first_frame - 1) / rate, {event.subject for event in known if event.subject.strip()}
    only_name = names.pop() if len(names) == 1 else ""
    for subject, event in ((subject, event) for subject, events_of in events_by_subject.items() for event in events_of):
        time_s = event.time_s + start_s
        same = [k for k, other in enumerate(known) if other.foot_and_kind == (event.side, event.kind) and other.is_of(subject)]
        nearest = min(same, key=lambda k: abs(known[k].time_s - time_s), default=None)
        if nearest is None or abs(known[nearest].time_s - time_s) > MAX_REPEATED_EVENT_S:
            events.append(_convert_event(event, subject or only_name, time_s))
        elif event.source == PLATE_SOURCE and abs(known[nearest].time_s - time_s) > MAX_FILE_EVENT_ERROR_S:
            events[nearest] = _move_event(known[nearest], time_s)
    if events != known:
        with replace_atomically(target) as part:
            part.write_bytes(_replace_events(head, events[: max(MAX_EVENTS, len(known))]) + data[data_start_byte:])
            check_copy_with_events(target, part, data, data_start_byte, EVENT_GROUP)
    return min(len(events), max(MAX_EVENTS, len(known))) - len(known)


def read_c3d_events(head: C3dHead) -> list[FileEvent]:
    """Return the events of a file's EVENT group."""
    labels = head.read_texts(EVENT_GROUP, "LABELS")
    texts = {name: head.read_texts(EVENT_GROUP, name) for name in ("CONTEXTS", "DESCRIPTIONS", "SUBJECTS")}
    numbers = {name: head.read_numbers(EVENT_GROUP, name) for name in ("USED", "TIMES", "ICON_IDS", "GENERIC_FLAGS")}
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


def _convert_event(event: GaitEvent, subject: str, time_s: float) -> FileEvent:
    source = {PLATE_SOURCE: "detected from force plate", FILE_SOURCE: "from the header of the file"}
    description = source.get(event.source, "detected from markers")
    minutes, seconds = divmod(time_s, EVENT_TIME_UNIT_S)
    return FileEvent(LABELS[event.kind], event.side.capitalize(), description, subject, minutes, seconds, ICONS[event.kind])


def _move_event(event: FileEvent, time_s: float) -> FileEvent:
    minutes, seconds = divmod(time_s, EVENT_TIME_UNIT_S)
    description = f"detected from force plate; was at {event.time_s:.3f} s"
    return event._replace(minutes=minutes, seconds=seconds, description=description)


def _replace_events(head: C3dHead, events: Sequence[FileEvent]) -> bytes:
    """Return the bytes before the data with these events."""
    count = len(events)
    times = [number for event in events for number in (event.minutes, event.seconds)]
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
