"""The models of a changes file: the changes of a take with a decision for each, and the corrections of the reviewer."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from mocapfix.faults import Decision, FaultKind
from mocapfix.files.yaml_models import StrictModel

CorrectionKind = Literal["wrong", "missing", "swap", "assign", "fill"]
RequestedFill = Literal["spline", "cluster", "body", "empty"]
MARKER_COUNTS: dict[CorrectionKind, int] = {"wrong": 1, "missing": 1, "swap": 2, "assign": 2, "fill": 1}
"""how many markers, or trajectories, a correction of each kind names"""
MAX_NOTE_LENGTH = 2000

NoteText = Annotated[str, Field(max_length=MAX_NOTE_LENGTH)]


class _IntervalStateModel(StrictModel):
    missing: int
    off_body_mm: float | None


class ChangeModel(StrictModel):
    """A change in a changes file; see mocapfix.changes.Change.

    reviewed  whether a person has decided
    note      what the reviewer wrote about it
    """

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
    reviewed: bool = False
    note: NoteText = ""


class CorrectionModel(StrictModel):
    """A correction by the reviewer, over frames in the file's own numbers, inclusive.

    kind     wrong: the samples of the marker are wrong, and are replaced. missing: they are removed, and the gap is filled.
             swap: the labels of two markers are exchanged. assign: the samples of an unlabelled trajectory are those of the
             marker, which is named first. fill: the missing or wrong samples are filled by `method`
    markers  labels
    method   how to fill; null unless the kind is fill
    """

    kind: CorrectionKind
    markers: list[str]
    first: int
    last: int
    method: RequestedFill | None = None
    note: NoteText = ""

    @model_validator(mode="after")
    def _check_markers_and_method(self) -> "CorrectionModel":
        count = MARKER_COUNTS[self.kind]
        if len(set(self.markers)) != count or len(self.markers) != count:
            names = {"swap": "two markers", "assign": "a marker and an unlabelled trajectory"}.get(self.kind, "one marker")
            raise ValueError(f"{self.kind} must name {names}")
        if (self.method is not None) != (self.kind == "fill"):
            text = "fill must have a method: spline, cluster, body or empty" if self.kind == "fill" else "only fill has a method"
            raise ValueError(text)
        return self


class ChangesFileModel(StrictModel):
    """A changes file.

    take         name of the take
    frames       its first and last frame
    corrections  those of the reviewer, in the order in which they are applied
    """

    take: str
    frames: tuple[int, int]
    changes: list[ChangeModel]
    corrections: list[CorrectionModel] = Field(default_factory=list)
