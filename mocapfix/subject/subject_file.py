"""The subject file: one person's bones and marker offsets as YAML that people can read, edit and use again."""

from pathlib import Path

import numpy as np
from pydantic import Field, FiniteFloat, NonNegativeInt

from mocapfix.errors import SceneError, format_name_list
from mocapfix.io.files import replace_atomically
from mocapfix.io.yaml_files import InlineMapping, JointName, StrictModel, Vector3, dump_yaml, read_yaml_model
from mocapfix.model.skeleton import Skeleton, load_cmu31_body
from mocapfix.model.subject import Subject

SUBJECT_FILE_HEADER = """\
# A subject of mocapfix: one person's bones and the markers on them. All lengths are in metres.
# offset: the joint in its parent's axes; end: the tip of a last bone in its joint's axes; place: the marker in the axes of its
# joint; spread: typical distance per axis of the marker from its place; sd: standard deviation per axis of the joint or marker
# due to the uncertainty of the calibration (0 if it was measured otherwise).
# Rest pose: a T-pose facing +Z, Y up, with all joint axes parallel to the world axes.
"""
LENGTH_DECIMALS = 7
"""Decimals of the lengths in the file: a tenth of a micrometre."""


def read_subject(path: str | Path) -> Subject:
    """Return the subject in a file that `write_subject` wrote, possibly edited since.

    Raises SceneError with the file and the path of the invalid key.
    """
    model = read_yaml_model(_SubjectModel, Path(path))
    _check_bones(Path(path), model.bones)
    skeleton, markers = load_cmu31_body().skeleton, model.markers.values()
    bones = [model.bones[name] for name in skeleton.names]
    return Subject(
        skeleton=Skeleton(
            skeleton.names,
            skeleton.parents,
            np.array([bone.offset for bone in bones], float),
            np.array([bone.end or [np.nan] * 3 for bone in bones], float),
        ),
        marker_set=model.marker_set,
        labels=tuple(model.markers),
        joints=np.array([skeleton.find_joint(marker.joint) for marker in markers], int),
        marker_offsets=np.array([marker.place for marker in markers], float).reshape(-1, 3),
        marker_spread=np.array([marker.spread for marker in markers], float),
        joint_sd=np.array([bone.sd for bone in bones], float),
        marker_sd=np.array([marker.sd for marker in markers], float),
        frame_count=model.frames,
        notes=model.notes,
    )


def write_subject(path: str | Path, subject: Subject) -> None:
    """Write a subject as YAML, with lengths rounded to LENGTH_DECIMALS.

    Raises WriteError if the folder cannot be written; an existing file is then left unchanged.
    """
    skeleton, names = subject.skeleton, subject.skeleton.names
    bones: dict[str, InlineMapping] = {}
    markers: dict[str, InlineMapping] = {}
    for name, parent, offset, end, sd in zip(
        names, skeleton.parents, skeleton.offsets, skeleton.ends, subject.joint_sd, strict=True
    ):
        bones[name] = InlineMapping(
            parent=names[parent] if parent >= 0 else None, offset=_round_lengths(offset), sd=_round_length(sd)
        )
        if not np.isnan(end).any():
            bones[name]["end"] = _round_lengths(end)
    for label, joint, offset, spread, sd in zip(
        subject.labels, subject.joints, subject.marker_offsets, subject.marker_spread, subject.marker_sd, strict=True
    ):
        markers[label] = InlineMapping(
            joint=names[joint], place=_round_lengths(offset), spread=_round_length(spread), sd=_round_length(sd)
        )
    notes = {"notes": list(subject.notes)} if subject.notes else {}
    data = {"marker_set": subject.marker_set, "frames": int(subject.frame_count), "bones": bones, "markers": markers, **notes}
    with replace_atomically(Path(path)) as new_file:
        new_file.write_text(SUBJECT_FILE_HEADER + dump_yaml(data), encoding="utf-8", newline="\n")


def _round_lengths(vector: np.ndarray) -> list[float]:
    return [_round_length(x) for x in vector]


def _round_length(value: float) -> float:
    return round(float(value), LENGTH_DECIMALS)


class _BoneModel(StrictModel):
    parent: str | None
    offset: Vector3
    end: Vector3 | None = None
    sd: FiniteFloat = Field(ge=0)


class _MarkerModel(StrictModel):
    joint: JointName
    place: Vector3
    spread: FiniteFloat = Field(ge=0)
    sd: FiniteFloat = Field(ge=0)


class _SubjectModel(StrictModel):
    marker_set: str
    frames: NonNegativeInt
    bones: dict[str, _BoneModel]
    markers: dict[str, _MarkerModel]
    notes: tuple[str, ...] = ()


def _check_bones(path: Path, bones: dict[str, _BoneModel]) -> None:
    """Raise SceneError unless the bones are those of the CMU skeleton, the only tree that the solver supports."""
    skeleton = load_cmu31_body().skeleton
    for name, bone in bones.items():
        if name not in skeleton.names:
            raise SceneError(
                f"{path}: bones.{name}: the skeleton has no such bone; its bones are {format_name_list(skeleton.names)}."
            )
        joint = skeleton.find_joint(name)
        parent = skeleton.names[skeleton.parents[joint]] if joint else None
        if bone.parent != parent:
            raise SceneError(f"{path}: bones.{name}.parent: must be {parent or 'null'}, not {bone.parent or 'null'}.")
        if (bone.end is None) != np.isnan(skeleton.ends[joint]).any():
            raise SceneError(
                f"{path}: bones.{name}.end: {'is missing' if bone.end is None else 'only the last bone of a chain has one'}."
            )
    if missing := [name for name in skeleton.names if name not in bones]:
        raise SceneError(f"{path}: bones.{missing[0]}: is missing.")
