"""A take that is open in a review: its decisions, what the page shows of it, and its cleaning."""

import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from mocapfix.errors import SceneError, WriteError
from mocapfix.model.take import Take
from mocapfix.options import EXTRA_FORMAT_NAMES, RIG_NAMES
from mocapfix.review.changes_file import ChangeModel, ChangesFileModel, CorrectionModel, locate_correction
from mocapfix.review.cleaning_run import CleaningRun, RunStatus, build_clean_command, explain_why_not, list_values
from mocapfix.review.decision_store import DecisionStore
from mocapfix.review.take_files import (
    Approval,
    CleanedTake,
    determine_state,
    read_approval,
    read_cleaned_take,
    withdraw_approval,
    write_approval,
)
from mocapfix.review.take_view import TakeView, load_take_view

MAX_LISTED_DIFFERENCES = 200
"""markers and changes in the list of what differs from the cleaning before"""


@dataclass(frozen=True)
class _Cleaning:
    """What a cleaning left: the view, and the changes by id."""

    view: TakeView
    changes: Mapping[str, ChangeModel]


class OpenTake:
    """A take under review. Its methods may be called from several threads.

    subjects  the takes that are cleaned together with it, itself among them
    """

    def __init__(self, take: CleanedTake, subjects: Sequence[CleanedTake]) -> None:
        self.take, self.subjects = take, subjects
        self.lock = threading.RLock()
        self.status = RunStatus()
        self.store = DecisionStore(take.changes_path, self._check_correction)
        self._view: TakeView | None = None
        self._before_run: _Cleaning | None = None
        self._difference: dict[str, Any] | None = None
        self._run: CleaningRun | None = None

    @property
    def view(self) -> TakeView:
        """What the page shows. Raises ReadError."""
        with self.lock:
            if self._view is None:
                self._view = load_take_view(self.take, self.store.file.changes)
            return self._view

    @property
    def is_running(self) -> bool:
        """Whether the take is being cleaned."""
        return self.status.state == "running"

    def release_view(self) -> None:
        """Forget the samples, which are read again when they are needed."""
        with self.lock:
            if not self.is_running:
                self._view = None

    def describe(self) -> dict[str, Any]:
        """Return all that the page needs but the samples. Raises ReadError, SceneError."""
        with self.lock:
            self.store.refresh()
            view, reason = self.view, explain_why_not(self.take)
            return {
                "id": self.take.id,
                "name": self.take.name,
                "subject": self.take.subject,
                "rate": view.rate,
                "first_frame": view.first_frame,
                "frame_count": view.frame_count,
                "floor_m": view.floor_height_m,
                "labels": view.labels,
                "unlabelled": view.unlabelled_labels,
                "joints": view.joint_names,
                "bones": view.bones,
                "notes": [*view.notes, *self.take.report.get("notes", [])],
                "run": self.status.to_json(),
                "difference": self._difference,
                "export": self._describe_export(),
                "can_clean": not reason,
                "cannot_clean_reason": reason,
                **self.describe_review(),
            }

    def describe_review(self, before: ChangesFileModel | None = None) -> dict[str, Any]:
        """Return the decisions as they are in the file, of the changes only those that differ from the content before."""
        with self.lock:
            file, approval = self.store.file, read_approval(self.take)
            own = {(each.kind, tuple(each.markers), each.first) for each in file.corrections}
            known = {id(change) for change in before.changes} if before else set[int]()
            return {
                "revision": self.store.revision,
                "state": determine_state(file, approval, self.store.revision),
                "changed" if before else "changes": [
                    describe_change(change, own) for change in file.changes if id(change) not in known
                ],
                "corrections": [each.model_dump() for each in file.corrections],
                "undo_count": self.store.undo_count,
                "approval": self._describe_approval(approval),
            }

    def edit(self, revision: str, action: Mapping[str, Any]) -> dict[str, Any]:
        """Carry out an edit, and return what it changed.

        Raises EditConflictError, WriteError while the take is being cleaned, SceneError for an edit that is not allowed.
        """
        with self.lock:
            self.check_not_running()
            store, before = self.store, self.store.file
            match action:
                case {"type": "decide", "ids": list() as ids, "decision": "accept" | "reject" | "keep" as decision}:
                    store.decide(revision, [str(each) for each in cast("list[object]", ids)], decision)
                case {"type": "note", "id": str() as name, "text": str() as text}:
                    store.note(revision, name, text)
                case {"type": "add", "correction": dict() as values}:
                    store.add_correction(revision, values)
                case {"type": "remove", "index": int() as index}:
                    store.remove_correction(revision, index)
                case {"type": "undo"}:
                    store.undo(revision)
                case _:
                    raise SceneError("The page sent an edit that is not known; load it again.")
            return self.describe_review(before)

    def approve(self, name: str) -> dict[str, Any]:
        """Approve the take as it is. Raises as `edit`."""
        with self.lock:
            self.check_not_running()
            self.store.refresh()
            write_approval(self.take, name)
            return self._describe_state()

    def withdraw(self) -> dict[str, Any]:
        """Withdraw the approval."""
        with self.lock:
            withdraw_approval(self.take)
            return self._describe_state()

    def start_cleaning(self, formats: Sequence[str], rigs: Sequence[str], report: Callable[[RunStatus], None]) -> RunStatus:
        """Clean the take again in the background, and report every change of its status. Raises SceneError, WriteError."""
        with self.lock:
            self.check_not_running()
            if reason := explain_why_not(self.take):
                raise SceneError(reason)
            command = build_clean_command(self.take, self.subjects, formats, rigs)
            self._before_run = _Cleaning(self.view, {change.id: change for change in self.store.file.changes})
            self.status = RunStatus("running", "start")

            def note_status(status: RunStatus) -> None:
                with self.lock:
                    if status.state == "done":
                        status = self._finish_cleaning()
                    self.status = status
                report(status)

            self._run = CleaningRun(command, self.take.folder, note_status)
            return self.status

    def cancel_cleaning(self) -> None:
        """Stop a cleaning that runs; the outputs stay as they were."""
        if self._run and self.is_running:
            self._run.cancel()

    def _finish_cleaning(self) -> RunStatus:
        """Read the new outputs, and find what differs from those before."""
        root = self.take.folder
        try:
            self.take = replace(read_cleaned_take(root, root, self.take.stem), id=self.take.id)
            self.store = DecisionStore(self.take.changes_path, self._check_correction)
            self._view = load_take_view(self.take, self.store.file.changes)
        except Exception as error:
            self._view = None
            return RunStatus("failed", message=f"The take was cleaned, but its outputs cannot be shown: {error}")
        if self._before_run:
            after = _Cleaning(self._view, {change.id: change for change in self.store.file.changes})
            self._difference = compare_cleanings(self._before_run, after)
        self._before_run = None
        return RunStatus("done")

    def check_not_running(self) -> None:
        """Raise WriteError while the take is being cleaned."""
        if self.is_running:
            raise WriteError(f"{self.take.name} is being cleaned; edit it when that has ended.")

    def _check_correction(self, correction: CorrectionModel) -> None:
        """Raise SceneError for a correction that the take does not allow."""
        view = self.view
        if self.take.report["take"].get("animation"):
            raise SceneError(f"{self.take.name} is an animation: corrections are for takes of markers.")
        loose = Take(view.unlabelled, view.unlabelled_labels, view.rate, view.first_frame)
        take = Take(view.after, view.labels, view.rate, view.first_frame, Path(self.take.name), unlabelled=loose)
        locate_correction(correction, take, "The correction")

    def _describe_export(self) -> dict[str, Any]:
        written = [*list_values(self.take.arguments, "--also"), *list_values(self.take.arguments, "--bvh-for")]
        return {"formats": EXTRA_FORMAT_NAMES, "rigs": RIG_NAMES, "written": written}

    def _describe_state(self) -> dict[str, Any]:
        approval = read_approval(self.take)
        state = determine_state(self.store.file, approval, self.store.revision)
        return {"approval": self._describe_approval(approval), "state": state}

    def _describe_approval(self, approval: Approval | None) -> dict[str, Any] | None:
        if approval is None:
            return None
        is_current = approval.changes_sha256 == self.store.revision
        return {"name": approval.name, "date": approval.date, "is_current": is_current}


