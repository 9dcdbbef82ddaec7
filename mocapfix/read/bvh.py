"""Read a BVH file: any hierarchy, with the channels of each joint in any order.

Source: Meredith and Maddock 2001, "Motion capture file formats explained". Where programs differ, the usage of most is
assumed: position channels of any joint replace its offset.
"""

import re
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from mocapfix.animation import Animation
from mocapfix.errors import ReadError
from mocapfix.files.read_options import DEFAULT_READ_OPTIONS, ReadOptions
from mocapfix.read.animation_inference import infer_conventions
from mocapfix.read.bvh_hierarchy import parse_hierarchy
from mocapfix.read.file_content import MAX_QUOTED_CHARACTERS, convert_to_utf_8, parse_number, read_file_bytes
from mocapfix.read.frame_rate import MAX_RATE_CONTRADICTION, MAX_RATE_ROUNDING, choose_rate, read_frame_time
from mocapfix.read.token_scanner import TextTokens, scan_tokens

MOTION_PATTERN = re.compile(rb"(?:^|(?<=[\r\n]))[ \t]*MOTION[ \t]*(?=[\r\n]|$)", re.IGNORECASE)
FRAME_COUNT_PATTERN = re.compile(rb"\s*Frames?\s*:?\s*(\S+)", re.IGNORECASE)
FRAME_TIME_PATTERN = re.compile(rb"\s*Frame\s*Time\s*:?[ \t]*(\S+)[^\r\n]*", re.IGNORECASE)
# Ratios of a joint's median position to its offset below which positions are displacements from the offset.
MAX_DISPLACEMENT_RATIO = 0.1
MAX_CONSTANT_DISPLACEMENT_RATIO = 0.005
MAX_BONE_CHANGE_RATIO = 0.01  # of the range of a joint's positions to their median, if they are constant
MIN_NOTED_STRETCH_M = 0.02  # change of a bone's length; constant positions, as most programs write them, change by 0


class _Timing(NamedTuple):
    """The two lines before the numbers of a BVH.

    Attributes:
        declared_frame_count: Number of frames as declared.
        rate: Frames per second.
        stop_byte: Byte after the two lines.
        notes: A sentence about the rate if it was rounded in the file.
        wrong_bytes: First byte and byte after the frame time if it is not that of the rate, even rounded.
    """

    declared_frame_count: int
    rate: float
    stop_byte: int
    notes: tuple[str, ...]
    wrong_bytes: tuple[int, int] | None


def is_bvh(head: bytes) -> bool:
    """Return whether a file with this beginning is a BVH."""
    return head.lstrip()[:9].upper() == b"HIERARCHY"


def read_bvh(path: str | Path, data: bytes | None = None, options: ReadOptions = DEFAULT_READ_OPTIONS) -> Animation:
    """Read the animation of a BVH: its values, in degrees and file units, and where each is in the file.

    The file has no unit and no up axis: they are inferred from the height of the figure and the position of its head. A rounded
    frame time is replaced by that of the common rate. `Animation.notes` lists the assumptions.

    Args:
        path: The file.
        data: The bytes of the file, if they were read already.
        options: What is known about the file.

    Raises:
        ReadError: If the file is invalid. The message names file and line.
    """
    path = Path(path)
    data = convert_to_utf_8(path, read_file_bytes(path) if data is None else data)
    match = MOTION_PATTERN.search(data)
    if not match:
        problem = "has no line MOTION after its hierarchy: it is not a BVH, or it was cut off"
        raise ReadError(f"{path}: {problem}. Export it again.")
    hierarchy = parse_hierarchy(path, data[: match.start()])
    timing = _parse_timing(path, data, match.end(), options)
    width = sum(len(each) for each in hierarchy.channels)
    tokens = scan_tokens(data, timing.stop_byte)
    frame_count = _count_frames(path, tokens, width)
    notes = list(timing.notes)
    if timing.declared_frame_count != frame_count:
        notes.append(f"It declares {timing.declared_frame_count} frames and has {frame_count}; all of these are read.")
    animation = Animation(
        names=hierarchy.names,
        parents=hierarchy.parents,
        offsets=hierarchy.offsets,
        end_sites=hierarchy.end_sites,
        channels=hierarchy.channels,
        values=tokens.values.reshape(frame_count, width),
        rate=timing.rate,
        path=path,
        wrong_rate_bytes=timing.wrong_bytes,
        value_byte_offsets=tokens.start_bytes.reshape(frame_count, width),
    )
    is_added, displacement_notes = _find_displacements(animation)
    animation = replace(animation, is_position_added=is_added, notes=(*notes, *displacement_notes))
    animation = infer_conventions(animation, options)
    return replace(animation, notes=(*animation.notes, *_describe_stretch(animation)))


def _parse_timing(path: Path, data: bytes, start: int, options: ReadOptions) -> _Timing:
    line_number = 1 + len(data[:start].splitlines())
    frames = FRAME_COUNT_PATTERN.match(data, start)
    time = FRAME_TIME_PATTERN.match(data, frames.end()) if frames else None
    if not frames or not time:
        problem = "there is no Frames: and Frame Time: with a number each after MOTION"
        raise ReadError(f"{path}, line {line_number}: {problem}.")
    frames_text, time_text = _decode_word(frames[1]), _decode_word(time[1])
    try:
        declared, stated = int(frames[1]), read_frame_time(time_text.replace(",", "."))
    except ValueError as error:
        problem = f"the number of frames {frames_text} or the frame time {time_text} is not a number"
        raise ReadError(f"{path}, line {line_number}: {problem}.") from error
    if options.rate_hz is not None:
        rate, notes = choose_rate(ReadError, stated[0] if stated else None, options)
    elif stated is not None:
        rate, notes = stated
    else:
        problem = f"a frame time of {time_text} s gives no possible rate (5 to 2000 Hz)"
        raise ReadError(f"{path}, line {line_number + 1}: {problem}; give the frames per second with --rate HZ.")
    frame_time = parse_number(time_text)
    is_right = abs(frame_time * rate - 1) < (MAX_RATE_ROUNDING if options.rate_hz is None else MAX_RATE_CONTRADICTION)
    return _Timing(declared, rate, time.end(), notes, None if is_right else time.span(1))


