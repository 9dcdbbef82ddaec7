"""Read an ASF file, Acclaim's skeleton: bones with a direction and a length in the rest pose, and their own axes.

Source: Lander 1998, "Working with motion capture file formats"; CMU's files. A bone begins where its parent ends. Its joint
is placed at the beginning of the bone and has its name.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NoReturn

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from mocapfix.errors import ReadError
from mocapfix.io.file_content import BYTE_ORDER_MARK, parse_number

METRES_PER_INCH = 0.0254  # lengths times the file's `length` are inches, as in CMU's files
ROOT_NAME = "root"
DEGREES_OF_FREEDOM = ("tx", "ty", "tz", "rx", "ry", "rz", "l")
CHANNEL_SUFFIXES = {"t": "position", "r": "rotation", "l": "Length"}  # of a channel's name, by the kind of degree of freedom


@dataclass
class AsfBone:
    """A bone as the file describes it.

    Attributes:
        name: Its name.
        line_number: Line on which its description begins.
        direction: Unit vector from its beginning to its end in the rest pose, in world axes.
        length: Length in file units.
        rotation_world_bone: Rotation from its own axes to world axes in the rest pose.
        degrees_of_freedom: Names such as "rx", in the order of the AMC's values. The first rotation is the innermost.
        parent: Name of the bone at whose end it begins, "" for the root.
    """

    name: str
    line_number: int
    direction: Float[np.ndarray, " 3"] = field(default_factory=lambda: np.zeros(3))
    length: float = 0.0
    rotation_world_bone: Float[np.ndarray, "3 3"] = field(default_factory=lambda: np.eye(3))
    degrees_of_freedom: tuple[str, ...] = ()
    parent: str = ""

    @property
    def tip_offset(self) -> Float[np.ndarray, " 3"]:
        """Vector from its beginning to its end in the rest pose, in file units and world axes."""
        return self.direction * self.length

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
    """The skeleton of an ASF.

    Attributes:
        bones: Parents before children; the first is the root.
        root_position: Position of the root in file units.
        unit_m: Metres per file unit.
    """

    bones: tuple[AsfBone, ...]
    root_position: Float[np.ndarray, " 3"]
    unit_m: float


def parse_asf(path: Path, text: str) -> AsfSkeleton:
    """Parse the text of an ASF.

    Raises:
        ReadError: If it is invalid. The message names file and line.
    """
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
        for self.line_number, line in enumerate(text.removeprefix(BYTE_ORDER_MARK).splitlines(), start=1):
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
        *angles, order = words or [""]
        if sorted(order.upper()) != ["X", "Y", "Z"]:
            self.raise_error(f"{order!r} is not an order of the axes X, Y, Z")
        numbers = self.parse_numbers(angles, 3)
        return Rotation.from_euler(order.lower(), numbers, degrees=self.uses_degrees).as_matrix()

    def parse_numbers(self, words: list[str], count: int) -> list[float]:
        try:
            numbers = [parse_number(word) for word in words]
        except ValueError:
            numbers = []
        if len(numbers) != count or not np.isfinite(numbers).all():
            expected = "a number is" if count == 1 else f"{count} numbers are"
            self.raise_error(f"{' '.join(words) or 'nothing'} is given where {expected} expected")
        return numbers

    def raise_error(self, problem: str) -> NoReturn:
        raise ReadError(f"{self.path}, line {self.line_number}: {problem}.")
