"""The takes of a folder under review: their decisions, what the page shows of them, and their cleaning.

A take is cleaned again by the command line, in a process of its own.
"""

import json
import os
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Executor, ProcessPoolExecutor
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass, replace
from functools import lru_cache, partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from mocapfix.errors import MocapfixError, ReadError, SceneError, WriteError
from mocapfix.io.changes_file import EXCLUDED_REASON, Review, is_prevented, locate_correction
from mocapfix.io.files import hold_process_lock
from mocapfix.io.yaml_files import ChangesFileModel, CorrectionModel
from mocapfix.model.faults import SHIFT_KINDS, RequestedFill
from mocapfix.model.stage_timer import STAGE_LINES_VARIABLE, parse_stage_line
from mocapfix.model.take import Take
from mocapfix.options import OPTION_BY_NAME, CleanOptions, FillOptions, format_arguments
from mocapfix.output_formats import get_file_version
from mocapfix.report.sample_states import find_worst_change, group_changes
from mocapfix.review import take_files
from mocapfix.review.edits import CarryEdit, DecisionStore, parse_edit, read_decisions
from mocapfix.solve.parallel import begin_second_process

EXPORT_OPTIONS = ("extra_formats", "rigs", "characters", "output_rate_hz", "trim")
MAX_MESSAGE_LENGTH = 1000
END_LIMIT_S = 5.0


@dataclass(frozen=True)
class RunStatus:
    """How far a cleaning is."""

    state: Literal["idle", "running", "done", "failed"] = "idle"
    stage: str = ""  # that it is in, while it runs
    percent: int = 0  # of the time of the cleaning before
    message: str = ""  # the sentence of its error


