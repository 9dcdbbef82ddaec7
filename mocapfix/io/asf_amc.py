"""Read and write ASF/AMC, the format of CMU's motion capture: a skeleton in one file, the values of a trial in another.

Source: Lander 1998, "Working with motion capture file formats"; CMU's files. A bone of an ASF has a direction and a length in the
rest pose, and begins where its parent ends; its joint is placed at its beginning and has its name. It has its own axes, rotated
by C from the world's in the rest pose, and its rotation M in the AMC is about those, with x as the innermost rotation. In world
axes it is C M C^-1.

Files are written in the form of CMU's: names, order and axes of its bones, lengths in inches times 0.45. Knees and elbows are
hinges in CMU's files; here every bone that rotates has three degrees of freedom, so that the motion is unchanged.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NoReturn

import numpy as np
from jaxtyping import Float, Int

from mocapfix.errors import ReadError, WriteError, format_name_list
from mocapfix.io import file_content
from mocapfix.io.conventions import infer_conventions
from mocapfix.io.files import replace_atomically
from mocapfix.io.frame_rate import FileFrames, choose_rate, count_frame_steps, describe_missing_frames
from mocapfix.io.shipped import read_shipped_yaml
from mocapfix.io.source_file import format_rows
from mocapfix.kernels import euler_angles
from mocapfix.model.animation import Animation
from mocapfix.model.motion import Motion
from mocapfix.model.skeleton import Skeleton
from mocapfix.options import DEFAULT_READ_OPTIONS, ReadOptions

METRES_PER_INCH = 0.0254  # lengths times the file's `length` are inches, as in CMU's files
ROOT_NAME = "root"
DEGREES_OF_FREEDOM = ("tx", "ty", "tz", "rx", "ry", "rz", "l")
CHANNEL_SUFFIXES = {"t": "position", "r": "rotation", "l": "Length"}  # of a channel's name, by the kind of degree of freedom


@dataclass
class AsfBone:
    """A bone as the file describes it.

    Attributes:
        direction: Unit vector from its beginning to its end in the rest pose, in world axes.
        rotation_world_bone: Rotation from its own axes to world axes in the rest pose.
        degrees_of_freedom: Names such as "rx", in the order of the AMC's values. The first rotation is the innermost.
    """

    name: str  # its name
    line_number: int  # line on which its description begins
    direction: Float[np.ndarray, " 3"] = field(default_factory=lambda: np.zeros(3))
    length: float = 0.0  # length in file units
    rotation_world_bone: Float[np.ndarray, "3 3"] = field(default_factory=lambda: np.eye(3))
    degrees_of_freedom: tuple[str, ...] = ()
    parent: str = ""  # name of the bone at whose end it begins, "" for the root

    @property
    def amc_columns(self) -> list[int]:
        """Index of each of its channels among its values in the AMC. The outermost rotation is the first rotation channel."""
        rotations = [i for i, name in enumerate(self.degrees_of_freedom) if name[0] == "r"]
        return [i for i in range(len(self.degrees_of_freedom)) if i not in rotations] + rotations[::-1]

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of its channels, as in `Animation`."""
        names = (self.degrees_of_freedom[i] for i in self.amc_columns)
        return tuple(name[1:].upper() + CHANNEL_SUFFIXES[name[0]] for name in names)


@dataclass(frozen=True)
class AsfSkeleton:
    """The skeleton of an ASF."""

    bones: tuple[AsfBone, ...]  # parents before children; the first is the root
    root_position: Float[np.ndarray, " 3"]  # position of the root in file units
    unit_m: float  # metres per file unit


def parse_asf(path: Path, text: str) -> AsfSkeleton:
    """Parse the text of an ASF."""
    return _AsfParser(path).parse(text)


