"""Read a BVH file, any hierarchy with the channels of each joint in any order, and write one.

Source: Meredith and Maddock 2001, "Motion capture file formats explained". Where programs differ, the usage of most is
assumed: position channels of any joint replace its offset.

By default a written file has Y up, facing +Z in the rest pose, in centimetres (BVH has no unit). The root has six channels, every
other joint three. All rotations are Z Y X in degrees, R = Rz Ry Rx, continuous over time. A rig may have another unit and order.
"""

import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple, NoReturn

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.errors import ReadError, WriteError, format_name_list
from mocapfix.io import file_content
from mocapfix.io.conventions import infer_conventions
from mocapfix.io.files import replace_atomically
from mocapfix.io.frame_rate import MAX_RATE_CONTRADICTION, MAX_RATE_ROUNDING, choose_rate, read_frame_time
from mocapfix.io.source_file import format_rows
from mocapfix.kernels import euler_angles
from mocapfix.model.animation import FOOT_JOINT_PATTERN, Animation
from mocapfix.model.motion import Motion
from mocapfix.model.skeleton import Skeleton
from mocapfix.model.windows import iterate_blocks
from mocapfix.options import DEFAULT_READ_OPTIONS, ReadOptions

# Separators of the items of a line, of which there may be several.
ITEM_PATTERN = re.compile(r"([{}])|[ \t]+(?=(?:OFFSET|CHANNELS)\s+[-+.\d])", re.IGNORECASE)
CHANNEL_PATTERN = re.compile(r"([XYZ])(position|rotation)", re.IGNORECASE)


@dataclass
class _BvhJoint:
    name: str
    parent: int
    offset: list[float] | None = None
    channels: tuple[str, ...] = ()
    end_sites: list[list[float]] = field(default_factory=list[list[float]])


def _split_items(text: bytes) -> Iterator[tuple[int, str]]:
    """Yield line number and text of each item; a line may have several, and a comment has none."""
    try:
        lines = text.decode("utf-8").splitlines()
    except UnicodeDecodeError:
        lines = text.decode("latin-1").splitlines()
    for line_number, line in enumerate(lines, start=1):
        if file_content.COMMENT_LINE_PATTERN.match(line):
            continue
        yield from ((line_number, item.strip()) for item in ITEM_PATTERN.split(line) if item and item.strip())


