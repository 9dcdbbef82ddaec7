"""Damage to files that knows their formats: numbers, counts, lengths, units, encodings, sections, and bytes at random.

A mutation is a function of the bytes of a file and a source of random numbers, and returns other bytes.
"""

import re
import struct
from collections.abc import Callable

import numpy as np

Mutation = Callable[[bytes, np.random.Generator], bytes]

STRANGE_NUMBERS = (
    "0", "-1", "1", "-0.0", "nan", "NaN", "-inf", "1e308", "1e400", "-1e-320", "1,5", "0x10", "1_000", "1" * 40, "9" * 5000, "",
    "-", ".", "+", "1e", "--5", "1.2.3", "65536", "4294967296", "-2147483649", "1.#QNAN", "\u0663", "\u00b2", "true", "1e9",
)  # fmt: skip
STRANGE_WORDS = (
    "", " ", '"', "'", "{", "}", "[", "]", ":", ",", "#", "!!python/object:os.system x", "&a *a", "*a", "<<: *a", "~", "|", ">",
    "2024-13-45", "0o9", ".nan", "12:61:61", "!!binary x", "!!timestamp x", "!!int x", "? - x", "mm", "furlong", "Frames:", "%",
    "JOINT", "End Site", "CHANNELS 3", ":root", "begin", "end", "\x00", "\ufeff", "\u2028", "\u00e9", "A" * 300, "MOTION",
)  # fmt: skip
STRANGE_UINT16 = (0, 1, 2, 127, 128, 255, 256, 32767, 32768, 65534, 65535)
STRANGE_FLOATS = (0.0, -0.0, 1.0, -1.0, 1e-45, 1e38, -1e38, 0.1, 1e6, float("nan"), float("inf"), float("-inf"))
STRANGE_BYTES = (0, 1, 2, 4, 80, 84, 85, 86, 127, 128, 129, 253, 254, 255)
TEXT_TOKEN_PATTERN = re.compile(rb"[^\s,;:{}\[\]\"']+")
NUMBER_PATTERN = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
HEAD_LINE_COUNT = 12
MAX_DEPTH = 20_000
"""of brackets in brackets"""
MAX_REPEATS = 20_000
"""of a line or a token"""
C3D_BLOCK = 512
C3D_HEADER_FLOATS = (12, 20)
"""byte offsets of the scale and of the rate"""


def replace_span(data: bytes, start: int, end: int, new: bytes) -> bytes:
    """Return the bytes with those from `start` to `end` replaced."""
    return data[:start] + new + data[end:]


def change_bytes(data: bytes, rng: np.random.Generator) -> bytes:
    """Change a few bytes anywhere, or near the beginning."""
    changed = bytearray(data)
    reach = len(data) if rng.random() < 0.5 else min(len(data), 2 * C3D_BLOCK)
    for position in rng.integers(0, max(reach, 1), int(rng.integers(1, 9))):
        if position < len(changed):
            changed[position] = int(rng.choice(STRANGE_BYTES)) if rng.random() < 0.5 else int(rng.integers(256))
    return bytes(changed)


