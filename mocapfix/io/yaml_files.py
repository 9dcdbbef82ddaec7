"""Strict models of the YAML files that users write and edit, and their types.

Modules that write such files as well import this one where they read: pydantic takes a tenth of a second.
"""

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args

import pydantic
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, FiniteFloat, NonNegativeInt, ValidationError

from mocapfix.errors import SceneError, format_name_list
from mocapfix.io.shipped import load_yaml, read_yaml
from mocapfix.model.faults import CorrectionKind, Decision, FaultKind, RequestedFill
from mocapfix.model.marker_set import fold_label
from mocapfix.model.skeleton import load_cmu31_body

YamlModel = TypeVar("YamlModel", bound=BaseModel)
Validated = TypeVar("Validated")

# Replacements, by pydantic's error type, of messages that are written for programmers.
PYDANTIC_MESSAGES = {
    "extra_forbidden": "there is no such key; check its spelling",
    "missing": "is missing",
    "tuple_type": "must be a list",
    "model_type": "must be key: value pairs",
    "dict_type": "must be key: value pairs",
    "string_type": "must be text",
    "literal_error": "must be {expected}",
    "union_tag_not_found": "is missing",
    "union_tag_invalid": "must be one of {expected_tags}, not {tag!r}",
}


class StrictModel(BaseModel):
    """A model that accepts no unknown keys and only finite numbers."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


def read_yaml_model(model: type[YamlModel], path: Path, load: Callable[[str], Any] = load_yaml) -> YamlModel:
    """Read a YAML file and validate it by a model. Raise SceneError as `read_validated_yaml` does."""
    return read_validated_yaml(model.model_validate, path, load)


def read_validated_yaml(validate: Callable[[Any], Validated], path: Path, load: Callable[[str], Any] = load_yaml) -> Validated:
    """Read a YAML file and validate it.

    Args:
        validate: Converts the content of the file, or raises pydantic's ValidationError.

    Returns:
        The converted content.

    Raises:
        SceneError: If the file is invalid. The message names the file and the first invalid key, and says what is wrong.
    """
    data = read_yaml(path, load)
    try:
        return validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        context: dict[str, Any] = first.get("ctx", {})
        key = ".".join(str(part) for part in first["loc"]) or str(context.get("discriminator", "the file")).strip("'")
        template = PYDANTIC_MESSAGES.get(first["type"])
        message = template.format(**context) if template else first["msg"].removeprefix("Value error, ")
        raise SceneError(f"{path}: {key}: {message}.") from error


def _validate_joint_name(name: str) -> str:
    names = load_cmu31_body().skeleton.names
    if name not in names:
        raise ValueError(f"there is no joint {name!r}; the joints are {format_name_list(names)}")
    return name


Vector3 = tuple[FiniteFloat, FiniteFloat, FiniteFloat]
JointName = Annotated[str, AfterValidator(_validate_joint_name)]

MARKER_COUNTS: dict[CorrectionKind, int] = {"wrong": 1, "missing": 1, "swap": 2, "assign": 2, "fill": 1, "keys": 1}
"""how many markers, or trajectories, a correction of each kind names"""
MAX_NOTE_LENGTH = 2000

NoteText = Annotated[str, Field(max_length=MAX_NOTE_LENGTH)]


class _IntervalStateModel(StrictModel):
    missing: int
    off_body_mm: float | None


class ChangeModel(StrictModel):
    """A change in a changes file; see mocapfix.model.changes.Change."""

    id: str
    kind: FaultKind
    markers: list[str] = Field(min_length=1)
    first: int
    last: int
    samples: int
    why: str
    method: str
    before: _IntervalStateModel
    after: _IntervalStateModel
    predicted_mm: float | None
    decision: Decision
    reviewed: bool = False  # whether a person has decided
    reviewer: NoteText = ""  # who has; "" if it is not known
    note: NoteText = ""  # what the reviewer wrote about it


class CorrectionModel(StrictModel):
    """A correction by the reviewer, over frames in the file's own numbers, inclusive."""

    # wrong: the samples of the marker are wrong, and are replaced. missing: they are removed, and the gap is filled. swap: the
    # labels of two markers are exchanged. assign: the samples of an unlabelled trajectory are those of the marker, which is
    # named first. fill: the missing or wrong samples are filled by `method`. keys: the samples are a spline through `points`
    kind: CorrectionKind
    markers: list[str]  # labels
    first: int
    last: int
    method: RequestedFill | None = None  # how to fill; null unless the kind is fill
    points: list[tuple[int, FiniteFloat, FiniteFloat, FiniteFloat]] = Field(default=[])  # frame, and x, y (up), z in mm
    note: NoteText = ""

    @pydantic.model_validator(mode="after")
    def _check_markers_and_method(self) -> "CorrectionModel":
        count = MARKER_COUNTS[self.kind]
        if len(set(self.markers)) != count or len(self.markers) != count:
            names = {"swap": "two markers", "assign": "a marker and an unlabelled trajectory"}.get(self.kind, "one marker")
            raise ValueError(f"{self.kind} must name {names}")
        if (self.method is not None) != (self.kind == "fill"):
            methods = format_name_list(get_args(RequestedFill))
            text = f"fill must have a method: {methods}" if self.kind == "fill" else "only fill has a method"
            raise ValueError(text)
        frames = [each[0] for each in self.points]
        is_within = len(frames) > 1 and [self.first, *frames, self.last] == sorted([self.first, *{*frames}, self.last])
        if bool(frames) != (self.kind == "keys") or (frames and not is_within):
            raise ValueError("keys must have two points or more, in order of their frames; other kinds have none")
        return self


