"""Reading an ASF, Acclaim's skeleton: bones with a direction and a length in the rest pose, and axes of their own.

Source: Lander 1998, "Working with motion capture file formats"; CMU's own files. A bone begins where its parent ends, so a
joint is put at its beginning and carries its name.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NoReturn

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.errors import ReadError

METRES_PER_INCH = 0.0254  # metres: lengths times the file's `length` are inches, as CMU has it
ROOT_NAME = "root"
DEGREES_OF_FREEDOM = ("tx", "ty", "tz", "rx", "ry", "rz", "l")
CHANNEL_SUFFIXES = {"t": "position", "r": "rotation", "l": "Length"}


@dataclass
class AsfBone:
    """A bone as the file has it.

    direction  (3,) from its beginning to its end in the rest pose, in the world's axes
    length    file units
    axes      (3, 3) its own axes in the world, in the rest pose
    freedoms  what it may do, in the order of the AMC's numbers: rx, tz, l; the first rotation is the innermost
    parent    the name of the bone it begins at, "" for the root
    """

    name: str
    line_number: int
    direction: np.ndarray = field(default_factory=lambda: np.zeros(3))
    length: float = 0.0
    rotation_world_bone: np.ndarray = field(default_factory=lambda: np.eye(3))
    degrees_of_freedom: tuple[str, ...] = ()
    parent: str = ""

    @property
    def tip_offset(self) -> np.ndarray:
        """(3,) file units: its end from its beginning, in the rest pose."""
        return self.direction * self.length

    @property
    def amc_columns(self) -> list[int]:
        """Which of the AMC's numbers each of the bone's channels is: the outermost rotation comes first there."""
        turning = [i for i, freedom in enumerate(self.degrees_of_freedom) if freedom[0] == "r"]
        return [i for i in range(len(self.degrees_of_freedom)) if i not in turning] + turning[::-1]

    @property
    def channels(self) -> tuple[str, ...]:
        names = (self.degrees_of_freedom[i] for i in self.amc_columns)
        return tuple(name[1:].upper() + CHANNEL_SUFFIXES[name[0]] for name in names)


@dataclass(frozen=True)
class AsfSkeleton:
    """The bones of an ASF, the root first and parents before children; where the root is, in file units; metres a unit."""

    bones: tuple[AsfBone, ...]
    root_position: np.ndarray
    unit_m: float


def parse_asf(path: Path, text: str) -> AsfSkeleton:
    """-> what an ASF's text says.

    Raises ReadError, naming the file, the line and what is wrong there.
    """
    return _AsfParser(path).parse(text)


class _AsfParser:
    """Where the reading of an ASF stands: the bones so far, the one that is described, and the section's name."""

    def __init__(self, path: Path) -> None:
        self.path, self.line = path, 0
        self.section = ""
        self.bones = {ROOT_NAME: AsfBone(ROOT_NAME, 1, degrees_of_freedom=("tx", "ty", "tz", "rx", "ry", "rz"))}
        self.bone = self.bones[ROOT_NAME]
        self.unit, self.degrees = METRES_PER_INCH, True
        self.place = np.zeros(3)
        self.turn, self.order = ["0", "0", "0"], "XYZ"  # of the root, said on lines of their own

    def parse(self, text: str) -> AsfSkeleton:
        for self.line, spelled in enumerate(text.splitlines(), start=1):
            keyword, *words = spelled.split("#")[0].split() or [""]
            if keyword.startswith(":"):
                self.section, keyword = keyword.lower(), ""
            if keyword and keyword.lower() not in ("begin", "end"):
                self.parse_line(keyword, words)
        self.bones[ROOT_NAME].rotation_world_bone = self.parse_rotation([*self.turn, self.order])
        bones = tuple(self.iterate_bones(ROOT_NAME))
        reached = {bone.name for bone in bones}
        for bone in self.bones.values():
            if bone.name not in reached:
                self.line = bone.line_number
                self.raise_error(f"bone {bone.name} hangs on none in the hierarchy")
        if len(bones) == 1:
            self.raise_error("the skeleton ends without bones under :bonedata")
        return AsfSkeleton(bones, self.place, self.unit)

    def parse_line(self, keyword: str, words: list[str]) -> None:
        match self.section, keyword.lower():
            case ":units", "length":
                if (length := self.parse_numbers(words, 1)[0]) <= 0:
                    self.raise_error(f"a unit of {words[0]} is none; CMU's is 0.45")
                self.unit = METRES_PER_INCH / length
            case ":units", "angle":
                self.degrees = words != ["rad"]
            case (":root", "order") | (":bonedata", "dof"):
                self.bone.degrees_of_freedom = self.parse_degrees_of_freedom(words)
            case ":root", "axis":
                self.order = " ".join(words)
            case ":root", "position":
                self.place = np.array(self.parse_numbers(words, 3))
            case ":root", "orientation":
                self.turn = words
            case ":bonedata", "name":
                self.begin_bone(" ".join(words))
            case ":bonedata", "direction":
                self.bone.direction = np.array(self.parse_numbers(words, 3))
            case ":bonedata", "length":
                (self.bone.length,) = self.parse_numbers(words, 1)
            case ":bonedata", "axis":
                self.bone.rotation_world_bone = self.parse_rotation(words)
            case ":hierarchy", _:
                self.children(keyword, words)

    def begin_bone(self, name: str) -> None:
        if name in self.bones or not name:
            self.raise_error(f"a second bone is called {name}" if name else "a bone has no name")
        self.bone = self.bones[name] = AsfBone(name, self.line)

    def add_children(self, parent: str, children: list[str]) -> None:
        for name in (parent, *children):
            if name not in self.bones:
                self.raise_error(f"bone {name} is in the hierarchy and not in :bonedata")
        for child in children:
            if self.bones[child].parent or child == ROOT_NAME:
                self.raise_error(f"bone {child} hangs on two others")
            self.bones[child].parent = parent

    def iterate_bones(self, name: str) -> Iterator[AsfBone]:
        """-> a bone and those that hang on it, parents before children."""
        yield self.bones[name]
        for child in self.bones.values():
            if child.parent == name:
                yield from self.iterate_bones(child.name)

    def parse_degrees_of_freedom(self, words: list[str]) -> tuple[str, ...]:
        for word in words:
            if word.lower() not in DEGREES_OF_FREEDOM:
                self.raise_error(f"{word} is none of the freedoms {', '.join(DEGREES_OF_FREEDOM)}")
        return tuple(word.lower() for word in words)

    def parse_rotation(self, words: list[str]) -> np.ndarray:
        """-> (3, 3), of three angles and the order of their axes, the first of which is turned about first."""
        *angles, order = words or [""]
        if sorted(order.upper()) != ["X", "Y", "Z"]:
            self.raise_error(f"{order!r} is no order of the axes X, Y, Z")
        return Rotation.from_euler(order.lower(), self.parse_numbers(angles, 3), degrees=self.degrees).as_matrix()

    def parse_numbers(self, words: list[str], count: int) -> list[float]:
        try:
            numbers = [float(word) for word in words]
        except ValueError:
            numbers = []
        if len(numbers) != count or not np.isfinite(numbers).all():
            belong = "a number belongs" if count == 1 else f"{count} numbers belong"
            self.raise_error(f"{' '.join(words) or 'nothing'} stands where {belong}")
        return numbers

    def raise_error(self, what: str) -> NoReturn:
        raise ReadError(f"{self.path}, line {self.line}: {what}.")