def truncate(data: bytes, rng: np.random.Generator) -> bytes:
    """Cut the file anywhere, or at a block."""
    stop = int(rng.integers(0, len(data) + 1))
    return data[: stop // C3D_BLOCK * C3D_BLOCK] if rng.random() < 0.3 else data[:stop]


def repeat_section(data: bytes, rng: np.random.Generator) -> bytes:
    """Insert a copy of some section elsewhere."""
    start, end = np.sort(rng.integers(0, len(data) + 1, 2))
    at = int(rng.integers(0, len(data) + 1))
    return data[:at] + data[start:end] + data[at:]


def remove_section(data: bytes, rng: np.random.Generator) -> bytes:
    """Remove some section."""
    start = int(rng.integers(0, len(data) + 1))
    return data[:start] + data[start + int(rng.integers(1, C3D_BLOCK)) :]


def append_bytes(data: bytes, rng: np.random.Generator) -> bytes:
    """Append zeros, noise or the file itself."""
    tails = (bytes(int(rng.integers(1, 2000))), rng.bytes(int(rng.integers(1, 2000))), data)
    return data + tails[rng.integers(len(tails))]


def change_c3d_header(data: bytes, rng: np.random.Generator) -> bytes:
    """Set a word or a float of a C3D header to a value at the limits."""
    changed = bytearray(data.ljust(C3D_BLOCK, b"\0"))
    if rng.random() < 0.3:
        struct.pack_into("<f", changed, int(rng.choice(C3D_HEADER_FLOATS)), float(rng.choice(STRANGE_FLOATS)))
    elif rng.random() < 0.2:
        changed[int(rng.integers(2))] = int(rng.choice(STRANGE_BYTES))
    else:
        struct.pack_into("<H", changed, 2 * int(rng.integers(1, 13)), int(rng.choice(STRANGE_UINT16)))
    return bytes(changed)


def list_c3d_records(data: bytes) -> list[tuple[int, int]]:
    """Return first and last + 1 byte of the groups and parameters of a C3D, as far as their lengths lead."""
    records: list[tuple[int, int]] = []
    start = C3D_BLOCK * (data[0] - 1) + 4 if data and data[0] else C3D_BLOCK + 4
    while start + 4 < len(data) and data[start]:
        name_length = struct.unpack_from("b", data, start)[0]
        offset_at = start + 2 + abs(name_length)
        if offset_at + 2 > len(data):
            break
        end = offset_at + struct.unpack_from("<H", data, offset_at)[0]
        if end <= start:
            break
        records.append((start, min(end, len(data))))
        start = end
    return records


def change_c3d_record(data: bytes, rng: np.random.Generator) -> bytes:
    """Change a group or a parameter: its name's length, its group, its length, its type, its dimensions or its values."""
    records = list_c3d_records(data)
    if not records:
        return change_c3d_header(data, rng)
    start, end = records[rng.integers(len(records))]
    name_end = start + 2 + abs(struct.unpack_from("b", data, start)[0])
    changed = bytearray(data)
    match int(rng.integers(7)):
        case 0:
            return data[:end] + data[start:end] + data[end:]
        case 1:
            return data[:start] + data[end:] + bytes(end - start)
        case 2 | 3:  # type, number of dimensions, dimensions
            at = name_end + 2 + int(rng.integers(0, 4))
            changed[min(at, len(changed) - 1)] = int(rng.choice(STRANGE_BYTES))
        case 4:
            changed[start + int(rng.integers(2))] = int(rng.choice(STRANGE_BYTES))
        case 5:
            struct.pack_into("<H", changed, min(name_end, len(changed) - 2), int(rng.choice(STRANGE_UINT16)))
        case _:
            at = int(rng.integers(start, end))
            changed[at : at + 4] = struct.pack("<f", float(rng.choice(STRANGE_FLOATS)))[: len(changed) - at]
    return bytes(changed)


def change_c3d_samples(data: bytes, rng: np.random.Generator) -> bytes:
    """Overwrite some aligned words behind the parameters with floats at the limits."""
    changed = bytearray(data)
    for _ in range(int(rng.integers(1, 20))):
        at = 4 * int(rng.integers(0, max(len(changed) // 4 - 1, 1)))
        changed[at : at + 4] = struct.pack("<f", float(rng.choice(STRANGE_FLOATS)))
    return bytes(changed)


def change_processor(data: bytes, rng: np.random.Generator) -> bytes:
    """Declare another kind of processor, or integers for floats."""
    at = C3D_BLOCK * (data[0] - 1) + 3 if data and data[0] else 0
    changed = bytearray(data)
    if at < len(changed):
        changed[at] = int(rng.choice((83, 84, 85, 86, 87, 0)))
    return bytes(changed)


def change_number(data: bytes, rng: np.random.Generator) -> bytes:
    """Replace a number of a text, most often one near its beginning."""
    return _replace_match(data, NUMBER_PATTERN, STRANGE_NUMBERS, rng)


def change_word(data: bytes, rng: np.random.Generator) -> bytes:
    """Replace a word of a text, most often one near its beginning."""
    return _replace_match(data, TEXT_TOKEN_PATTERN, STRANGE_WORDS + STRANGE_NUMBERS, rng)


def exchange_words(data: bytes, rng: np.random.Generator) -> bytes:
    """Write one word of the text in place of another."""
    tokens = list(TEXT_TOKEN_PATTERN.finditer(data[: 1 << 14]))
    if not tokens:
        return data
    one, other = (tokens[int(rng.integers(len(tokens)))] for _ in range(2))
    return replace_span(data, *one.span(), other[0])


def _replace_match(data: bytes, pattern: re.Pattern[bytes], words: tuple[str, ...], rng: np.random.Generator) -> bytes:
    head = data[:400] if rng.random() < 0.5 else data[: 1 << 14]
    found = list(pattern.finditer(head))
    if not found:
        return data
    return replace_span(data, *found[int(rng.integers(len(found)))].span(), words[int(rng.integers(len(words)))].encode())


def change_lines(data: bytes, rng: np.random.Generator) -> bytes:
    """Remove, repeat, exchange or empty lines."""
    lines = data.split(b"\n")
    reach = min(len(lines), HEAD_LINE_COUNT) if rng.random() < 0.5 else len(lines)
    one, other = (int(rng.integers(reach)) for _ in range(2))
    match int(rng.integers(5)):
        case 0:
            del lines[one : one + int(rng.integers(1, 4))]
        case 1:
            lines.insert(other, lines[one])
        case 2:
            lines[one], lines[other] = lines[other], lines[one]
        case 3:
            lines[one] = b""
        case _:
            lines[one:one] = [lines[other]] * int(rng.choice([2, 100, MAX_REPEATS // max(len(lines[other]), 1) + 1]))
    return b"\n".join(lines)


def change_cells(data: bytes, rng: np.random.Generator) -> bytes:
    """Remove, repeat or add cells of a line."""
    lines = data.split(b"\n")
    index = int(rng.integers(len(lines)))
    delimiter = next((each for each in (b"\t", b",", b";", b" ") if each in lines[index]), b",")
    cells = lines[index].split(delimiter)
    at = int(rng.integers(len(cells)))
    match int(rng.integers(3)):
        case 0:
            del cells[at:]
        case 1:
            cells[at:at] = [cells[at]] * int(rng.choice([1, 2, 1000]))
        case _:
            cells[at] = b'"' + cells[at]
    lines[index] = delimiter.join(cells)
    return b"\n".join(lines)


def change_encoding(data: bytes, rng: np.random.Generator) -> bytes:
    """Write the text in another encoding, with other line ends or other delimiters."""
    text = data.decode("latin-1")
    match int(rng.integers(8)):
        case 0:
            return b"\xff\xfe" + text.encode("utf-16-le")
        case 1:
            return b"\xfe\xff" + text.encode("utf-16-be")[: int(rng.integers(1, 2 * len(text) + 2))]
        case 2:
            return b"\xef\xbb\xbf" + data
        case 3:
            return data.replace(b"\r\n", b"\n").replace(b"\n", b"\r")
        case 4:
            return data.replace(b"\n", b"\r\n" if rng.random() < 0.5 else b"\n\n")
        case 5:
            return data.replace(b",", rng.choice([b";", b"\t", b" "]).item())
        case 6:
            return data.replace(b".", b",")
        case _:
            return data.replace(b" ", bytes(1)) if rng.random() < 0.3 else data.replace(b"\t", b" ")


def nest_deeply(data: bytes, rng: np.random.Generator) -> bytes:
    """Insert brackets, blocks or joints that contain each other many times."""
    depth = int(rng.choice([10, 1000, MAX_DEPTH]))
    opening, closing = (
        (b"[", b"]"), (b"{", b"}"), (b"JOINT x\n{\nOFFSET 0 0 0\nCHANNELS 0\n", b"}\n"), (b'{"a":', b"}"), (b"begin\n", b"end\n"),
    )[rng.integers(5)]  # fmt: skip
    found = list(TEXT_TOKEN_PATTERN.finditer(data[: 1 << 14]))
    at = found[int(rng.integers(len(found)))].start() if found else 0
    return data[:at] + opening * depth + (closing * depth if rng.random() < 0.5 else b"") + data[at:]


def add_aliases(data: bytes, rng: np.random.Generator) -> bytes:
    """Insert YAML aliases that refer to each other, nine times ninefold."""
    levels = int(rng.integers(3, 10))
    text = "a0: &a0 [x, x, x, x, x, x, x, x, x]\n"
    text += "".join(f"a{level}: &a{level} [{', '.join([f'*a{level - 1}'] * 9)}]\n" for level in range(1, levels))
    found = list(re.finditer(rb"(?m)^[a-z_]+:(.*)$", data))
    if not found:
        return text.encode() + data
    chosen = found[int(rng.integers(len(found)))]
    return text.encode() + replace_span(data, *chosen.span(1), f" *a{levels - 1}".encode())


ANY_MUTATIONS: tuple[Mutation, ...] = (change_bytes, truncate, repeat_section, remove_section, append_bytes)
C3D_MUTATIONS: tuple[Mutation, ...] = (
    *ANY_MUTATIONS, *(change_c3d_header, change_c3d_record) * 4, change_c3d_samples, change_processor,
)  # fmt: skip
TEXT_MUTATIONS: tuple[Mutation, ...] = (
    *ANY_MUTATIONS, *(change_number, change_word) * 4, exchange_words, change_lines, change_lines, change_cells, change_encoding,
    nest_deeply,
)  # fmt: skip
YAML_MUTATIONS: tuple[Mutation, ...] = (*TEXT_MUTATIONS, add_aliases)


def choose_mutations(name: str) -> tuple[Mutation, ...]:
    """Return the mutations for a file, by its suffix."""
    if name.endswith(".c3d"):
        return C3D_MUTATIONS
    if name.endswith(".safetensors"):
        return ANY_MUTATIONS
    return YAML_MUTATIONS if name.endswith(".yaml") else TEXT_MUTATIONS
