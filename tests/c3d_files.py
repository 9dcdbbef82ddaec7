"""C3D files in all six encodings, built byte by byte, for tests of readers and patches."""

import math
import struct
from collections.abc import Mapping, Sequence

import numpy as np

from mocapfix.model.take import C3dLayout, Take

ENCODINGS = [(processor, is_float) for processor in (84, 85, 86) for is_float in (False, True)]
Value = str | int | float | list[str] | list[int]


def c3d_bytes(
    xyz: np.ndarray,
    labels: Sequence[str],
    words: np.ndarray | None = None,
    encoding: tuple[int, bool] = (84, True),
    scale: float = 0.1,
    first: int = 1,
    extra: Mapping[str, Value | None] | None = None,
    analog: tuple[int, int] = (3, 1),
) -> bytes:
    """Return a C3D of coordinates `xyz` (T, P, 3) in file units, stored as counts of `scale` in an integer file.

    `words` are the residual words (T, P), by default 0. `extra` adds parameters or replaces them, by "GROUP:NAME"; None removes
    one. Every frame ends with `analog` channels and samples of noise, the data with half a block of noise, and the header has an
    event: bytes that a copy must keep.
    """
    processor, is_float = encoding
    order = ">" if processor == 86 else "<"
    frames, points = xyz.shape[:2]
    given: dict[str, Value | None] = {
        "POINT:USED": points,
        "POINT:SCALE": float(-scale if is_float else scale),
        "POINT:RATE": 120.0,
        "POINT:FRAMES": frames & 0xFFFF,
        "POINT:UNITS": "mm",
        "POINT:LABELS": list(labels[:255]),
    }
    for more in range(255, len(labels), 255):
        given[f"POINT:LABELS{1 + more // 255}"] = list(labels[more : more + 255])
    section = _parameter_section({**given, **(extra or {})}, processor, order)
    header = _header(points, first, frames, -scale if is_float else scale, 2 + len(section) // 512, processor, order)
    header = replace_word(header + section, 3, analog[0] * analog[1])
    header = replace_word(header, 10, analog[1])
    return header + _data(xyz, words, encoding, scale, order, analog[0] * analog[1])


def replace_word(data: bytes, number: int, value: int) -> bytes:
    """Return a C3D with another value of a word of its header, counted from 1."""
    order = ">" if data[512 + 3] == 86 else "<"
    return data[: 2 * number - 2] + struct.pack(order + "H", value) + data[2 * number :]


def get_layout(take: Take) -> C3dLayout:
    """Return where the parts of the C3D file of a take are."""
    assert isinstance(take.layout, C3dLayout)
    return take.layout


def vax(value: float) -> bytes:
    """Return a DEC F float: sign, exponent + 128, fraction in 0.5..1 without its leading bit, the high 16-bit word first."""
    if value == 0:
        return bytes(4)
    fraction, exponent = math.frexp(abs(value))
    bits = (value < 0) << 31 | (exponent + 128) << 23 | round(fraction * 2**24) & 0x7FFFFF
    return struct.pack("<HH", bits >> 16, bits & 0xFFFF)


def _float(value: float, processor: int) -> bytes:
    return vax(np.float32(value).item()) if processor == 85 else struct.pack(">f" if processor == 86 else "<f", value)


def _data(xyz: np.ndarray, words: np.ndarray | None, encoding: tuple[int, bool], scale: float, order: str, analog: int) -> bytes:
    processor, is_float = encoding
    stored = np.concatenate([xyz if is_float else np.rint(xyz / scale), np.zeros((*xyz.shape[:2], 1))], axis=-1)
    if words is not None:
        stored[..., 3] = words
    rows = stored.reshape(len(xyz), 4 * xyz.shape[1])
    if is_float and processor == 85:
        vaxes = b"".join(map(vax, rows.astype(np.float32).ravel().tolist()))
        frames = np.frombuffer(vaxes, "u1").reshape(len(rows), 4 * rows.shape[1])
    else:
        frames = np.ascontiguousarray(rows.astype(order + ("f4" if is_float else "i2"))).view("u1")
    noise = np.random.default_rng(0)
    analog_bytes = noise.integers(0, 256, (len(rows), analog * (4 if is_float else 2)), np.uint8)
    return np.hstack([frames, analog_bytes]).tobytes() + noise.bytes(256)


def _header(points: int, first: int, frames: int, scale: float, block: int, processor: int, order: str) -> bytes:
    last = min(first + frames - 1, 65535)
    start = struct.pack(order + "HHHHH", points, 3, first & 0xFFFF, last, 10) + _float(scale, processor)
    start += struct.pack(order + "HH", block, 1) + _float(120.0, processor)
    events = struct.pack(order + "HHH", 12345, 1, 0) + _float(0.5, processor).ljust(72, b"\0")
    events += bytes([1]).ljust(18, b"\0") + bytes(2) + b"RHS ".ljust(72)
    return (bytes([2, 0x50]) + start).ljust(298, b"\0") + events.ljust(214, b"\0")


def _parameter_section(values: Mapping[str, Value | None], processor: int, order: str) -> bytes:
    groups = {name: i for i, name in enumerate(dict.fromkeys(key.split(":")[0] for key in values), start=1)}
    chain = b"".join(struct.pack("bb", len(g), -i) + g.encode() + struct.pack(order + "hB", 3, 0) for g, i in groups.items())
    for key, value in values.items():
        if value is not None:
            group, name = key.split(":")
            kind, shape, payload = _stored(value, processor, order)
            body = struct.pack("bB", kind, len(shape)) + bytes(shape) + payload + b"\0"
            chain += struct.pack("bb", len(name), groups[group]) + name.encode() + struct.pack(order + "h", 2 + len(body)) + body
    blocks = -(-(4 + len(chain) + 2) // 512)
    return (bytes([1, 0x50, blocks, processor]) + chain).ljust(512 * blocks, b"\0")


def _stored(value: Value, processor: int, order: str) -> tuple[int, list[int], bytes]:
    """Return type, dimensions and bytes of a parameter; whole numbers are 16-bit words."""
    if isinstance(value, str):
        return -1, [len(value)], value.encode()
    if isinstance(value, float):
        return 4, [], _float(value, processor)
    if isinstance(value, int):
        return 2, [], struct.pack(order + "H", value)
    texts = [text for text in value if isinstance(text, str)]
    if texts:
        width = max(map(len, texts))
        return -1, [width, len(texts)], "".join(text.ljust(width) for text in texts).encode()
    return 2, [len(value)], struct.pack(f"{order}{len(value)}H", *value)
