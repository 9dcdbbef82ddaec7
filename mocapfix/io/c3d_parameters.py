"""Header and parameters of a C3D file: read, and replaced in one group while all else keeps its bytes.

Source: C3D User Guide, "The Header Section" and "The Parameter Section". A parameter section is a chain of records: groups with
their numbers, and parameters with the number of their group.
"""

import math
import struct
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from mmap import mmap
from typing import NamedTuple

from mocapfix.model.take import C3D_BLOCK_BYTES, DEC_PROCESSOR, INTEL_PROCESSOR, MAX_C3D_WORD, SGI_PROCESSOR

PROCESSOR_TYPES = (INTEL_PROCESSOR, DEC_PROCESSOR, SGI_PROCESSOR)
MAGIC_BYTE = 0x50  # second byte of every C3D file
PROCESSOR_BYTE = 3  # offset of the processor type in the parameter section
FIRST_RECORD_BYTE = 4  # offset of the first record in it
VICON_OUTPUT_GROUPS = ("ANGLES", "FORCES", "MOMENTS", "POWERS", "SCALARS", "REACTIONS")
VICON_MARKER_GROUPS = ("MODELED_MARKERS", "MODELED_MARKER")  # lists of outputs that are positions
TEXT_TYPE, BYTE_TYPE, WORD_TYPE, FLOAT_TYPE = -1, 1, 2, 4  # types of a parameter: the bytes of an element, -1 for texts
CODES = {BYTE_TYPE: "b", WORD_TYPE: "h", FLOAT_TYPE: "f"}
TEXT_PADDING = " \0\t\r\n"
MAX_SERIES_NUMBER = 100  # of a parameter with an entry for each point, such as LABELS, that is continued in LABELS2 and so on
MAX_TEXTS_PER_PARAMETER = 255  # and the length of a text
MAX_PARAMETER_BYTES = 32_000  # of the texts of a parameter
MAX_PARAMETER_BLOCKS = 255
LARGEST_GROUP = 127  # number of a group
POINT_COUNT_WORD, DATA_BLOCK_WORD = 2, 16  # offsets in the header of the numbers of points and of the first block of data


class ParameterRecord(NamedTuple):
    """A group or a parameter: its name, the number of its group (negative for the group itself), and its bytes."""

    name: str
    group: int
    name_bytes: bytes
    content: bytes


class C3dParameter(NamedTuple):
    """The type of a parameter, its dimensions, and the bytes of its values in the order of the file."""

    kind: int
    dimensions: tuple[int, ...]
    data: bytes


