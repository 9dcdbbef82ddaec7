"""The takes of a folder under review, and what happens to them, for all pages that show them."""

import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from mocapfix.errors import MocapfixError, ReadError
from mocapfix.files.yaml_models import read_yaml_model
from mocapfix.review.approvals import determine_state, hash_changes, read_approval
from mocapfix.review.cleaning_run import RunStatus
from mocapfix.review.file_models import ChangesFileModel
from mocapfix.review.open_take import OpenTake
from mocapfix.review.take_files import CleanedTake, find_cleaned_takes, find_takes_of_one_file

Event = dict[str, Any]
MAX_OPEN_VIEWS = 2
"""takes whose samples are kept in memory"""


class ReviewSession:
    """The cleaned takes below a folder.

    Raises ReadError if there are none.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._takes = {take.id: take for take in find_cleaned_takes(folder)}
        self._open: dict[str, OpenTake] = {}
        self._lock = threading.RLock()
        self._listeners: list[Callable[[Event], None]] = []

    @property
    def ids(self) -> list[str]:
        """The ids of all takes."""
        return list(self._takes)

    @property
    def is_running(self) -> bool:
        """Whether any take is being cleaned."""
        return any(each.is_running for each in list(self._open.values()))

    def add_listener(self, receive: Callable[[Event], None]) -> Callable[[], None]:
        """Call a function with every event from now on; return the function that ends this."""
        with self._lock:
            self._listeners.append(receive)

        def remove() -> None:
            with self._lock:
                self._listeners.remove(receive)

        return remove

    def announce(self, event: Event) -> None:
        """Send an event to all pages."""
        with self._lock:
            for receive in self._listeners:
                receive(event)

    def describe(self) -> dict[str, Any]:
        """Return the list of takes with their states."""
        return {
            "folder": str(self.folder.resolve().name),
            "is_batch": len(self._takes) > 1,
            "takes": [describe_take(take) for take in self._takes.values()],
        }

    def open_take(self, name: str) -> OpenTake:
        """Return a take under review. Raises ReadError if there is none of this id, or its files are damaged."""
        with self._lock:
            if name not in self._takes:
                raise ReadError(f"{name}: is no take of this review.")
            if name not in self._open:
                take = self._takes[name]
                self._open[name] = OpenTake(take, find_takes_of_one_file(take, list(self._takes.values())))
            opened = self._open.pop(name)
            self._open[name] = opened  # the last is the one that was used last
            for other in list(self._open.values())[:-MAX_OPEN_VIEWS]:
                other.release_view()
            return opened

    def edit(self, name: str, revision: str, action: Mapping[str, Any]) -> dict[str, Any]:
        """Edit the decisions on a take, and announce it. Raises as `OpenTake.edit`."""
        edited = self.open_take(name).edit(revision, action)
        self.announce({"type": "edited", "take": name, "revision": edited["revision"]})
        return edited

    def start_cleaning(self, name: str, formats: Sequence[str], rigs: Sequence[str]) -> RunStatus:
        """Clean a take again in the background. Raises as `OpenTake.start_cleaning`."""
        opened = self.open_take(name)
        others = [each.id for each in opened.subjects if each.id != name]
        for other in others:
            self.open_take(other).check_not_running()

        def report(status: RunStatus) -> None:
            if status.state == "done":
                self._takes[name] = opened.take
                for other in others:  # their outputs are new as well
                    self._open.pop(other, None)
            self.announce({"type": "run", "take": name, "run": status.to_json()})
            if status.state in ("done", "failed"):
                self.announce({"type": "session"})

        return opened.start_cleaning(formats, rigs, report)

    def approve(self, name: str, by: str) -> dict[str, Any]:
        """Approve a take. Raises as `OpenTake.approve`."""
        described = self.open_take(name).approve(by)
        self.announce({"type": "session"})
        return described

    def withdraw(self, name: str) -> dict[str, Any]:
        """Withdraw the approval of a take."""
        described = self.open_take(name).withdraw()
        self.announce({"type": "session"})
        return described

    def close(self) -> None:
        """Stop what runs, and tell the pages that the review ends."""
        for opened in list(self._open.values()):
            opened.cancel_cleaning()
        self.announce({"type": "closing"})


def describe_take(take: CleanedTake) -> dict[str, Any]:
    """Return the entry of a take in the list of a session; one that cannot be read has its error."""
    entry: dict[str, Any] = {"id": take.id, "name": take.name, "subject": take.subject, "error": ""}
    try:
        file, approval, revision = read_yaml_model(ChangesFileModel, take.changes_path), read_approval(take), hash_changes(take)
    except MocapfixError as error:
        return entry | {
            "state": "untouched",
            "change_count": 0,
            "reviewed_count": 0,
            "worst_mm": None,
            "approved_by": "",
            "approved_at": "",
            "error": str(error),
        }
    state = determine_state(file, approval, revision)
    predicted = [change.predicted_mm for change in file.changes if change.predicted_mm is not None]
    return entry | {
        "state": state,
        "change_count": len(file.changes),
        "reviewed_count": sum(change.reviewed for change in file.changes),
        "worst_mm": max(predicted, default=None),
        "approved_by": approval.name if approval and state == "approved" else "",
        "approved_at": approval.date if approval and state == "approved" else "",
    }
