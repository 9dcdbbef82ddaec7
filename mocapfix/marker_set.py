"""Marker sets: which labels there are, which joint each marker rides on, and where; and which set a take wears."""

from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Literal, TypeVar

import numpy as np
from pydantic import AfterValidator, BaseModel, Field, FiniteFloat, ValidationError, field_validator

from mocapfix.errors import SceneError
from mocapfix.scenes import folder, read_yaml
from mocapfix.skeleton import cmu31
from mocapfix.subject import Subject

SHARE = 0.6  # of a set's markers: with fewer the body is guessed rather than seen
LIMB_MARKERS = 2  # on a limb before it counts as seen
LIMBS = {
    "left arm": ("LeftArm", "LeftForeArm", "LeftHand"),
    "right arm": ("RightArm", "RightForeArm", "RightHand"),
    "left leg": ("LeftUpLeg", "LeftLeg", "LeftFoot", "LeftToeBase"),
    "right leg": ("RightUpLeg", "RightLeg", "RightFoot", "RightToeBase"),
}

Form = TypeVar("Form", bound=BaseModel)


@dataclass(frozen=True)
class MarkerSet:
    """K markers on the average body.

    name      what --marker-set and a subject file call it
    title     what people call it
    skeleton  the name of the skeleton it is for
    labels    K names
    joints    (K,) index of the joint each marker rides on
    places    (K, 3) metres: the marker in its joint's axes
    spread    (K,) metres: standard deviation per axis of one person's marker about its place
    aliases   K tuples of other names for the marker
    """

    name: str
    title: str
    skeleton: str
    labels: tuple[str, ...]
    joints: np.ndarray
    places: np.ndarray
    spread: np.ndarray
    aliases: tuple[tuple[str, ...], ...]

    def match(self, labels: Sequence[str]) -> dict[str, int]:
        """-> this set's marker name: index among a take's labels, for the markers that are there.

        Case does not matter, a marker's own name goes before its aliases, and the first of several equal labels counts.
        Where labels carry subjects' prefixes ("Jim:LFHD"), the subject with the most of this set's markers is taken.
        """
        subjects: dict[str, dict[str, int]] = {}
        for index, label in enumerate(labels):
            prefix, _, bare = label.rpartition(":")
            subjects.setdefault(prefix, {}).setdefault(bare.strip().upper(), index)
        return max((self._match_bare(bare) for bare in subjects.values()), key=len, default={})

    def columns(self, labels: Sequence[str]) -> np.ndarray:
        """-> (K,) the index of each of this set's markers among a take's labels, -1 where it is not there."""
        found = self.match(labels)
        return np.array([found.get(label, -1) for label in self.labels])

    def _match_bare(self, indices: dict[str, int]) -> dict[str, int]:
        found = {}
        for label, aliases in zip(self.labels, self.aliases, strict=True):
            there = [indices[name.upper()] for name in (label, *aliases) if name.upper() in indices]
            if there:
                found[label] = there[0]
        return found

    def lack(self, found: Collection[str]) -> str:
        """-> what the markers `found` lack to show a whole body, as part of a sentence; "" where they show one."""
        joints = [cmu31().skeleton.names[j] for label, j in zip(self.labels, self.joints, strict=True) if label in found]
        missing = [part for part, joint in (("hips", "Hips"), ("thorax", "Spine1")) if joint not in joints]
        hidden = [limb for limb, bones in LIMBS.items() if sum(joint in bones for joint in joints) < LIMB_MARKERS]
        if missing or len(hidden) > 1:
            need = f"the {_listed([*missing, *hidden])} can hardly be seen"
        elif len(found) < SHARE * len(self.labels):
            need = f"at least {SHARE:.0%} are needed"
        else:
            return ""
        return f"{need}; not found: {_listed([label for label in self.labels if label not in found])}"


@dataclass(frozen=True)
class Choice:
    """The marker set a take wears, None where none fits, and a sentence that says why."""

    marker_set: MarkerSet | None
    reason: str


