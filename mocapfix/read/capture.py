"""Reading takes: the one place where files become metres, Y up. What a file is is told by what it holds, not by its name."""

import codecs
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from mocapfix.errors import ReadError
from mocapfix.read import amc, bvh, c3d, motive, nexus, plain_csv, qualisys, trc
from mocapfix.read import motive as motive_rows
from mocapfix.read.coordinates import rotate_to_up_axis
from mocapfix.read.file_content import BYTE_ORDER_MARK, decode_text, read_file_bytes
from mocapfix.take import Take

HEAD_BYTES = 1 << 16  # bytes, by which a kind is told


class FileFormat(NamedTuple):
    """A kind of file: what people call it, whether a file that begins with `head` is one, and the take in its bytes.

    head is the file's first 64 KiB; of text in UTF-8, without a byte-order mark, whatever its own encoding.
    """

    name: str
    matches: Callable[[bytes], bool]
    read: Callable[[Path, bytes], Take]


# The first that recognises a file reads it.
FILE_FORMATS = (
    FileFormat("C3D", c3d.is_c3d, c3d.read_c3d),
    FileFormat("TRC", trc.is_trc, trc.read_trc),
    FileFormat("Motive CSV", motive.is_motive_csv, motive.read_motive_csv),
    FileFormat("Motive CSV 1.1", motive_rows.is_motive_rows_csv, motive_rows.read_motive_rows_csv),
    FileFormat("Nexus CSV", nexus.is_nexus_csv, nexus.read_nexus_csv),
    FileFormat("Qualisys TSV", qualisys.is_qualisys_tsv, qualisys.read_qualisys_tsv),
    FileFormat("plain CSV", plain_csv.is_plain_csv, plain_csv.read_plain_csv),
    FileFormat("BVH", bvh.is_bvh, bvh.read_bvh_take),
    FileFormat("ASF/AMC", amc.is_asf_or_amc, amc.read_amc_take),
)


def read_capture(path: str | Path, up_axis: str | None = None) -> Take:
    """-> the take in a file of any of the kinds; of an animation that of its joints' places, with the animation as its layout.

    up  "X", "Y" or "Z": the file's axis that points to the sky; None: as the file says, or else as its markers tell

    Raises ReadError, naming the file and what to do, where it cannot be opened, is of no kind, or has a fault.
    """
    path = Path(path)
    data = read_file_bytes(path)
    head = extract_head(data)
    for kind in FILE_FORMATS:
        if kind.matches(head):
            found = kind.read(path, data)
            return rotate_to_up_axis(found, up_axis) if up_axis else found
    names = ", ".join(kind.name for kind in FILE_FORMATS)
    raise ReadError(f"{path}: is not a file that mocapfix reads; export the capture as one of: {names}.")


def extract_head(data: bytes) -> bytes:
    """-> the head that kinds are told by."""
    text, encoding = decode_text(data[:HEAD_BYTES])
    if encoding == "latin-1":  # or UTF-8 that the head's end cuts within a letter
        return data[:HEAD_BYTES].removeprefix(codecs.BOM_UTF8)
    return text.removeprefix(BYTE_ORDER_MARK).encode("utf-8", "replace")
