"""The edits of a changes file: each kind is a class, each is saved at once, and what it changed can be undone.

Edits of others, made in another page or program, are never overwritten.
"""

import hashlib
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import Field, TypeAdapter, ValidationError

from mocapfix.errors import MocapfixError, ReadError, SceneError, format_name_list
from mocapfix.io.changes_file import format_change, join_changes_file, read_changes_model
from mocapfix.io.files import replace_atomically
from mocapfix.io.yaml_files import ChangesFileModel, CorrectionModel, NoteText, StrictModel
from mocapfix.model.faults import Decision


class FileEdit(StrictModel):
    """An edit of the content of a changes file. Each kind is a class, which `AnyEdit` names."""

    def change(self, file: ChangesFileModel) -> ChangesFileModel:
        """Return the content after the edit. Raises SceneError if it is not allowed."""
        raise NotImplementedError

    def apply(self, state: "EditedState") -> "EditedState":
        """Return the state after the edit. Raises as `change`."""
        file = self.change(state.file)
        return EditedState(file, (*state.done[-MAX_UNDO_STEPS + 1 :], _find_step(file, state.file)))


class DecideEdit(FileEdit):
    """A decision on changes."""

    type: Literal["decide"]
    ids: list[str]
    decision: Decision
    reviewer: NoteText = ""

    def change(self, file: ChangesFileModel) -> ChangesFileModel:
        return _update_changes(file, self.ids, {"decision": self.decision, "reviewed": True, "reviewer": self.reviewer})


class NoteEdit(FileEdit):
    """A note on a change."""

    type: Literal["note"]
    id: str
    text: NoteText

    def change(self, file: ChangesFileModel) -> ChangesFileModel:
        return _update_changes(file, [self.id], {"note": self.text})


class AddEdit(FileEdit):
    """New corrections."""

    type: Literal["add"]
    corrections: list[CorrectionModel]

    def change(self, file: ChangesFileModel) -> ChangesFileModel:
        return file.model_copy(update={"corrections": [*file.corrections, *self.corrections]})


class RemoveEdit(FileEdit):
    """The end of a correction, by its index."""

    type: Literal["remove"]
    index: int

    def change(self, file: ChangesFileModel) -> ChangesFileModel:
        corrections = list(file.corrections)
        if not 0 <= self.index < len(corrections):
            raise SceneError(f"The changes file has no correction {self.index + 1}.")
        del corrections[self.index]
        return file.model_copy(update={"corrections": corrections})


class CarryEdit(FileEdit):
    """The decisions by which `after` differs from `before`, in a later file: on the same ids, else kinds, markers and frames."""

    before: ChangesFileModel
    after: ChangesFileModel

    def change(self, file: ChangesFileModel) -> ChangesFileModel:
        before = {change.id: change for change in self.before.changes}
        for each in (change for change in self.after.changes if change != before.get(change.id)):
            same_kind = [one for one in file.changes if (one.kind, one.markers) == (each.kind, each.markers)]
            shared = [one.id for one in same_kind if one.first <= each.last and each.first <= one.last]
            found = [each.id] if each.id in (one.id for one in file.changes) else shared
            file = _update_changes(file, found, {key: getattr(each, key) for key in EDITED_KEYS})
            if not found and each.decision != "accept":
                file.changes.append(each.model_copy(update={"samples": 0, "after": each.before}))
        return file.model_copy(update={"corrections": self.after.corrections})

    def apply(self, state: "EditedState") -> "EditedState":
        """Return the state after the edit, which is not undone: no later edit belongs to the file without it."""
        return EditedState(self.change(state.file))


class StepEdit(StrictModel):
    """The undoing of the last edit, or the making again of the edit that was undone last."""

    type: Literal["undo", "redo"]

    def apply(self, state: "EditedState") -> "EditedState":
        """Return the state after the step. Raises SceneError if there is no such edit."""
        if not (steps := state.done if self.type == "undo" else state.undone):
            raise SceneError(f"There is nothing to {'undo' if self.type == 'undo' else 'make again'}.")
        file = _take_step(state.file, steps[-1])
        others = (*(state.undone if self.type == "undo" else state.done), _find_step(file, state.file))
        return EditedState(file, *((steps[:-1], others) if self.type == "undo" else (others, steps[:-1])))


AnyEdit = DecideEdit | NoteEdit | AddEdit | RemoveEdit | StepEdit
EDIT_ADAPTER: TypeAdapter[AnyEdit] = TypeAdapter(Annotated[AnyEdit, Field(discriminator="type")])
MAX_UNDO_STEPS = 1000


