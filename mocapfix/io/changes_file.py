"""The changes file: all changes of a take as YAML, with a decision for each and the reviewer's own corrections.

It is written by a cleaning, edited by hand or in the browser, and read by the next cleaning.
"""

import json
import re
from bisect import bisect_left, bisect_right
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from itertools import accumulate
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from yaml import YAMLError

from mocapfix.errors import SceneError, TakeError, format_name_list, join_names
from mocapfix.io.files import replace_atomically
from mocapfix.io.shipped import InlineSequence, dump_yaml, load_yaml
from mocapfix.model.changes import Change, SampleState, list_affected_markers, serialize_changes
from mocapfix.model.faults import LABEL_KINDS, MISSING_KINDS, SHIFT_KINDS, Fault, FaultReview, Fragment
from mocapfix.model.take import Take
from mocapfix.model.windows import crop_intervals
from mocapfix.options import FillOptions

if TYPE_CHECKING:
    from mocapfix.io.yaml_files import ChangeModel, ChangesFileModel, CorrectionModel

MARK_REASONS = {"wrong": "A reviewer marked the samples as wrong.", "missing": "A reviewer marked the samples as missing."}
KEYS_REASON = "A reviewer set the samples by hand."
SWAP_REASON = "A reviewer exchanged the labels."
EXCLUDED_REASON = "excluded from editing by --keep or --frames"
ASSIGNMENT_REASON = "A reviewer assigned the trajectory to the marker."


@dataclass(frozen=True)
class Correction:
    """A correction of a take."""

    entry: "CorrectionModel"  # the correction as in the file
    markers: tuple[int, ...]  # indices of its markers and of an unlabelled trajectory in the take
    first: int  # first, last: frame indices, inclusive
    last: int
    is_exchange: bool = False  # a swap with a marker of another subject, in whose review it stands with that marker only

    @property
    def label_fault(self) -> Fault | None:
        """The fault of a swap within the take or an assignment, None for other corrections."""
        marker, frames = self.markers[0], (self.first, self.last)
        if self.entry.kind == "swap" and not self.is_exchange:
            return Fault("swap", marker, *frames, np.nan, SWAP_REASON, other_markers=self.markers[1:])
        if self.entry.kind == "assign":
            reason, donor = ASSIGNMENT_REASON, self.markers[1]
            return Fragment("fragment", marker, *frames, np.nan, reason, donor=donor, relation="replaces")
        return None

    @property
    def marked_fault(self) -> Fault | None:
        """The fault of a stretch that is wrong, missing or set by hand, None for other corrections."""
        reason = KEYS_REASON if self.entry.kind == "keys" else MARK_REASONS.get(self.entry.kind)
        return Fault("marked", self.markers[0], self.first, self.last, np.nan, reason) if reason else None


def list_label_corrections(corrections: Sequence[Correction]) -> list[Fault]:
    """Return the faults of labels that corrections name, in their order."""
    return [fault for each in corrections if (fault := each.label_fault)]


def is_prevented(entry: "CorrectionModel", options: FillOptions) -> bool:
    """Return whether the options `keep` and `frames` prevent a correction: that of labels for any sample, another for all."""
    first, last = options.frames or (entry.first, entry.last)
    is_outside = [entry.first < first or entry.last > last, entry.last < first or entry.first > last]
    names = {name for each in entry.markers for name in (each, each.rpartition(":")[2])}
    return is_outside[entry.kind not in ("swap", "assign")] or bool(names & {*options.keep})


def locate_correction(entry: "CorrectionModel", take: Take, place: str, all_labels: Sequence[str] = ()) -> Correction:
    """Return a correction with the indices of its markers and frames; the second label of a swap may be one of `all_labels`.

    Raises:
        SceneError: If the take does not have the markers or the frames.
    """
    markers, first, last = _locate_entry(entry, take, _index_labels(take, all_labels if entry.kind == "swap" else ()), place)
    is_exchange = markers[-1] >= len(take.labels) + (len(take.unlabelled.labels) if take.unlabelled else 0)
    labelled = markers[:1] if entry.kind == "assign" or is_exchange else markers
    if any(marker >= len(take.labels) for marker in labelled):
        raise SceneError(f"{place}.markers: {entry.kind} must name labelled markers, first of {take.name}; assign takes others.")
    if entry.kind == "assign" and markers[1] < len(take.labels):
        raise SceneError(f"{place}.markers: {entry.markers[1]} is a labelled marker; exchange labels with swap.")
    return Correction(entry, markers, first, last, is_exchange)


