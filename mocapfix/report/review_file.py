"""The changes file: every change to a take as YAML, for somebody to decide on and give back."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import yaml
from pydantic import Field

from mocapfix.changes import Change, Decision, SampleState, list_affected_markers
from mocapfix.errors import SceneError
from mocapfix.faults import MISSING_KINDS, SHIFT_KINDS, Fault, FaultKind
from mocapfix.files.output_files import replace_atomically
from mocapfix.files.yaml_models import StrictModel, read_yaml_model
from mocapfix.take import Take

REVIEW_FILE_HEADER = """\
# What mocapfix changed in a take, interval by interval; frames are the file's own, inclusive.
# To take something back, set its decision and clean the take again with --changes and this file:
#   accept  it is made
#   reject  it is not made: its samples stay as they were, and nothing else differs
#   keep    it is not made, and what was measured there is believed: the body follows it
"""


@dataclass(frozen=True)
class ReviewedChange:
    """A change that somebody decided not to accept: what it was, and the decision; indices into the take."""

    entry: dict
    markers: tuple[int, ...]
    first: int
    last: int
    decision: Decision

    def matches(self, fault: Fault) -> bool:
        """Is it this fault that was decided upon?"""
        return fault.kind == self.entry["kind"] and fault.marker == self.markers[0] and self._overlaps(fault)

    def keeps(self, fault: Fault) -> bool:
        """Did somebody say that what is there is right?"""
        return self.decision == "keep" and self.matches(fault)

    def rejects(self, fault: Fault) -> bool:
        """Did somebody say that it is to stay?"""
        return self.decision == "reject" and self.matches(fault)

    def to_change(self) -> Change:
        """-> the change as it was, with the decision, for the record of a cleaning that did not make it."""
        before = SampleState(**self.entry["before"])
        return Change(**{**self.entry, "markers": tuple(self.entry["markers"]), "before": before, "after": before, "samples": 0})

    def _overlaps(self, fault: Fault) -> bool:
        return fault.first <= self.last and self.first <= fault.last


def write_review_file(path: str | Path, take: Take, changes: Sequence[Change]) -> None:
    """Write the changes of a take. Raises WriteError where the folder cannot be written, and then leaves what was there."""
    said = {
        "take": take.name,
        "frames": [take.first_frame, take.get_frame_number(take.frame_count - 1)],
        "changes": serialize_changes(changes),
    }
    text = yaml.dump(said, Dumper=_ReviewFileDumper, sort_keys=False, allow_unicode=True, width=120)
    with replace_atomically(Path(path)) as part:
        part.write_text(REVIEW_FILE_HEADER + text, encoding="utf-8", newline="\n")


def serialize_changes(changes: Sequence[Change]) -> list[dict]:
    """-> the changes as plain data, as the record and the file hold them."""
    return [{**asdict(change), "markers": list(change.markers)} for change in changes]


def read_review_files(paths: Sequence[str | Path], takes: Sequence[Take]) -> list[tuple[ReviewedChange, ...]]:
    """-> what somebody decided of each take, in the file that is about it, if there is one. Raises SceneError as `load`."""
    names, about = [take.name for take in takes], {}
    for path in paths:
        name = read_yaml_model(_ReviewFileModel, Path(path)).take
        if name not in names:
            whose, one = " or ".join(names), any(name.startswith(f"{each} (") for each in names)
            alone = ", or say with --subject-prefix whose it is" if one else ""
            raise SceneError(f"{path}: take: is about {name}, not {whose}; give the file that its own cleaning wrote{alone}.")
        if name in about:
            raise SceneError(f"{path}: take: is about {name}, as {about[name]} is; give one of them.")
        about[name] = path
    return [read_review_file(about[take.name], take) if take.name in about else () for take in takes]


def read_review_file(path: str | Path, take: Take) -> tuple[ReviewedChange, ...]:
    """-> what of the changes in a file that `save` wrote somebody decided not to accept.

    Raises SceneError with the file and the path of the wrong key, also where the file is about another take.
    """
    form = read_yaml_model(_ReviewFileModel, Path(path))
    if form.take != take.name:
        raise SceneError(f"{path}: take: is about {form.take}, not {take.name}; give the file that its own cleaning wrote.")
    first, last = take.first_frame, take.get_frame_number(take.frame_count - 1)
    if form.frames != (first, last):
        raise SceneError(
            f"{path}: frames: is about frames {form.frames[0]} to {form.frames[1]}; {take.name} has {first} to {last}."
        )
    count = len(take.labels) + (len(take.unlabelled.labels) if take.unlabelled else 0)
    known = {}
    for index in reversed(range(count)):
        known[take.get_label(index)] = index
    decided = []
    for n, each in enumerate(form.changes):
        if strange := [label for label in each.markers if label not in known]:
            raise SceneError(f"{path}: changes.{n}.markers: {take.name} has no marker {', '.join(strange)}.")
        if not first <= each.first <= each.last <= last:
            raise SceneError(f"{path}: changes.{n}: frames {each.first} to {each.last} are not in {take.name}.")
        if each.decision != "accept":
            markers = tuple(known[label] for label in each.markers)
            decided.append(ReviewedChange(each.model_dump(), markers, each.first - first, each.last - first, each.decision))
    return tuple(decided)


def build_fault_filter(take: Take, reviewed_changes: tuple[ReviewedChange, ...]) -> Callable[[Fault], bool]:
    """-> whether a fault may be one, for all that somebody decided: none that touches what is kept as measured, and no
    marker has moved that is said not to have."""
    count = len(take.labels)
    kept = np.zeros((take.frame_count, count), bool)
    for each in reviewed_changes:
        if each.decision == "keep" and each.entry["kind"] not in (*MISSING_KINDS, *SHIFT_KINDS):
            kept[each.first : each.last + 1, [m for m in each.markers if m < count]] = True

    def stands(fault: Fault) -> bool:
        if fault.kind in MISSING_KINDS:
            return True  # nobody can vouch for what is not there
        if fault.kind in SHIFT_KINDS:
            return not any(each.matches(fault) for each in reviewed_changes)
        return not kept[fault.frame_slice][:, list_affected_markers(fault, count)].any()

    return stands


class _ReviewFileDumper(yaml.SafeDumper):
    """Short lists in one line."""


def _represent_list(dumper: yaml.SafeDumper, data: list) -> yaml.Node:
    return dumper.represent_sequence("tag:yaml.org,2002:seq", data, flow_style=not any(isinstance(each, dict) for each in data))


_ReviewFileDumper.add_representer(list, _represent_list)


class _IntervalStateModel(StrictModel):
    missing: int
    off_body_mm: float | None


class _ChangeModel(StrictModel):
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


class _ReviewFileModel(StrictModel):
    take: str
    frames: tuple[int, int]
    changes: list[_ChangeModel]