class _AsfParser:
    """State of the parser: the bones so far, the bone that is being described, and the current section."""

    def __init__(self, path: Path) -> None:
        self.path, self.line_number = path, 0
        self.section = ""
        self.bones = {ROOT_NAME: AsfBone(ROOT_NAME, 1, degrees_of_freedom=("tx", "ty", "tz", "rx", "ry", "rz"))}
        self.current_bone = self.bones[ROOT_NAME]
        self.unit_m, self.uses_degrees = METRES_PER_INCH, True
        self.root_position = np.zeros(3)
        self.root_angles, self.root_axis_order = ["0", "0", "0"], "XYZ"

    def parse(self, text: str) -> AsfSkeleton:
        for self.line_number, line in enumerate(text.removeprefix(file_content.BYTE_ORDER_MARK).splitlines(), start=1):
            keyword, *words = line.split("#")[0].split() or [""]
            if keyword.startswith(":"):
                self.section, keyword = keyword.lower(), ""
            if keyword and keyword.lower() not in ("begin", "end"):
                self.parse_line(keyword, words)
        self.bones[ROOT_NAME].rotation_world_bone = self.parse_rotation([*self.root_angles, self.root_axis_order])
        bones = tuple(self.iterate_bones(ROOT_NAME))
        reached = {bone.name for bone in bones}
        for bone in self.bones.values():
            if bone.name not in reached:
                self.line_number = bone.line_number
                self.raise_error(f"bone {bone.name} has no parent in the hierarchy")
        if len(bones) == 1:
            self.raise_error("the skeleton has no bones in :bonedata")
        return AsfSkeleton(bones, self.root_position, self.unit_m)

    def parse_line(self, keyword: str, words: list[str]) -> None:
        match self.section, keyword.lower():
            case ":units", "length":
                if (length := self.parse_numbers(words, 1)[0]) <= 0:
                    self.raise_error(f"the unit of length is {words[0]} and must be positive; CMU's is 0.45")
                self.unit_m = METRES_PER_INCH / length
            case ":units", "angle":
                self.uses_degrees = words != ["rad"]
            case (":root", "order") | (":bonedata", "dof"):
                self.current_bone.degrees_of_freedom = self.parse_degrees_of_freedom(words)
            case ":root", "axis":
                self.root_axis_order = " ".join(words)
            case ":root", "position":
                self.root_position = np.array(self.parse_numbers(words, 3))
            case ":root", "orientation":
                self.root_angles = words
            case ":bonedata", "name":
                self.begin_bone(" ".join(words))
            case ":bonedata", "direction":
                self.current_bone.direction = np.array(self.parse_numbers(words, 3))
            case ":bonedata", "length":
                (self.current_bone.length,) = self.parse_numbers(words, 1)
            case ":bonedata", "axis":
                self.current_bone.rotation_world_bone = self.parse_rotation(words)
            case ":hierarchy", _:
                self.add_children(keyword, words)
            case _:
                pass

    def begin_bone(self, name: str) -> None:
        if name in self.bones or not name:
            self.raise_error(f"there is a second bone {name}" if name else "a bone has no name")
        self.current_bone = self.bones[name] = AsfBone(name, self.line_number)

    def add_children(self, parent: str, children: list[str]) -> None:
        for name in (parent, *children):
            if name not in self.bones:
                self.raise_error(f"bone {name} is in the hierarchy and not in :bonedata")
        for child in children:
            if self.bones[child].parent or child == ROOT_NAME:
                self.raise_error(f"bone {child} has two parents")
            self.bones[child].parent = parent

    def iterate_bones(self, name: str) -> Iterator[AsfBone]:
        """Yield a bone and its descendants, parents before children."""
        yield self.bones[name]
        for child in self.bones.values():
            if child.parent == name:
                yield from self.iterate_bones(child.name)

    def parse_degrees_of_freedom(self, words: list[str]) -> tuple[str, ...]:
        for word in words:
            if word.lower() not in DEGREES_OF_FREEDOM:
                self.raise_error(f"{word} is not one of the degrees of freedom {', '.join(DEGREES_OF_FREEDOM)}")
        return tuple(word.lower() for word in words)

    def parse_rotation(self, words: list[str]) -> Float[np.ndarray, "3 3"]:
        """Return the rotation given by three angles and the order of their axes, the innermost first."""
        from scipy.spatial.transform import Rotation  # slow to import

        *angles, order = words or [""]
        if sorted(order.upper()) != ["X", "Y", "Z"]:
            self.raise_error(f"{order!r} is not an order of the axes X, Y, Z")
        numbers = self.parse_numbers(angles, 3)
        return Rotation.from_euler(order.lower(), numbers, degrees=self.uses_degrees).as_matrix()

    def parse_numbers(self, words: list[str], count: int) -> list[float]:
        try:
            numbers = [file_content.parse_number(word) for word in words]
        except ValueError:
            numbers = []
        if len(numbers) != count or not np.isfinite(numbers).all():
            expected = "a number is" if count == 1 else f"{count} numbers are"
            self.raise_error(f"{' '.join(words) or 'nothing'} is given where {expected} expected")
        return numbers

    def raise_error(self, problem: str) -> NoReturn:
        raise ReadError(f"{self.path}, line {self.line_number}: {problem}.")


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