def _index_labels(take: Take, all_labels: Sequence[str] = ()) -> dict[str, int]:
    """Return the trajectory of each label: markers, unlabelled trajectories, and after these the labels of other subjects."""
    count = len(take.labels) + (len(take.unlabelled.labels) if take.unlabelled else 0)
    index_by_label = {label: count + index for index, label in enumerate(all_labels)}
    return index_by_label | {take.get_label(index): index for index in reversed(range(count))}  # the first of equal labels


def _locate_entry(
    entry: "CorrectionModel | ChangeModel", take: Take, index_by_label: Mapping[str, int], place: str
) -> tuple[tuple[int, ...], int, int]:
    """Return the indices of the markers and of the first and last frame of an entry. Raises SceneError if there are none."""
    if unknown := [label for label in entry.markers if label not in index_by_label]:
        raise SceneError(f"{place}.markers: {take.name} has no marker {format_name_list(unknown)}.")
    first, last = take.first_frame, take.get_frame_number(take.frame_count - 1)
    if not first <= entry.first <= entry.last <= last:
        raise SceneError(f"{place}: frames {entry.first} to {entry.last} are not in {take.name}, which has {first} to {last}.")
    return tuple(index_by_label[label] for label in entry.markers), entry.first - first, entry.last - first


@dataclass(frozen=True)
class ReviewedChange:
    """A change that a review declined."""

    entry: "ChangeModel"  # the change as in the file
    markers: tuple[int, ...]  # indices of its markers and unlabelled trajectories in the take
    first: int  # first, last: frame indices, inclusive
    last: int

    def matches(self, fault: Fault) -> bool:
        """Return whether the change corrected this fault: the same kind and marker, and overlapping frames."""
        is_same = fault.kind == self.entry.kind and fault.marker == self.markers[0]
        return is_same and fault.first <= self.last and self.first <= fault.last

    def keeps(self, fault: Fault) -> bool:
        """Return whether the review declares the samples of this fault correct."""
        return self.entry.decision == "keep" and self.matches(fault)

    def rejects(self, fault: Fault) -> bool:
        """Return whether the review leaves this fault uncorrected."""
        return self.entry.decision == "reject" and self.matches(fault)

    def to_change(self) -> Change:
        """Return the change with its decision, as an entry of a report in which it is not applied."""
        fields = self.entry.model_dump(exclude={"reviewed", "reviewer", "note"})
        fields["markers"], fields["samples"] = tuple(self.entry.markers), 0
        fields["before"] = fields["after"] = SampleState(**fields["before"])
        return Change(**fields)


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


CHANGES_SUFFIX = "changes.yaml"
CHANGES_KEY = "changes"
CHANGES_FILE_HEADER = """\
# Changes that mocapfix made to a take, interval by interval. Frame numbers are the file's own, inclusive.
# To decline a change, edit its decision and clean the take again with --changes and this file:
#   accept  apply the change
#   reject  do not apply the change; the samples stay as they were, and nothing else is affected
#   keep    do not apply the change; leave the samples as they are and use them in the solve
# Corrections of your own, under the key corrections, are applied as well:
#   - {kind: wrong, markers: [LKNE], first: 10, last: 20}             the samples are wrong: replace them
#   - {kind: missing, markers: [LKNE], first: 10, last: 20}           remove the samples, and fill the gap
#   - {kind: swap, markers: [LKNE, LSHN], first: 10, last: 20}        exchange the labels of two markers
#   - {kind: assign, markers: [LKNE, "*12"], first: 10, last: 20}     give an unlabelled trajectory to a marker
#   - {kind: fill, markers: [LKNE], first: 10, last: 20, method: M}   fill by M: spline, cluster, rigid_group,
#     body, gaussian_process, line or empty
#   - {kind: keys, markers: [LKNE], first: 10, last: 20, points: [[12, 104.5, 910.0, -30.0], [18, 110.0, 912.5, -31.0]]}
#                       the samples are a spline through points: the frame, and x, y (up) and z in millimetres
"""
CHANGES_FILE_LINE_LENGTH = 120  # characters


