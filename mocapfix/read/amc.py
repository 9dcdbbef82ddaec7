"""Reading ASF/AMC, the form in which CMU publishes its motion: the skeleton in one file, a trial's numbers in another.

An ASF bone has axes of its own, turned by C from the world's in the rest pose; its turn M in the AMC is about those. In the
axes of the world that is C M C^-1.
"""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from mocapfix.animation import Animation
from mocapfix.animations.joint_points import build_joint_take
from mocapfix.errors import ReadError
from mocapfix.read.animation_inference import infer_unit, infer_up_axis
from mocapfix.read.asf import AsfSkeleton, parse_asf
from mocapfix.read.file_content import read_file_bytes
from mocapfix.read.token_scanner import TextTokens, scan_tokens
from mocapfix.take import Take

FIRST_FRAME_PATTERN = re.compile(rb"(?:^|(?<=[\r\n]))[ \t]*\d+[ \t]*(?=[\r\n]|$)")  # the line with the first frame's number
# no keyword of the format says the rate: what a comment or a keyword of some program's own says is taken
RATE_PATTERN = re.compile(rb":SAMPLES-PER-SECOND\s+(\d+\.?\d*)|(\d+\.?\d*) ?(?:fps|Hz|frames (?:a|per) second)", re.IGNORECASE)
DEFAULT_AMC_RATE_HZ = 120.0  # Hz: CMU's, but for some subjects at 60
BONE_SECTION_KEYWORD = b":bonedata"
# comments, keywords, and then the first frame's number and a bone's
AMC_HEAD_PATTERN = re.compile(rb"\s*(?:[#:][^\n]*\n\s*)*\d+[ \t]*\r?\n[ \t]*[A-Za-z]\S*(?:[ \t]+[-+.\d]\S*)+[ \t]*\r?(?:\n|$)")


def is_asf_or_amc(head: bytes) -> bool:
    """-> does a file that begins so claim to be an AMC, or the ASF that goes with one?"""
    lower = head.lower()
    keywords = b":fully-specified", b":degrees", b":radians"  # a file that was cut off may have no more
    return BONE_SECTION_KEYWORD in lower or lower.lstrip().startswith(keywords) or bool(AMC_HEAD_PATTERN.match(head))


def read_amc_take(path: Path, data: bytes) -> Take:
    """-> the take of the joints that move in an AMC's bytes. Raises ReadError as `animation`, and for a skeleton alone."""
    if BONE_SECTION_KEYWORD in data.lower():
        raise ReadError(f"{path}: is a skeleton without motion; name the AMC that moves it.")
    return build_joint_take(read_amc(path, data))


def read_amc(path: str | Path, data: bytes | None = None, asf_path: str | Path | None = None) -> Animation:
    """-> the motion of an AMC on the `skeleton`, an ASF, that is given or beside it; or the rest pose of an ASF, as one frame.

    Angles are in degrees, whatever the file has them in. Joints are where bones begin and carry their names.

    data  the file's bytes, where they were read already

    Raises ReadError where the AMC's skeleton is not beside it, and, naming file and line, where either has a fault.
    """
    path = Path(path)
    data = read_file_bytes(path) if data is None else data
    if BONE_SECTION_KEYWORD in data.lower():
        return _build_rest_animation(path, data)
    beside = Path(asf_path) if asf_path is not None else find_asf(path)
    body = parse_asf(beside, _decode_text(read_file_bytes(beside)))
    start = FIRST_FRAME_PATTERN.search(data)
    if not start:
        raise ReadError(f"{path}: holds no frames; an AMC has a line with each frame's number. Export it again.")
    found = scan_tokens(data, start.start())
    first, at = _locate_values(path, found, body)
    said = RATE_PATTERN.search(data[: start.start()])
    rate = float(said[1] or said[2]) if said else 0.0
    notes = () if rate > 0 else (f"An AMC does not say its rate; {DEFAULT_AMC_RATE_HZ:.0f} Hz, CMU's, was taken.",)
    values, radians = found.values[at], b":radians" in data[: start.start()].lower()
    read = _build_animation(path, body, values, rate or DEFAULT_AMC_RATE_HZ, (f"Its skeleton is {beside.name}.", *notes), first)
    read = replace(read, value_byte_offsets=found.start_bytes[at], skeleton_path=beside, uses_radians=radians)
    if not radians:
        return read
    turning = np.concatenate([read.get_rotation_channels(joint)[0] for joint in range(len(read.names))])
    values[:, turning] = np.degrees(values[:, turning])
    return read