@dataclass(frozen=True)
class C3dHead:
    """The bytes of a C3D file, or those before its data. Damaged ones raise ValueError, struct.error or IndexError."""

    data: bytes | mmap

    @property
    def section_start_byte(self) -> int:
        """Where the parameter section begins."""
        return C3D_BLOCK_BYTES * (self.data[0] - 1)

    @property
    def processor_type(self) -> int:
        """One of PROCESSOR_TYPES, which gives the order of bytes and the format of floats."""
        return self.data[self.section_start_byte + PROCESSOR_BYTE]

    @cached_property
    def records(self) -> list[ParameterRecord]:
        """All groups and parameters before the data, also those that are beyond the declared end of the section."""
        return self._read_records(len(self.data) - 1)[0]

    @cached_property
    def section_end_byte(self) -> int:
        """The first block boundary after the last parameter."""
        return -(-self._read_declared_records()[1] // C3D_BLOCK_BYTES) * C3D_BLOCK_BYTES

    @cached_property
    def parameters(self) -> dict[str, C3dParameter]:
        """The parameters by name, such as POINT:LABELS. Of two with one name, as in some Vicon files, the first counts."""
        records, _ = self._read_declared_records()
        groups = {each.name: -each.group for each in reversed(records) if each.group < 0}
        names = {number: name for name, number in groups.items()}
        parameters = [(each, _parse_parameter(each.content)) for each in records if each.group > 0]
        return {f"{names[each.group]}:{each.name}": found for each, found in reversed(parameters) if each.group in names}

    def _read_declared_records(self) -> tuple[list[ParameterRecord], int]:
        start = self.section_start_byte
        return self._read_records(start + C3D_BLOCK_BYTES * self.data[start + 2])

    def _read_records(self, stop_byte: int) -> tuple[list[ParameterRecord], int]:
        """Return the records that begin before a byte, and where they end."""
        records, at, order = list[ParameterRecord](), self.section_start_byte + FIRST_RECORD_BYTE, self._get_byte_order()
        while at < stop_byte:
            name_length, group = struct.unpack_from("bb", self.data, at)
            if not name_length or not group:
                return records, at + 2
            name_end = at + 2 + abs(name_length)
            (offset,) = struct.unpack_from(f"{order}h", self.data, name_end)
            if offset < 0:
                raise ValueError("a parameter has a negative length")
            start, is_last = name_end + 2, offset < 2
            end = start + _measure_content(self.data, start, group) if is_last else name_end + offset
            name = _decode_text(self.data[at + 2 : name_end]).upper()
            records.append(ParameterRecord(name, group, self.data[at:name_end], self.data[start:end]))
            at = max(end, stop_byte) if is_last else end
        return records, at

    def _get_byte_order(self) -> str:
        return ">" if self.processor_type == SGI_PROCESSOR else "<"

    def read_word(self, offset: int) -> int:
        return struct.unpack_from(f"{self._get_byte_order()}H", self.data, offset)[0]

    def read_floats(self, offset: int, count: int) -> tuple[float, ...]:
        """Return numbers from an offset of the header on."""
        return self._decode_numbers(self.data[offset : offset + FLOAT_TYPE * count], FLOAT_TYPE)

    def _decode_numbers(self, data: bytes, kind: int) -> tuple[float, ...]:
        if kind == FLOAT_TYPE and self.processor_type == DEC_PROCESSOR:
            return tuple(value / 4 for value in struct.unpack(f"<{len(data) // 4}f", _swap_words(data)))
        return struct.unpack(f"{self._get_byte_order()}{len(data) // kind}{CODES[kind]}", data)

    def read_texts(self, name: str) -> list[str]:
        """Return the texts of a parameter, without blanks around them; none if it is missing."""
        parameter = self.parameters.get(name)
        if parameter is None:
            return []
        width, *counts = parameter.dimensions if len(parameter.dimensions) > 1 else (len(parameter.data),)
        count = min(math.prod(counts), MAX_C3D_WORD)
        texts = (parameter.data[k * width : (k + 1) * width] for k in range(count))
        return [_decode_text(text).strip(TEXT_PADDING) for text in texts]

    def read_text_series(self, name: str) -> list[str]:
        """Return a list that is spread over NAME, NAME2, NAME3 ...: a parameter has at most 255 texts."""
        texts, number = self.read_texts(name), 2
        while f"{name}{number}" in self.parameters:
            texts += self.read_texts(f"{name}{number}")
            number += 1
        return texts

    def read_listed_labels(self, lists: Iterable[str]) -> frozenset[str]:
        """Return the labels in some lists of the group POINT."""
        return frozenset(label for name in lists for label in self.read_text_series(f"POINT:{name}") if label)

    def read_numbers(self, name: str) -> tuple[float, ...]:
        """Return the numbers of a parameter in the order of the file; none if it is missing."""
        parameter = self.parameters.get(name)
        is_number = parameter is not None and parameter.kind in CODES
        return self._decode_numbers(parameter.data, parameter.kind) if parameter and is_number else ()

    def read_whole_number(self, name: str) -> int | None:
        """Return a whole number stored as one 16-bit word, two (the low one first) or a float; None if there is none."""
        parameter, numbers = self.parameters.get(name), self.read_numbers(name)
        if parameter is None or not parameter.data:
            return None
        if parameter.kind == FLOAT_TYPE:
            return int(numbers[0])
        if parameter.kind != WORD_TYPE:
            raise ValueError(f"{name} is no whole number")
        return sum((int(word) & MAX_C3D_WORD) << 16 * i for i, word in enumerate(numbers))

    def replace_parameters(
        self, group: str, build: Callable[[int], Sequence[ParameterRecord]], dropped: Collection[str] = ()
    ) -> bytes:
        """Return the bytes before the data with other parameters in a group, which is added if it is missing.

        The data begin later if the parameters need more blocks than there are before the data. POINT:DATA_START is set.

        Args:
            build: Returns the records of the new parameters, from the number of the group.
            dropped: Names of parameters that are removed, besides those of the new ones.
        """
        numbers, added = dict[str, int](), list[ParameterRecord]()
        for name in dict.fromkeys(("POINT", group)):
            number = next((-each.group for each in self.records if each.group < 0 and each.name == name), None)
            if number is None:
                used = {abs(each.group) for each in (*self.records, *added)}
                number = next(k for k in range(1, LARGEST_GROUP) if k not in used)
                added.append(build_group_record(name, number))
            numbers[name] = number
        new = build(numbers[group])
        names, data_start = {*dropped, *(each.name for each in new)}, (numbers["POINT"], "DATA_START")
        kept = [
            each
            for each in self.records
            if not (each.group == numbers[group] and each.name in names) and (each.group, each.name) != data_start
        ]
        return self._join((*kept, *added, *new), numbers["POINT"])

    def _join(self, records: Sequence[ParameterRecord], point_group: int) -> bytes:
        """Return the bytes before the data with these records and POINT:DATA_START."""
        head, first, order = self.data, self.section_start_byte, self._get_byte_order()

        def join(data_block: int) -> bytes:
            data_start = build_number_record("DATA_START", point_group, WORD_TYPE, (), [data_block], self.processor_type)
            return join_records((*records, data_start), order) + bytes(2)

        block_count = -(-(FIRST_RECORD_BYTE + len(join(0))) // C3D_BLOCK_BYTES)
        data_block = max(len(head) // C3D_BLOCK_BYTES, head[0] - 1 + block_count) + 1
        start = bytearray(head[:first])
        struct.pack_into(f"{order}H", start, DATA_BLOCK_WORD, data_block)
        section = head[first : first + 2] + bytes([min(block_count, MAX_PARAMETER_BLOCKS), head[first + PROCESSOR_BYTE]])
        return bytes(start + section + join(data_block)).ljust(C3D_BLOCK_BYTES * (data_block - 1), b"\0")


def _decode_text(data: bytes) -> str:
    """Return a text in UTF-8, or else in Latin-1."""
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def _parse_parameter(content: bytes) -> C3dParameter:
    """Return a parameter from the content of its record: type, dimensions, values and description."""
    kind, count = struct.unpack_from("bB", content)
    dimensions, start = tuple(content[2 : 2 + count]), 2 + count
    stop = start + abs(kind) * math.prod(dimensions)
    if len(content) <= stop:  # the length of the description follows the values
        raise ValueError("a parameter is cut off")
    return C3dParameter(kind, dimensions, content[start:stop])


def _measure_content(data: bytes | mmap, at: int, group: int) -> int:
    """Return the number of bytes of the content of the last record, which gives no offset to a next one."""
    if group < 0:
        return 1 + data[at]
    (kind,) = struct.unpack_from("b", data, at)
    dimensions = data[at + 2 : at + 2 + data[at + 1]]
    description = at + 2 + len(dimensions) + abs(kind) * math.prod(dimensions)
    return description + 1 + data[description] - at


def _swap_words(data: bytes) -> bytes:
    """Return 32-bit numbers with their two words exchanged."""
    return b"".join(data[k + 2 : k + 4] + data[k : k + 2] for k in range(0, len(data), 4))


def join_records(records: Sequence[ParameterRecord], order: str = "<") -> bytes:
    """Return the bytes of records, with their offsets in a byte order as for `struct`."""
    return b"".join(each.name_bytes + struct.pack(f"{order}h", len(each.content) + 2) + each.content for each in records)


def build_group_record(name: str, number: int) -> ParameterRecord:
    return ParameterRecord(name, -number, struct.pack("bb", len(name), -number) + name.encode(), b"\0")


def _build_record(name: str, group: int, kind: int, dimensions: Sequence[int], data: bytes) -> ParameterRecord:
    content = struct.pack("bB", kind, len(dimensions)) + bytes(dimensions) + data + b"\0"
    return ParameterRecord(name, group, struct.pack("bb", len(name), group) + name.encode(), content)


def build_number_record(
    name: str, group: int, kind: int, dimensions: Sequence[int], values: Sequence[float], processor_type: int = INTEL_PROCESSOR
) -> ParameterRecord:
    """Return the record of numbers of a type (BYTE_TYPE, WORD_TYPE or FLOAT_TYPE) in the order of the file."""
    order = ">" if processor_type == SGI_PROCESSOR else "<"
    if kind == FLOAT_TYPE and processor_type == DEC_PROCESSOR:  # a VAX float is four times an IEEE one
        data = _swap_words(struct.pack(f"<{len(values)}f", *(4 * value for value in values)))
    elif kind == FLOAT_TYPE:
        data = struct.pack(f"{order}{len(values)}f", *values)
    else:
        largest = 256**kind - 1
        data = struct.pack(f"{order}{len(values)}{CODES[kind].upper()}", *(int(value) & largest for value in values))
    return _build_record(name, group, kind, dimensions, data)


def build_text_record(name: str, group: int, text: bytes) -> ParameterRecord:
    return _build_record(name, group, TEXT_TYPE, (len(text),), text)


def build_list_records(name: str, group: int, texts: Sequence[bytes]) -> list[ParameterRecord]:
    """Return a list spread over NAME, NAME2, NAME3 ..., each with as many texts as a parameter can hold, padded to one length."""
    width = min(max(map(len, texts), default=1), MAX_TEXTS_PER_PARAMETER)
    count = min(MAX_TEXTS_PER_PARAMETER, MAX_PARAMETER_BYTES // max(width, 1))
    records: list[ParameterRecord] = []
    for number, first in enumerate(range(0, max(len(texts), 1), count)):
        part = texts[first : first + count]
        length = min(max(map(len, part), default=1), width)
        data = b"".join(text[:length].ljust(length) for text in part)
        records.append(_build_record(f"{name}{number + 1 if number else ''}", group, TEXT_TYPE, (length, len(part)), data))
    return records


def replace_point_parameters(head: bytes, labels: Sequence[str], *, has_same_points: bool) -> bytes:
    """Return the bytes before the data of a C3D file for points with other labels.

    Args:
        head: The bytes from the beginning of the file to its data.
        has_same_points: Whether these are the points of the file, whose descriptions are then kept.
    """
    opened = C3dHead(head)
    texts = {"LABELS": [label.encode("utf-8") or b" " for label in labels]}
    if not has_same_points:
        texts["DESCRIPTIONS"] = [b" "] * len(labels)

    def build(group: int) -> list[ParameterRecord]:
        used = build_number_record("USED", group, WORD_TYPE, (), [len(labels)], opened.processor_type)
        return [used, *(record for name, each in texts.items() for record in build_list_records(name, group, each))]

    series = {f"{name}{number or ''}" for name in texts for number in (0, *range(2, MAX_SERIES_NUMBER))}
    replaced = bytearray(opened.replace_parameters("POINT", build, series))
    struct.pack_into(">H" if opened.processor_type == SGI_PROCESSOR else "<H", replaced, POINT_COUNT_WORD, len(labels))
    return bytes(replaced)


@dataclass(frozen=True)
class C3dParameters:
    """What a C3D file declares about itself, in its own units.

    Attributes:
        model_outputs: Labels of the points that the file lists as angles, forces and other outputs that are no positions.
    """

    processor_type: int  # one of PROCESSOR_TYPES
    point_count: int  # points per frame, by POINT:USED
    header_point_count: int  # points per frame, by the header
    header_analog_words: int  # analog values after the points of a frame, by the header's third word
    header_samples_per_frame: int  # analog samples of a channel in a frame, by the header's tenth word
    analog_channel_count: int | None  # ANALOG:USED, None if not given
    analog_rate: float  # ANALOG:RATE, NaN if not given
    header_data_block: int  # number of the first block of data by the header, 0 if not given
    data_start_block: int  # POINT:DATA_START, 0 if not given
    section_end_byte: int  # first block boundary after the last parameter
    scale_factor: float  # POINT:SCALE, negative if samples are floats
    header_scale_factor: float  # the same by the header
    rate: float  # frames per second
    header_rate: float  # the same by the header
    unit_name: str  # POINT:UNITS, "" if not given
    screen_axis: str  # the file axis that its program draws upwards, such as "+Z", "" if not given
    labels: tuple[str, ...]  # Labels of all points, without blanks around them. There may be more or fewer than points.
    descriptions: tuple[str, ...]  # descriptions of the points, if there are any
    model_outputs: frozenset[str]
    modelled_markers: frozenset[str]  # labels of the points that the file lists as computed positions
    subject_names: tuple[str, ...]  # names of the subjects that the file lists, as Vicon's files do
    first_frame: int  # number of the first frame
    header_frame_count: int  # number of frames by the header
    frame_counts: tuple[int, ...]  # numbers of frames by header and parameters; the header's words end at 65535
    is_count_saturated: bool  # whether the header's last frame is 65535 and no parameter declares more


def read_c3d_parameters(data: bytes) -> C3dParameters:
    """Return what the C3D file with the bytes `data` declares about itself."""
    try:
        return _parse_parameters(C3dHead(data))
    except (struct.error, IndexError, OverflowError) as error:
        raise ValueError(str(error)) from error


def _parse_parameters(head: C3dHead) -> C3dParameters:
    if head.data[1] != MAGIC_BYTE or head.processor_type not in PROCESSOR_TYPES:
        raise ValueError(f"unknown processor type {head.processor_type}")
    words = (head.read_word(offset) for offset in (POINT_COUNT_WORD, 4, 6, 8, DATA_BLOCK_WORD, 18))
    header_point_count, header_analog_words, header_first, header_last, header_data_block, header_samples = words
    (header_scale_factor,), (header_rate,) = head.read_floats(12, 1), head.read_floats(20, 1)
    first = head.read_whole_number("TRIAL:ACTUAL_START_FIELD")
    last = head.read_whole_number("TRIAL:ACTUAL_END_FIELD")
    trial_frame_count = last - first + 1 if last and first is not None else None
    header_frame_count = header_last - header_first + 1
    if first is not None and first > MAX_C3D_WORD:  # the header's words are cut off or have overflowed
        header_frame_count = trial_frame_count or 0
    declared = (head.read_whole_number(name) for name in ("POINT:FRAMES", "POINT:LONG_FRAMES"))
    counts = tuple(n for n in (header_frame_count, *declared, trial_frame_count) if n is not None)
    point_count = head.read_whole_number("POINT:USED")
    type_groups = {*VICON_OUTPUT_GROUPS, *head.read_texts("POINT:TYPE_GROUPS")} - {"", *VICON_MARKER_GROUPS}
    return C3dParameters(
        processor_type=head.processor_type,
        point_count=header_point_count if point_count is None else point_count,
        header_point_count=header_point_count,
        header_analog_words=header_analog_words,
        header_samples_per_frame=header_samples,
        analog_channel_count=head.read_whole_number("ANALOG:USED"),
        analog_rate=next(iter(head.read_numbers("ANALOG:RATE")), math.nan),
        header_data_block=header_data_block,
        data_start_block=head.read_whole_number("POINT:DATA_START") or 0,
        section_end_byte=head.section_end_byte,
        scale_factor=next(iter(head.read_numbers("POINT:SCALE")), header_scale_factor),
        header_scale_factor=header_scale_factor,
        rate=next(iter(head.read_numbers("POINT:RATE")), header_rate),
        header_rate=header_rate,
        unit_name=next(iter(head.read_texts("POINT:UNITS")), ""),
        screen_axis="".join(head.read_texts("POINT:Y_SCREEN")).upper(),
        labels=tuple(head.read_text_series("POINT:LABELS")),
        descriptions=tuple(head.read_text_series("POINT:DESCRIPTIONS")),
        model_outputs=head.read_listed_labels(type_groups),
        modelled_markers=head.read_listed_labels(VICON_MARKER_GROUPS),
        subject_names=tuple(name for name in head.read_texts("SUBJECTS:NAMES") if name),
        first_frame=header_first if first is None else first,
        header_frame_count=header_frame_count,
        frame_counts=counts,
        is_count_saturated=header_last == MAX_C3D_WORD and max(*counts, last or 0) <= MAX_C3D_WORD,
    )