@dataclass(frozen=True)
class Review:
    """What a reviewer decided about a take."""

    declined: tuple[ReviewedChange, ...] = ()  # changes that are not made
    corrections: tuple[Correction, ...] = ()  # the reviewer's own, in the order in which they are applied
    reviewers: Mapping[str, str] = field(default_factory=dict[str, str])  # who has decided on a change, by its id; "" if unknown
    notes: Mapping[str, str] = field(default_factory=dict[str, str])  # the reviewer's notes by id of the change

    @property
    def own_corrections(self) -> list[Correction]:
        """Those in the changes file of the take; exchanges with a subject may stand in the file of that subject."""
        return [each for each in self.corrections if len(each.markers) == len(each.entry.markers)]

    def report_corrections(self, options: FillOptions) -> tuple[list[dict[str, Any]], list[str]]:
        """Return those of its own that are made, as in the file, and notes on those that the options prevent."""
        own = [(each.entry, is_prevented(each.entry, options)) for each in self.own_corrections]
        note = f"A correction is not made ({{0.kind}} {{1}}, frames {{0.first}} to {{0.last}}): {EXCLUDED_REASON}."
        notes = [note.format(each, join_names(each.markers)) for each, is_left in own if is_left]
        return [each.model_dump(mode="json") for each, is_left in own if not is_left], notes

    def select_frames(self, frames: slice) -> "Review":
        """Return the review of a part of the take."""
        declined, corrections = (crop_intervals(each, frames) for each in (self.declined, self.corrections))
        return replace(self, declined=tuple(declined), corrections=tuple(corrections))


NO_REVIEW = Review()


def write_changes_file(path: str | Path, take: Take, changes: Sequence[Change], review: Review = NO_REVIEW) -> None:
    """Write the changes of a take, with what the reviewer noted on them and the corrections.

    Raises:
        WriteError: If the folder cannot be written; an existing file stays as it is then.
    """
    remarks = partial(_describe_remarks, review.reviewers, review.notes)
    lines = [_format_entry({**entry, **remarks(entry["id"])}) for entry in serialize_changes(changes)]
    frames = (take.first_frame, take.get_frame_number(take.frame_count - 1))
    text = join_changes_file(take.name, frames, lines, [each.entry for each in review.own_corrections])
    with replace_atomically(Path(path)) as part:
        part.write_text(text, encoding="utf-8", newline="\n")


def join_changes_file(
    take: str, frames: tuple[int, int], changes: Sequence[str], corrections: Sequence["CorrectionModel"]
) -> str:
    """Return the text of a changes file, given the lines of its changes."""
    text = CHANGES_FILE_HEADER + dump_yaml({"take": take, "frames": InlineSequence(frames)}, CHANGES_FILE_LINE_LENGTH)
    text += f"{CHANGES_KEY}:\n" + "".join(changes) if changes else dump_yaml({CHANGES_KEY: []})
    if corrections:
        own = [each.model_dump(exclude_defaults=True) for each in corrections]
        own = [entry | {key: InlineSequence(entry[key]) for key in {"markers", "points"} & set(entry)} for entry in own]
        text += dump_yaml({"corrections": own}, CHANGES_FILE_LINE_LENGTH)
    return text


def format_change(change: "ChangeModel") -> str:
    """Return the lines of one change in a changes file."""
    remarks = _describe_remarks({change.id: change.reviewer} if change.reviewed else {}, {change.id: change.note}, change.id)
    return _format_entry(change.model_dump(exclude={"reviewed", "reviewer", "note"}) | remarks)


def _describe_remarks(reviewers: Mapping[str, str], notes: Mapping[str, str], name: str) -> dict[str, Any]:
    """Return the keys of a change that a reviewer has decided on or noted."""
    remarks: dict[str, Any] = {"reviewed": True} if name in reviewers else {}
    remarks |= {"reviewer": reviewers[name]} if reviewers.get(name) else {}
    return remarks | ({"note": notes[name]} if notes.get(name) else {})


_PLAIN_TEXT = re.compile(r"(?ai)(?!(y|n|yes|no|on|off|true|false|null)$)[a-z_]([\w.()/*-]|:(?=\w)|,? (?=[\w(]))*")
_PLAIN_NUMBER = re.compile(r"-?\d+(\.\d+)?|null|true|false")
_QUOTED_LABEL = re.compile(r"(?ai)[a-z_]\w*(:\w+)+|\*\w+")  # in a list: with a colon or a star
MAX_KEPT_TEXTS = 4096  # of values: most entries of a long take have the same kinds, reasons and small numbers
_NOT_PLAIN = "\0"  # in place of a value that YAML has in quotes or otherwise