EDITED_KEYS = ("decision", "reviewed", "reviewer", "note")  # of a change
# What leads to another content of a changes file: the ids of the changes that differ, by their values there, and all corrections.
Step = tuple[dict[tuple[Any, ...], list[str]], list[CorrectionModel]]


def _find_step(file: ChangesFileModel, other: ChangesFileModel) -> Step:
    ids: dict[tuple[Any, ...], list[str]] = {}
    for one, new in zip(file.changes, other.changes, strict=True):
        if one is not new:
            ids.setdefault(tuple(getattr(new, key) for key in EDITED_KEYS), []).append(new.id)
    return ids, other.corrections


def _take_step(file: ChangesFileModel, step: Step) -> ChangesFileModel:
    for values, ids in step[0].items():
        file = _update_changes(file, ids, dict(zip(EDITED_KEYS, values, strict=True)))
    return file.model_copy(update={"corrections": step[1]})


class EditedState(NamedTuple):
    """The content of a changes file, the steps that undo its edits, and those that make them again, the next one last."""

    file: ChangesFileModel
    done: tuple[Step, ...] = ()
    undone: tuple[Step, ...] = ()


def parse_edit(action: object) -> AnyEdit:
    """Return an edit as the page sent it. Raises SceneError."""
    try:
        return EDIT_ADAPTER.validate_python(action)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        raise SceneError(f"The edit is not allowed: {key} {first['msg'].removeprefix('Value error, ')}.") from error


def _update_changes(file: ChangesFileModel, ids: Sequence[str], values: dict[str, Any]) -> ChangesFileModel:
    """Return the content with new values of some changes. Raises SceneError if there are no such changes."""
    chosen = set(ids)
    if unknown := chosen - {change.id for change in file.changes}:
        raise SceneError(f"{file.take}: has no change {format_name_list(sorted(unknown))}.")
    changes = [change.model_copy(update=values) if change.id in chosen else change for change in file.changes]
    return file.model_copy(update={"changes": changes})


def hash_changes(path: Path) -> str:
    """Return the hash of a changes file. Raises ReadError."""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise ReadError(f"{path}: cannot be read ({error.strerror or error}).") from error


def read_decisions(path: Path) -> tuple[ChangesFileModel, str]:
    """Return the content of a changes file and the hash of its bytes. Raises SceneError, ReadError."""
    revision = hash_changes(path)
    while True:
        file, before = _read_revision(path, revision), revision
        if (revision := hash_changes(path)) == before:  # else it was replaced while it was read
            return file, revision


@lru_cache(1)
def _read_revision(path: Path, _revision: str) -> ChangesFileModel:
    return read_changes_model(path)


class EditConflictError(MocapfixError):
    """The changes file is not what the editor knows: another page, program or person has changed it."""


class DecisionStore:
    """A changes file that is read once, and written at each edit.

    Attributes:
        state, revision: Its content with the edits, and the hash of its bytes, when it was last read or written.
        check_correction: Raises SceneError for a correction that the take does not allow.
    """

    def __init__(self, path: Path, check_correction: Callable[[CorrectionModel], object] = lambda _: None) -> None:
        self.path = path
        self._check_correction = check_correction
        self._read()

    @property
    def file(self) -> ChangesFileModel:
        """The content of the file."""
        return self.state.file

    def refresh(self) -> None:
        """Read the file again if it was changed. Raises SceneError if it is invalid now."""
        if hash_changes(self.path) != self.revision:
            self._read()

    def edit(self, revision: str, edit: AnyEdit | CarryEdit) -> None:
        """Make an edit, and write the file.

        Raises:
            EditConflictError: If it is not the one that the editor knows.
            SceneError: If the edit is not allowed.
            WriteError: If it cannot be written.
        """
        if revision != self.revision or hash_changes(self.path) != self.revision:
            self.refresh()
            raise EditConflictError(
                f"{self.path.name} was changed by another page, program or person; your last edit is not saved. "
                "The page shows the file as it is now."
            )
        state = edit.apply(self.state)
        for each in state.file.corrections:
            if each not in self.file.corrections:
                self._check_correction(each)
        file = state.file
        lines = {id(change): self._lines.get(id(change)) or format_change(change) for change in file.changes}
        data = join_changes_file(file.take, file.frames, list(lines.values()), file.corrections).encode()
        with replace_atomically(self.path) as part:
            part.write_bytes(data)
        self._lines, self.state, self.revision = lines, state, hashlib.sha256(data).hexdigest()

    def _read(self) -> None:
        """Read the file as it is. Raises as `read_decisions`."""
        file, self.revision = read_decisions(self.path)
        self.state = EditedState(file)
        self._lines: dict[int, str] = {}  # of the changes in the version, by their identity: most stay the same in an edit
