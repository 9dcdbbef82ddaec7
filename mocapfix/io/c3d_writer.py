"""Write a take as a new C3D file: Intel floats, a header, the groups POINT and TRIAL, the samples.

The bytes are built here (c3d.org, "The C3D file format", sections 2 to 4), because the file is nearly the smallest possible
one, and the libraries that write C3D lose residual words or long takes.

The parameter section of a C3D file with other labels of the points. All other parameters keep their bytes.
"""

import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from mocapfix.errors import WriteError
from mocapfix.io.files import replace_atomically
from mocapfix.io.source_file import FileFrame, get_file_frame
from mocapfix.model.take import C3D_BLOCK_BYTES, INTEL_PROCESSOR, MAX_C3D_WORD, MAX_RESIDUAL_COUNTS, SGI_PROCESSOR, Take

RESIDUAL_COUNT_M = 1e-4  # metres per count of the residual
MISSING_RESIDUAL = -1  # residual word of a missing sample
MEASURED_RESIDUAL = 0  # residual word of a measured sample
UNKNOWN_SD_RESIDUAL = 1  # residual word of an estimated sample without a standard deviation
MAX_LABEL_BYTES = 255
MAX_LABELS_PER_PARAMETER = 255
MAX_PARAMETER_BYTES = 32_000
MAX_PARAMETER_BLOCKS = 255
RIGHT_AXIS_NAMES = {0: "+Y", 1: "+X", 2: "+X"}  # axis that points right, by the index of the up axis


class _Parameter(NamedTuple):
    """Name of a parameter, and its type, dimensions and values as bytes."""

    name: str
    content: bytes


def write_c3d(target: str | Path, take: Take) -> None:
    """Write the markers of a take, followed by its unlabelled trajectories, in the unit and axes of the source file.

    A measured sample has the residual word 0. An estimated one has its predicted standard deviation in counts of 0.1 mm, clamped
    to 1..255, and camera mask 0. A missing one has coordinates 0 and residual -1. Labels beyond 255 are stored in LABELS2 and so
    on, and frame numbers beyond 65535 in TRIAL and POINT:LONG_FRAMES. C3D counts frames from 0 on, so a take whose frame numbers
    are negative is numbered from 1.

    Raises:
        WriteError: If the take has more or longer labels than a C3D can hold, or `target` is not writable.
    """
    target, frame = Path(target), get_file_frame(take)
    labels = [*take.labels, *(take.unlabelled.labels if take.unlabelled else ())]
    encoded = [label.encode("utf-8") or b" " for label in labels]
    if too_long := next((label for label in encoded if len(label) > MAX_LABEL_BYTES), None):
        problem = f"the label {too_long.decode()[:30]}... is longer than the {MAX_LABEL_BYTES} bytes a C3D can hold"
        raise WriteError(f"{target}: {problem}; shorten it.")
    first = take.first_frame if take.first_frame >= 0 else 1
    last, point_count = first + take.frame_count - 1, len(labels)
    data_block = 2 + len(_encode_parameters(frame, take, encoded, first, 0)) // C3D_BLOCK_BYTES
    if point_count > MAX_C3D_WORD or data_block - 2 > MAX_PARAMETER_BLOCKS:
        problem = f"{point_count} points with such labels are more than a C3D can hold"
        raise WriteError(f"{target}: {problem}; write another format.")
    scale, ends = RESIDUAL_COUNT_M / frame.unit_m, (min(first, MAX_C3D_WORD), min(last, MAX_C3D_WORD))
    header = struct.pack("<BBHHHHHfHHf", 2, 80, point_count, 0, *ends, 0, -scale, data_block, 0, take.rate)
    with replace_atomically(target) as part, part.open("wb") as file:
        file.write(_pad_to_block(header) + _encode_parameters(frame, take, encoded, first, data_block))
        data = _build_words(frame, take).tobytes()
        # If the header cannot give the last frame, ezc3d reads padding in the last block as frames.
        file.write(data if last > MAX_C3D_WORD else _pad_to_block(data))


