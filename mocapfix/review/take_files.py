"""The cleaned takes in an output folder, and the files of each: its decisions and its approval.

Every decision is saved at once in the changes file, and edits of others are never overwritten.
"""

import hashlib
import json
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, cast

from pydantic import Field, ValidationError

from mocapfix.errors import MocapfixError, ReadError, SceneError, format_name_list
from mocapfix.io.changes_file import (
    CHANGES_SUFFIX,
    MAX_NOTE_LENGTH,
    ChangesFileModel,
    CorrectionModel,
    format_change,
    join_changes_file,
)
from mocapfix.io.files import JSON_REPORT_SUFFIX, get_source_suffixes, replace_atomically
from mocapfix.io.yaml_files import StrictModel, read_yaml_model
from mocapfix.model.faults import Decision
from mocapfix.options import CleanOptions, parse_arguments

KEPT_REPORT_KEYS = ("take", "arguments", "notes")


@dataclass(frozen=True)
class CleanedTake:
    """A cleaned take, or one subject of it, and its files."""

    id: str  # path of its outputs without their suffixes, relative to the folder that is reviewed, with "/"
    folder: Path  # of its outputs
    stem: str  # of the names of its outputs
    report: dict[str, Any]  # the parts of the JSON report that a review needs: a session may have thousands

    @property
    def name(self) -> str:
        return str(self.report["take"]["file"])

    @property
    def subject(self) -> str:
        """The subject, "" for a take of one subject."""
        return str(self.report["take"].get("person", ""))

    @property
    def arguments(self) -> list[str]:
        """The input and the options with which the take was cleaned; empty if the report does not have them."""
        return list(self.report.get("arguments", ()))

    @cached_property
    def options(self) -> CleanOptions:
        """The options with which the take was cleaned; the files that they name are relative to the folder."""
        return parse_arguments(self.arguments[1:])

    @property
    def input_path(self) -> Path | None:
        """The input file; None if the report does not name it, or it is not there any more."""
        path = self.folder / self.arguments[0] if self.arguments else None
        return path if path and path.is_file() else None

    @property
    def cleaned_path(self) -> Path:
        return self.folder / f"{Path(self.name).stem}.{get_source_suffixes(Path(self.name))[0]}"

    def get_path(self, suffix: str) -> Path:
        """Return the path of an output of this take or subject."""
        return self.folder / f"{self.stem}.{suffix}"

    @property
    def changes_path(self) -> Path:
        return self.get_path(CHANGES_SUFFIX)

    @property
    def approval_path(self) -> Path:
        """The file that records the approval."""
        return self.get_path("approval.json")


def find_cleaned_takes(folder: Path) -> list[CleanedTake]:
    """Return the cleaned takes in an output folder of `clean` or `batch`, by their ids. Raises ReadError if there are none."""
    if not folder.is_dir():
        raise ReadError(f"{folder}: is no folder; name the output folder of `mocapfix clean` or `mocapfix batch`.")
    takes: list[CleanedTake] = []
    for parent, folders, names in os.walk(folder, followlinks=True):
        folders[:] = [name for name in folders if not name.startswith(".")]
        for name in names:
            if name.endswith(JSON_REPORT_SUFFIX) and not name.startswith("."):
                stem = name.removesuffix(JSON_REPORT_SUFFIX)
                take = read_cleaned_take(folder, Path(parent), stem)
                if take.changes_path.is_file():
                    takes.append(take)
    if not takes:
        raise ReadError(f"{folder}: holds no cleaned take; name the output folder of `mocapfix clean` or `mocapfix batch`.")
    return sorted(takes, key=lambda take: take.id)


