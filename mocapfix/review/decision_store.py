"""The changes file of a take while it is reviewed: every decision is saved at once, and edits of others are never overwritten."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from pydantic import ValidationError

from mocapfix.errors import MocapfixError, ReadError, SceneError, format_name_list
from mocapfix.io.files import replace_atomically
from mocapfix.io.yaml_files import read_yaml_model
from mocapfix.model.faults import Decision
from mocapfix.review.changes_file import MAX_NOTE_LENGTH, ChangesFileModel, CorrectionModel, format_change, join_changes_file

MAX_UNDO_STEPS = 1000


class EditConflictError(MocapfixError):
    """The changes file is not what the editor knows: another page, program or person has changed it."""


@dataclass(frozen=True)
class _Version:
    """The content of the file, and the hash of its bytes."""

    file: ChangesFileModel
    revision: str


class DecisionStore:
    """A changes file that is read once, and written at each edit.

    check_correction  raises SceneError for a correction that the take does not allow
    """

    def __init__(self, path: Path, check_correction: Callable[[CorrectionModel], object] = lambda _: None) -> None:
        self.path = path
        self._check_correction = check_correction
        self._undo: list[ChangesFileModel] = []
        self._lines: dict[int, str] = {}  # of the changes in the version, by their identity: most stay the same in an edit
        self._version = self._read()

    @property
    def file(self) -> ChangesFileModel:
        """The content of the file when it was last read or written."""
        return self._version.file

    @property
    def revision(self) -> str:
        """The hash of the file when it was last read or written."""
        return self._version.revision

    @property
    def undo_count(self) -> int:
        """How many edits can be undone."""
        return len(self._undo)

    def refresh(self) -> bool:
        """Read the file again if it was changed; return whether it was. Raises SceneError if it is invalid now."""
        if self._hash_file() == self._version.revision:
            return False
        self._version = self._read()
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
        if revision != self.revision or self._hash_file() != self.revision:
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
        self._version = _Version(file, hashlib.sha256(data).hexdigest())

    def _read(self) -> _Version:
        """Return the file as it is. Raises SceneError, ReadError."""
        revision = self._hash_file()
        while True:
            file = read_yaml_model(ChangesFileModel, self.path)
            again = self._hash_file()
            if again == revision:
                return _Version(file, revision)
            revision = again  # it was replaced while it was read

    def _hash_file(self) -> str:
        try:
            return hashlib.sha256(self.path.read_bytes()).hexdigest()
        except OSError as error:
            raise ReadError(f"{self.path}: cannot be read ({error.strerror or error}).") from error