def _format_entry(entry: Mapping[str, Any]) -> str:
    """Return the lines of a change, as `dump_yaml` writes them: it takes ten times as long, and is left to what needs quotes."""
    if plain := _format_plain_entry(entry):
        return plain
    data = {CHANGES_KEY: [{**entry, "markers": InlineSequence(entry["markers"])}]}
    return dump_yaml(data, CHANGES_FILE_LINE_LENGTH).removeprefix(f"{CHANGES_KEY}:\n")


def _format_plain_entry(entry: Mapping[str, Any]) -> str:
    """Return the lines of a change without quotes but those of labels, "" if it needs others."""
    lines: list[str] = []
    for key, value in entry.items():
        if isinstance(value, dict):
            parts = cast("Mapping[str, object]", value)
            lines += [f"  {key}:", *(f"    {name}: {_format_plain_value(part)}" for name, part in parts.items())]
        elif key == "markers":
            is_quoted, plain = _QUOTED_LABEL.fullmatch, _format_plain_value
            labels = [f"'{each}'" if is_quoted(each) else plain(each.replace(",", _NOT_PLAIN)) for each in value]
            lines.append(f"  {key}: [{', '.join(labels)}]")
        else:
            lines.append(f"  {key}: {_format_plain_value(value)}")
    text = "- " + "\n".join(lines)[2:] + "\n"
    return "" if max(map(len, lines)) > CHANGES_FILE_LINE_LENGTH or _NOT_PLAIN in text else text


@lru_cache(MAX_KEPT_TEXTS, typed=True)
def _format_plain_value(value: object) -> str:
    text = value if isinstance(value, str) else json.dumps(value)
    return text if (_PLAIN_TEXT if isinstance(value, str) else _PLAIN_NUMBER).fullmatch(text) else _NOT_PLAIN


_ENTRIES = re.compile(rf"^{CHANGES_KEY}:\n((?:- \w[^\n]*\n(?:  [^\n]*\n)*)+)", re.MULTILINE)
_ENTRY_LINE = re.compile(r"^(?:- |  )(  )?(\w+):(?: (.+))?$", re.MULTILINE)


def load_changes(text: str) -> Any:
    """Return what `load_yaml` returns of a changes file: it takes seven times as long, and is left to what is not plain."""
    if "&" in text or text.count(f"{CHANGES_KEY}:") != 1 or not (match := _ENTRIES.search(text)):  # anchors join entries
        return load_yaml(text)
    start, end = match.span(1)
    with suppress(YAMLError, ValueError, TypeError, KeyError):  # an entry is none without the others, or the file is invalid
        entries = [_parse_entry(f"- {each}\n") for each in text[start + 2 : end - 1].split("\n- ")]
        if (rest := load_yaml(text[:start] + text[end:]))[CHANGES_KEY] is None:
            return rest | {CHANGES_KEY: entries}
    return load_yaml(text)


def _parse_entry(lines: str) -> Any:
    """Return the change in its lines. They are plain if they are those that `_format_plain_entry` writes of it."""
    entry = part = dict[str, Any]()
    for inner, key, text in _ENTRY_LINE.findall(lines):
        if key == "markers":
            entry[key] = [each.strip("'") for each in text[1:-1].split(", ")]
        elif text:
            (part if inner else entry)[key] = json.loads(text) if _PLAIN_NUMBER.fullmatch(text) else text
        else:
            part = entry[key] = dict[str, Any]()
    if {} in entry.values() or _format_plain_entry(entry) != lines:  # a key without a value is null
        (entry,) = load_yaml(lines)
    return entry


def read_changes_files(paths: Sequence[str | Path], takes: Sequence[Take], all_labels: Sequence[str] = ()) -> list[Review]:
    """Return the review of each take, from the file on that take, if there is one.

    `all_labels` are those of the file: a subject may exchange labels with another one. An exchange that a reviewer makes stands
    in the file of the subject of its first marker, and is among the corrections of both.

    Raises SceneError as `read_changes_file`, if two files are on one take or a file is on none of them, and for an exchange with
    a subject that is not among the takes.
    """
    names = [take.name for take in takes]
    path_by_take: dict[str, str | Path] = {}
    for path in paths:
        name = read_changes_model(path).take
        if name not in names:
            is_subject = any(name.startswith(f"{each} (") for each in names)
            remedy = ", or select the subject with --subject-prefix" if is_subject else ""
            raise SceneError(
                f"{path}: take: the file is for {name}, not for {' or '.join(names)}; use the changes file of this take{remedy}."
            )
        if name in path_by_take:
            raise SceneError(f"{path}: take: {path_by_take[name]} is for {name} as well; give one of them.")
        path_by_take[name] = path
    reviews = {take.name: NO_REVIEW for take in takes}
    for take in (each for each in takes if each.name in path_by_take):
        reviews[take.name] = read_changes_file(path_by_take[take.name], take, all_labels)
    for name, each in [(name, each) for name, review in reviews.items() for each in review.corrections if each.is_exchange]:
        other = next((take for take in takes if each.entry.markers[1] in take.labels), None)
        if other is None:
            raise SceneError(
                f"{path_by_take[name]}: corrections: {each.entry.markers[1]} is not cleaned with it; clean all subjects."
            )
        mirrored = replace(each, markers=(other.labels.index(each.entry.markers[1]),))
        reviews[other.name] = replace(reviews[other.name], corrections=(*reviews[other.name].corrections, mirrored))
    return list(reviews.values())