class _HierarchyParser:
    """State of the parser: the joints so far, and the braces that are open."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.joints: list[_BvhJoint] = []
        self.open_joints: list[int | None] = []  # index of the joint of each open brace, None for an end site
        self.pending_joints: list[int | None] = []  # those whose brace is not open yet

    def parse(self, items: Iterator[tuple[int, str]]) -> list[_BvhJoint]:
        """Return the joints that the items describe."""
        line_number = 1
        for line_number, item in items:
            self.parse_item(line_number, item)
        if self.open_joints or self.pending_joints:
            open_braces = len(self.open_joints) + len(self.pending_joints)
            self.raise_error(line_number, f"the hierarchy ends with {open_braces} braces not closed")
        if not self.joints:
            self.raise_error(1, "the hierarchy has no ROOT")
        for joint in self.joints:
            if joint.offset is None:
                self.raise_error(line_number, f"joint {joint.name} has no OFFSET")
        roots = [joint for joint, each in enumerate(self.joints) if each.parent < 0]
        trees = [self.joints[start:stop] for start, stop in pairwise([*roots, len(self.joints)])]
        figures = [tree[0].name for tree in trees if any(FOOT_JOINT_PATTERN.search(joint.name) for joint in tree)]
        if len(figures) > 1:
            self.raise_error(line_number, f"{format_name_list(figures)} are the roots of two figures; give each its own file")
        return self.joints

    def parse_item(self, line_number: int, item: str) -> None:
        keyword, _, rest = item.replace("\t", " ").partition(" ")
        match keyword.upper():
            case "HIERARCHY":
                pass
            case "ROOT" | "JOINT":
                self.add_joint(line_number, keyword, rest.strip())
            case "END":
                self.get_open_joint(line_number, item)
                self.pending_joints.append(None)
            case "{":
                if not self.pending_joints:
                    self.raise_error(line_number, "a brace opens where no joint is named")
                self.open_joints.append(self.pending_joints.pop())
            case "}":
                if not self.open_joints:
                    self.raise_error(line_number, "a brace closes that was not opened")
                self.open_joints.pop()
            case "OFFSET":
                self.add_offset(line_number, rest)
            case "CHANNELS":
                self.set_channels(line_number, rest)
            case _:
                quoted = repr(item[: file_content.MAX_QUOTED_CHARACTERS])
                self.raise_error(line_number, f"{quoted} is not one of ROOT, JOINT, End Site, OFFSET, CHANNELS")

    def add_joint(self, line_number: int, keyword: str, name: str) -> None:
        if not name:
            self.raise_error(line_number, "a joint has no name")
        is_root = keyword.upper() == "ROOT"
        if is_root and (self.open_joints or self.pending_joints):
            self.raise_error(line_number, f"ROOT {name} is inside of another joint; a brace is missing before it")
        self.joints.append(_BvhJoint(name, -1 if is_root else self.get_open_joint(line_number, f"JOINT {name}")))
        self.pending_joints.append(len(self.joints) - 1)

    def add_offset(self, line_number: int, rest: str) -> None:
        """Set the offset of the open joint, or add an end site to its parent."""
        joint = self.joints[self.open_joints[-1]] if self.open_joints and self.open_joints[-1] is not None else None
        try:
            vector = [file_content.parse_number(word) for word in rest.split()]
        except ValueError:
            self.raise_error(line_number, f"OFFSET {rest} is not three numbers")
        if len(vector) != 3 or not np.isfinite(vector).all():
            self.raise_error(line_number, f"OFFSET {rest} is not three numbers")
        if joint:
            joint.offset = vector
        elif len(self.open_joints) > 1 and (parent := self.open_joints[-2]) is not None:
            self.joints[parent].end_sites.append(vector)
        else:
            self.raise_error(line_number, "an OFFSET is outside of any joint")

    def set_channels(self, line_number: int, rest: str) -> None:
        joint = self.joints[self.get_open_joint(line_number, "CHANNELS")]
        count, *names = rest.split() or [""]
        matches = [CHANNEL_PATTERN.fullmatch(name) for name in names]
        if not all(matches):
            invalid = names[matches.index(None)]
            self.raise_error(line_number, f"channel {invalid} is neither a position nor a rotation about X, Y or Z")
        if count != str(len(names)):
            self.raise_error(line_number, f"{count or 'no number of'} channels are declared and {len(names)} named")
        joint.channels = tuple(match[1].upper() + match[2].lower() for match in matches if match)

    def get_open_joint(self, line_number: int, keyword: str) -> int:
        """Return the joint whose brace is open. `keyword` is what needs one, for the error message."""
        if not self.open_joints or self.open_joints[-1] is None or self.pending_joints:
            problem = f"{keyword} is outside of any joint"
            self.raise_error(line_number, f"{problem}; a brace is missing or superfluous before it")
        return self.open_joints[-1]

    def raise_error(self, line_number: int, problem: str) -> NoReturn:
        raise ReadError(f"{self.path}, line {line_number}: {problem}.")


MOTION_PATTERN = re.compile(rb"(?:^|(?<=[\r\n]))[ \t]*MOTION[ \t]*(?=[\r\n]|$)", re.IGNORECASE)
FRAME_COUNT_PATTERN = re.compile(rb"\s*Frames?\s*:?\s*(\S+)", re.IGNORECASE)
FRAME_TIME_PATTERN = re.compile(rb"\s*Frame\s*Time\s*:?[ \t]*(\S+)[^\r\n]*", re.IGNORECASE)
# Ratios of a joint's median position to its offset, the median of all joints, below which positions are displacements.
MAX_DISPLACEMENT_RATIO = 0.3
MAX_CONSTANT_DISPLACEMENT_RATIO = 0.005
MAX_BONE_CHANGE_RATIO = 0.01  # of the range of a joint's positions to their median, if they are constant
MIN_NOTED_STRETCH_M = 0.02  # change of a bone's length; constant positions, as most programs write them, change by 0


class _Timing(NamedTuple):
    """The two lines before the numbers of a BVH."""

    declared_frame_count: int  # number of frames as declared
    rate: float  # frames per second
    stop_byte: int  # byte after the two lines
    notes: tuple[str, ...]  # a sentence about the rate if it was rounded in the file
    wrong_bytes: tuple[int, int] | None  # first byte and byte after the frame time if it is not that of the rate, even rounded


def is_bvh(head: bytes) -> bool:
    """Return whether a file with this beginning is a BVH."""
    return head.lstrip()[:9].upper() == b"HIERARCHY"


def read_bvh(path: str | Path, data: bytes | None = None, options: ReadOptions = DEFAULT_READ_OPTIONS) -> Animation:
    """Read the animation of a BVH: its values, in degrees and file units, and where each is in the file.

    The file has no unit and no up axis: they are inferred from the height of the figure and the position of its head. A rounded
    frame time is replaced by that of the common rate. `Animation.notes` lists the assumptions.

    Args:
        data: The bytes of the file, if they were read already.
        options: What is known about the file.
    """
    path = Path(path)
    data = file_content.convert_to_utf_8(path, file_content.read_file_bytes(path) if data is None else data)
    match = MOTION_PATTERN.search(data)
    if not match:
        problem = "has no line MOTION after its hierarchy: it is not a BVH, or it was cut off"
        raise ReadError(f"{path}: {problem}. Export it again.")
    joints = _HierarchyParser(path).parse(_split_items(data[: match.start()].removeprefix(b"\xef\xbb\xbf")))
    timing = _parse_timing(path, data, match.end(), options)
    width = sum(len(joint.channels) for joint in joints)
    tokens = file_content.scan_tokens(data, timing.stop_byte)
    frame_count = _count_frames(path, tokens, width)
    notes = list(timing.notes)
    if timing.declared_frame_count != frame_count:
        notes.append(f"It declares {timing.declared_frame_count} frames and has {frame_count}; all of these are read.")
    names, channels = tuple(joint.name for joint in joints), tuple(joint.channels for joint in joints)
    parents, offsets = np.array([joint.parent for joint in joints]), np.array([joint.offset for joint in joints], float)
    end_sites = tuple(np.array(joint.end_sites, float).reshape(-1, 3) for joint in joints)
    values, starts = (each.reshape(frame_count, width) for each in (tokens.values, tokens.start_bytes))
    animation = Animation(names, parents, offsets, end_sites, channels, values, timing.rate, path)
    animation = replace(animation, wrong_rate_bytes=timing.wrong_bytes, value_byte_offsets=starts)
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
    frames_text, time_text = (match[1].decode("utf-8", "replace") for match in (frames, time))
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
    frame_time = file_content.parse_number(time_text)
    is_right = abs(frame_time * rate - 1) < (MAX_RATE_ROUNDING if options.rate_hz is None else MAX_RATE_CONTRADICTION)
    return _Timing(declared, rate, time.end(), notes, None if is_right else time.span(1))


def _count_frames(path: Path, tokens: file_content.TextTokens, width: int) -> int:
    """Return the number of frames of `width` values. A frame may take several lines, but begins on its own line.

    Raises:
        ReadError: If a token is not a number, or a line has too few or too many values.
    """
    if not tokens.is_number.all():
        invalid = int(np.argmin(tokens.is_number))
        quoted = repr(tokens.get_text(invalid)[: file_content.MAX_QUOTED_CHARACTERS])
        raise ReadError(f"{path}, line {tokens.line_numbers[invalid]}: {quoted} is not a number.")
    if width == 0 or not len(tokens):
        raise ReadError(f"{path}: has no motion: {width} channels and {len(tokens)} numbers after the frame time.")
    line_tokens = np.r_[0, 1 + np.flatnonzero(tokens.line_numbers[1:] != tokens.line_numbers[:-1])]  # first token of each line
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
    the hips. All of these joints are taken so if their positions are short on the whole, which would leave no bones. Positions
    that are short and constant are those of bones whose offset lies far away.
    """
    is_below = animation.is_below_body_root
    positioned = [joint for joint in np.flatnonzero(is_below).tolist() if animation.get_position_channels(joint)[0].size]
    lengths = np.linalg.norm(animation.offsets, axis=1)[is_below]
    usual_length = np.median(lengths[lengths > 0]) if lengths.any() else 0.0
    ratios, constant = list[float](), list[bool]()
    for joint in positioned:
        columns, axes = animation.get_position_channels(joint)
        length = min(float(np.linalg.norm(animation.offsets[joint, axes])), float(usual_length))
        values = animation.values[:, columns]
        values = values[np.isfinite(values).all(1)]
        if length > 0 and len(values):
            position = float(np.linalg.norm(np.median(values, axis=0)))
            constant.append(float(np.ptp(values, axis=0).max()) < MAX_BONE_CHANGE_RATIO * position)
            ratios.append(position / length)
    is_added = np.zeros(len(animation.names), bool)
    max_ratio = MAX_CONSTANT_DISPLACEMENT_RATIO if 2 * sum(constant) > len(constant) else MAX_DISPLACEMENT_RATIO
    if not ratios or np.median(ratios) >= max_ratio:
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


