"""The head of a C3D file, which is everything before its data: parameters read, and replaced in one group."""

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

from mocapfix.files.layouts import C3D_BLOCK_BYTES, DEC_PROCESSOR, SGI_PROCESSOR
from mocapfix.write.c3d_parameter_records import (
    LARGEST_GROUP,
    ParameterRecord,
    build_group_record,
    build_record,
    build_text_record,
    find_point_group,
    join_head,
    read_parameter_records,
)

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
