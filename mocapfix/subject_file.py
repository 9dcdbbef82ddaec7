"""The subject file: one person's bones and marker places as YAML that people can read, mend and give back."""

from pathlib import Path

import numpy as np
from pydantic import Field, FiniteFloat, NonNegativeInt

from mocapfix.errors import SceneError
from mocapfix.files import replacing
from mocapfix.skeleton import Skeleton, cmu31
from mocapfix.subject import Subject
from mocapfix.yaml_form import Joint, Line, Stated, Vector, checked, dumped

HEADER = """\
# A subject of mocapfix: one person's bones and where the markers lie on them.
# All lengths are in metres. A bone's offset is the joint in its parent's axes, its end the tip of a last bone; a marker's
# place is in the axes of the joint it rides on, and spread is how far it strays from there on average. What calibration
# could not tell displaces joints and markers by sd (standard deviation per axis; 0 where they were measured otherwise).
# Rest pose: a T-pose facing +Z, Y up, every joint's axes along the world's.
"""
DIGITS = 7  # a tenth of a micrometre


def load(path: str | Path) -> Subject:
    """-> the subject that `save` wrote to a YAML file, or that a person mended there.

    Raises SceneError with the file and the path of the wrong key.
    """
    form = checked(_SubjectForm, Path(path))
    _check_bones(Path(path), form.bones)
    skeleton, markers = cmu31().skeleton, form.markers.values()
    bones = [form.bones[name] for name in skeleton.names]
    return Subject(
        skeleton=Skeleton(
            skeleton.names,
            skeleton.parents,
            np.array([bone.offset for bone in bones], float),
            np.array([bone.end or [np.nan] * 3 for bone in bones], float),
        ),
        marker_set=form.marker_set,
        labels=tuple(form.markers),
        joints=np.array([skeleton.index(marker.joint) for marker in markers], int),
        places=np.array([marker.place for marker in markers], float).reshape(-1, 3),
        spread=np.array([marker.spread for marker in markers], float),
        joint_sd=np.array([bone.sd for bone in bones], float),
        marker_sd=np.array([marker.sd for marker in markers], float),
        frames=form.frames,
    )


def save(path: str | Path, subject: Subject) -> None:
    """Write a subject as YAML, lengths rounded to a tenth of a micrometre.

    Raises WriteError where the folder cannot be written, and then leaves what was there.
    """
    skeleton, bones, markers = subject.skeleton, {}, {}
    names = skeleton.names
    for name, parent, offset, end, sd in zip(
        names, skeleton.parents, skeleton.offsets, skeleton.ends, subject.joint_sd, strict=True
    ):
        bones[name] = Line(parent=names[parent] if parent >= 0 else None, offset=_metres(offset), sd=_length(sd))
        if not np.isnan(end).any():
            bones[name]["end"] = _metres(end)
    for label, joint, place, spread, sd in zip(
        subject.labels, subject.joints, subject.places, subject.spread, subject.marker_sd, strict=True
    ):
        markers[label] = Line(joint=names[joint], place=_metres(place), spread=_length(spread), sd=_length(sd))
    data = {"marker_set": subject.marker_set, "frames": int(subject.frames), "bones": bones, "markers": markers}
    with replacing(Path(path)) as part:
        part.write_text(HEADER + dumped(data), encoding="utf-8", newline="\n")


def _metres(vector: np.ndarray) -> list[float]:
    return [_length(x) for x in vector]


def _length(value: float) -> float:
    return round(float(value), DIGITS)


class _BoneForm(Stated):
    parent: str | None
    offset: Vector
    end: Vector | None = None
    sd: FiniteFloat = Field(ge=0)


class _MarkerForm(Stated):
    joint: Joint
    place: Vector
    spread: FiniteFloat = Field(ge=0)
    sd: FiniteFloat = Field(ge=0)


class _SubjectForm(Stated):
    marker_set: str
    frames: NonNegativeInt
    bones: dict[str, _BoneForm]
    markers: dict[str, _MarkerForm]


def _check_bones(path: Path, bones: dict[str, _BoneForm]) -> None:
    """The bones must be the skeleton's, for the solver knows no other tree."""
    skeleton = cmu31().skeleton
    for name, bone in bones.items():
        if name not in skeleton.names:
            raise SceneError(f"{path}: bones.{name}: the skeleton has no such bone; its bones are {', '.join(skeleton.names)}.")
        joint = skeleton.index(name)
        parent = skeleton.names[skeleton.parents[joint]] if joint else None
        if bone.parent != parent:
            raise SceneError(f"{path}: bones.{name}.parent: must be {parent or 'null'}, not {bone.parent or 'null'}.")
        if (bone.end is None) != np.isnan(skeleton.ends[joint]).any():
            raise SceneError(f"{path}: bones.{name}.end: {'is missing' if bone.end is None else 'only a last bone has one'}.")
    if missing := [name for name in skeleton.names if name not in bones]:
        raise SceneError(f"{path}: bones.{missing[0]}: is missing.")
