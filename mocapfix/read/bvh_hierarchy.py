"""The HIERARCHY of a BVH: joints, offsets, channels and end sites, line by line."""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NoReturn

import numpy as np

from mocapfix.errors import ReadError

ITEM_PATTERN = re.compile(r"([{}])|[ \t]+(?=(?:OFFSET|CHANNELS)\s+[-+.\d])", re.IGNORECASE)  # several may be on a line
CHANNEL_PATTERN = re.compile(r"([XYZ])(position|rotation)", re.IGNORECASE)


@dataclass(frozen=True)
class BvhHierarchy:
    """J joints, parents before children, as `Animation` has them."""

    names: tuple[str, ...]
    parents: np.ndarray
    offsets: np.ndarray
    end_sites: tuple[np.ndarray, ...]
    channels: tuple[tuple[str, ...], ...]


@dataclass
class _BvhJoint:
    name: str
    parent: int
    offset: list[float] | None = None
    channels: tuple[str, ...] = ()
    end_sites: list[list[float]] = field(default_factory=list)


def parse_hierarchy(path: Path, text: bytes) -> BvhHierarchy:
    """-> the tree that a BVH's text before MOTION describes, keywords in upper or lower case.

    Raises ReadError with the line where it is not as it should be.
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
    """-> line number and text of each item, of which there may be several on a line."""
    try:
        lines = text.decode("utf-8").splitlines()
    except UnicodeDecodeError:
        lines = text.decode("latin-1").splitlines()
    for number, line in enumerate(lines, start=1):
        yield from ((number, item.strip()) for item in ITEM_PATTERN.split(line) if item and item.strip())


class _HierarchyParser:
    """Where the reading of a hierarchy stands: the joints so far, and the braces that are open."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.joints: list[_BvhJoint] = []
        self.open_joints: list[int | None] = []  # joints by index, None for an end site
        self.pending_joints: list[int | None] = []  # what the next brace opens

    def parse(self, items: Iterator[tuple[int, str]]) -> list[_BvhJoint]:
        line = 1
        for line, item in items:
            self.item(line, item)
        if self.open_joints or self.pending_joints:
            self.raise_error(
                line, f"the hierarchy ends with {len(self.open_joints) + len(self.pending_joints)} braces not closed"
            )
        if not self.joints:
            self.raise_error(1, "the hierarchy holds no ROOT")
        for joint in self.joints:
            if joint.offset is None:
                self.raise_error(line, f"joint {joint.name} has no OFFSET")
        return self.joints

    def parse_item(self, line: int, item: str) -> None:
        keyword, _, rest = item.replace("\t", " ").partition(" ")
        match keyword.upper():
            case "HIERARCHY":
                pass
            case "ROOT" | "JOINT":
                self.add_joint(line, keyword, rest.strip())
            case "END":
                self.get_open_joint(line, item)
                self.pending_joints.append(None)
            case "{":
                if not self.pending_joints:
                    self.raise_error(line, "a brace opens where no joint is named")
                self.open_joints.append(self.pending_joints.pop())
            case "}":
                if not self.open_joints:
                    self.raise_error(line, "a brace closes that was not opened")
                self.open_joints.pop()
            case "OFFSET":
                self.add_offset(line, rest)
            case "CHANNELS":
                self.set_channels(line, rest)
            case _:
                self.raise_error(line, f"{item[:40]!r} is none of ROOT, JOINT, End Site, OFFSET, CHANNELS")

    def add_joint(self, line: int, keyword: str, name: str) -> None:
        if keyword.upper() == "ROOT" and self.joints:
            self.raise_error(line, f"a second ROOT, {name}, follows {self.joints[0].name}; give each figure a file of its own")
        if not name:
            self.raise_error(line, "a joint has no name")
        parent = -1 if keyword.upper() == "ROOT" else self.get_open_joint(line, f"JOINT {name}")
        self.joints.append(_BvhJoint(name, parent))
        self.pending_joints.append(len(self.joints) - 1)

    def add_offset(self, line: int, rest: str) -> None:
        joint = self.joints[self.open_joints[-1]] if self.open_joints and self.open_joints[-1] is not None else None
        try:
            vector = [float(word) for word in rest.split()]
        except ValueError:
            self.raise_error(line, f"OFFSET {rest} are no three numbers")
        if len(vector) != 3 or not np.isfinite(vector).all():
            self.raise_error(line, f"OFFSET {rest} are no three numbers")
        if joint:
            joint.offset = vector
        elif len(self.open_joints) > 1 and (parent := self.open_joints[-2]) is not None:
            self.joints[parent].end_sites.append(vector)
        else:
            self.raise_error(line, "an OFFSET stands outside of any joint")

    def set_channels(self, line: int, rest: str) -> None:
        joint = self.joints[self.get_open_joint(line, "CHANNELS")]
        count, *names = rest.split() or [""]
        told = [CHANNEL_PATTERN.fullmatch(name) for name in names]
        if not all(told):
            self.raise_error(line, f"channel {names[told.index(None)]} is neither a position nor a rotation about X, Y or Z")
        if count != str(len(names)):
            self.raise_error(line, f"{count or 'no number of'} channels are announced and {len(names)} named")
        joint.channels = tuple(each[1].upper() + each[2].lower() for each in told if each)

    def get_open_joint(self, line: int, what: str) -> int:
        """-> the joint whose braces are open."""
        if not self.open_joints or self.open_joints[-1] is None or self.pending_joints:
            self.raise_error(line, f"{what} stands outside of any joint; a brace is missing or too many before it")
        return self.open_joints[-1]

    def raise_error(self, line: int, what: str) -> NoReturn:
        raise ReadError(f"{self.path}, line {line}: {what}.")
