"""Read captures as metres with Y up (see `mocapfix.io.conventions`).

The format is detected from the content of a file, not from its extension.
"""

import codecs
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from mocapfix.errors import ReadError, TakeError
from mocapfix.io import asf_amc, bvh, c3d, keypoint_json, text_tables
from mocapfix.io.file_content import BYTE_ORDER_MARK, LEADING_COMMENTS_PATTERN, decode_text, read_file_bytes
from mocapfix.model.animation import Animation
from mocapfix.model.take import Take
from mocapfix.model.windows import MAX_PIECE_FRAMES, store_take
from mocapfix.options import DEFAULT_READ_OPTIONS, ReadOptions

HEAD_BYTES = 1 << 16  # beginning of a file from which its format is detected


class FileFormat(NamedTuple):
    """A file format.

    Attributes:
        matches: Whether a file with the given beginning has the format. The beginning is the first 64 KiB of the file. That of
            a text is in UTF-8, without a byte-order mark, whatever the encoding of the file.
        read: Reads a capture from a path (for messages), the bytes of the file, and what is known about it.
    """

    name: str  # its name in messages
    matches: Callable[[bytes], bool]
    read: Callable[[Path, bytes, ReadOptions], Take | Animation]


# A file is read as the first format that matches.
FILE_FORMATS = (
    FileFormat("C3D", c3d.is_c3d, c3d.read_c3d),
    FileFormat("TRC", text_tables.is_trc, text_tables.read_trc),
    FileFormat("Motive CSV", text_tables.is_motive_csv, text_tables.read_motive_csv),
    FileFormat("Motive CSV 1.1", text_tables.is_motive_rows_csv, text_tables.read_motive_rows_csv),
    FileFormat("Nexus CSV", text_tables.is_nexus_csv, text_tables.read_nexus_csv),
    FileFormat("Qualisys TSV", text_tables.is_qualisys_tsv, text_tables.read_qualisys_tsv),
    FileFormat("plain CSV", text_tables.is_plain_csv, text_tables.read_plain_csv),
    FileFormat("JSON of 3-D keypoints", keypoint_json.is_keypoint_json, keypoint_json.read_keypoint_json),
    FileFormat("BVH", bvh.is_bvh, bvh.read_bvh),
    FileFormat("ASF/AMC", asf_amc.is_asf_or_amc, asf_amc.read_amc_motion),
)


def read_capture(path: str | Path, options: ReadOptions = DEFAULT_READ_OPTIONS, *, has_windows: bool = False) -> Take | Animation:
    """Read a file of any supported format.

    Args:
        options: What is known about the file; what is not is taken from the file, its markers or its joints.
        has_windows: Store a take that is too long to be cleaned in one piece, as `store_take` does.

    Returns:
        A take for marker formats, an animation for BVH and AMC.

    Raises:
        ReadError: If the file cannot be opened, has no supported format or is invalid. The message names the file and the
            remedy.
    """
    capture = read_capture_bytes(Path(path), read_file_bytes(Path(path)), options)
    is_stored = has_windows and isinstance(capture, Take) and capture.frame_count > MAX_PIECE_FRAMES
    return store_take(capture) if is_stored and isinstance(capture, Take) else capture


def read_capture_bytes(path: Path, data: bytes, options: ReadOptions = DEFAULT_READ_OPTIONS) -> Take | Animation:
    """Read the bytes of a file as `read_capture`; the path is only the one that it reports."""
    head = extract_head(data)
    for file_format in FILE_FORMATS:
        if file_format.matches(head):
            return file_format.read(path, data, options)
    names = ", ".join(file_format.name for file_format in FILE_FORMATS)
    raise ReadError(f"{path}: has no format that mocapfix reads; export the capture as one of: {names}.")


def read_take(path: str | Path, options: ReadOptions = DEFAULT_READ_OPTIONS) -> Take:
    """Read a file of markers, as `read_capture` does.

    Raises:
        ReadError: As `read_capture` does.
        TakeError: If the file is an animation.
    """
    capture = read_capture(path, options)
    if isinstance(capture, Animation):
        raise TakeError(f"{capture.name}: has joints and no markers to learn from; give the capture that it was solved from.")
    return capture


def extract_head(data: bytes) -> bytes:
    """Return the beginning of a file from which its format is detected, that of a text without comments before it."""
    text, encoding = decode_text(data[:HEAD_BYTES])
    if encoding == "latin-1":  # or UTF-8 that is cut within a character at the end of the head
        head = data[:HEAD_BYTES].removeprefix(codecs.BOM_UTF8)
    else:
        head = text.removeprefix(BYTE_ORDER_MARK).encode("utf-8", "replace")
    comments = None if b"\0" in head else LEADING_COMMENTS_PATTERN.match(head)
    return head[comments.end() :] if comments else head
