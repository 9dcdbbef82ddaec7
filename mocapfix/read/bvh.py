"""Reading a BVH: any hierarchy, each joint's channels in an order of its own.

Source: Meredith and Maddock 2001, "Motion capture file formats explained"; where programs differ, what most of them write is
taken: positions of the root stand in the place of its offset.
"""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from mocapfix.animation import Animation
from mocapfix.animations.joint_points import build_joint_take
from mocapfix.errors import ReadError
from mocapfix.read.animation_inference import infer_rate, infer_unit, infer_up_axis
from mocapfix.read.bvh_hierarchy import parse_hierarchy
from mocapfix.read.file_content import read_file_bytes
from mocapfix.read.token_scanner import TextTokens, scan_tokens
from mocapfix.take import Take

MOTION_PATTERN = re.compile(rb"(?:^|(?<=[\r\n]))[ \t]*MOTION[ \t]*(?=[\r\n]|$)", re.IGNORECASE)
FRAME_COUNT_PATTERN = re.compile(rb"\s*Frames?\s*:?\s*(\S+)", re.IGNORECASE)
FRAME_TIME_PATTERN = re.compile(rb"\s*Frame\s*Time\s*:?[ \t]*(\S+)[^\r\n]*", re.IGNORECASE)


def is_bvh(head: bytes) -> bool:
    """-> does a file that begins so claim to be a BVH?"""
    return head.lstrip()[:9].upper() == b"HIERARCHY"


def read_bvh_take(path: Path, data: bytes) -> Take:
    """-> the take of the joints that move in a BVH's bytes. Raises ReadError as `animation`."""
    return build_joint_take(read_bvh(path, data))


def read_bvh(path: str | Path, data: bytes | None = None) -> Animation:
    """-> the animation in a BVH file: its own numbers, in degrees and its units, and where each is spelled.

    data  the file's bytes, where they were read already

    The unit is told from the figure's height and the way up from where its head is, for the file says neither; a frame time
    that was rounded is taken as the usual rate it was rounded from. `notes` says what was assumed.

    Raises ReadError, naming the file, the line and what is wrong there.
    """
    path = Path(path)
    data = read_file_bytes(path) if data is None else data
    found = MOTION_PATTERN.search(data)
    if not found:
        raise ReadError(f"{path}: has no line MOTION after its hierarchy; it is no BVH, or it was cut off. Export it again.")
    tree = parse_hierarchy(path, data[: found.start()])
    declared, rate, first, note = _parse_timing(path, data, found.end())
    width = sum(len(each) for each in tree.channels)
    numbers = scan_tokens(data, first)
    frames = _count_frames(path, numbers, width)
    notes = [note] if note else []
    if declared != frames:
        notes.append(f"It declares {declared} frames and holds {frames}, which were taken.")
    read = Animation(
        names=tree.names,
        parents=tree.parents,
        offsets=tree.offsets,
        end_sites=tree.end_sites,
        channels=tree.channels,
        values=numbers.values.reshape(frames, width),
        rate=rate,
        path=path,
        value_byte_offsets=numbers.start_bytes.reshape(frames, width),
    )
    read = replace(read, is_position_added=_detect_displacements(read), notes=tuple(notes))
    return infer_unit(infer_up_axis(read))


def _parse_timing(path: Path, data: bytes, at: int) -> tuple[int, float, int, str]:
    """-> the frames declared, the rate in Hz, the byte after the two lines that say them, and a note on the rate or ""."""
    line = 1 + len(data[:at].splitlines())
    frames = FRAME_COUNT_PATTERN.match(data, at)
    time = FRAME_TIME_PATTERN.match(data, frames.end()) if frames else None
    if not frames or not time:
        raise ReadError(f"{path}, line {line}: after MOTION come Frames: and Frame Time: with a number each; they are not there.")
    try:
        declared, seconds = int(frames[1]), float(time[1])
    except ValueError as error:
        raise ReadError(
            f"{path}, line {line}: {_decode_word(frames[1])} frames of {_decode_word(time[1])} s are no numbers."
        ) from error
    if not (np.isfinite(seconds) and seconds > 0):
        raise ReadError(
            f"{path}, line {line + 1}: a frame time of {_decode_word(time[1])} s gives no rate; give the seconds a frame."
        )
    rate, note = infer_rate(_decode_word(time[1]))
    return declared, rate, time.end(), note


def _decode_word(word: bytes) -> str:
    return word.decode("utf-8", "replace")


def _count_frames(path: Path, numbers: TextTokens, width: int) -> int:
    """-> how many frames of `width` numbers there are; one may take several lines, but each begins on a line of its own.

    Raises ReadError at the first word that is no number, and at the first line with too few numbers or too many.
    """
    if not numbers.is_number.all():
        bad = int(np.argmin(numbers.is_number))
        raise ReadError(f"{path}, line {numbers.line_numbers[bad]}: {numbers.get_text(bad)[:40]!r} is no number.")
    if width == 0 or not len(numbers):
        raise ReadError(f"{path}: holds no motion: {width} channels and {len(numbers)} numbers after the frame time.")
    heads = np.flatnonzero(np.diff(numbers.line_numbers, prepend=-1))  # of the lines, among the numbers
    frames, over = divmod(len(numbers), width)
    if not over and np.isin(np.arange(frames) * width, heads).all():
        return frames
    counts = np.diff(heads, append=len(numbers))
    wrapped = np.bincount(counts).argmax() < width and counts.max() < width
    bad = _find_first_torn_line(heads, width) if wrapped else int(np.argmax(counts != width))
    line = numbers.line_numbers[heads[bad]]
    raise ReadError(f"{path}, line {line}: holds {counts[bad]} numbers where the channels are {width}; the file is torn there.")


def _find_first_torn_line(heads: np.ndarray, width: int) -> int:
    """-> the line, among those with numbers, in which a frame of several lines ends too late or not at all."""
    missed = np.setdiff1d(np.arange(0, heads[-1] + width, width), heads)
    return int(np.searchsorted(heads, missed[0]) - 1) if len(missed) else len(heads) - 1


def _detect_displacements(read: Animation) -> np.ndarray:
    """-> (J,) bool: the joints below the root whose positions are displacements, since most of them lie nearer to none than
    to the offset that they would stand in the place of."""
    added = np.zeros(len(read.names), bool)
    for joint in range(1, len(read.names)):
        columns, axes = read.get_position_channels(joint)
        told = read.values[:, columns]
        told = told[np.isfinite(told).all(1)]
        if told.size:
            middle = np.median(told, axis=0)
            added[joint] = np.linalg.norm(middle) < np.linalg.norm(middle - read.offsets[joint, axes])
    return added