def read_changes_model(path: str | Path) -> "ChangesFileModel":
    """Read a changes file. Raises SceneError as `read_yaml_model` does."""
    from mocapfix.io.yaml_files import ChangesFileModel, read_yaml_model

    return read_yaml_model(ChangesFileModel, Path(path), load_changes)


def read_changes_file(path: str | Path, take: Take, all_labels: Sequence[str] = ()) -> Review:
    """Return the review in a changes file. Markers of other subjects have higher indices.

    Raises SceneError with the file and the key if the file is invalid or is for another take.
    """
    file = read_changes_model(path)
    if file.take != take.name:
        raise SceneError(f"{path}: take: the file is for {file.take}, not for {take.name}; use the changes file of this take.")
    first, last = take.first_frame, take.get_frame_number(take.frame_count - 1)
    if file.frames != (first, last):
        raise SceneError(
            f"{path}: frames: the file is for frames {file.frames[0]} to {file.frames[1]}; {take.name} has {first} to {last}."
        )
    index_by_label = _index_labels(take, all_labels)
    located = [(each, _locate_entry(each, take, index_by_label, f"{path}: changes.{n}")) for n, each in enumerate(file.changes)]
    declined = tuple(ReviewedChange(each, *places) for each, places in located if each.decision != "accept")
    corrections = (
        locate_correction(entry, take, f"{path}: corrections.{n}", all_labels) for n, entry in enumerate(file.corrections)
    )
    reviewers = {entry.id: entry.reviewer for entry in file.changes if entry.reviewed}
    return Review(declined, tuple(corrections), reviewers, {entry.id: entry.note for entry in file.changes if entry.note})


def build_fault_review(take: Take, review: Review) -> FaultReview:
    """Return what a review says of the faults of a take.

    Not accepted are faults of samples that the review keeps as measured, marker shifts that it declines, and faults of labels
    that the reviewer corrected.
    """
    count, index = len(take.labels), ReviewIndex(review.declined)
    kept = np.zeros((take.frame_count, count), bool)
    for each in review.declined:
        if each.entry.decision == "keep" and each.entry.kind not in (*MISSING_KINDS, *SHIFT_KINDS):
            kept[each.first : each.last + 1, [m for m in each.markers if m < count]] = True
    labels, has_corrected_label = list_label_corrections(review.corrections), np.zeros(kept.shape, bool)
    for fault in labels:
        has_corrected_label[fault.frame_slice, list(fault.markers)] = True
    for each in (correction for correction in review.corrections if correction.is_exchange):
        has_corrected_label[each.first : each.last + 1, each.markers[0]] = True

    def is_accepted(fault: Fault) -> bool:
        if fault.kind in MISSING_KINDS:
            return True  # missing samples cannot be declared correct
        if fault.kind in SHIFT_KINDS:
            return not index.find_matches(fault)
        samples = fault.frame_slice, list_affected_markers(fault, count)
        if (fault.kind in LABEL_KINDS or isinstance(fault, Fragment)) and has_corrected_label[samples[0]][:, samples[1]].any():
            return False
        return not kept[samples[0]][:, samples[1]].any()

    return FaultReview(tuple(labels), tuple(fault for each in review.corrections if (fault := each.marked_fault)), is_accepted)


def reject_corrections(review: Review, name: str, kind: str) -> None:
    """Raise TakeError if a review has corrections and is on another kind of file than markers, such as "this is an animation"."""
    if review.corrections:
        raise TakeError(f"{name}: corrections in a changes file are for markers, and {kind}; remove them.")
