"""Read ASF/AMC, the format of CMU's motion capture: a skeleton in one file, the values of a trial in another.

A bone of an ASF has its own axes, rotated by C from the world's in the rest pose, and its rotation M in the AMC is about
those. In world axes it is C M C^-1.
"""

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from mocapfix.animation import Animation
from mocapfix.errors import ReadError, format_name_list
from mocapfix.files.read_options import DEFAULT_READ_OPTIONS, ReadOptions
from mocapfix.read.animation_inference import infer_conventions
from mocapfix.read.asf import AsfSkeleton, parse_asf
from mocapfix.read.file_content import MAX_QUOTED_CHARACTERS, convert_to_utf_8, decode_text, read_file_bytes
from mocapfix.read.frame_rate import FileFrames, choose_rate, count_frame_steps, describe_missing_frames
from mocapfix.read.token_scanner import TextTokens, scan_tokens

FIRST_FRAME_PATTERN = re.compile(rb"(?:^|(?<=[\r\n]))[ \t]*\d+[ \t]*(?=[\r\n]|$)")  # the line of the first frame's number
# The format has no keyword for the rate, so it is read from comments or keywords of some programs.
RATE_NUMBER = rb"(\d{1,9}(?:\.\d{0,9})?)"
RATE_PATTERN = re.compile(
    rb":SAMPLES-PER-SECOND\s+" + RATE_NUMBER + rb"(?!\d)|(?<!\d)" + RATE_NUMBER + rb" ?(?:fps|Hz|frames (?:a|per) second)",
    re.IGNORECASE,
)
MAX_BLANK_BYTE = 32  # bytes up to it separate tokens
MAX_AMC_FRAME_NUMBER = 1e9
DEFAULT_AMC_RATE_HZ = 120.0  # CMU's, except for some subjects at 60 Hz
BONE_SECTION_KEYWORD = b":bonedata"
AMC_KEYWORDS = (b":fully-specified", b":degrees", b":radians")  # at the beginning of a file; a cut-off one may have no more
# Comments, keywords, the first frame's number, then a bone with its values.
AMC_HEAD_PATTERN = re.compile(rb"\s*(?:[#:][^\n]*\n\s*)*\d+[ \t]*\r?\n[ \t]*[A-Za-z]\S*(?:[ \t]+[-+.\d]\S*)+[ \t]*\r?(?:\n|$)")


@dataclass(frozen=True)
class _BoneLines:
    """The lines of one bone in an AMC.

    Attributes:
        frames: Frame of each line, counted from 1.
        tokens: Token that each line begins with.
        value_counts: Number of values on each line.
    """

    frames: Int[np.ndarray, " n"]
    tokens: Int[np.ndarray, " n"]
    value_counts: Int[np.ndarray, " n"]


def is_asf_or_amc(head: bytes) -> bool:
    """Return whether a file with this beginning is an AMC or an ASF."""
    lower = head.lower()
    return BONE_SECTION_KEYWORD in lower or lower.lstrip().startswith(AMC_KEYWORDS) or AMC_HEAD_PATTERN.match(head) is not None


def read_amc_motion(path: Path, data: bytes, options: ReadOptions) -> Animation:
    """Return the motion in the bytes of an AMC, as `read_amc` does, and raise ReadError for an ASF, which has none."""
    if BONE_SECTION_KEYWORD in convert_to_utf_8(path, data).lower():
        raise ReadError(f"{path}: is a skeleton without motion; name the AMC file of the motion.")
    return read_amc(path, data, options=options)