CENTIMETRE_M = 0.01
BVH_DECIMALS = 6  # of every number


def write_bvh_tree(
    target: Path,
    skeleton: Skeleton,
    positions: Mapping[int, Float[np.ndarray, "T 3"]],
    local_rotations: Float[np.ndarray, "T J 3 3"],
    rate: float,
    unit_m: float = CENTIMETRE_M,
    rotation_order: str = "ZYX",
) -> None:
    """Write a motion as `write_bvh` does, in which several joints may have position channels.

    Args:
        positions: Joint to its positions (T, 3) in metres in its parent's axes; the root, joint 0, must have them.
    """
    joints = list(_iterate_depth_first(skeleton))
    angles = np.zeros((1, len(joints), 3))
    header = "".join(_build_hierarchy(target, skeleton, joints, positions, unit_m, rotation_order))
    header += f"MOTION\nFrames: {len(local_rotations)}\nFrame Time: {1 / rate:.10f}\n"
    with replace_atomically(Path(target)) as part, part.open("wb") as file:
        file.write(header.encode("utf-8"))
        for frames, rotations in iterate_blocks(local_rotations, len(local_rotations)):
            angles = compute_euler_angles(rotations, rotation_order, angles[-1])
            columns: list[np.ndarray] = []
            for joint, _ in joints:
                columns += [positions[joint][frames] * (1 / unit_m)] if joint in positions else []
                columns.append(np.degrees(angles[:, joint]))
            file.write(format_rows(np.hstack(columns), BVH_DECIMALS))


