"""Reading takes: the one place where files become metres, Y up. What a file is is told by what it holds, not by its name."""

import codecs
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from mocapfix.errors import ReadError
from mocapfix.read import amc, bvh, c3d, motive, motive_rows, nexus, plain, qualisys, trc
from mocapfix.read.axes import turned
from mocapfix.read.opened import file_bytes
from mocapfix.read.text import BOM, decoded
from mocapfix.take import Take

HEAD = 1 << 16  # bytes, by which a kind is told


class Kind(NamedTuple):
    """A kind of file: what people call it, whether a file that begins with `head` is one, and the take in its bytes.

    head is the file's first 64 KiB; of text in UTF-8, without a byte-order mark, whatever its own encoding.
    """

    name: str
    recognises: Callable[[bytes], bool]
    take: Callable[[Path, bytes], Take]


# The first that recognises a file reads it.
KINDS = (
    Kind("C3D", c3d.recognises, c3d.take),
    Kind("TRC", trc.recognises, trc.take),
    Kind("Motive CSV", motive.recognises, motive.take),
    Kind("Motive CSV 1.1", motive_rows.recognises, motive_rows.take),
    Kind("Nexus CSV", nexus.recognises, nexus.take),
    Kind("Qualisys TSV", qualisys.recognises, qualisys.take),
    Kind("plain CSV", plain.recognises, plain.take),
    Kind("BVH", bvh.recognises, bvh.take),
    Kind("ASF/AMC", amc.recognises, amc.take),
)


def take(path: str | Path, up: str | None = None) -> Take:
    """-> the take in a file of any of the kinds; of an animation that of its joints' places, with the animation as its layout.

    up  "X", "Y" or "Z": the file's axis that points to the sky; None: as the file says, or else as its markers tell

    Raises ReadError, naming the file and what to do, where it cannot be opened, is of no kind, or has a fault.
    """
    path = Path(path)
    data = file_bytes(path)
    head = beginning(data)
    for kind in KINDS:
        if kind.recognises(head):
            found = kind.take(path, data)
            return turned(found, up) if up else found
    names = ", ".join(kind.name for kind in KINDS)
    raise ReadError(f"{path}: is not a file that mocapfix reads; export the capture as one of: {names}.")


def beginning(data: bytes) -> bytes:
    """-> the head that kinds are told by."""
    text, encoding = decoded(data[:HEAD])
    if encoding == "latin-1":  # or UTF-8 that the head's end cuts within a letter
        return data[:HEAD].removeprefix(codecs.BOM_UTF8)
    return text.removeprefix(BOM).encode("utf-8", "replace")


__all__ = ["KINDS", "Kind", "take"]
