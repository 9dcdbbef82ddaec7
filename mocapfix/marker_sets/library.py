"""Marker sets as YAML: those that travel with mocapfix (scenes/marker-sets), and a studio's own."""

from collections import Counter
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field, FiniteFloat, field_validator

from mocapfix.files.output_files import replace_atomically
from mocapfix.files.shipped import find_shipped_folder
from mocapfix.files.yaml_models import InlineMapping, JointName, StrictModel, Vector3, dump_yaml, find_by_name, read_yaml_model
from mocapfix.marker_set import MarkerSet, fold_label, format_name_list
from mocapfix.skeleton import load_cmu31_body
from mocapfix.subject import Subject

MARKER_OFFSET_DECIMALS = 4  # a tenth of a millimetre: nobody sticks a marker on more exactly


@cache
def load_shipped_marker_sets() -> tuple[MarkerSet, ...]:
    """-> the marker sets that travel with mocapfix, by name."""
    return tuple(_read_marker_set(path) for path in sorted((find_shipped_folder("scenes") / "marker-sets").glob("*.yaml")))


def load_marker_set(name_or_path: str | Path) -> MarkerSet:
    """-> a shipped marker set by its name, or one from a YAML file of the same form.

    Raises SceneError: no such set (the message lists those there are), or a file with a wrong key, named by its path.
    """
    called = {each.name: each for each in load_shipped_marker_sets()}
    called |= {also: each for each in load_shipped_marker_sets() for also in each.other_names}
    return find_by_name(name_or_path, called, "marker set", _read_marker_set)


def build_subject_marker_set(subject: Subject) -> MarkerSet:
    """-> the markers that a subject wears as a set, with the aliases of the shipped set they came from."""
    known = next((each for each in load_shipped_marker_sets() if each.name == subject.marker_set), None)
    aliases = dict(zip(known.labels, known.aliases, strict=True)) if known else {}
    return MarkerSet(
        name=subject.marker_set,
        title=known.title if known else subject.marker_set,
        skeleton="cmu31",
        labels=subject.labels,
        joints=subject.joints,
        marker_offsets=subject.marker_offsets,
        marker_spread=subject.marker_spread,
        aliases=tuple(aliases.get(label, ()) for label in subject.labels),
        optional_labels=known.optional_labels & set(subject.labels) if known else frozenset(),
    )


def write_marker_set(path: str | Path, marker_set: MarkerSet, comment: str = "") -> None:
    """Write a set as YAML that `load` reads, under a comment of one line or several.

    Raises WriteError where the folder cannot be written, and then leaves what was there.
    """
    names, markers = load_cmu31_body().skeleton.names, {}
    for k, label in enumerate(marker_set.labels):
        place = [round(float(x), MARKER_OFFSET_DECIMALS) for x in marker_set.marker_offsets[k]]
        line = InlineMapping(
            joint=names[marker_set.joints[k]],
            offset=place,
            spread=round(float(marker_set.marker_spread[k]), MARKER_OFFSET_DECIMALS),
        )
        line |= {"aliases": list(marker_set.aliases[k])} if marker_set.aliases[k] else {}
        line |= {"optional": True} if label in marker_set.optional_labels else {}
        markers[label] = line
    head: dict = {"name": marker_set.name, "title": marker_set.title}
    head |= {"also_called": list(marker_set.other_names)} if marker_set.other_names else {}
    head |= {"skeleton": marker_set.skeleton}
    said = "".join(f"# {line}".rstrip() + "\n" for line in comment.splitlines())
    with replace_atomically(Path(path)) as part:
        part.write_text(said + dump_yaml({**head, "markers": markers}), encoding="utf-8", newline="\n")


def _read_marker_set(path: Path) -> MarkerSet:
    form = read_yaml_model(_MarkerSetModel, path)
    markers = form.markers.values()
    return MarkerSet(
        name=form.name,
        title=form.title,
        skeleton=form.skeleton,
        labels=tuple(form.markers),
        joints=np.array([load_cmu31_body().skeleton.find_joint(marker.joint) for marker in markers]),
        marker_offsets=np.array([marker.offset for marker in markers], float),
        marker_spread=np.array([marker.spread for marker in markers], float),
        aliases=tuple(marker.aliases for marker in markers),
        optional_labels=frozenset(label for label, marker in form.markers.items() if marker.optional),
        other_names=form.also_called,
    )


class _SetMarkerModel(StrictModel):
    joint: JointName
    offset: Vector3
    spread: FiniteFloat = Field(gt=0)
    aliases: tuple[str, ...] = ()
    optional: bool = False


class _MarkerSetModel(StrictModel):
    name: str
    title: str
    also_called: tuple[str, ...] = ()
    skeleton: Literal["cmu31"]
    markers: dict[str, _SetMarkerModel] = Field(min_length=1)

    @field_validator("markers")
    @classmethod
    def _check_names_unique(cls, markers: dict[str, _SetMarkerModel]) -> dict[str, _SetMarkerModel]:
        names = Counter(fold_label(name) for label, marker in markers.items() for name in (label, *marker.aliases))
        if twice := [name for name, count in names.items() if count > 1]:
            raise ValueError(f"{format_name_list(twice)} would name more than one marker; case and marks do not count")
        if nameless := [label for label in markers if not fold_label(label)]:
            raise ValueError(f"{format_name_list(nameless)} is no name")
        return markers