class CleaningRun:
    """A running `mocapfix clean`, which replaces the outputs when it has written all of them.

    Attributes:
        take: The take that is cleaned; the progress is estimated from the times of its last cleaning.
        report: Called with each new status, in a thread.
    """

    def __init__(self, command: Sequence[str], take: take_files.CleanedTake, report: Callable[[RunStatus], None]) -> None:
        self._report, self._is_cancelled, self._times = report, False, take.report.get("times", {})
        pipes: dict[str, Any] = {"stdin": subprocess.DEVNULL, "stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
        pipes |= {"encoding": "utf-8", "errors": "replace"}
        self._process = subprocess.Popen(command, cwd=take.folder, env={**os.environ, STAGE_LINES_VARIABLE: "1"}, **pipes)
        self._thread = threading.Thread(target=self._follow, daemon=True)
        self._thread.start()

    def cancel(self) -> None:
        """End the run; the outputs stay as they were."""
        self._is_cancelled = True
        self._process.terminate()
        try:
            self._process.wait(END_LIMIT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()

    def _follow(self) -> None:
        assert self._process.stderr is not None
        messages, percent = list[str](), 0
        seconds = [0.0, *(each["seconds"] for each in self._times.values())]
        starts = dict(zip(self._times, (100 * np.cumsum(seconds) / max(sum(seconds), 1e-3)).astype(int).tolist(), strict=False))
        for line in self._process.stderr:
            if stage := parse_stage_line(line):
                percent = max(percent, starts.get(stage, 0))  # a part may run again
                self._report(RunStatus("running", stage, percent))
            elif line.strip():
                messages.append(line.strip())
        if not self._process.wait():
            self._report(RunStatus("done"))
        elif self._is_cancelled:
            self._report(RunStatus("failed", message="The cleaning was stopped; the outputs are unchanged."))
        else:
            text = " ".join(messages)[-MAX_MESSAGE_LENGTH:]
            self._report(RunStatus("failed", message=text or "The cleaning ended without a message; the outputs are unchanged."))


def change_output(take: take_files.CleanedTake, export: Mapping[str, object]) -> dict[str, Any]:
    """Return the output options of an export, whose formats, programs and characters are written besides those of the take.

    Args:
        export: Texts by the name of the option, as after its flag; "" for the default. Raises SceneError if one does not fit.
    """
    choices, values = take.export_choices, dict[str, Any]()
    for name, text in export.items():
        if name not in EXPORT_OPTIONS or not isinstance(text, str):
            raise SceneError(f"{name}: cannot be chosen for an export; choose of {', '.join(EXPORT_OPTIONS)}.")
        values[name] = OPTION_BY_NAME[name].parse([text]) if text else OPTION_BY_NAME[name].default
        if name in choices:
            if unknown := [each for each in values[name] if each not in choices[name]]:
                raise SceneError(f"{unknown[0]}: cannot be exported; choose of {', '.join(choices[name])}.")
            values[name] = tuple(dict.fromkeys((*getattr(take.options.output, name), *values[name])))
    return values


def build_clean_command(
    take: take_files.CleanedTake, subjects: Sequence[take_files.CleanedTake], export: Mapping[str, object]
) -> list[str]:
    """Return the command that cleans a take in its folder in full, with the changes files of all its subjects."""
    options = take.options.change(**change_output(take, export), is_fast=False)
    command = [sys.executable, "-P", "-m", "mocapfix", "clean", take.arguments[0], *format_arguments(options)]
    command += [argument for each in subjects for argument in ("--changes", each.changes_path.name)]
    return [*command, "--out", ".", "--overwrite"]


def explain_why_not(take: take_files.CleanedTake) -> str:
    """Return why a take cannot be cleaned again from here; "" if it can."""
    if not take.arguments:
        return "The report does not say how the take was cleaned; clean it once more on the command line."
    if take.input_path is None:
        return f"The input file {take.arguments[0]} is not there; put it back, or clean the take again on the command line."
    return ""


@lru_cache(1)
def _plan_subject(folder: Path, input_name: str, options: CleanOptions, name: str, _key: str) -> Any:
    from mocapfix import pipeline  # the server does not need it

    os.chdir(folder)  # the options name files relative to it
    return pipeline.plan_subject(Path(input_name), options, name)


@lru_cache(1)
def _fit_window(subject: tuple[Path, str, CleanOptions, str, str], n: int) -> Any:
    return _plan_subject(*subject)[n].fit()


def estimate_fills(
    subject: tuple[Path, str, CleanOptions, str, str], corrections: Sequence[CorrectionModel], wanted: CorrectionModel
) -> list[dict[str, Any]]:
    """Return each estimate of the stretch of a wanted fill, by whatever method it is, as the next cleaning with others makes it.

    Of each: its samples with position and standard deviation per axis in metres, None without, and why samples stay empty.
    """
    plan, methods = _plan_subject(*subject), [each for each in get_args(RequestedFill) if each != "empty"]
    located = [locate_correction(each, plan[0].whole, "The correction") for each in (*corrections, wanted)]
    parts = [list[tuple[np.ndarray, np.ndarray]]() for _ in methods]
    for n, (first, stop, start, end) in enumerate(each.window for each in plan):
        frames = slice(max(start, located[-1].first) - first, min(end, located[-1].last + 1) - first)
        if frames.start < frames.stop:  # the stretch is in this window
            *known, one = Review(corrections=tuple(located)).select_frames(slice(first, stop)).corrections
            requests = [[*known, replace(one, entry=wanted.model_copy(update={"method": each}))] for each in methods]
            for part, filled in zip(parts, _fit_window(subject, n).fill_gaps(requests, subject[2]), strict=True):
                take, at = filled.take, (frames, one.markers[0])
                part.append((np.c_[take.markers[at], take.estimated_sd[at]], filled.unfilled_reasons[at]))
    fills = list[dict[str, Any]]()
    for method, (rows, reasons) in zip(methods, (map(np.concatenate, zip(*part, strict=True)) for part in parts), strict=True):
        known_m, reason = rows[~np.isnan(rows[:, 3]), 3], next(filter(None, reasons), "")
        shown = [None if np.isnan(row[3]) else row.tolist() for row in np.round(rows, 6)]
        predicted_mm = round(float(np.sqrt(3 * (known_m**2).mean())) * 1e3, 1) if len(known_m) else None
        fills.append({"method": method, "samples": shown, "predicted_mm": predicted_mm, "reason": reason})
    return fills


class OpenTake:
    """A take under review. Its methods may be called from several threads.

    Attributes:
        subjects: The takes that are cleaned together with it, itself among them.
    """

    def __init__(self, take: take_files.CleanedTake, subjects: Sequence[take_files.CleanedTake]) -> None:
        self.take, self.subjects = take, subjects
        self.lock = threading.RLock()
        self.status = RunStatus()
        self.store = DecisionStore(take.changes_path, self._check_correction)
        self._view: take_files.TakeView | None = None
        self._before_run: tuple[take_files.TakeView, list[str]] | None = None
        self._difference: dict[str, Any] | None = None
        self._grouped: tuple[list[tuple[str, int, int]], list[list[str]]] = [], []  # changes, and their ids by events
        self._run: CleaningRun | None = None
        self.started = self.decided = self.store.file  # when a cleaning began, and after the last edit

    @property
    def view(self) -> take_files.TakeView:
        """What the page shows. Raises ReadError."""
        with self.lock:
            if self._view is None:
                self._view = take_files.load_take_view(self.take, self.store.file.changes)
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
            output, choices = self.take.options.output, self.take.export_choices
            written = {name: list(map(str, getattr(output, name))) for name in choices}
            return {
                **{key: getattr(self.take, key) for key in ("id", "name", "subject")},
                **{key: getattr(view, key) for key in ("rate", "first_frame", "frame_count", "labels", "sticks")},
                "floor_m": view.floor_height_m,
                "unlabelled": view.unlabelled_labels,
                "joints": view.body.names if view.body else (),
                "bones": [(int(k), j) for j, k in enumerate(view.body.parents) if k >= 0] if view.body else [],
                "characters": list(self.take.find_characters()),
                "motion_floor_m": output.floor_height_m,
                "motion_start": max(0, output.trim[0] - view.first_frame) if output.trim else 0,
                "notes": [*view.notes, *self.take.report.get("notes", [])],
                "run": asdict(self.status),
                "is_preview": self.take.options.initialise.is_fast,
                "difference": self._difference,
                "export": {"choices": choices, "written": written, "output_rate_hz": output.output_rate_hz, "trim": output.trim},
                "can_correct": not self.take.report["take"].get("animation"),
                "cannot_clean_reason": reason,
                **self.describe_review(),
            }

    def describe_review(self, before: ChangesFileModel | None = None) -> dict[str, Any]:
        """Return the decisions as they are in the file, of the changes only those that differ from the content before."""
        with self.lock:
            file = self.store.file
            known = {id(change) for change in before.changes} if before else set[int]()
            made = self.take.report.get("corrections", self.started.corrections)  # an older report does not tell
            if not before and self._grouped[0] != (places := [(each.id, each.first, each.last) for each in file.changes]):
                events = group_changes(file.changes, self.view.labels, self.view.after)
                self._grouped = places, [[change.id for change in each] for each in events]
            return {
                "revision": self.store.revision,
                "changed" if before else "changes": [
                    {**each.model_dump(exclude={"reviewed"}), "is_reviewed": each.reviewed}
                    for each in file.changes
                    if id(each) not in known
                ],
                **({} if before else {"events": self._grouped[1]}),
                "corrections": describe_corrections(file.corrections, made, self.take.options.fill),
                "undo_count": len(self.store.state.done),
                "redo_count": len(self.store.state.undone),
                **self._describe_state(),
            }

    def edit(self, revision: str, action: Mapping[str, Any]) -> dict[str, Any]:
        """Carry out an edit, and return what it changed. Raises EditConflictError, SceneError for an edit that is not allowed."""
        with self.lock:
            before = self.store.file
            self.store.edit(revision, parse_edit(action))
            self.decided = self.store.file
            return self.describe_review(before)

    def request_fills(self, marker: str, first: int, last: int) -> "partial[list[dict[str, Any]]]":
        """Return the call of `estimate_fills` for a stretch of a marker. Raises SceneError."""
        with self.lock:
            if reason := explain_why_not(self.take):
                raise SceneError(reason)
            file, subjects = self.store.file, [each.changes_path for each in self.subjects]
            wanted = CorrectionModel(kind="fill", markers=[marker], first=first, last=last, method="spline")
            self._check_correction(wanted)
            stretch = {"markers", "first", "last"}
            same = wanted.model_dump(include=stretch)
            fills = [each for each in file.corrections if each.kind == "fill" and each.model_dump(include=stretch) != same]
            others = [each.model_dump() for each in file.corrections if each.kind != "fill"]
            declined = [each for each in file.changes if each.decision != "accept"]
            kept = [each.id for each in declined if each.decision == "keep" or each.kind in SHIFT_KINDS]
            versions = [get_file_version(path) for path in subjects if path != self.take.changes_path]
            options = self.take.options.change(is_fast=False, review_files=tuple(path.name for path in subjects))
            subject = self.take.folder, self.take.arguments[0], options, file.take, json.dumps([others, kept, versions])
            return partial(estimate_fills, subject, fills, wanted)

    def approve(self, name: str | None) -> dict[str, Any]:
        """Approve the take as it is, or withdraw its approval: None. Raises as `edit`."""
        with self.lock:
            if name is None:
                self.take.approval_path.unlink(missing_ok=True)
                return self._describe_state()
            self.check_not_running()
            self.store.refresh()
            take_files.write_approval(self.take, name)
            return self._describe_state()

    def start_cleaning(self, export: Mapping[str, object], report: Callable[[RunStatus], None]) -> RunStatus:
        """Clean the take again in the background, and report every change of its status. Raises SceneError, WriteError."""
        with self.lock:
            self.check_not_running()
            if reason := explain_why_not(self.take):
                raise SceneError(reason)
            command = build_clean_command(self.take, self.subjects, export)
            before_run = (self.view, [change.id for change in self.store.file.changes])

            def note_status(status: RunStatus) -> None:
                with self.lock:
                    if status.state == "done":
                        status = self._finish_cleaning()
                    self.status = status
                report(status)

            try:
                self._run = CleaningRun(command, self.take, note_status)
            except OSError as error:
                problem = error.strerror or error
                raise WriteError(
                    f"{self.take.name} cannot be cleaned: its process cannot be started ({problem}); try again."
                ) from error
            self._before_run, self.status = before_run, RunStatus("running", "start")
            return self.status

    def cancel_cleaning(self) -> None:
        """Stop a cleaning that runs; the outputs stay as they were."""
        if self._run and self.is_running:
            self._run.cancel()

    def _finish_cleaning(self) -> RunStatus:
        """Read the new outputs, and find what differs from those before."""
        try:
            self.read_outputs()
            self._view = take_files.load_take_view(self.take, self.store.file.changes)
        except Exception as error:
            return RunStatus("failed", message=f"The take was cleaned, but its outputs cannot be shown: {error}")
        if self._before_run:
            after = (self._view, [change.id for change in self.store.file.changes])
            self._difference = take_files.compare_cleanings(*self._before_run, *after)
        self._before_run = None
        return RunStatus("done")

    def read_outputs(self) -> None:
        """Read new outputs, and make the decisions in them that were made during the cleaning. Raises ReadError, WriteError."""
        with self.lock:
            root, self._view = self.take.folder, None
            self.take = replace(take_files.read_cleaned_take(root, root, self.take.stem), id=self.take.id)
            self.store, self._grouped = DecisionStore(self.take.changes_path, self._check_correction), ([], [])
            if self.decided != self.started:
                self.store.edit(self.store.revision, CarryEdit(before=self.started, after=self.decided))

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
        labels = [label for each in self.subjects for label in each.report["take"].get("labels", ())]
        locate_correction(correction, take, "The correction", labels)

    def _describe_state(self) -> dict[str, Any]:
        """Return how far the review is, and its approval."""
        approval, revision = take_files.read_approval(self.take), self.store.revision
        entry = approval and {"name": approval.name, "date": approval.date, "is_current": approval.changes_sha256 == revision}
        return {"approval": entry, "state": take_files.determine_state(self.store.file, approval, revision)}


def describe_corrections(entered: list[CorrectionModel], made: Sequence[object], options: FillOptions) -> list[dict[str, Any]]:
    """Return corrections as the page has them: whether they are not `made` yet, and why the options prevent them, "" if not."""
    entries = [each.model_dump(mode="json") for each in entered]
    left = Counter(json.dumps(each, sort_keys=True, default=CorrectionModel.model_dump) for each in made)
    for each, entry in zip(entered, entries, strict=True):
        left[key := json.dumps(entry, sort_keys=True)] -= 1
        entry["prevented"] = EXCLUDED_REASON if is_prevented(each, options) else ""
        entry["is_pending"] = left[key] < 0 and not entry["prevented"]
    return entries


Event = dict[str, Any]
REVIEW_LOCK_NAME = ".review.lock"
MAX_TAKES_READ_AT_ONCE = 30
MAX_OPEN_VIEWS = 2  # takes whose samples are kept in memory


class ReviewSession:
    """The cleaned takes below a folder; `reviewer` is who decides.

    Raises:
        ReadError: If there are none.
    """

    def __init__(self, folder: Path, reviewer: str = "") -> None:
        self.folder, self.reviewer = folder, reviewer[: take_files.MAX_NAME_LENGTH]
        self._takes = {take.id: take for take in take_files.find_cleaned_takes(folder)}
        self._open: dict[str, OpenTake] = {}
        self._lock = threading.RLock()
        self._listeners: list[Callable[[Event], None]] = []
        self._locks, self._held_folders = ExitStack(), set[Path]()
        self._process: Executor | None = None  # in which fills are estimated, when they have been asked for
        self._fills: dict[str, list[dict[str, Any]]] = {}
        self._summaries: dict[str, tuple[object, dict[str, Any]]] = {}

    @property
    def ids(self) -> list[str]:
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
            "reviewer": self.reviewer,
            "takes": [self._summarise(take) if reads_all or take.id in self._summaries else name_take(take) for take in takes],
        }

    def read_ahead(self) -> None:
        """Read the take that a page shows at first, while the browser starts, and the list of a large session."""
        open_takes = [each for each in self.describe()["takes"] if not each["error"] and each["state"] != "approved"]
        if open_takes:
            with suppress(MocapfixError):  # its page says what is wrong
                self.open_take(max(open_takes, key=lambda each: each["worst_mm"] or -1.0)["id"]).describe()
        if len(takes := list(self._takes.values())) > MAX_TAKES_READ_AT_ONCE:
            for take in takes:
                if not self._takes:  # the review ends
                    return
                self._summarise(take)
            self.announce({"type": "session"})

    def _summarise(self, take: take_files.CleanedTake) -> dict[str, Any]:
        """Return the entry of a take, from its files if they were changed since it was last read."""
        key = [get_file_version(path) for path in (take.changes_path, take.approval_path)]
        with self._lock:
            if self._summaries.get(take.id, (None,))[0] != key:
                self._summaries[take.id] = key, describe_take(take)
            return self._summaries[take.id][1]

    def open_take(self, name: str) -> OpenTake:
        """Return a take under review. Raises ReadError if there is none of this id, or its files are damaged."""
        with self._lock:
            if name not in self._takes:
                raise ReadError(f"{name}: is no take of this review.")
            if name not in self._open:
                take = self._takes[name]
                self._hold_folder(take.folder)
                of_file = [each for each in self._takes.values() if (each.folder, each.name) == (take.folder, take.name)]
                self._open[name] = OpenTake(take, of_file)
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
        """Edit the decisions on a take, and announce it. Raises as `OpenTake.edit`. An exchange ends the other's approval."""
        named = {**action, "reviewer": self.reviewer} if action.get("type") == "decide" else action
        opened = self.open_take(name)
        before, edited, after = opened.store.file.corrections, opened.edit(revision, named), opened.store.file.corrections
        changed = {label for each in (*before, *after) if before.count(each) != after.count(each) for label in each.markers}
        for other in opened.subjects:
            if other.id != name and changed.intersection(other.report["take"].get("labels", ())):
                other.approval_path.unlink(missing_ok=True)
        self.announce({"type": "edited", "take": name, "revision": edited["revision"]})
        return edited

    def estimate_fills(self, name: str, marker: str, first: int, last: int) -> list[dict[str, Any]]:
        """Return what `estimate_fills` does, in a process of its own. Raises as `OpenTake.request_fills`, and ReadError."""
        call = self.open_take(name).request_fills(marker, first, last)
        if (key := repr(call)) not in self._fills:
            try:
                with self._lock:
                    self._process = self._process or ProcessPoolExecutor(1, get_context("spawn"), begin_second_process)
                fills = self._process.submit(call).result()
            except (BrokenExecutor, MemoryError) as error:
                self._process = None
                raise ReadError(f"{name}: the process that estimates fills has ended; try again.") from error
            self._fills = {**dict(list(self._fills.items())[-50:]), key: fills}  # of the last stretches
        return self._fills[key]

    def start_cleaning(self, name: str, export: Mapping[str, object]) -> RunStatus:
        """Clean a take again in the background. Raises as `OpenTake.start_cleaning`."""
        opened = self.open_take(name)
        others = [self.open_take(each.id) for each in opened.subjects if each.id != name]
        for each in (opened, *others):
            each.check_not_running()
            each.started = each.decided = each.store.file

        def report(status: RunStatus) -> None:
            if status.state == "done":
                for other in others:  # their outputs are new as well
                    with suppress(MocapfixError):  # its page says what is wrong
                        other.read_outputs()
                self._takes |= {each.take.id: each.take for each in (opened, *others)}
            self.announce({"type": "run", "take": name, "run": asdict(status)})
            if status.state in ("done", "failed"):
                self.announce({"type": "session"})

        return opened.start_cleaning(export, report)

    def approve(self, name: str, by: str | None) -> dict[str, Any]:
        """Approve a take, or withdraw its approval. Raises as `OpenTake.approve`."""
        described = self.open_take(name).approve(by)
        self.announce({"type": "session"})
        return described

    def close(self) -> None:
        """Stop what runs, and tell the pages that the review ends."""
        for opened in list(self._open.values()):
            opened.cancel_cleaning()
        if self._process:
            self._process.shutdown(wait=False, cancel_futures=True)
        self.announce({"type": "closing"})
        with self._lock:
            self._takes.clear()  # none is opened from now on
            self._locks.close()


def describe_other_review(folder: Path, holder: str) -> str:
    """Return the sentence on a folder whose outputs another process reviews."""
    return f"{folder}: is being reviewed or cleaned by another process ({holder}); end that first."


def name_take(take: take_files.CleanedTake) -> dict[str, Any]:
    """Return the entry of a take whose files have not been read."""
    entry = {"id": take.id, "name": take.name, "subject": take.subject, "error": "", "state": "", "change_count": 0}
    return entry | {"reviewed_count": 0, "worst_mm": None, "approved_by": "", "approved_at": ""}


def describe_take(take: take_files.CleanedTake) -> dict[str, Any]:
    """Return the entry of a take in the list of a session; one that cannot be read has its error."""
    entry = name_take(take)
    try:
        (file, revision), approval = read_decisions(take.changes_path), take_files.read_approval(take)
    except MocapfixError as error:
        return entry | {"error": str(error)}
    state = take_files.determine_state(file, approval, revision)
    worst = find_worst_change(file.changes)
    entry |= {"approved_by": approval.name, "approved_at": approval.date} if approval and state == "approved" else {}
    entry |= {"change_count": len(file.changes), "reviewed_count": sum(change.reviewed for change in file.changes)}
    return entry | {"state": state, "worst_mm": worst.predicted_mm if worst else None}