def read_cleaned_take(root: Path, folder: Path, stem: str) -> CleanedTake:
    """Return the take whose outputs have a stem, in a folder below `root`. Raises ReadError if its report cannot be read."""
    path = folder / f"{stem}{JSON_REPORT_SUFFIX}"
    try:
        report = cast("dict[str, Any]", json.loads(path.read_bytes()))
        kept = {key: report[key] for key in KEPT_REPORT_KEYS if key in report}
        take = CleanedTake((folder.relative_to(root) / stem).as_posix(), folder, stem, kept)
        Path(take.name, take.subject, *take.arguments)  # raises TypeError if they are no texts
        _ = take.options
    except (MocapfixError, OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise ReadError(f"{path}: is damaged; clean the take again.") from error
    return take


def find_takes_of_one_file(take: CleanedTake, takes: Sequence[CleanedTake]) -> list[CleanedTake]:
    """Return the subjects that were cleaned with a take from one file, itself among them."""
    return [each for each in takes if each.folder == take.folder and each.name == take.name]


MAX_NAME_LENGTH = 200
ReviewState = Literal["untouched", "in review", "approved"]


class Approval(StrictModel):
    """An approval, as in its file."""

    name: str = Field(min_length=1, max_length=MAX_NAME_LENGTH)  # who approved
    date: str  # when, in ISO 8601 with time zone
    changes_sha256: str  # hash of the changes file that was approved: the approval ends with any further decision or cleaning


def read_approval(take: CleanedTake) -> Approval | None:
    """Return the approval of a take, None if there is none. Raises ReadError if it cannot be read."""
    try:
        return Approval.model_validate_json(take.approval_path.read_bytes())
    except FileNotFoundError:
        return None
    except (OSError, ValidationError) as error:
        raise ReadError(f"{take.approval_path}: is damaged; remove it, and approve the take again.") from error


def write_approval(take: CleanedTake, name: str) -> Approval:
    """Approve a take with its changes file as it is. Raises SceneError for a name that is not allowed, WriteError."""
    name = name.strip()
    if not 0 < len(name) <= MAX_NAME_LENGTH:
        raise SceneError(f"An approval needs a name of at most {MAX_NAME_LENGTH} characters.")
    date = datetime.now().astimezone().isoformat(timespec="seconds")
    approval = Approval(name=name, date=date, changes_sha256=hash_changes(take.changes_path))
    with replace_atomically(take.approval_path) as part:
        part.write_text(approval.model_dump_json(indent=1) + "\n", encoding="utf-8")
    return approval


def withdraw_approval(take: CleanedTake) -> None:
    take.approval_path.unlink(missing_ok=True)


def hash_changes(path: Path) -> str:
    """Return the hash of a changes file. Raises ReadError."""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise ReadError(f"{path}: cannot be read ({error.strerror or error}).") from error


def determine_state(file: ChangesFileModel, approval: Approval | None, revision: str) -> ReviewState:
    """Return how far the review of a take is. `revision` is the hash of its changes file."""
    if approval and approval.changes_sha256 == revision:
        return "approved"
    is_touched = bool(file.corrections) or any(change.reviewed or change.note for change in file.changes)
    return "in review" if is_touched or approval else "untouched"


MAX_UNDO_STEPS = 1000


class EditConflictError(MocapfixError):
    """The changes file is not what the editor knows: another page, program or person has changed it."""


class DecisionStore:
    """A changes file that is read once, and written at each edit.

    file, revision    its content, and the hash of its bytes, when it was last read or written
    check_correction  raises SceneError for a correction that the take does not allow
    """

    def __init__(self, path: Path, check_correction: Callable[[CorrectionModel], object] = lambda _: None) -> None:
        self.path = path
        self._check_correction = check_correction
        self._undo: list[ChangesFileModel] = []
        self._lines: dict[int, str] = {}  # of the changes in the version, by their identity: most stay the same in an edit
        self.file, self.revision = self._read()

    @property
    def undo_count(self) -> int:
        """How many edits can be undone."""
        return len(self._undo)

    def refresh(self) -> bool:
        """Read the file again if it was changed; return whether it was. Raises SceneError if it is invalid now."""
        if hash_changes(self.path) == self.revision:
            return False
        self.file, self.revision = self._read()
        self._undo.clear()
        self._lines.clear()
        return True

    def decide(self, revision: str, ids: Sequence[str], decision: Decision) -> None:
        """Decide on changes. Raises as `_save`, and SceneError if there is no such change."""
        chosen = set(ids)
        if unknown := chosen - {change.id for change in self.file.changes}:
            raise SceneError(f"{self.path.name}: has no change {format_name_list(sorted(unknown))}.")
        decided = {"decision": decision, "reviewed": True}
        changes = [change.model_copy(update=decided) if change.id in chosen else change for change in self.file.changes]
        self._save(revision, self.file.model_copy(update={"changes": changes}))

    def note(self, revision: str, name: str, text: str) -> None:
        """Note something on a change. Raises as `decide`, and if the text is too long."""
        if len(text) > MAX_NOTE_LENGTH:
            raise SceneError(f"A note can have {MAX_NOTE_LENGTH} characters; this one has {len(text)}.")
        if name not in {change.id for change in self.file.changes}:
            raise SceneError(f"{self.path.name}: has no change {name}.")
        changes = [change.model_copy(update={"note": text}) if change.id == name else change for change in self.file.changes]
        self._save(revision, self.file.model_copy(update={"changes": changes}))

    def add_correction(self, revision: str, values: object) -> None:
        """Add a correction. Raises as `_save`, and SceneError if its values are not allowed."""
        try:
            correction = CorrectionModel.model_validate(values)
        except ValidationError as error:
            first = error.errors()[0]
            key = ".".join(str(part) for part in first["loc"])
            raise SceneError(f"The correction is not allowed: {key} {first['msg'].removeprefix('Value error, ')}.") from error
        self._check_correction(correction)
        self._save(revision, self.file.model_copy(update={"corrections": [*self.file.corrections, correction]}))

    def remove_correction(self, revision: str, index: int) -> None:
        """Remove a correction by its index. Raises as `_save`, and SceneError if there is none."""
        corrections = list(self.file.corrections)
        if not 0 <= index < len(corrections):
            raise SceneError(f"{self.path.name}: has no correction {index + 1}.")
        del corrections[index]
        self._save(revision, self.file.model_copy(update={"corrections": corrections}))

    def undo(self, revision: str) -> None:
        """Undo the last edit. Raises as `_save`, and SceneError if there is none."""
        if not self._undo:
            raise SceneError("There is nothing to undo.")
        last, undo = self._undo[-1], self._undo[:-1]
        self._save(revision, last)
        self._undo = undo

    def _save(self, revision: str, file: ChangesFileModel) -> None:
        """Write the file.

        Raises EditConflictError if it is not the one that the editor knows, WriteError if it cannot be written.
        """
        if revision != self.revision or hash_changes(self.path) != self.revision:
            self.refresh()
            raise EditConflictError(
                f"{self.path.name} was changed by another page, program or person; your last edit is not saved. "
                "The page shows the file as it is now."
            )
        lines = {id(change): self._lines.get(id(change)) or format_change(change) for change in file.changes}
        data = join_changes_file(file.take, file.frames, list(lines.values()), file.corrections).encode()
        with replace_atomically(self.path) as part:
            part.write_bytes(data)
        self._lines = lines
        self._undo = [*self._undo[-MAX_UNDO_STEPS + 1 :], self.file]
        self.file, self.revision = file, hashlib.sha256(data).hexdigest()

    def _read(self) -> tuple[ChangesFileModel, str]:
        """Return the file as it is, and its hash. Raises SceneError, ReadError."""
        revision = hash_changes(self.path)
        while True:
            file, before = read_yaml_model(ChangesFileModel, self.path), revision
            if (revision := hash_changes(self.path)) == before:  # else it was replaced while it was read
                return file, revision