def compute_euler_angles(
    rotations: Float[np.ndarray, "T J 3 3"], rotation_order: str = "ZYX", before: Float[np.ndarray, "J 3"] | None = None
) -> Float[np.ndarray, "T J 3"]:
    """Return the Euler angles (rad) of rotations, each joint continuous over time, from those `before` the first frame on.

    A rotation is the product of the three rotations about the axes in `rotation_order`. A step is at most a right angle plus the
    rotation of the motion itself. It comes close to that only if the motion passes gimbal lock at a smaller angle than it
    rotates in a frame.
    """
    axes = np.array(["XYZ".index(axis) for axis in rotation_order])
    angles = np.empty((*rotations.shape[:2], 3))
    for joint, start in enumerate(np.zeros((rotations.shape[1], 3)) if before is None else before):
        own = np.ascontiguousarray(rotations[:, joint], float)
        angles[:, joint] = euler_angles.compute_continuous_euler_angles(own, axes, start)
    return angles


def _iterate_depth_first(skeleton: Skeleton, joint: int = 0, depth: int = 0) -> Iterator[tuple[int, int]]:
    """Yield joint and depth in the order in which BVH lists joints and their channels."""
    yield joint, depth
    for child in np.flatnonzero(skeleton.parents == joint):
        yield from _iterate_depth_first(skeleton, int(child), depth + 1)


def _build_hierarchy(
    target: Path,
    skeleton: Skeleton,
    joints: list[tuple[int, int]],
    positioned_joints: Collection[int],
    unit_m: float,
    rotation_order: str,
) -> Iterator[str]:
    """Yield the lines of the HIERARCHY section."""
    yield "HIERARCHY\n"
    rotation_channels = " ".join(f"{axis}rotation" for axis in rotation_order)
    for (joint, depth), next_depth in zip(joints, [*(depth for _, depth in joints[1:]), 0], strict=True):
        name, indent = skeleton.names[joint], "\t" * depth
        is_positioned = joint in positioned_joints
        position_channels = "Xposition Yposition Zposition " if is_positioned else ""
        offset = skeleton.offsets[joint] if depth else np.zeros(3)  # the position of the root is in its channels
        yield f"{indent}{'JOINT' if depth else 'ROOT'} {name}\n{indent}{{\n"
        yield f"{indent}\tOFFSET {_format_vector(offset, unit_m)}\n"
        yield f"{indent}\tCHANNELS {6 if is_positioned else 3} {position_channels}{rotation_channels}\n"
        if next_depth <= depth:
            end = skeleton.ends[joint]
            if not np.linalg.norm(end) > 0:
                raise WriteError(f"{target}: the last bone {name} has no length; give it an end in the subject file.")
            yield f"{indent}\tEnd Site\n{indent}\t{{\n{indent}\t\tOFFSET {_format_vector(end, unit_m)}\n{indent}\t}}\n"
        yield from ("\t" * level + "}\n" for level in range(depth, next_depth - 1, -1))


def _format_vector(vector: Float[np.ndarray, " 3"], unit_m: float) -> str:
    return " ".join(f"{x * (1 / unit_m):.{BVH_DECIMALS}f}" for x in vector)


def write_bvh(
    target: Path, skeleton: Skeleton, motion: Motion, rate: float, unit_m: float = CENTIMETRE_M, rotation_order: str = "ZYX"
) -> None:
    """Write a motion.

    Args:
        rate: Frames per second.
        unit_m: Metres per unit of the file.
        rotation_order: Order of a joint's rotation channels, the outermost first.

    Raises:
        WriteError: If `target` is not writable or a leaf of the skeleton has no end site.
    """
    write_bvh_tree(target, skeleton, {0: motion.root_position}, motion.local_rotations, rate, unit_m, rotation_order)
