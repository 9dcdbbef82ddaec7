"""A composed take as a C3D file, as a motion capture system would have exported it: millimetres, Z up, floats.

Written here byte by byte (c3d.org, "The C3D file format", sections 2 to 4), for it is nearly the smallest file there
can be: a header, the group POINT, the samples.
"""

import struct
from pathlib import Path

import numpy as np

from mocapfix.files import replacing
from mocapfix.synthetic.truth import Truth

BLOCK = 512  # bytes
INTEL = 84  # the processor whose byte order and floats the file has
SCALE = 0.1  # millimetres in a count of the residual
MEASURED, MISSING = 5, -1  # the residual word: half a millimetre; not seen


def write(path: Path, truth: Truth) -> None:
    """Write the damaged take, at most 65,535 frames, numbered from 1.

    Raises WriteError where the folder cannot be written.
    """
    frames, markers = truth.struck.shape
    start = 2 + len(_parameters(truth, 0)) // BLOCK
    header = struct.pack("<BBHHHHHfHHf", 2, 80, markers, 0, 1, frames, 0, -SCALE, start, 0, truth.rate)
    with replacing(Path(path)) as part:
        part.write_bytes(_filled(header) + _parameters(truth, start) + _filled(_words(truth).tobytes()))


def _parameters(truth: Truth, start: int) -> bytes:
    """-> whole blocks: the group POINT, with the number of the `start` block of the samples."""
    frames, markers = truth.struck.shape
    width = max(map(len, truth.labels))
    labels = "".join(label.ljust(width) for label in truth.labels)
    body = struct.pack("<bb5shB", 5, -1, b"POINT", 3, 0) + b"".join(
        [
            _number("USED", "H", markers),
            _number("FRAMES", "H", frames),
            _number("DATA_START", "H", start),
            _number("SCALE", "f", -SCALE),
            _number("RATE", "f", truth.rate),
            _text("UNITS", "mm", 2),
            _text("X_SCREEN", "+X", 2),
            _text("Y_SCREEN", "+Z", 2),
            _text("LABELS", labels, width, markers),
            _text("DESCRIPTIONS", " " * markers, 1, markers),
        ]
    )
    blocks = len(_filled(bytes(4) + body)) // BLOCK
    return _filled(struct.pack("BBBB", 1, 80, blocks, INTEL) + body)


def _filled(data: bytes) -> bytes:
    """-> with zeros up to the end of its last block."""
    return data + bytes(-len(data) % BLOCK)


def _number(name: str, form: str, value: float) -> bytes:
    """-> the record of an integer ("H") or a float ("f")."""
    return _record(name, struct.pack("<bB" + form, 4 if form == "f" else 2, 0, value))


def _text(name: str, text: str, *dimensions: int) -> bytes:
    return _record(name, struct.pack("<bB", -1, len(dimensions)) + bytes(dimensions) + text.encode("ascii"))


def _record(name: str, content: bytes) -> bytes:
    """-> a parameter of group 1 without a description; the length counts itself and the description's."""
    return struct.pack("<bb", len(name), 1) + name.encode("ascii") + struct.pack("<h", len(content) + 3) + content + b"\0"


def _words(truth: Truth) -> np.ndarray:
    """-> (T, M, 4) x, y, z in millimetres, Z up, and the residual word; zeros where nothing was seen."""
    words = np.zeros((*truth.struck.shape, 4), "<f4")
    words[..., :3] = np.where(truth.struck[..., None], 0, truth.damaged[..., [2, 0, 1]] * 1000)
    words[..., 3] = np.where(truth.struck, MISSING, MEASURED)
    return words
