"""The review file: all changes of a take as YAML, with a decision for each, to be edited and read back."""

from bisect import bisect_left, bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path

import numpy as np
from pydantic import Field

from mocapfix.changes import Change, Decision, SampleState, list_affected_markers
from mocapfix.errors import SceneError
from mocapfix.faults import MISSING_KINDS, SHIFT_KINDS, Fault, FaultKind
from mocapfix.files.output_files import replace_atomically
from mocapfix.files.yaml_lists import dump_yaml_list
from mocapfix.files.yaml_models import InlineSequence, StrictModel, dump_yaml, read_yaml_model
from mocapfix.report.report import ChangeEntry
from mocapfix.take import Take

REVIEW_FILE_HEADER = """\
# Changes that mocapfix made to a take, interval by interval. Frame numbers are the file's own, inclusive.
# To decline a change, edit its decision and clean the take again with --changes and this file:
#   accept  apply the change
#   reject  do not apply the change; the samples stay as they were, and nothing else is affected
#   keep    do not apply the change; leave the samples as they are and use them in the solve
"""
REVIEW_FILE_LINE_LENGTH = 120  # characters


class _IntervalStateModel(StrictModel):
    missing: int
    off_body_mm: float | None


class ChangeModel(StrictModel):
    """A change in a review file; see mocapfix.changes.Change."""

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
    changes: list[ChangeModel]


@dataclass(frozen=True)
class ReviewedChange:
    """A change that a review declined.

    entry        the change as in the file
    markers      indices of its markers and unlabelled trajectories in the take
    first, last  frame indices, inclusive
    """

    entry: ChangeModel
    markers: tuple[int, ...]
    first: int
    last: int

    @property
    def decision(self) -> Decision:
        """ "reject" or "keep"."""
        return self.entry.decision

    def matches(self, fault: Fault) -> bool:
        """Return whether the change corrected this fault: the same kind and marker, and overlapping frames."""
        return fault.kind == self.entry.kind and fault.marker == self.markers[0] and self._overlaps(fault)

    def keeps(self, fault: Fault) -> bool:
        """Return whether the review declares the samples of this fault correct."""
        return self.decision == "keep" and self.matches(fault)

    def rejects(self, fault: Fault) -> bool:
        """Return whether the review leaves this fault uncorrected."""
        return self.decision == "reject" and self.matches(fault)

    def to_change(self) -> Change:
        """Return the change with its decision, as an entry of a report in which it is not applied."""
        entry = self.entry
        state = SampleState(entry.before.missing, entry.before.off_body_mm)
        return Change(
            id=entry.id,
            kind=entry.kind,
            markers=tuple(entry.markers),
            first=entry.first,
            last=entry.last,
            samples=0,
            why=entry.why,
            method=entry.method,
            before=state,
            after=state,
            predicted_mm=entry.predicted_mm,
            decision=entry.decision,
        )

    def _overlaps(self, fault: Fault) -> bool:
        return fault.first <= self.last and self.first <= fault.last


class ReviewIndex:
    """Declined changes by kind and marker and in order of time, so that those that match a fault are found without a search."""

    def __init__(self, reviewed_changes: Sequence[ReviewedChange]) -> None:
        groups: dict[tuple[str, int], list[int]] = {}
        for n, each in enumerate(reviewed_changes):
            groups.setdefault((each.entry.kind, each.markers[0]), []).append(n)
        self._changes = reviewed_changes
        self._groups = {key: self._order_by_time(numbers) for key, numbers in groups.items()}

    def find_matches(self, fault: Fault) -> list[ReviewedChange]:
        """Return the changes that corrected this fault, in the order of the review file."""
        group = self._groups.get((fault.kind, fault.marker))
        if group is None:
            return []
        numbers, first, latest = group
        nearby = numbers[bisect_left(latest, fault.first) : bisect_right(first, fault.last)]
        return [self._changes[n] for n in sorted(nearby) if self._changes[n].matches(fault)]

    def _order_by_time(self, numbers: list[int]) -> tuple[list[int], list[int], list[int]]:
        """Return the numbers of changes in order of time, their first frames, and the latest frame that any so far reaches."""
        ordered = sorted(numbers, key=lambda n: self._changes[n].first)
        latest = accumulate((self._changes[n].last for n in ordered), max)
        return ordered, [self._changes[n].first for n in ordered], list(latest)


def write_review_file(path: str | Path, take: Take, changes: Sequence[Change]) -> None:
    """Write the changes of a take.

    Raises WriteError if the folder cannot be written; an existing file stays as it is then.
    """
    last_frame = take.get_frame_number(take.frame_count - 1)
    entries = [{**entry, "markers": InlineSequence(entry["markers"])} for entry in serialize_changes(changes)]
    head = {"take": take.name, "frames": InlineSequence([take.first_frame, last_frame])}
    with replace_atomically(Path(path)) as part:
        changes_text = dump_yaml_list("changes", entries, REVIEW_FILE_LINE_LENGTH)
        text = REVIEW_FILE_HEADER + dump_yaml(head, REVIEW_FILE_LINE_LENGTH) + changes_text
        part.write_text(text, encoding="utf-8", newline="\n")