def read_amc(
    path: str | Path,
    data: bytes | None = None,
    asf_path: str | Path | None = None,
    options: ReadOptions = DEFAULT_READ_OPTIONS,
) -> Animation:
    """Read the motion of an AMC, or the rest pose of an ASF as one frame.

    Joints are at the beginning of bones and have their names. Angles are in degrees, whatever the file uses.

    Args:
        path: The AMC or ASF file.
        data: The bytes of the file, if they were read already.
        asf_path: The skeleton of an AMC; by default the one that `find_asf` finds.
        options: What is known about the motion.

    Raises:
        ReadError: If there is no skeleton, or a file is invalid. The message names file and line.
    """
    path = Path(path)
    data = convert_to_utf_8(path, read_file_bytes(path) if data is None else data)
    if BONE_SECTION_KEYWORD in data.lower():
        return infer_conventions(_build_rest_animation(path, data), options)
    skeleton_path = Path(asf_path) if asf_path is not None else find_asf(path)
    skeleton = parse_asf(skeleton_path, decode_text(read_file_bytes(skeleton_path))[0])
    start = FIRST_FRAME_PATTERN.search(data)
    if not start:
        raise ReadError(f"{path}: has no frames; an AMC has a line with the number of each frame. Export it again.")
    header, tokens = data[: start.start()], scan_tokens(data, start.start())
    frame_numbers, value_tokens = _locate_values(path, tokens, skeleton)
    rate, rate_notes = _find_rate(path, header, options)
    notes = [f"Its skeleton is {skeleton_path.name}.", *rate_notes]
    steps, _, irregular = count_frame_steps(frame_numbers)
    if irregular is not None or steps.sum() >= 2 * len(frame_numbers):
        row = int(np.argmax(steps)) if irregular is None else irregular
        problem = f"Frame {frame_numbers[row + 1]:.0f} follows frame {frame_numbers[row]:.0f}"
        notes.append(f"{problem} in the file; frames are counted from the first.")
        steps = np.ones(len(steps), int)
    row_frames, first_frame = np.concatenate([[0], np.cumsum(steps)]).astype(int), int(frame_numbers[0])
    frames = FileFrames(rate, first_frame, row_frames, (*notes, *describe_missing_frames(first_frame, row_frames)))
    values, uses_radians = frames.spread_rows(tokens.values[value_tokens]), b":radians" in header.lower()
    animation = _build_animation(path, skeleton, values, frames.rate, frames.notes, first_frame)
    value_byte_offsets = frames.spread_rows(tokens.start_bytes[value_tokens], -1)
    animation = replace(animation, value_byte_offsets=value_byte_offsets, skeleton_path=skeleton_path, uses_radians=uses_radians)
    if uses_radians:
        rotation_columns = np.concatenate([animation.get_rotation_channels(joint)[0] for joint in range(len(animation.names))])
        values[:, rotation_columns] = np.degrees(values[:, rotation_columns])
    return infer_conventions(animation, options)


def _find_rate(path: Path, header: bytes, options: ReadOptions) -> tuple[float, tuple[str, ...]]:
    """Return the rate (Hz) of an AMC by the option or its comments, or that of CMU, and a note on what was assumed."""
    match = RATE_PATTERN.search(header)
    stated = float(match[1] or match[2]) if match else 0.0
    if stated > 0 or options.rate_hz is not None:
        return choose_rate(lambda sentence: ReadError(f"{path}: {sentence}"), stated or None, options)
    return DEFAULT_AMC_RATE_HZ, (f"An AMC file has no rate; {DEFAULT_AMC_RATE_HZ:.0f} Hz, CMU's, is assumed (--rate).",)


def find_asf(path: Path) -> Path:
    """Return the ASF in the folder of an AMC.

    If names of ASF files are beginnings of the AMC's name (02.asf for 02_01.amc), it is the longest of these, else the only ASF.

    Raises:
        ReadError: If there is none, or several are possible.
    """
    candidates = sorted(each for each in path.parent.iterdir() if each.suffix.lower() == ".asf")
    matching = [each for each in candidates if path.stem.lower().startswith(each.stem.lower())]
    if matching:
        return max(matching, key=lambda each: len(each.stem))
    if len(candidates) == 1:
        return candidates[0]
    present = f"only {format_name_list([each.name for each in candidates])}" if candidates else "no ASF"
    expected = " or ".join(f"{stem}.asf" for stem in dict.fromkeys((path.stem.partition("_")[0], path.stem)))
    raise ReadError(f"{path}: its skeleton is not in its folder, {present}; copy it there as {expected}.")


def _build_rest_animation(path: Path, data: bytes) -> Animation:
    skeleton = parse_asf(path, decode_text(data)[0])
    width = sum(len(bone.degrees_of_freedom) for bone in skeleton.bones)
    notes = ("It is a skeleton without motion, in its rest pose.",)
    return _build_animation(path, skeleton, np.zeros((1, width)), DEFAULT_AMC_RATE_HZ, notes, 1)


def _build_animation(
    path: Path,
    skeleton: AsfSkeleton,
    values: Float[np.ndarray, "T C"],
    rate: float,
    notes: tuple[str, ...],
    first_frame: int,
) -> Animation:
    """Return the animation of a skeleton with inferred unit and up axis. The values are in the order of its channels."""
    names = tuple(bone.name for bone in skeleton.bones)
    parents = np.array([names.index(bone.parent) if bone.parent else -1 for bone in skeleton.bones])
    tips = np.array([bone.tip_offset for bone in skeleton.bones])
    is_leaf = [joint not in parents for joint in range(len(names))]
    return Animation(
        names=names,
        parents=parents,
        offsets=np.vstack([skeleton.root_position, tips[parents[1:]]]),
        end_sites=tuple(tip[None] if leaf else np.empty((0, 3)) for tip, leaf in zip(tips, is_leaf, strict=True)),
        channels=tuple(bone.channels for bone in skeleton.bones),
        values=values,
        rate=rate,
        path=path,
        first_frame=first_frame,
        unit_m=skeleton.unit_m,
        rest_rotations=np.array([bone.rotation_world_bone for bone in skeleton.bones]),
        is_position_added=np.ones(len(names), bool),
        notes=notes,
    )