def find_asf(path: Path) -> Path:
    """-> the ASF beside an AMC: of those whose name the AMC's begins with (02.asf for 02_01.amc) the longest, else the only one.

    Raises ReadError where there is none or which it is cannot be told.
    """
    beside = sorted(each for each in path.parent.iterdir() if each.suffix.lower() == ".asf")
    own = [each for each in beside if path.stem.lower().startswith(each.stem.lower())]
    if own:
        return max(own, key=lambda each: len(each.stem))
    if len(beside) == 1:
        return beside[0]
    there = f"only {', '.join(each.name for each in beside)}" if beside else "no ASF"
    likely = " or ".join(f"{stem}.asf" for stem in dict.fromkeys((path.stem.partition("_")[0], path.stem)))
    raise ReadError(f"{path}: its skeleton is not beside it, {there}; put it there as {likely}.")


def _build_rest_animation(path: Path, data: bytes) -> Animation:
    body = parse_asf(path, _decode_text(data))
    width = sum(len(bone.degrees_of_freedom) for bone in body.bones)
    return _build_animation(
        path, body, np.zeros((1, width)), DEFAULT_AMC_RATE_HZ, ("It is a skeleton without motion, in its rest pose.",), 1
    )


def _decode_text(data: bytes) -> str:
    return data.decode("utf-8", "replace")


def _build_animation(
    path: Path, body: AsfSkeleton, values: np.ndarray, rate: float, notes: tuple[str, ...], first: int
) -> Animation:
    """-> the animation of a figure, its values in the order of its channels."""
    names = tuple(bone.name for bone in body.bones)
    parents = np.array([names.index(bone.parent) if bone.parent else -1 for bone in body.bones])
    tips = np.array([bone.tip_offset for bone in body.bones])
    leaves = [joint not in parents for joint in range(len(names))]
    read = Animation(
        names=names,
        parents=parents,
        offsets=np.vstack([body.root_position, tips[parents[1:]]]),
        end_sites=tuple(tip[None] if leaf else np.empty((0, 3)) for tip, leaf in zip(tips, leaves, strict=True)),
        channels=tuple(bone.channels for bone in body.bones),
        values=values,
        rate=rate,
        path=path,
        first_frame=first,
        unit_m=body.unit_m,
        rest_rotations=np.array([bone.rotation_world_bone for bone in body.bones]),
        is_position_added=np.ones(len(names), bool),
        notes=notes,
    )
    return infer_unit(infer_up_axis(read))


def _locate_values(path: Path, found: TextTokens, body: AsfSkeleton) -> tuple[int, np.ndarray]:
    """-> the first frame's number, and (T, C) which of the words is each frame's number for each channel.

    Raises ReadError at a word that is no number, a bone the skeleton has not, or one that lacks, comes twice or has too few
    numbers.
    """
    heads = np.flatnonzero(np.diff(found.line_numbers, prepend=-1))
    counts = np.diff(heads, append=len(found))
    named = ~found.is_number[heads]
    stray = ~found.is_number
    stray[heads] = False
    if stray.any() or (bad := ~named & (counts != 1)).any():
        at = int(np.argmax(stray)) if stray.any() else heads[np.argmax(bad)]
        what = f"{found.get_text(at)[:40]!r} stands where a bone's numbers or a frame's belong"
        raise ReadError(f"{path}, line {found.line_numbers[at]}: {what}.")
    frame = np.cumsum(~named)
    lines: dict[str, list[int]] = {bone.name: [] for bone in body.bones}
    for line in np.flatnonzero(named).tolist():
        name = found.get_text(heads[line])
        if name not in lines:
            raise ReadError(f"{path}, line {found.line_numbers[heads[line]]}: bone {name[:40]} is not in the skeleton.")
        lines[name].append(line)
    columns = []
    for bone in body.bones:
        if bone.degrees_of_freedom:
            own = np.array(lines[bone.name], int)
            _check_bone_lines(
                path, found, bone.name, heads[~named], frame[own], heads[own], counts[own] - 1, len(bone.degrees_of_freedom)
            )
            columns.append(heads[own, None] + 1 + np.array(bone.amc_columns))
    return int(found.values[heads[0]]), np.hstack(columns)


def _check_bone_lines(
    path: Path,
    found: TextTokens,
    name: str,
    frames: np.ndarray,
    own: np.ndarray,
    heads: np.ndarray,
    counts: np.ndarray,
    width: int,
) -> None:
    """Raise ReadError unless a bone is there once in every frame, with `width` numbers.

    frames (T,) the words that are the frames' numbers; own (n,) the frame of each of the bone's lines, the first being 1,
    heads (n,) the words they begin with, counts (n,) their numbers.
    """
    times = np.bincount(own, minlength=len(frames) + 1)[1:]
    if (times != 1).any():
        at = frames[np.argmax(times != 1)]
        how = "twice" if times.max() > 1 and times[np.argmax(times != 1)] > 1 else "not"
        raise ReadError(f"{path}, line {found.line_numbers[at]}: bone {name} is {how} in frame {found.get_text(at)}.")
    if (counts != width).any():
        at = int(np.argmax(counts != width))
        raise ReadError(
            f"{path}, line {found.line_numbers[heads[at]]}: {name} has {counts[at]} numbers where its freedoms are {width}."
        )