def is_asf_or_amc(head: bytes) -> bool:
    """Return whether a file with this beginning is an AMC or an ASF."""
    lower = head.lower()
    return BONE_SECTION_KEYWORD in lower or lower.lstrip().startswith(AMC_KEYWORDS) or AMC_HEAD_PATTERN.match(head) is not None


def read_amc_motion(path: Path, data: bytes, options: ReadOptions) -> Animation:
    """Return the motion in the bytes of an AMC, as `read_amc` does, and raise ReadError for an ASF, which has none."""
    if BONE_SECTION_KEYWORD in file_content.convert_to_utf_8(path, data).lower():
        raise ReadError(f"{path}: is a skeleton without motion; name the AMC file of the motion.")
    return read_amc(path, data, options=options)


def read_amc(
    path: str | Path, data: bytes | None = None, asf_path: str | Path | None = None, options: ReadOptions = DEFAULT_READ_OPTIONS
) -> Animation:
    """Read the motion of an AMC, or the rest pose of an ASF as one frame.

    Joints are at the beginning of bones and have their names. Angles are in degrees, whatever the file uses.

    Args:
        data: The bytes of the file, if they were read already.
        asf_path: The skeleton of an AMC; by default the one that `find_asf` finds.
        options: What is known about the motion.

    Raises:
        ReadError: If there is no skeleton, or a file is invalid. The message names file and line.
    """
    path = Path(path)
    data = file_content.convert_to_utf_8(path, file_content.read_file_bytes(path) if data is None else data)
    if BONE_SECTION_KEYWORD in data.lower():
        skeleton = parse_asf(path, file_content.decode_text(data)[0])
        width = sum(len(bone.degrees_of_freedom) for bone in skeleton.bones)
        notes = ("It is a skeleton without motion, in its rest pose.",)
        rest = _build_animation(path, skeleton, np.zeros((1, width)), DEFAULT_AMC_RATE_HZ, notes, 1)
        return infer_conventions(rest, options)
    skeleton_path = Path(asf_path) if asf_path is not None else find_asf(path)
    skeleton = parse_asf(skeleton_path, file_content.decode_text(file_content.read_file_bytes(skeleton_path))[0])
    start = FIRST_FRAME_PATTERN.search(data)
    if not start:
        raise ReadError(f"{path}: has no frames; an AMC has a line with the number of each frame. Export it again.")
    header, tokens = data[: start.start()], file_content.scan_tokens(data, start.start())
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


def _build_animation(
    path: Path, skeleton: AsfSkeleton, values: Float[np.ndarray, "T C"], rate: float, notes: tuple[str, ...], first_frame: int
) -> Animation:
    """Return the animation of a skeleton with inferred unit and up axis. The values are in the order of its channels."""
    names = tuple(bone.name for bone in skeleton.bones)
    parents = np.array([names.index(bone.parent) if bone.parent else -1 for bone in skeleton.bones])
    tips = np.array([bone.direction * bone.length for bone in skeleton.bones])  # from their beginnings
    is_leaf = [joint not in parents for joint in range(len(names))]
    offsets, channels = np.vstack([skeleton.root_position, tips[parents[1:]]]), tuple(bone.channels for bone in skeleton.bones)
    end_sites = tuple(tip[None] if leaf else np.empty((0, 3)) for tip, leaf in zip(tips, is_leaf, strict=True))
    animation = Animation(names, parents, offsets, end_sites, channels, values, rate, path, first_frame)
    return replace(
        animation,
        unit_m=skeleton.unit_m,
        rest_rotations=np.array([bone.rotation_world_bone for bone in skeleton.bones]),
        is_position_added=np.ones(len(names), bool),
        notes=notes,
    )