def _locate_values(
    path: Path, tokens: TextTokens, skeleton: AsfSkeleton
) -> tuple[Float[np.ndarray, " T"], Int[np.ndarray, "T C"]]:
    """Return the number of each frame, and the token of each channel's value in it.

    Raises:
        ReadError: If a token is not a number, or a bone is not in the skeleton, is missing, occurs twice or has another number
            of values than degrees of freedom.
    """
    line_tokens = np.flatnonzero(np.diff(tokens.line_numbers, prepend=-1))  # first token of each line
    token_counts = np.diff(line_tokens, append=len(tokens))
    is_bone_line = ~tokens.is_number[line_tokens]
    is_stray = ~tokens.is_number
    is_stray[line_tokens] = False
    is_frame_number = np.abs(tokens.values[line_tokens]) <= MAX_AMC_FRAME_NUMBER
    is_invalid_frame_line = ~is_bone_line & ((token_counts != 1) | ~is_frame_number)
    if is_stray.any() or is_invalid_frame_line.any():
        token = int(np.argmax(is_stray) if is_stray.any() else line_tokens[np.argmax(is_invalid_frame_line)])
        quoted = repr(tokens.get_text(token)[:MAX_QUOTED_CHARACTERS])
        problem = f"{quoted} is given where the values of a bone or the number of a frame are expected"
        raise ReadError(f"{path}, line {tokens.line_numbers[token]}: {problem}.")
    frame_of_line = np.cumsum(~is_bone_line)
    names = [bone.name for bone in skeleton.bones]
    bone_of_line = _match_names(tokens, line_tokens, names)
    for line in np.flatnonzero(is_bone_line & (bone_of_line < 0)).tolist():  # names that are not valid UTF-8, too
        name = tokens.get_text(int(line_tokens[line]))
        if name not in names:
            line_number = tokens.line_numbers[line_tokens[line]]
            raise ReadError(f"{path}, line {line_number}: bone {name[:MAX_QUOTED_CHARACTERS]} is not in the skeleton.")
        bone_of_line[line] = names.index(name)
    columns: list[np.ndarray] = []
    for index, bone in enumerate(skeleton.bones):
        if bone.degrees_of_freedom:
            own = np.flatnonzero(is_bone_line & (bone_of_line == index))
            bone_lines = _BoneLines(frame_of_line[own], line_tokens[own], token_counts[own] - 1)
            frame_tokens = line_tokens[~is_bone_line]
            _check_bone_lines(path, tokens, bone.name, frame_tokens, bone_lines, len(bone.degrees_of_freedom))
            columns.append(line_tokens[own, None] + 1 + np.array(bone.amc_columns))
    return tokens.values[line_tokens[~is_bone_line]], np.hstack(columns)


def _match_names(tokens: TextTokens, line_tokens: Int[np.ndarray, " L"], names: list[str]) -> Int[np.ndarray, " L"]:
    """Return the index of the name that the first token of each line is, -1 if it is none."""
    encoded_names = [name.encode() for name in names]
    text = np.frombuffer(tokens.data, np.uint8)
    token_bytes = tokens.start_bytes[line_tokens, None] + np.arange(max(map(len, encoded_names)) + 1)
    letters = np.where(token_bytes < len(text), text[np.minimum(token_bytes, len(text) - 1)], np.uint8(0))
    letters[~np.logical_and.accumulate(letters > MAX_BLANK_BYTE, axis=1)] = 0
    first_words = np.ascontiguousarray(letters).view(f"S{letters.shape[1]}")[:, 0]
    name_of_line = np.full(len(line_tokens), -1)
    for index, name in enumerate(encoded_names):
        name_of_line[first_words == name] = index
    return name_of_line


def _check_bone_lines(
    path: Path, tokens: TextTokens, name: str, frame_tokens: Int[np.ndarray, " T"], lines: _BoneLines, width: int
) -> None:
    """Raise ReadError unless a bone has one line with `width` values in every frame; `frame_tokens` are the frame numbers."""
    line_counts = np.bincount(lines.frames, minlength=len(frame_tokens) + 1)[1:]
    if (line_counts != 1).any():
        frame = int(np.argmax(line_counts != 1))
        token = int(frame_tokens[frame])
        problem = "occurs twice" if line_counts[frame] > 1 else "is missing"
        frame_number = tokens.get_text(token)
        raise ReadError(f"{path}, line {tokens.line_numbers[token]}: bone {name} {problem} in frame {frame_number}.")
    if (lines.value_counts != width).any():
        line = int(np.argmax(lines.value_counts != width))
        problem = f"bone {name} has {lines.value_counts[line]} values and {width} degrees of freedom"
        raise ReadError(f"{path}, line {tokens.line_numbers[lines.tokens[line]]}: {problem}.")