def _encode_parameters(frame: FileFrame, take: Take, labels: Sequence[bytes], first: int, data_block: int) -> bytes:
    """Return the groups POINT and TRIAL in complete blocks. `data_block` is the number of the first block of samples."""
    last, up = first + take.frame_count - 1, int(np.abs(frame.rotation_y_up_file[1]).argmax())
    up_axis = f"{'+' if frame.rotation_y_up_file[1, up] > 0 else '-'}{'XYZ'[up]}"
    point = [
        _encode_number("USED", "H", len(labels)),
        _encode_number("FRAMES", "H", min(take.frame_count, MAX_C3D_WORD)),
        _encode_number("LONG_FRAMES", "f", take.frame_count),
        _encode_number("DATA_START", "H", data_block),
        _encode_number("SCALE", "f", -RESIDUAL_COUNT_M / frame.unit_m),
        _encode_number("RATE", "f", take.rate),
        _encode_texts("UNITS", [frame.unit_name.encode()]),
        _encode_texts("X_SCREEN", [RIGHT_AXIS_NAMES[up].encode()]),
        _encode_texts("Y_SCREEN", [up_axis.encode()]),
        *_encode_text_series("LABELS", labels),
        *_encode_text_series("DESCRIPTIONS", [b" "] * len(labels)),
    ]
    trial = [
        _encode_word_pair("ACTUAL_START_FIELD", first),
        _encode_word_pair("ACTUAL_END_FIELD", last),
        _encode_number("CAMERA_RATE", "f", take.rate),
    ]
    groups = _encode_group(1, "POINT", point) + _encode_group(2, "TRIAL", trial)
    blocks = len(_pad_to_block(bytes(4) + groups)) // C3D_BLOCK_BYTES
    return _pad_to_block(struct.pack("BBBB", 1, 80, min(blocks, MAX_PARAMETER_BLOCKS), INTEL_PROCESSOR) + groups)


def _pad_to_block(data: bytes) -> bytes:
    """Return the data followed by zeros up to the end of its last block."""
    return data + bytes(-len(data) % C3D_BLOCK_BYTES)


def _encode_group(number: int, name: str, parameters: Sequence[_Parameter]) -> bytes:
    """Return the records of a group and its parameters, without descriptions.

    The length in a record includes itself and the length of the description.
    """
    head = struct.pack("<bb", len(name), -number) + name.encode("ascii") + struct.pack("<hB", 3, 0)
    return head + b"".join(
        struct.pack("<bb", len(parameter.name), number)
        + parameter.name.encode("ascii")
        + struct.pack("<H", len(parameter.content) + 3)
        + parameter.content
        + b"\0"
        for parameter in parameters
    )


def _encode_number(name: str, kind: str, value: float) -> _Parameter:
    """Return a 16-bit integer (kind "H") or a float (kind "f")."""
    return _Parameter(name, struct.pack("<bB" + kind, 4 if kind == "f" else 2, 0, value))


def _encode_word_pair(name: str, value: int) -> _Parameter:
    """Return a whole number as two 16-bit words, the low one first."""
    return _Parameter(name, struct.pack("<bBBHH", 2, 1, 2, value % 2**16, value // 2**16 % 2**16))


def _encode_texts(name: str, texts: Sequence[bytes]) -> _Parameter:
    width = max(map(len, texts), default=1)
    shape = [width] if len(texts) == 1 and name != "LABELS" else [width, len(texts)]
    padded = b"".join(text.ljust(width) for text in texts)
    return _Parameter(name, struct.pack("<bB", -1, len(shape)) + bytes(shape) + padded)


def _encode_text_series(name: str, texts: Sequence[bytes]) -> list[_Parameter]:
    """Return a list spread over NAME, NAME2, NAME3 ..., each with as many texts as a parameter can hold."""
    count = min(MAX_LABELS_PER_PARAMETER, MAX_PARAMETER_BYTES // max(map(len, texts), default=1))
    chunks = [texts[i : i + count] for i in range(0, len(texts), count)] or [texts]
    return [_encode_texts(f"{name}{i + 1 if i else ''}", chunk) for i, chunk in enumerate(chunks)]


def _build_words(frame: FileFrame, take: Take) -> Float[np.ndarray, "T P 4"]:
    """Return X, Y, Z in the unit and axes of the file and the residual word, for markers and unlabelled trajectories."""
    unlabelled = take.unlabelled.markers if take.unlabelled else np.zeros((take.frame_count, 0, 3))
    xyz = frame.compute_coordinates(np.concatenate([take.markers, unlabelled], axis=1))
    words = np.zeros((*xyz.shape[:2], 4), "<f4")
    words[..., :3] = xyz
    residual_words = np.where(take.measured | ~take.visible, MEASURED_RESIDUAL, UNKNOWN_SD_RESIDUAL).astype(float)
    if take.sample_sd is not None:
        residuals = np.clip(np.rint(take.sample_sd / RESIDUAL_COUNT_M), 1, MAX_RESIDUAL_COUNTS)
        residual_words = np.where(np.isnan(residuals), residual_words, residuals)
    words[:, : len(take.labels), 3] = residual_words
    words[np.isnan(xyz).any(-1)] = (0, 0, 0, MISSING_RESIDUAL)
    return words


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
