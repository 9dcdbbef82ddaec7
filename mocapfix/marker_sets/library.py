"""Read and write marker sets as YAML: the shipped ones in scenes/marker-sets, and those of a studio."""

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

MARKER_OFFSET_DECIMALS = 4
"""decimals of lengths in metres in a file; markers are placed less accurately than 0.1 mm"""


@cache
def load_shipped_marker_sets() -> tuple[MarkerSet, ...]:
    """Return the shipped marker sets in the order of their names."""
    return tuple(_read_marker_set(path) for path in sorted((find_shipped_folder("scenes") / "marker-sets").glob("*.yaml")))


def load_marker_set(name_or_path: str | Path) -> MarkerSet:
    """Return a shipped marker set by its name, or the set in a YAML file.

    Raises SceneError if there is no such set (the message lists the shipped ones) or the file has a wrong key.
    """
    set_of_name = {each.name: each for each in load_shipped_marker_sets()}
    set_of_name |= {name: each for each in load_shipped_marker_sets() for name in each.other_names}
    return find_by_name(name_or_path, set_of_name, "marker set", _read_marker_set)


def build_subject_marker_set(subject: Subject) -> MarkerSet:
    """Return a subject's markers as a set, with the aliases of the shipped set from which they are."""
    shipped = next((each for each in load_shipped_marker_sets() if each.name == subject.marker_set), None)
    aliases = dict(zip(shipped.labels, shipped.aliases, strict=True)) if shipped else {}
    return MarkerSet(
        name=subject.marker_set,
        title=shipped.title if shipped else subject.marker_set,
        skeleton="cmu31",
        labels=subject.labels,
        joints=subject.joints,
        marker_offsets=subject.marker_offsets,
        marker_spread=subject.marker_spread,
        aliases=tuple(aliases.get(label, ()) for label in subject.labels),
        optional_labels=shipped.optional_labels & set(subject.labels) if shipped else frozenset(),
    )


def write_marker_set(path: str | Path, marker_set: MarkerSet, comment: str = "") -> None:
    """Write a marker set as YAML for `load_marker_set`, below a comment of any number of lines.

    Raises WriteError if the folder cannot be written to; an existing file then stays as it is.
    """
    joint_names = load_cmu31_body().skeleton.names
    markers: dict[str, InlineMapping] = {}
    for k, label in enumerate(marker_set.labels):
        markers[label] = InlineMapping(
            joint=joint_names[marker_set.joints[k]],
            offset=[round(float(x), MARKER_OFFSET_DECIMALS) for x in marker_set.marker_offsets[k]],
            spread=round(float(marker_set.marker_spread[k]), MARKER_OFFSET_DECIMALS),
        )
        if marker_set.aliases[k]:
            markers[label]["aliases"] = list(marker_set.aliases[k])
        if label in marker_set.optional_labels:
            markers[label]["optional"] = True
    data: dict[str, object] = {"name": marker_set.name, "title": marker_set.title}
    if marker_set.other_names:
        data["also_called"] = list(marker_set.other_names)
    data |= {"skeleton": marker_set.skeleton, "markers": markers}
    comment_lines = "".join(f"# {line}".rstrip() + "\n" for line in comment.splitlines())
    with replace_atomically(Path(path)) as part:
        part.write_text(comment_lines + dump_yaml(data), encoding="utf-8", newline="\n")


def _read_marker_set(path: Path) -> MarkerSet:
    model = read_yaml_model(_MarkerSetModel, path)
    markers = model.markers.values()
    skeleton = load_cmu31_body().skeleton
    return MarkerSet(
        name=model.name,
        title=model.title,
        skeleton=model.skeleton,
        labels=tuple(model.markers),
        joints=np.array([skeleton.find_joint(marker.joint) for marker in markers], int),
        marker_offsets=np.array([marker.offset for marker in markers], float),
        marker_spread=np.array([marker.spread for marker in markers], float),
        aliases=tuple(marker.aliases for marker in markers),
        optional_labels=frozenset(label for label, marker in model.markers.items() if marker.optional),
        other_names=model.also_called,
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
        if repeated := [name for name, count in names.items() if count > 1]:
            raise ValueError(f"{format_name_list(repeated)} names more than one marker; case and separators are ignored")
        if empty := [label for label in markers if not fold_label(label)]:
            raise ValueError(f"{format_name_list(empty)} has neither letters nor digits")
        return markers
