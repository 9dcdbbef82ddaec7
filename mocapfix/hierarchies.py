"""Which joint of an animation is which of the 31, by the names that programs give them: scenes/hierarchies, a style a file."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import takewhile
from pathlib import Path

import numpy as np
from pydantic import Field

from mocapfix.scenes import folder
from mocapfix.skeleton import cmu31
from mocapfix.yaml_form import Joint, Stated, checked, named

SIGNS = re.compile(r"[\W_]+")  # what does not count in a name, nor does its case
NEEDED = ("Hips", "Spine1") + tuple(side + bone for side in ("Left", "Right") for bone in ("UpLeg", "Leg", "Arm", "ForeArm"))
PREFIX = 3  # letters: fewer that all names begin with are chance


class _Form(Stated):
    name: str
    title: str
    joints: dict[Joint, tuple[str, ...]] = Field(min_length=1)


@dataclass(frozen=True)
class Style:
    """How some programs name joints: for joints of the 31 the names theirs may have, the likeliest first.

    Of the file's joints each is taken once, by the first of the 31 in the style's order that wants it.
    """

    name: str
    title: str
    names: dict[str, tuple[str, ...]]

    def joints(self, names: Sequence[str], parents: np.ndarray) -> np.ndarray:
        """-> (31,) the file's joint for each of ours, -1 where there is none, of names (J,) in a tree parents (J,)."""
        there: dict[str, int] = {}
        for spelled in (plain(names), [_plain(name) for name in names]):
            for joint, name in enumerate(spelled):
                there.setdefault(name, joint)
        ours = cmu31().skeleton
        found = np.full(len(ours.names), -1)
        for joint, likely in self.names.items():
            free = (there[name] for name in map(_plain, likely) if name in there and there[name] not in found)
            found[ours.index(joint)] = next(free, -1)
        return _in_line(found, parents, ours.parents)


@dataclass(frozen=True)
class Mapped:
    """The 31 joints in a file's tree.

    joints  (31,) the file's joint for each of ours, -1 where there is none
    title   what people call the style of the names
    """

    joints: np.ndarray
    title: str

    def names(self, theirs: Sequence[str]) -> dict[str, str]:
        """-> joint of the 31: the name of the file's."""
        return {ours: theirs[int(at)] for ours, at in zip(cmu31().skeleton.names, self.joints, strict=True) if at >= 0}


@dataclass(frozen=True)
class Choice:
    """The 31 joints in a file's tree, None where too few of them are there, and a sentence that says why."""

    mapped: Mapped | None
    reason: str


def mapped(names: Sequence[str], parents: np.ndarray, given: str | Path | None = None) -> Choice:
    """-> the 31 joints among a tree's names (J,), by the style that finds the most of them, or by the one that is given.

    Case, signs, namespaces ("Jim:Hips") and what all names begin with do not count. Hips, thorax, both legs and both arms must
    be found, or there is no body to speak of.

    given  the name of a style that travels with mocapfix, or a YAML file of the same form. Raises SceneError where it is neither
    """
    styles = (load(given),) if given is not None else shipped()
    ours = cmu31().skeleton.names
    found = [(style, style.joints(names, parents)) for style in styles]
    best, joints = max(found, key=lambda pair: (not _lacking(pair[1]), (pair[1] >= 0).sum()))
    count = int((joints >= 0).sum())
    if lacking := _lacking(joints):
        near = f"nearest came {best.title}, which lacks {', '.join(lacking)}" if count else "none is known"
        return Choice(None, f"The joints are not a body's by their names: {near}; give a YAML file of the names (--hierarchy).")
    return Choice(Mapped(joints, best.title), f"{best.title}: {count} of the {len(ours)} joints were found.")


def _lacking(joints: np.ndarray) -> list[str]:
    names = cmu31().skeleton.names
    return [name for name in NEEDED if joints[names.index(name)] < 0]


def _in_line(found: np.ndarray, parents: np.ndarray, ours: np.ndarray) -> np.ndarray:
    """-> `found` without joints that do not hang, near or far, on the file's joint for the nearest of ours above them."""
    kept = found.copy()
    for joint, at in enumerate(found):
        above = ancestor(joint, ours, kept >= 0)
        if above >= 0 and at >= 0:
            while at >= 0 and at != kept[above]:
                at = parents[at]
            kept[joint] = found[joint] if at >= 0 else -1
    return kept


def ancestor(joint: int, parents: np.ndarray, among: np.ndarray) -> int:
    """-> the nearest joint above one in a tree parents (J,) that is `among` (J,) bool, -1 where none is."""
    joint = int(parents[joint])
    while joint >= 0 and not among[joint]:
        joint = int(parents[joint])
    return joint


def way(joint: int, above: int, parents: np.ndarray) -> list[int]:
    """-> the joints from below `above` (-1: from the root) down to `joint`, in a tree parents (J,)."""
    between = []
    while joint != above:
        between.insert(0, int(joint))
        joint = int(parents[joint])
    return between


def below(joint: int, parents: np.ndarray, among: np.ndarray) -> list[int]:
    """-> a joint if it is `among` (J,) bool, else the nearest ones below it that are."""
    if among[joint]:
        return [joint]
    return [each for child in np.flatnonzero(parents == joint).tolist() for each in below(child, parents, among)]


def plain(names: Sequence[str]) -> list[str]:
    """-> names without what does not count: namespaces, signs, case, and what all of them begin with ("mixamorig")."""
    bare = [_plain(re.split(r"[:|]", name)[-1]) for name in names]
    alike = takewhile(lambda letters: len(set(letters)) == 1, zip(*bare[1:], strict=False))
    common = "".join(letters[0] for letters in alike)  # the root may be called just that: Bip01
    if len(common) < PREFIX or len(bare) < len(NEEDED):
        return bare
    return [name.removeprefix(common) or name for name in bare]


def _plain(name: str) -> str:
    return SIGNS.sub("", name).lower()


@cache
def shipped() -> tuple[Style, ...]:
    """-> the styles that travel with mocapfix, by name."""
    return tuple(_read(path) for path in sorted((folder("scenes") / "hierarchies").glob("*.yaml")))


def load(name_or_path: str | Path) -> Style:
    """-> a shipped style by its name, or one from a YAML file of the same form.

    Raises SceneError: no such style (the message lists those there are), or a file with a wrong key, named by its path.
    """
    return named(name_or_path, {style.name: style for style in shipped()}, "style of names", _read)


def _read(path: Path) -> Style:
    form = checked(_Form, path)
    return Style(form.name, form.title, dict(form.joints))
