"""The takes of a folder under review, and what happens to them, for all pages that show them."""

import os
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

from mocapfix.errors import MocapfixError, ReadError
from mocapfix.io.files import hold_process_lock
from mocapfix.io.yaml_files import read_yaml_model
from mocapfix.review.changes_file import ChangesFileModel
from mocapfix.review.cleaning_run import RunStatus
from mocapfix.review.open_take import OpenTake
from mocapfix.review.take_files import (
    CleanedTake,
    determine_state,
    find_cleaned_takes,
    find_takes_of_one_file,
    hash_changes,
    read_approval,
)

Event = dict[str, Any]
REVIEW_LOCK_NAME = ".review.lock"
MAX_TAKES_READ_AT_ONCE = 30
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
        self._locks, self._held_folders = ExitStack(), set[Path]()
        self._summaries: dict[str, tuple[object, dict[str, Any]]] = {}
        if len(self._takes) > MAX_TAKES_READ_AT_ONCE:
            threading.Thread(target=self._read_summaries, daemon=True).start()

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
        """Return the list of takes with their states; those of a large session are read in the background and then announced."""
        takes = list(self._takes.values())
        reads_all = len(takes) <= MAX_TAKES_READ_AT_ONCE
        return {
            "folder": str(self.folder.resolve().name),
            "is_batch": len(takes) > 1,
            "takes": [self._summarise(take) if reads_all or take.id in self._summaries else name_take(take) for take in takes],
        }

    def _read_summaries(self) -> None:
        for take in list(self._takes.values()):
            self._summarise(take)
        self.announce({"type": "session"})

    def _summarise(self, take: CleanedTake) -> dict[str, Any]:
        """Return the entry of a take, from its files if they were changed since it was last read."""
        key = [(stat.st_mtime_ns, stat.st_size) for path in (take.changes_path, take.approval_path) if (stat := stat_file(path))]
        known = self._summaries.get(take.id)
        if known is None or known[0] != key:
            known = self._summaries[take.id] = (key, describe_take(take))
        return known[1]

    def open_take(self, name: str) -> OpenTake:
        """Return a take under review. Raises ReadError if there is none of this id, or its files are damaged."""
        with self._lock:
            if name not in self._takes:
                raise ReadError(f"{name}: is no take of this review.")
            if name not in self._open:
                take = self._takes[name]
                self._hold_folder(take.folder)
                self._open[name] = OpenTake(take, find_takes_of_one_file(take, list(self._takes.values())))
            opened = self._open.pop(name)
            self._open[name] = opened  # the last is the one that was used last
            for other in list(self._open.values())[:-MAX_OPEN_VIEWS]:
                other.release_view()
            return opened

    def _hold_folder(self, folder: Path) -> None:
        """Hold the lock on the outputs of a take until the session ends. Raises WriteError if another process reviews them."""
        folder = folder.resolve()
        if folder not in self._held_folders:
            self._locks.enter_context(hold_process_lock(folder / REVIEW_LOCK_NAME, partial(describe_other_review, folder)))
            self._held_folders.add(folder)

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
        self._locks.close()


def describe_other_review(folder: Path, holder: str) -> str:
    """Return the sentence on a folder whose outputs another process reviews."""
    return f"{folder}: is being reviewed or cleaned by another process ({holder}); end that first."


def stat_file(path: Path) -> os.stat_result | None:
    """Return the status of a file, None if it is not there."""
    try:
        return path.stat()
    except OSError:
        return None


def name_take(take: CleanedTake) -> dict[str, Any]:
    """Return the entry of a take whose files have not been read."""
    return {
        "id": take.id,
        "name": take.name,
        "subject": take.subject,
        "error": "",
        "state": "",
        "change_count": 0,
        "reviewed_count": 0,
        "worst_mm": None,
        "approved_by": "",
        "approved_at": "",
    }


def describe_take(take: CleanedTake) -> dict[str, Any]:
    """Return the entry of a take in the list of a session; one that cannot be read has its error."""
    entry = name_take(take)
    try:
        file, approval, revision = read_yaml_model(ChangesFileModel, take.changes_path), read_approval(take), hash_changes(take)
    except MocapfixError as error:
        return entry | {"error": str(error)}
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
