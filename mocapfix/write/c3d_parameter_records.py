"""The parameter section of a C3D file with other labels of the points. All other parameters keep their bytes."""

import struct
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from mocapfix.files.layouts import C3D_BLOCK_BYTES, SGI_PROCESSOR

MAX_SERIES_NUMBER = 100  # of a parameter with an entry for each point, such as LABELS, that is continued in LABELS2 and so on
MAX_TEXTS_PER_PARAMETER = 255  # of a parameter, and the length of a text
LARGEST_GROUP = 127  # number of a group
DATA_BLOCK_WORD = 16  # offset in the header of the number of the first block of data
POINT_COUNT_WORD = 2  # offset in the header of the number of points


class ParameterRecord(NamedTuple):
    """A group or a parameter: its name, the number of its group (negative for the group itself), and its bytes."""

    name: str
    group: int
    name_bytes: bytes
    content: bytes


def replace_point_parameters(head: bytes, labels: Sequence[str], *, has_same_points: bool) -> bytes:
    """Return the bytes before the data of a C3D file for points with other labels.

    The data begin later if the parameters need more blocks than there are before the data.

    Args:
        head: The bytes from the beginning of the file to its data.
        labels: The labels of all points.
        has_same_points: Whether these are the points of the file, whose descriptions are then kept.
    """
    order = _find_byte_order(head)
    records = read_parameter_records(head)
    point_group, group_records = find_point_group(records)
    texts = {"LABELS": [label.encode("utf-8") or b" " for label in labels]}
    if not has_same_points:
        texts["DESCRIPTIONS"] = [b" "] * len(labels)
    series = {f"{name}{number or ''}" for name in texts for number in (0, *range(2, MAX_SERIES_NUMBER))}
    kept = [each for each in records if each.group != point_group or each.name not in {*series, "USED", "DATA_START"}]
    added = [*group_records, _build_word("USED", point_group, len(labels), order), *_build_text_series(point_group, texts)]
    start = bytearray(join_head(head, kept, added, point_group))
    struct.pack_into(order + "H", start, POINT_COUNT_WORD, len(labels))
    return bytes(start)


def find_point_group(records: Sequence[ParameterRecord]) -> tuple[int, list[ParameterRecord]]:
    """Return the number of the group POINT and, if a file has none, the record of a new one."""
    numbers = {each.name: -each.group for each in records if each.group < 0}
    if "POINT" in numbers:
        return numbers["POINT"], []
    number = next(k for k in range(1, LARGEST_GROUP) if k not in {abs(each.group) for each in records})
    return number, [build_group_record("POINT", number)]


def build_group_record(name: str, number: int) -> ParameterRecord:
    """Return the record of a group without a description."""
    return ParameterRecord(name, -number, struct.pack("bb", len(name), -number) + name.encode(), b"\0")


def join_head(head: bytes, kept: Sequence[ParameterRecord], added: Sequence[ParameterRecord], point_group: int) -> bytes:
    """Return the bytes before the data with other parameter records; POINT:DATA_START, not among them, is set.

    The data begin later if the parameters need more blocks than there are before the data.
    """
    first, order = C3D_BLOCK_BYTES * (head[0] - 1), _find_byte_order(head)
    data_start_bytes = len(_join_records([_build_word("DATA_START", point_group, 0, order)], order))
    size = len(_join_records([*kept, *added], order)) + data_start_bytes + 2 + 4
    block_count = -(-size // C3D_BLOCK_BYTES)
    data_block = max(len(head) // C3D_BLOCK_BYTES, head[0] - 1 + block_count) + 1
    records = [*kept, *added, _build_word("DATA_START", point_group, data_block, order)]
    section = head[first : first + 2] + bytes([min(block_count, 255), head[first + 3]]) + _join_records(records, order) + bytes(2)
    section = section.ljust(C3D_BLOCK_BYTES * block_count, b"\0")
    start = bytearray(head[:first])
    struct.pack_into(order + "H", start, DATA_BLOCK_WORD, data_block)
    return bytes(start + section).ljust(C3D_BLOCK_BYTES * (data_block - 1), b"\0")


def _find_byte_order(head: bytes) -> str:
    """Return the byte order of the numbers in the parameters, as for `struct`."""
    return ">" if head[C3D_BLOCK_BYTES * (head[0] - 1) + 3] == SGI_PROCESSOR else "<"


def read_parameter_records(head: bytes) -> list[ParameterRecord]:
    """Return all groups and parameters in the bytes before the data of a C3D file."""
    return _read_records(head, C3D_BLOCK_BYTES * (head[0] - 1) + 4, _find_byte_order(head))


def _read_records(head: bytes, at: int, order: str) -> list[ParameterRecord]:
    records: list[ParameterRecord] = []
    while at + 2 <= len(head) and head[at]:
        name_length, group = struct.unpack_from("bb", head, at)
        name_end = at + 2 + abs(name_length)
        (offset,) = struct.unpack_from(order + "h", head, name_end)
        content_start = name_end + 2
        content_end = name_end + offset if offset > 0 else content_start + _measure_content(head, content_start, group, order)
        records.append(
            ParameterRecord(
                head[at + 2 : name_end].decode("latin-1").upper(), group, head[at:name_end], head[content_start:content_end]
            )
        )
        if offset <= 0:
            break
        at = content_end
    return records


def _measure_content(head: bytes, at: int, group: int, order: str) -> int:
    """Return the number of bytes of the content of the last record, which gives no offset to a next one."""
    if group < 0:
        return 1 + head[at]
    size = abs(struct.unpack_from("b", head, at)[0])
    for dimension in head[at + 2 : at + 2 + head[at + 1]]:
        size *= dimension
    description = at + 2 + head[at + 1] + size
    return description + 1 + head[description] - at


def _join_records(records: Sequence[ParameterRecord], order: str) -> bytes:
    return b"".join(each.name_bytes + struct.pack(order + "h", len(each.content) + 2) + each.content for each in records)


def _build_text_series(group: int, texts: Mapping[str, Sequence[bytes]]) -> list[ParameterRecord]:
    """Return the records of the texts of the points, by the name of the parameter."""
    records: list[ParameterRecord] = []
    for name, series in texts.items():
        for number, first in enumerate(range(0, max(len(series), 1), MAX_TEXTS_PER_PARAMETER)):
            part = series[first : first + MAX_TEXTS_PER_PARAMETER]
            records.append(build_text_record(f"{name}{number + 1 if number else ''}", group, part))
    return records


def build_text_record(name: str, group: int, texts: Sequence[bytes]) -> ParameterRecord:
    """Return the record of a list of at most MAX_TEXTS_PER_PARAMETER texts, padded to one length."""
    width = min(max(map(len, texts), default=1), MAX_TEXTS_PER_PARAMETER)
    content = struct.pack("bBBB", -1, 2, width, len(texts)) + b"".join(text[:width].ljust(width) for text in texts) + b"\0"
    return build_record(name, group, content)


def _build_word(name: str, group: int, value: int, order: str) -> ParameterRecord:
    return build_record(name, group, struct.pack("bB", 2, 0) + struct.pack(order + "H", value) + b"\0")


def build_record(name: str, group: int, content: bytes) -> ParameterRecord:
    """Return the record of a parameter with a content: type, dimensions, values, description."""
    return ParameterRecord(name, group, struct.pack("bb", len(name), group) + name.encode(), content)