def choose(labels: Sequence[str]) -> Choice:
    """-> of the shipped sets that find a whole body among a take's labels, the one that explains most of them.

    A whole body is SHARE of the set's markers, with some on hips, thorax and at least three of the four limbs.
    """
    sets = {each.name: (each, each.match(labels)) for each in shipped()}
    fitting = [(each, found) for each, found in sets.values() if not each.lack(found)]
    if fitting:
        best, _ = max(fitting, key=lambda pair: len(pair[1]))
        return Choice(best, fit(best, labels))
    nearest, found = max(sets.values(), key=lambda pair: len(pair[1]))
    why = f"nearest came {nearest.name} with {len(found)} of its {len(nearest.labels)} markers, but {nearest.lack(found)}"
    if not found:
        why = f"none of them is in any set ({', '.join(sets)})"
    return Choice(None, f"No marker set fits the labels {_listed(labels)}: {why}.")


def fit(worn: MarkerSet, labels: Sequence[str]) -> str:
    """-> a sentence on how many of a set's markers are among a take's labels."""
    return f"{worn.title}: {len(worn.match(labels))} of its {len(worn.labels)} markers were found."


def _listed(names: Sequence[str], most: int = 12) -> str:
    """-> names as one reads them in a sentence, the first dozen and how many more."""
    if not names:
        return "(none)"
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


@cache
def shipped() -> tuple[MarkerSet, ...]:
    """-> the marker sets that travel with mocapfix, by name."""
    return tuple(_read(path) for path in sorted((folder("scenes") / "marker-sets").glob("*.yaml")))


def of_subject(subject: Subject) -> MarkerSet:
    """-> the markers that a subject wears as a set, with the aliases of the shipped set they came from."""
    known = next((each for each in shipped() if each.name == subject.marker_set), None)
    aliases = dict(zip(known.labels, known.aliases, strict=True)) if known else {}
    return MarkerSet(
        name=subject.marker_set,
        title=known.title if known else subject.marker_set,
        skeleton="cmu31",
        labels=subject.labels,
        joints=subject.joints,
        places=subject.places,
        spread=subject.spread,
        aliases=tuple(aliases.get(label, ()) for label in subject.labels),
    )


def load(name_or_path: str | Path) -> MarkerSet:
    """-> a shipped marker set by its name, or one from a YAML file of the same form.

    Raises SceneError: no such set (the message lists those there are), or a file with a wrong key, named by its path.
    """
    sets = {each.name: each for each in shipped()}
    if str(name_or_path) in sets:
        return sets[str(name_or_path)]
    if not Path(name_or_path).is_file():
        raise SceneError(f"{name_or_path}: no such marker set; name one of {', '.join(sets)}, or give a YAML file.")
    return _read(Path(name_or_path))


def _read(path: Path) -> MarkerSet:
    form = checked(_MarkerSetForm, path)
    markers = form.markers.values()
    return MarkerSet(
        name=form.name,
        title=form.title,
        skeleton=form.skeleton,
        labels=tuple(form.markers),
        joints=np.array([cmu31().skeleton.index(marker.joint) for marker in markers]),
        places=np.array([marker.offset for marker in markers], float),
        spread=np.array([marker.spread for marker in markers], float),
        aliases=tuple(marker.aliases for marker in markers),
    )


def checked(form: type[Form], path: Path) -> Form:
    """-> what a YAML file says, in the form it must have.

    Raises SceneError with the file, the path of the first wrong key and what is wrong with it.
    """
    data = read_yaml(path)
    try:
        return form.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"]) or "the file"
        raise SceneError(f"{path}: {key}: {first['msg'].removeprefix('Value error, ')}.") from error


def _known_joint(name: str) -> str:
    if name not in cmu31().skeleton.names:
        raise ValueError(f"there is no joint {name!r}; the joints are {', '.join(cmu31().skeleton.names)}")
    return name


Vector = tuple[FiniteFloat, FiniteFloat, FiniteFloat]
Joint = Annotated[str, AfterValidator(_known_joint)]


class _MarkerForm(BaseModel, extra="forbid"):
    joint: Joint
    offset: Vector
    spread: FiniteFloat = Field(gt=0)
    aliases: tuple[str, ...] = ()


class _MarkerSetForm(BaseModel, extra="forbid"):
    name: str
    title: str
    skeleton: Literal["cmu31"]
    markers: dict[str, _MarkerForm] = Field(min_length=1)

    @field_validator("markers")
    @classmethod
    def _names_are_unique(cls, markers: dict[str, _MarkerForm]) -> dict[str, _MarkerForm]:
        names = Counter(name.upper() for label, marker in markers.items() for name in (label, *marker.aliases))
        if twice := [name for name, count in names.items() if count > 1]:
            raise ValueError(f"{_listed(twice)} would name more than one marker; upper and lower case are one")
        return markers