def _decode_word(word: bytes) -> str:
    return word.decode("utf-8", "replace")


def _count_frames(path: Path, tokens: TextTokens, width: int) -> int:
    """Return the number of frames of `width` values. A frame may take several lines, but begins on its own line.

    Raises:
        ReadError: If a token is not a number, or a line has too few or too many values.
    """
    if not tokens.is_number.all():
        invalid = int(np.argmin(tokens.is_number))
        quoted = repr(tokens.get_text(invalid)[:MAX_QUOTED_CHARACTERS])
        raise ReadError(f"{path}, line {tokens.line_numbers[invalid]}: {quoted} is not a number.")
    if width == 0 or not len(tokens):
        raise ReadError(f"{path}: has no motion: {width} channels and {len(tokens)} numbers after the frame time.")
    line_tokens = np.flatnonzero(np.diff(tokens.line_numbers, prepend=-1))  # first token of each line
    frame_count, remainder = divmod(len(tokens), width)
    if not remainder and np.isin(np.arange(frame_count) * width, line_tokens).all():
        return frame_count
    counts = np.diff(line_tokens, append=len(tokens))
    has_wrapped_frames = np.bincount(counts).argmax() < width and counts.max() < width
    invalid = _find_first_invalid_line(line_tokens, width) if has_wrapped_frames else int(np.argmax(counts != width))
    line_number = tokens.line_numbers[line_tokens[invalid]]
    problem = f"has {counts[invalid]} numbers for {width} channels"
    raise ReadError(f"{path}, line {line_number}: {problem}; the file is damaged there.")


def _find_first_invalid_line(line_tokens: Int[np.ndarray, " n"], width: int) -> int:
    """Return the line, among those with numbers, in which a frame of several lines ends too late or not at all."""
    missed = np.setdiff1d(np.arange(0, line_tokens[-1] + width, width), line_tokens)
    return int(np.searchsorted(line_tokens, missed[0]) - 1) if len(missed) else len(line_tokens) - 1


def _find_displacements(animation: Animation) -> tuple[Bool[np.ndarray, " J"], tuple[str, ...]]:
    """Return the joints whose position channels are added to their offsets, and a note if there are any.

    Position channels replace the offset of a joint. Some files have displacements from the offset in those of the joints below
    the hips. All of these joints are taken so if most of them have positions near zero, which would leave no bones. Positions
    that are short and constant are those of bones whose offset lies far away.
    """
    is_below = animation.is_below_body_root
    positioned = [joint for joint in np.flatnonzero(is_below).tolist() if animation.get_position_channels(joint)[0].size]
    lengths = np.linalg.norm(animation.offsets, axis=1)[is_below]
    usual_length = np.median(lengths[lengths > 0]) if lengths.any() else 0.0
    votes: list[bool] = []
    for joint in positioned:
        columns, axes = animation.get_position_channels(joint)
        length = min(float(np.linalg.norm(animation.offsets[joint, axes])), float(usual_length))
        values = animation.values[:, columns]
        values = values[np.isfinite(values).all(1)]
        if length > 0 and len(values):
            position = float(np.linalg.norm(np.median(values, axis=0)))
            is_constant = float(np.ptp(values, axis=0).max()) < MAX_BONE_CHANGE_RATIO * position
            votes.append(position < (MAX_CONSTANT_DISPLACEMENT_RATIO if is_constant else MAX_DISPLACEMENT_RATIO) * length)
    is_added = np.zeros(len(animation.names), bool)
    if 2 * sum(votes) <= len(votes):
        return is_added, ()
    is_added[positioned] = True
    shown = animation.names[positioned[0]] + (f" and {len(positioned) - 1} more joints" if len(positioned) > 1 else "")
    return is_added, (f"The positions of {shown} are near zero; they are taken as displacements from the offsets.",)


def _describe_stretch(animation: Animation) -> tuple[str, ...]:
    """Return a note on the bones that change in length most, if any do."""
    changes = np.zeros(len(animation.names))
    for joint in np.flatnonzero(animation.is_below_body_root).tolist():
        columns, axes = animation.get_position_channels(joint)
        positions = np.tile(animation.offsets[joint], (animation.frame_count, 1))
        positions[:, axes] = animation.values[:, columns] + animation.is_position_added[joint] * positions[:, axes]
        lengths = np.linalg.norm(positions, axis=1)
        lengths = lengths[np.isfinite(lengths)]
        changes[joint] = np.ptp(lengths) * animation.unit_m if len(lengths) else 0.0
    stretched = np.flatnonzero(changes > MIN_NOTED_STRETCH_M)
    if not len(stretched):
        return ()
    longest = int(np.argmax(changes))
    bones = f"{len(stretched)} bones change" if len(stretched) > 1 else "One bone changes"
    problem = f"{bones} in length, that to {animation.names[longest]} by {changes[longest] * 1e3:.0f} mm"
    return (f"{problem}; the copy of the file keeps this, the skeleton has their median lengths.",)
