"""The HIERARCHY of a BVH: joints, offsets, channels and end sites, line by line."""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NoReturn

import numpy as np

from mocapfix.errors import ReadError

ITEMS = re.compile(r"([{}])|[ \t]+(?=(?:OFFSET|CHANNELS)\s+[-+.\d])", re.IGNORECASE)  # several may be on a line
CHANNEL = re.compile(r"([XYZ])(position|rotation)", re.IGNORECASE)


@dataclass(frozen=True)
class Hierarchy:
    """J joints, parents before children, as `Animation` has them."""

    names: tuple[str, ...]
    parents: np.ndarray
    offsets: np.ndarray
    ends: tuple[np.ndarray, ...]
    channels: tuple[tuple[str, ...], ...]


@dataclass
class _Joint:
    name: str
    parent: int
    offset: list[float] | None = None
    channels: tuple[str, ...] = ()
    ends: list[list[float]] = field(default_factory=list)


def hierarchy(path: Path, text: bytes) -> Hierarchy:
    """-> the tree that a BVH's text before MOTION describes, keywords in upper or lower case.

    Raises ReadError with the line where it is not as it should be.
    """
    joints = _Reading(path).joints(_items(text.removeprefix(b"\xef\xbb\xbf")))
    return Hierarchy(
        names=tuple(joint.name for joint in joints),
        parents=np.array([joint.parent for joint in joints]),
        offsets=np.array([joint.offset for joint in joints], float),
        ends=tuple(np.array(joint.ends, float).reshape(-1, 3) for joint in joints),
        channels=tuple(joint.channels for joint in joints),
    )


def _items(text: bytes) -> Iterator[tuple[int, str]]:
    """-> line number and text of each item, of which there may be several on a line."""
    try:
        lines = text.decode("utf-8").splitlines()
    except UnicodeDecodeError:
        lines = text.decode("latin-1").splitlines()
    for number, line in enumerate(lines, start=1):
        yield from ((number, item.strip()) for item in ITEMS.split(line) if item and item.strip())


class _Reading:
    """Where the reading of a hierarchy stands: the joints so far, and the braces that are open."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.found: list[_Joint] = []
        self.open: list[int | None] = []  # joints by index, None for an end site
        self.waiting: list[int | None] = []  # what the next brace opens

    def joints(self, items: Iterator[tuple[int, str]]) -> list[_Joint]:
        line = 1
        for line, item in items:
            self.item(line, item)
        if self.open or self.waiting:
            self.refuse(line, f"the hierarchy ends with {len(self.open) + len(self.waiting)} braces not closed")
        if not self.found:
            self.refuse(1, "the hierarchy holds no ROOT")
        for joint in self.found:
            if joint.offset is None:
                self.refuse(line, f"joint {joint.name} has no OFFSET")
        return self.found

    def item(self, line: int, item: str) -> None:
        keyword, _, rest = item.replace("\t", " ").partition(" ")
        match keyword.upper():
            case "HIERARCHY":
                pass
            case "ROOT" | "JOINT":
                self.joint(line, keyword, rest.strip())
            case "END":
                self.inside(line, item)
                self.waiting.append(None)
            case "{":
                if not self.waiting:
                    self.refuse(line, "a brace opens where no joint is named")
                self.open.append(self.waiting.pop())
            case "}":
                if not self.open:
                    self.refuse(line, "a brace closes that was not opened")
                self.open.pop()
            case "OFFSET":
                self.offset(line, rest)
            case "CHANNELS":
                self.channels(line, rest)
            case _:
                self.refuse(line, f"{item[:40]!r} is none of ROOT, JOINT, End Site, OFFSET, CHANNELS")

    def joint(self, line: int, keyword: str, name: str) -> None:
        if keyword.upper() == "ROOT" and self.found:
            self.refuse(line, f"a second ROOT, {name}, follows {self.found[0].name}; give each figure a file of its own")
        if not name:
            self.refuse(line, "a joint has no name")
        parent = -1 if keyword.upper() == "ROOT" else self.inside(line, f"JOINT {name}")
        self.found.append(_Joint(name, parent))
        self.waiting.append(len(self.found) - 1)

    def offset(self, line: int, rest: str) -> None:
        joint = self.found[self.open[-1]] if self.open and self.open[-1] is not None else None
        try:
            vector = [float(word) for word in rest.split()]
        except ValueError:
            self.refuse(line, f"OFFSET {rest} are no three numbers")
        if len(vector) != 3 or not np.isfinite(vector).all():
            self.refuse(line, f"OFFSET {rest} are no three numbers")
        if joint:
            joint.offset = vector
        elif len(self.open) > 1 and (parent := self.open[-2]) is not None:
            self.found[parent].ends.append(vector)
        else:
            self.refuse(line, "an OFFSET stands outside of any joint")

    def channels(self, line: int, rest: str) -> None:
        joint = self.found[self.inside(line, "CHANNELS")]
        count, *names = rest.split() or [""]
        told = [CHANNEL.fullmatch(name) for name in names]
        if not all(told):
            self.refuse(line, f"channel {names[told.index(None)]} is neither a position nor a rotation about X, Y or Z")
        if count != str(len(names)):
            self.refuse(line, f"{count or 'no number of'} channels are announced and {len(names)} named")
        joint.channels = tuple(each[1].upper() + each[2].lower() for each in told if each)

    def inside(self, line: int, what: str) -> int:
        """-> the joint whose braces are open."""
        if not self.open or self.open[-1] is None or self.waiting:
            self.refuse(line, f"{what} stands outside of any joint; a brace is missing or too many before it")
        return self.open[-1]

    def refuse(self, line: int, what: str) -> NoReturn:
        raise ReadError(f"{self.path}, line {line}: {what}.")
