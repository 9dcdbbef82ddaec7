"""Approvals: who approved a reviewed take, when, and with which decisions."""

import hashlib
from datetime import datetime
from typing import Literal

from pydantic import Field, ValidationError

from mocapfix.errors import ReadError, SceneError
from mocapfix.files.output_files import replace_atomically
from mocapfix.files.yaml_models import StrictModel
from mocapfix.review.file_models import ChangesFileModel
from mocapfix.review.take_files import CleanedTake

MAX_NAME_LENGTH = 200
ReviewState = Literal["untouched", "in review", "approved"]


class Approval(StrictModel):
    """An approval, as in its file.

    name            who approved
    date            when, in ISO 8601 with time zone
    changes_sha256  hash of the changes file that was approved: the approval ends with any further decision or cleaning
    """

    name: str = Field(min_length=1, max_length=MAX_NAME_LENGTH)
    date: str
    changes_sha256: str


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
    approval = Approval(name=name, date=date, changes_sha256=hash_changes(take))
    with replace_atomically(take.approval_path) as part:
        part.write_text(approval.model_dump_json(indent=1) + "\n", encoding="utf-8")
    return approval


def withdraw_approval(take: CleanedTake) -> None:
    """Remove the approval of a take, if there is one."""
    take.approval_path.unlink(missing_ok=True)


def hash_changes(take: CleanedTake) -> str:
    """Return the hash of a take's changes file. Raises ReadError."""
    try:
        return hashlib.sha256(take.changes_path.read_bytes()).hexdigest()
    except OSError as error:
        raise ReadError(f"{take.changes_path}: cannot be read ({error.strerror or error}).") from error


def determine_state(file: ChangesFileModel, approval: Approval | None, revision: str) -> ReviewState:
    """Return how far the review of a take is. `revision` is the hash of its changes file."""
    if approval and approval.changes_sha256 == revision:
        return "approved"
    is_touched = bool(file.corrections) or any(change.reviewed or change.note for change in file.changes)
    return "in review" if is_touched or approval else "untouched"