class ChangesFileModel(StrictModel):
    take: str  # name of the take
    frames: tuple[int, int]  # its first and last frame
    changes: list[ChangeModel]
    # those of the reviewer, in the order in which they are applied
    corrections: list[CorrectionModel] = Field(default_factory=list)


class BoneModel(StrictModel):
    parent: str | None
    offset: Vector3
    end: Vector3 | None = None
    sd: FiniteFloat = Field(ge=0)


class MarkerModel(StrictModel):
    joint: JointName
    place: Vector3
    spread: FiniteFloat = Field(ge=0)
    sd: FiniteFloat = Field(ge=0)


class SubjectModel(StrictModel):
    marker_set: str
    frames: NonNegativeInt
    bones: dict[str, BoneModel]
    markers: dict[str, MarkerModel]
    notes: tuple[str, ...] = ()


class SetMarkerModel(StrictModel):
    landmark: str | None = None
    joint: JointName | None = None
    offset: Vector3 | None = None
    spread: FiniteFloat | None = Field(default=None, gt=0)
    aliases: tuple[str, ...] = ()
    optional: bool = False

    @pydantic.model_validator(mode="after")
    def _check_place(self) -> "SetMarkerModel":
        if self.landmark is not None:
            if self.joint is not None or self.offset is not None:
                raise ValueError("the place of a marker is either a landmark or a joint with an offset, not both")
        elif self.joint is None or self.offset is None or self.spread is None:
            raise ValueError("a marker needs a joint, an offset and a spread, or a landmark")
        return self


class MarkerSetModel(StrictModel):
    name: str
    title: str
    also_called: tuple[str, ...] = ()
    skeleton: Literal["cmu31"]
    laboratory: bool = False
    point_sd: FiniteFloat = Field(default=0.0, ge=0)
    markers: dict[str, SetMarkerModel] = Field(min_length=1)
    props: dict[str, tuple[str, ...]] = Field(default_factory=dict[str, tuple[str, ...]])

    @pydantic.field_validator("markers")
    @classmethod
    def _check_names_unique(cls, markers: dict[str, SetMarkerModel]) -> dict[str, SetMarkerModel]:
        names = Counter(fold_label(name) for label, marker in markers.items() for name in (label, *marker.aliases))
        if repeated := [name for name, count in names.items() if count > 1]:
            raise ValueError(f"{format_name_list(repeated)} names more than one marker; case and separators are ignored")
        if empty := [label for label in markers if not fold_label(label)]:
            raise ValueError(f"{format_name_list(empty)} has neither letters nor digits")
        return markers

    @pydantic.model_validator(mode="after")
    def _check_props(self) -> "MarkerSetModel":
        names = Counter(fold_label(label) for labels in self.props.values() for label in labels)
        names.update({fold_label(name) for label, marker in self.markers.items() for name in (label, *marker.aliases)})
        if repeated := [name for name, count in names.items() if count > 1]:
            raise ValueError(f"props: {format_name_list(repeated)} is on more than one prop, or also on the body")
        return self