def _locate_values(
    path: Path, tokens: file_content.TextTokens, skeleton: AsfSkeleton
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
        quoted = repr(tokens.get_text(token)[: file_content.MAX_QUOTED_CHARACTERS])
        problem = f"{quoted} is given where the values of a bone or the number of a frame are expected"
        raise ReadError(f"{path}, line {tokens.line_numbers[token]}: {problem}.")
    frame_of_line = np.cumsum(~is_bone_line)
    names = [bone.name for bone in skeleton.bones]
    bone_of_line = _match_names(tokens, line_tokens, names)
    for line in np.flatnonzero(is_bone_line & (bone_of_line < 0)).tolist():  # names that are not valid UTF-8, too
        name = tokens.get_text(int(line_tokens[line]))
        if name not in names:
            line_number = tokens.line_numbers[line_tokens[line]]
            raise ReadError(
                f"{path}, line {line_number}: bone {name[: file_content.MAX_QUOTED_CHARACTERS]} is not in the skeleton."
            )
        bone_of_line[line] = names.index(name)
    columns: list[np.ndarray] = []
    frame_tokens = line_tokens[~is_bone_line]  # the frame numbers
    for index, bone in enumerate(skeleton.bones):
        if bone.degrees_of_freedom:
            own = np.flatnonzero(is_bone_line & (bone_of_line == index))
            width, values = len(bone.degrees_of_freedom), token_counts[own] - 1
            counts = np.bincount(frame_of_line[own], minlength=len(frame_tokens) + 1)[1:]
            if (counts != 1).any():
                frame = int(np.argmax(counts != 1))
                line, number = tokens.line_numbers[frame_tokens[frame]], tokens.get_text(int(frame_tokens[frame]))
                problem = "occurs twice" if counts[frame] > 1 else "is missing"
                raise ReadError(f"{path}, line {line}: bone {bone.name} {problem} in frame {number}.")
            if (values != width).any():
                wrong = int(np.argmax(values != width))
                problem = f"bone {bone.name} has {values[wrong]} values and {width} degrees of freedom"
                raise ReadError(f"{path}, line {tokens.line_numbers[line_tokens[own][wrong]]}: {problem}.")
            columns.append(line_tokens[own, None] + 1 + np.array(bone.amc_columns))
    return tokens.values[line_tokens[~is_bone_line]], np.hstack(columns)


def _match_names(tokens: file_content.TextTokens, line_tokens: Int[np.ndarray, " L"], names: list[str]) -> Int[np.ndarray, " L"]:
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


CMU_LENGTH_FACTOR = 0.45  # of lengths in inches
CMU_LENGTH_UNIT_M = 0.0254 / CMU_LENGTH_FACTOR
# Degrees about x, y, z by which the axes of CMU's left bones are rotated; those of the right bones are the mirror image.
CMU_BONE_AXES_DEG = {
    "femur": (0, 0, 20),
    "tibia": (0, 0, 20),
    "foot": (-90, 0, 20),
    "toes": (-90, 0, 20),
    "humerus": (180, -30, -90),
    "radius": (180, -30, -90),
    "thumb": (-90, 45, 0),
    "wrist": (0, 90, 90),
    "hand": (0, 90, 90),
    "fingers": (0, 90, 90),
}
FIXED_BONES = ("lhipjoint", "rhipjoint")  # without degrees of freedom, unless the motion rotates them
ZYX_AXES = np.array([2, 1, 0])  # the outermost first
MAX_JOINT_DISTANCE_M = 1e-7  # between joints that begin at the same position
GAP_BONE_SUFFIX = "base"  # of a fixed bone from the end of a joint's parent to the joint
AMC_DECIMALS = 6  # of every number
ASF_HEADER = f"""\
:version 1.10
:name VICON
:units
  mass 1.0
  length {CMU_LENGTH_FACTOR}
  angle deg
:documentation
   Written by mocapfix.
:root
   order TX TY TZ RX RY RZ
   axis XYZ
   position 0 0 0
   orientation 0 0 0
:bonedata
"""


def write_asf_amc(
    asf_target: Path, amc_target: Path, skeleton: Skeleton, motion: Motion, rate: float, first_frame: int = 1
) -> None:
    """Write a skeleton as ASF and its motion as AMC. Both files are replaced, or neither.

    The AMC has the rate in hertz in a comment, because the format has no keyword for it.

    Raises:
        WriteError: If the motion is incomplete, or a file is not writable.
    """
    names = get_cmu_bone_names(skeleton)
    if not (np.isfinite(motion.root_position).all() and np.isfinite(motion.local_rotations).all()):
        raise WriteError(f"{amc_target}: the motion has missing frames, which an AMC cannot represent.")
    is_rotating = [
        name not in FIXED_BONES or not np.allclose(motion.local_rotations[:, joint], np.eye(3))
        for joint, name in enumerate(names)
    ]
    bone_data = "".join(_build_bone_data(skeleton, names, is_rotating))
    asf = ASF_HEADER + bone_data + "".join(_build_hierarchy(skeleton, names))
    with replace_atomically(Path(asf_target)) as asf_part, replace_atomically(Path(amc_target)) as amc_part:
        asf_part.write_bytes(asf.encode("ascii"))
        amc_part.write_bytes(_build_frames(names, is_rotating, motion, rate, first_frame))


def get_cmu_bone_names(skeleton: Skeleton) -> list[str]:
    """Return CMU's name of the bone that begins at each joint."""
    acclaim = read_shipped_yaml("hierarchies/acclaim.yaml")["joints"]
    return [acclaim[name][0] for name in skeleton.names]


def get_bone_axes_deg(bone: str) -> tuple[float, float, float]:
    """Return the degrees about x, y, z, in this order, by which the axes of a bone are rotated in the rest pose."""
    x, y, z = CMU_BONE_AXES_DEG.get(bone[1:], (0, 0, 0))
    return (x, y, z) if bone[0] == "l" else (x, -y, -z)


def _build_bone_data(skeleton: Skeleton, names: list[str], is_rotating: list[bool]) -> Iterator[str]:
    """Yield the text of each bone except the root, and of the fixed one before it where it begins beside its parent's end."""
    dof = "    dof rx ry rz\n    limits (-180.0 180.0)\n" + "           (-180.0 180.0)\n" * 2
    gaps = _measure_gaps(skeleton)
    for joint, name in list(enumerate(names))[1:]:
        bones = [(joint, name, _find_tip(skeleton, joint), get_bone_axes_deg(name), dof * is_rotating[joint])]
        if joint in gaps:
            bones.insert(0, (len(names) + joint, name + GAP_BONE_SUFFIX, gaps[joint], (0.0, 0.0, 0.0), ""))
        for number, bone, tip, axes, freedom in bones:
            length = float(np.linalg.norm(tip))
            direction = tip / length if length > 0 else np.array([0.0, 1.0, 0.0])
            direction_text, axes_text = (" ".join(f"{x + 0.0:.15g}" for x in vector) for vector in (direction, axes))
            yield f"  begin\n     id {number}\n     name {bone}\n     direction {direction_text}\n"
            yield f"     length {length / CMU_LENGTH_UNIT_M:.15g}\n     axis {axes_text} XYZ\n{freedom}  end\n"


def _find_tip(skeleton: Skeleton, joint: int) -> Float[np.ndarray, " 3"]:
    """Return the vector (m) from the beginning of a bone to its end: where its first child begins, or the end site."""
    children = np.flatnonzero(skeleton.parents == joint)
    return skeleton.offsets[children[0]] if len(children) else np.nan_to_num(skeleton.ends[joint])


def _measure_gaps(skeleton: Skeleton) -> dict[int, Float[np.ndarray, " 3"]]:
    """Return by joint the vector (m) from the end of its parent, which is a point if it is the root, if it begins elsewhere."""
    parents = skeleton.parents.tolist()
    gaps = {j: skeleton.offsets[j] - (_find_tip(skeleton, p) if p else 0.0) for j, p in enumerate(parents) if p >= 0}
    return {joint: gap for joint, gap in gaps.items() if np.linalg.norm(gap) > MAX_JOINT_DISTANCE_M}


def _build_hierarchy(skeleton: Skeleton, names: list[str]) -> Iterator[str]:
    gaps = _measure_gaps(skeleton)
    yield ":hierarchy\n  begin\n"
    for joint, name in enumerate(names):
        if len(children := np.flatnonzero(skeleton.parents == joint)):
            yield f"    {name} {' '.join(names[child] + GAP_BONE_SUFFIX * (child in gaps) for child in children)}\n"
            yield from (f"    {names[child]}{GAP_BONE_SUFFIX} {names[child]}\n" for child in children if child in gaps)
    yield "  end\n"


def _build_frames(names: list[str], is_rotating: list[bool], motion: Motion, rate: float, first_frame: int) -> bytes:
    """Return the AMC: for every frame its number and a line for each bone that rotates."""
    from scipy.spatial.transform import Rotation  # slow to import

    columns = [[f"{frame}\n".encode() for frame in range(first_frame, first_frame + motion.frame_count)]]
    for joint, name in enumerate(names):
        if is_rotating[joint]:
            rotation_world_bone = Rotation.from_euler("xyz", get_bone_axes_deg(name), degrees=True).as_matrix()
            rotations = np.ascontiguousarray(rotation_world_bone.T @ motion.local_rotations[:, joint] @ rotation_world_bone)
            angles_zyx = euler_angles.compute_continuous_euler_angles(rotations, ZYX_AXES, np.zeros(3))
            degrees = np.degrees(angles_zyx)[:, ::-1]
            numbers = np.hstack([motion.root_position / CMU_LENGTH_UNIT_M, degrees]) if joint == 0 else degrees
            lines = format_rows(numbers, AMC_DECIMALS).splitlines(keepends=True)
            columns.append([name.encode() + b" " + line for line in lines])
    header = f"#!OML:ASF written by mocapfix, {rate:.10g} frames a second\n:FULLY-SPECIFIED\n:DEGREES\n".encode("ascii")
    return header + b"".join(line for frame in zip(*columns, strict=True) for line in frame)