def serialize_changes(changes: Sequence[Change]) -> list[ChangeEntry]:
    """Return the changes as plain data, as in the review file and the JSON report."""
    return [
        {
            "id": change.id,
            "kind": change.kind,
            "markers": list(change.markers),
            "first": change.first,
            "last": change.last,
            "samples": change.samples,
            "why": change.why,
            "method": change.method,
            "before": {"missing": change.before.missing, "off_body_mm": change.before.off_body_mm},
            "after": {"missing": change.after.missing, "off_body_mm": change.after.off_body_mm},
            "predicted_mm": change.predicted_mm,
            "decision": change.decision,
        }
        for change in changes
    ]


def read_review_files(
    paths: Sequence[str | Path], takes: Sequence[Take], all_labels: Sequence[str] = ()
) -> list[tuple[ReviewedChange, ...]]:
    """Return the declined changes of each take, from the file on that take, if there is one.

    `all_labels` are those of the file: a subject may exchange labels with another one.

    Raises SceneError as `read_review_file`, and if two files are on one take or a file is on none of them.
    """
    names = [take.name for take in takes]
    path_by_take: dict[str, str | Path] = {}
    for path in paths:
        name = read_yaml_model(_ReviewFileModel, Path(path)).take
        if name not in names:
            is_subject = any(name.startswith(f"{each} (") for each in names)
            remedy = ", or select the subject with --subject-prefix" if is_subject else ""
            raise SceneError(
                f"{path}: take: the file is for {name}, not for {' or '.join(names)}; use the review file of this take{remedy}."
            )
        if name in path_by_take:
            raise SceneError(f"{path}: take: {path_by_take[name]} is for {name} as well; give one of them.")
        path_by_take[name] = path
    return [read_review_file(path_by_take[take.name], take, all_labels) if take.name in path_by_take else () for take in takes]


def read_review_file(path: str | Path, take: Take, all_labels: Sequence[str] = ()) -> tuple[ReviewedChange, ...]:
    """Return the declined changes in a file written by `write_review_file`. Markers of other subjects have higher indices.

    Raises SceneError with the file and the key if the file is invalid or is for another take.
    """
    file = read_yaml_model(_ReviewFileModel, Path(path))
    if file.take != take.name:
        raise SceneError(f"{path}: take: the file is for {file.take}, not for {take.name}; use the review file of this take.")
    first, last = take.first_frame, take.get_frame_number(take.frame_count - 1)
    if file.frames != (first, last):
        raise SceneError(
            f"{path}: frames: the file is for frames {file.frames[0]} to {file.frames[1]}; {take.name} has {first} to {last}."
        )
    count = len(take.labels) + (len(take.unlabelled.labels) if take.unlabelled else 0)
    index_by_label = {label: count + index for index, label in enumerate(all_labels)}
    index_by_label |= {take.get_label(index): index for index in reversed(range(count))}  # the first of equal labels
    declined: list[ReviewedChange] = []
    for n, entry in enumerate(file.changes):
        if unknown := [label for label in entry.markers if label not in index_by_label]:
            raise SceneError(f"{path}: changes.{n}.markers: {take.name} has no marker {', '.join(unknown)}.")
        if not first <= entry.first <= entry.last <= last:
            raise SceneError(f"{path}: changes.{n}: frames {entry.first} to {entry.last} are not in {take.name}.")
        if entry.decision != "accept":
            markers = tuple(index_by_label[label] for label in entry.markers)
            declined.append(ReviewedChange(entry, markers, entry.first - first, entry.last - first))
    return tuple(declined)


def build_fault_filter(take: Take, reviewed_changes: Sequence[ReviewedChange]) -> Callable[[Fault], bool]:
    """Return the function that decides whether a fault may be detected.

    Excluded are faults of samples that the review keeps as measured, and marker shifts that the review declines.
    """
    count, index = len(take.labels), ReviewIndex(reviewed_changes)
    kept = np.zeros((take.frame_count, count), bool)
    for each in reviewed_changes:
        if each.decision == "keep" and each.entry.kind not in (*MISSING_KINDS, *SHIFT_KINDS):
            kept[each.first : each.last + 1, [m for m in each.markers if m < count]] = True

    def is_accepted(fault: Fault) -> bool:
        if fault.kind in MISSING_KINDS:
            return True  # missing samples cannot be declared correct
        if fault.kind in SHIFT_KINDS:
            return not index.find_matches(fault)
        return not kept[fault.frame_slice][:, list_affected_markers(fault, count)].any()

    return is_accepted
