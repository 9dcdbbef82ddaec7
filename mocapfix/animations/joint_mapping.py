"""Which joint of an animation is which of the 31, by the names that programs give them: scenes/hierarchies, a style a file."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import takewhile
from pathlib import Path

import numpy as np
from pydantic import Field

from mocapfix.files.shipped import find_shipped_folder
from mocapfix.files.yaml_models import JointName, StrictModel, find_by_name, read_yaml_model
from mocapfix.skeleton import load_cmu31_body

NON_ALPHANUMERIC = re.compile(r"[\W_]+")  # what does not count in a name, nor does its case
REQUIRED_JOINTS = ("Hips", "Spine1") + tuple(
    side + bone for side in ("Left", "Right") for bone in ("UpLeg", "Leg", "Arm", "ForeArm")
)
MIN_COMMON_PREFIX_LENGTH = 3  # letters: fewer that all names begin with are chance


class _NamingConventionFile(StrictModel):
    name: str
    title: str
    joints: dict[JointName, tuple[str, ...]] = Field(min_length=1)


@dataclass(frozen=True)
class NamingConvention:
    """How some programs name joints: for joints of the 31 the names theirs may have, the likeliest first.

    Of the file's joints each is taken once, by the first of the 31 in the style's order that wants it.
    """

    name: str
    title: str
    candidate_names: dict[str, tuple[str, ...]]

    def match_joints(self, names: Sequence[str], parents: np.ndarray) -> np.ndarray:
        """-> (31,) the file's joint for each of ours, -1 where there is none, of names (J,) in a tree parents (J,)."""
        there: dict[str, int] = {}
        for spelled in (normalise_names(names), [_normalise_name(name) for name in names]):
            for joint, name in enumerate(spelled):
                there.setdefault(name, joint)
        ours = load_cmu31_body().skeleton
        found = np.full(len(ours.names), -1)
        for joint, likely in self.candidate_names.items():
            free = (there[name] for name in map(_normalise_name, likely) if name in there and there[name] not in found)
            found[ours.find_joint(joint)] = next(free, -1)
        return _discard_misplaced_joints(found, parents, ours.parents)


@dataclass(frozen=True)
class JointMapping:
    """The 31 joints in a file's tree.

    joints  (31,) the file's joint for each of ours, -1 where there is none
    title   what people call the style of the names
    """

    file_joints: np.ndarray
    title: str

    def names(self, theirs: Sequence[str]) -> dict[str, str]:
        """-> joint of the 31: the name of the file's."""
        return {
            ours: theirs[int(at)] for ours, at in zip(load_cmu31_body().skeleton.names, self.file_joints, strict=True) if at >= 0
        }


@dataclass(frozen=True)
class JointMappingResult:
    """The 31 joints in a file's tree, None where too few of them are there, and a sentence that says why."""

    mapping: JointMapping | None
    reason: str


def map_joints(names: Sequence[str], parents: np.ndarray, convention: str | Path | None = None) -> JointMappingResult:
    """-> the 31 joints among a tree's names (J,), by the style that finds the most of them, or by the one that is given.

    Case, signs, namespaces ("Jim:Hips") and what all names begin with do not count. Hips, thorax, both legs and both arms must
    be found, or there is no body to speak of.

    given  the name of a style that travels with mocapfix, or a YAML file of the same form. Raises SceneError where it is neither
    """
    styles = (load_naming_convention(convention),) if convention is not None else load_shipped_conventions()
    ours = load_cmu31_body().skeleton.names
    found = [(style, style.match_joints(names, parents)) for style in styles]
    best, joints = max(found, key=lambda pair: (not _find_missing_joints(pair[1]), (pair[1] >= 0).sum()))
    count = int((joints >= 0).sum())
    if lacking := _find_missing_joints(joints):
        near = f"nearest came {best.title}, which lacks {', '.join(lacking)}" if count else "none is known"
        return JointMappingResult(
            None, f"The joints are not a body's by their names: {near}; give a YAML file of the names (--hierarchy)."
        )
    return JointMappingResult(JointMapping(joints, best.title), f"{best.title}: {count} of the {len(ours)} joints were found.")


def _find_missing_joints(file_joints: np.ndarray) -> list[str]:
    names = load_cmu31_body().skeleton.names
    return [name for name in REQUIRED_JOINTS if file_joints[names.index(name)] < 0]


def _discard_misplaced_joints(file_joints: np.ndarray, parents: np.ndarray, model_parents: np.ndarray) -> np.ndarray:
    """-> `found` without joints that do not hang, near or far, on the file's joint for the nearest of ours above them."""
    kept = file_joints.copy()
    for joint, at in enumerate(file_joints):
        above = find_ancestor(joint, model_parents, kept >= 0)
        if above >= 0 and at >= 0:
            while at >= 0 and at != kept[above]:
                at = parents[at]
            kept[joint] = file_joints[joint] if at >= 0 else -1
    return kept


def find_ancestor(joint: int, parents: np.ndarray, is_candidate: np.ndarray) -> int:
    """-> the nearest joint above one in a tree parents (J,) that is `among` (J,) bool, -1 where none is."""
    joint = int(parents[joint])
    while joint >= 0 and not is_candidate[joint]:
        joint = int(parents[joint])
    return joint


def find_path(joint: int, above: int, parents: np.ndarray) -> list[int]:
    """-> the joints from below `above` (-1: from the root) down to `joint`, in a tree parents (J,)."""
    between = []
    while joint != above:
        between.insert(0, int(joint))
        joint = int(parents[joint])
    return between


def find_descendants(joint: int, parents: np.ndarray, is_candidate: np.ndarray) -> list[int]:
    """-> a joint if it is `among` (J,) bool, else the nearest ones below it that are."""
    if is_candidate[joint]:
        return [joint]
    return [
        each for child in np.flatnonzero(parents == joint).tolist() for each in find_descendants(child, parents, is_candidate)
    ]


def normalise_names(names: Sequence[str]) -> list[str]:
    """-> names without what does not count: namespaces, signs, case, and what all of them begin with ("mixamorig")."""
    bare = [_normalise_name(re.split(r"[:|]", name)[-1]) for name in names]
    alike = takewhile(lambda letters: len(set(letters)) == 1, zip(*bare[1:], strict=False))
    common = "".join(letters[0] for letters in alike)  # the root may be called just that: Bip01
    if len(common) < MIN_COMMON_PREFIX_LENGTH or len(bare) < len(REQUIRED_JOINTS):
        return bare
    return [name.removeprefix(common) or name for name in bare]


def _normalise_name(name: str) -> str:
    return NON_ALPHANUMERIC.sub("", name).lower()


@cache
def load_shipped_conventions() -> tuple[NamingConvention, ...]:
    """-> the styles that travel with mocapfix, by name."""
    return tuple(_read_naming_convention(path) for path in sorted((find_shipped_folder("scenes") / "hierarchies").glob("*.yaml")))


def load_naming_convention(name_or_path: str | Path) -> NamingConvention:
    """-> a shipped style by its name, or one from a YAML file of the same form.

    Raises SceneError: no such style (the message lists those there are), or a file with a wrong key, named by its path.
    """
    return find_by_name(
        name_or_path, {style.name: style for style in load_shipped_conventions()}, "style of names", _read_naming_convention
    )


def _read_naming_convention(path: Path) -> NamingConvention:
    form = read_yaml_model(_NamingConventionFile, path)
    return NamingConvention(form.name, form.title, dict(form.joints))