def describe_change(change: ChangeModel, corrections: set[tuple[str, tuple[str, ...], int]]) -> dict[str, Any]:
    """Return a change as the page shows it, and whether it follows from one of the corrections (kind, markers, first frame)."""
    kinds = {"marked": ("wrong", "missing"), "swap": ("swap",), "fragment": ("assign",)}.get(change.kind, ())
    is_correction = any((kind, tuple(change.markers), change.first) in corrections for kind in kinds)
    return {**change.model_dump(exclude={"reviewed"}), "is_reviewed": change.reviewed, "is_correction": is_correction}


def compare_cleanings(before: _Cleaning, after: _Cleaning) -> dict[str, Any]:
    """Return what differs between two cleanings of a take: samples, by marker, and changes."""
    one, other = before.view, after.view
    markers: list[dict[str, Any]] = []
    total = 0
    if one.after.shape == other.after.shape and one.labels == other.labels:
        differs = ~((one.after == other.after) | (np.isnan(one.after) & np.isnan(other.after))).all(-1)
        distance_mm = np.linalg.norm(one.after - other.after, axis=-1) * 1e3
        total = int(differs.sum())
        for m in np.argsort(-differs.sum(0), kind="stable")[:MAX_LISTED_DIFFERENCES]:
            known = distance_mm[differs[:, m], m]
            known = known[np.isfinite(known)]
            if differs[:, m].any():
                largest = round(float(known.max()), 1) if len(known) else None
                markers.append({"label": one.labels[m], "samples": int(differs[:, m].sum()), "largest_mm": largest})
    return {
        "samples": total,
        "markers": markers,
        "added": [name for name in after.changes if name not in before.changes][:MAX_LISTED_DIFFERENCES],
        "removed": [name for name in before.changes if name not in after.changes][:MAX_LISTED_DIFFERENCES],
    }
