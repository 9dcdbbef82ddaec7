"""Marker sets as YAML: those that travel with mocapfix (scenes/marker-sets), and a studio's own."""

from collections import Counter
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field, FiniteFloat, field_validator

from mocapfix.files import replacing
from mocapfix.marker_set.labels import folded, listed
from mocapfix.marker_set.nominal import MarkerSet
from mocapfix.scenes import folder
from mocapfix.skeleton import cmu31
from mocapfix.subject import Subject
from mocapfix.yaml_form import Joint, Line, Stated, Vector, checked, dumped, named

DIGITS = 4  # a tenth of a millimetre: nobody sticks a marker on more exactly


@cache
def shipped() -> tuple[MarkerSet, ...]:
    """-> the marker sets that travel with mocapfix, by name."""
    return tuple(_read(path) for path in sorted((folder("scenes") / "marker-sets").glob("*.yaml")))


def load(name_or_path: str | Path) -> MarkerSet:
    """-> a shipped marker set by its name, or one from a YAML file of the same form.

    Raises SceneError: no such set (the message lists those there are), or a file with a wrong key, named by its path.
    """
    called = {each.name: each for each in shipped()}
    called |= {also: each for each in shipped() for also in each.also_called}
    return named(name_or_path, called, "marker set", _read)


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
        optional=known.optional & set(subject.labels) if known else frozenset(),
    )


def save(path: str | Path, marker_set: MarkerSet, comment: str = "") -> None:
    """Write a set as YAML that `load` reads, under a comment of one line or several.

    Raises WriteError where the folder cannot be written, and then leaves what was there.
    """
    names, markers = cmu31().skeleton.names, {}
    for k, label in enumerate(marker_set.labels):
        place = [round(float(x), DIGITS) for x in marker_set.places[k]]
        line = Line(joint=names[marker_set.joints[k]], offset=place, spread=round(float(marker_set.spread[k]), DIGITS))
        line |= {"aliases": list(marker_set.aliases[k])} if marker_set.aliases[k] else {}
        line |= {"optional": True} if label in marker_set.optional else {}
        markers[label] = line
    head: dict = {"name": marker_set.name, "title": marker_set.title}
    head |= {"also_called": list(marker_set.also_called)} if marker_set.also_called else {}
    head |= {"skeleton": marker_set.skeleton}
    said = "".join(f"# {line}".rstrip() + "\n" for line in comment.splitlines())
    with replacing(Path(path)) as part:
        part.write_text(said + dumped({**head, "markers": markers}), encoding="utf-8", newline="\n")


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
        optional=frozenset(label for label, marker in form.markers.items() if marker.optional),
        also_called=form.also_called,
    )


class _MarkerForm(Stated):
    joint: Joint
    offset: Vector
    spread: FiniteFloat = Field(gt=0)
    aliases: tuple[str, ...] = ()
    optional: bool = False


class _MarkerSetForm(Stated):
    name: str
    title: str
    also_called: tuple[str, ...] = ()
    skeleton: Literal["cmu31"]
    markers: dict[str, _MarkerForm] = Field(min_length=1)

    @field_validator("markers")
    @classmethod
    def _names_are_unique(cls, markers: dict[str, _MarkerForm]) -> dict[str, _MarkerForm]:
        names = Counter(folded(name) for label, marker in markers.items() for name in (label, *marker.aliases))
        if twice := [name for name, count in names.items() if count > 1]:
            raise ValueError(f"{listed(twice)} would name more than one marker; case and marks do not count")
        if nameless := [label for label in markers if not folded(label)]:
            raise ValueError(f"{listed(nameless)} is no name")
        return markers
