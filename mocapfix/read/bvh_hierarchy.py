"""The HIERARCHY section of a BVH file: joints, offsets, channels and end sites."""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NoReturn

import numpy as np
from jaxtyping import Float, Int

from mocapfix.errors import ReadError
from mocapfix.read.file_content import COMMENT_LINE_PATTERN, MAX_QUOTED_CHARACTERS, parse_number

# Separators of the items of a line, of which there may be several.
ITEM_PATTERN = re.compile(r"([{}])|[ \t]+(?=(?:OFFSET|CHANNELS)\s+[-+.\d])", re.IGNORECASE)
CHANNEL_PATTERN = re.compile(r"([XYZ])(position|rotation)", re.IGNORECASE)


@dataclass(frozen=True)
class BvhHierarchy:
    """The J joints of a BVH, parents before children. The fields are those of `Animation`."""

    names: tuple[str, ...]
    parents: Int[np.ndarray, " J"]
    offsets: Float[np.ndarray, "J 3"]
    end_sites: tuple[Float[np.ndarray, "_ 3"], ...]
    channels: tuple[tuple[str, ...], ...]


@dataclass
class _BvhJoint:
    name: str
    parent: int
    offset: list[float] | None = None
    channels: tuple[str, ...] = ()
    end_sites: list[list[float]] = field(default_factory=list[list[float]])


def parse_hierarchy(path: Path, text: bytes) -> BvhHierarchy:
    """Parse the text of a BVH before MOTION, with keywords in any case.

    Raises:
        ReadError: If the hierarchy is invalid. The message names file and line.
    """
    joints = _HierarchyParser(path).parse(_split_items(text.removeprefix(b"\xef\xbb\xbf")))
    return BvhHierarchy(
        names=tuple(joint.name for joint in joints),
        parents=np.array([joint.parent for joint in joints]),
        offsets=np.array([joint.offset for joint in joints], float),
        end_sites=tuple(np.array(joint.end_sites, float).reshape(-1, 3) for joint in joints),
        channels=tuple(joint.channels for joint in joints),
    )


def _split_items(text: bytes) -> Iterator[tuple[int, str]]:
    """Yield line number and text of each item; a line may have several, and a comment has none."""
    try:
        lines = text.decode("utf-8").splitlines()
    except UnicodeDecodeError:
        lines = text.decode("latin-1").splitlines()
    for line_number, line in enumerate(lines, start=1):
        if COMMENT_LINE_PATTERN.match(line):
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
                quoted = repr(item[:MAX_QUOTED_CHARACTERS])
                self.raise_error(line_number, f"{quoted} is not one of ROOT, JOINT, End Site, OFFSET, CHANNELS")

    def add_joint(self, line_number: int, keyword: str, name: str) -> None:
        if keyword.upper() == "ROOT" and self.joints:
            problem = f"a second ROOT, {name}, follows {self.joints[0].name}"
            self.raise_error(line_number, f"{problem}; give each figure its own file")
        if not name:
            self.raise_error(line_number, "a joint has no name")
        parent = -1 if keyword.upper() == "ROOT" else self.get_open_joint(line_number, f"JOINT {name}")
        self.joints.append(_BvhJoint(name, parent))
        self.pending_joints.append(len(self.joints) - 1)

    def add_offset(self, line_number: int, rest: str) -> None:
        """Set the offset of the open joint, or add an end site to its parent."""
        joint = self.joints[self.open_joints[-1]] if self.open_joints and self.open_joints[-1] is not None else None
        try:
            vector = [parse_number(word) for word in rest.split()]
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
