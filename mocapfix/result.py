"""The result of cleaning a take, and the files that are written of it.

`CleaningResult.write` writes them, `build_output_notes` says of them what the report must. `merge_results` joins the results of
several subjects.
"""

import json
import os
from collections.abc import Callable, Collection, Hashable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from mocapfix.contacts.contacts import CONTACT_JOINTS, BodyContacts, HeldFeet, estimate_floor
from mocapfix.contacts.plate_contacts import is_file_event_wrong
from mocapfix.detect.gaps import detect_gaps, detect_lost_segments
from mocapfix.errors import WriteError
from mocapfix.hands.solve_hands import HandMotion
from mocapfix.io.c3d_events import add_c3d_events
from mocapfix.io.changes_file import NO_REVIEW, Review
from mocapfix.io.files import check_outputs_absent, get_source_suffixes, make_output_folder, replace_together
from mocapfix.labels.multi_subject import SubjectExchanges
from mocapfix.model.changes import Change, Decided, UnfilledRun, serialize_changes
from mocapfix.model.detected import find_namesakes
from mocapfix.model.faults import MISSING_KINDS, SHIFT_KINDS, Fault, Faults, Fragment, overlap_in_time
from mocapfix.model.motion import Motion, is_frame_subset
from mocapfix.model.stage_timer import ProgressCallback, StageTimer
from mocapfix.model.subject import Subject
from mocapfix.model.take import C3dLayout, ComputedPoints, TableLayout, Take
from mocapfix.model.windows import Window, crop_intervals, is_stored, join_at_cuts, map_arrays, open_array, release_pages
from mocapfix.options import FEET_OFF, CleanOptions, OutputOptions, format_arguments
from mocapfix.output_formats import (
    BVH_FORMAT,
    DEFAULT_FORMATS,
    OutputContent,
    OutputFormat,
    build_exported_motion,
    list_output_formats,
    record_cleaning,
    write_cleaned_copy,
)
from mocapfix.report.build_report import build_fill_section
from mocapfix.report.notes import SolvedBody
from mocapfix.report.report import MultiSubjectReport, Report
from mocapfix.report.sample_states import CleaningComparison
from mocapfix.report.stick_figures import add_hand_points
from mocapfix.report.terms import get_point_terms
from mocapfix.solve.lost_in_sight import LostPart
from mocapfix.solve.parallel import compute_beside, map_in_threads
from mocapfix.subject.library import SubjectChoice


def build_output_notes(options: OutputOptions, take: Take, has_body: bool) -> list[str]:
    """Return sentences about requested formats, formats that are not written, and a changed rate or height."""
    is_animation = take.point_kind == "joint"
    requested = [
        each
        for each in list_output_formats(options)
        if each not in (BVH_FORMAT, *DEFAULT_FORMATS) and each.suffix not in get_source_suffixes(take.path)
    ]
    notes = [f"{each.suffix} {each.usage_note}" for each in requested if each.usage_note and (has_body or not each.needs_body)]
    reason = f"the {'animation' if is_animation else 'take'} has no body"
    notes += [f"{each.suffix} is not written: {reason}." for each in requested if each.needs_body and not has_body]
    if isinstance(take.layout, TableLayout) and not take.layout.has_field_per_sample:
        kind = "is JSON" if take.path is not None and take.path.suffix.lower() == ".json" else "lists only visible markers"
        notes.append(f"{take.name} {kind}, so the cleaned markers are written as a plain table.")
    output_rate = options.output_rate_hz
    if has_body and output_rate and output_rate != take.rate:
        is_subset = is_frame_subset(take.rate, output_rate)
        method = f"one of {take.rate / output_rate:.0f} solved frames" if is_subset else "splines between the solved frames"
        other = "the cleaned file keeps" if is_animation else "markers keep"
        notes.append(f"Motion files have {output_rate:g} frames per second ({method}); {other} {take.rate:g}.")
    if has_body and options.floor_height_m:
        other = "the cleaned file" if is_animation else "the markers"
        notes.append(f"Motion files are {options.floor_height_m:g} m lower than {other}, so that their floor is at height 0.")
    first, last = take.get_frame_number(0), take.get_frame_number(take.frame_count - 1)
    if options.trim and (options.trim[0] < first or options.trim[1] > last):
        notes.append(f"--trim names frames that {take.name} does not have; it has {first} to {last}.")
    return notes


DEFAULT_OUTPUT_OPTIONS = OutputOptions()
DEFAULT_CLEAN_OPTIONS = CleanOptions()


@dataclass(frozen=True)
class CleaningResult:
    """A cleaned take with its faults, changes, body and report.

    Attributes:
        input_take: The take as read.
        relabelled_take: The same with corrected labels.
        take: The cleaned take.
        faults: Detected faults, indexing the markers of `relabelled_take`.
        changes: Changes that were applied or declined in review.
        unfilled_runs: Intervals that stay empty, with their reasons.
        report: Contents of the JSON report.
        fragment_donors: Markers whose samples are fragments of other markers.
        subject: Calibrated subject; None if no marker set matches.
        motion: Motion of the subject; None if no marker set matches.
        joint_position_world: Metres, the solved joints; NaN for joints that the markers do not show; None without a body.
        residual_m: Distance of each inlier marker from the body in metres, NaN for other samples; None without a body.
        contacts: When joints of the body are in contact with the floor, and the events of gait; None without a body.
        hands: The motion of each hand whose fingers markers show.
        review: What a reviewer decided after an earlier cleaning.
        requested: The options with which the take was cleaned.
        subject_results: Results by subject of a take of several subjects. Their common result has no body of its own.
    """

    input_take: Take
    relabelled_take: Take
    take: Take
    faults: Faults
    changes: tuple[Change, ...]
    unfilled_runs: tuple[UnfilledRun, ...]
    report: Report | MultiSubjectReport
    fragment_donors: tuple[int, ...] = ()
    subject: Subject | None = None
    motion: Motion | None = None
    joint_position_world: Float[np.ndarray, "T J 3"] | None = None
    residual_m: Float[np.ndarray, "T M"] | None = None
    contacts: BodyContacts | None = None
    hands: tuple[HandMotion, ...] = ()
    review: Review = NO_REVIEW
    requested: CleanOptions = DEFAULT_CLEAN_OPTIONS
    subject_results: tuple["CleaningResult", ...] = ()

    def write(
        self,
        folder: str | Path,
        overwrite: bool = False,
        report_progress: ProgressCallback | None = None,
        options: OutputOptions | None = None,
    ) -> dict[str, Path]:
        """Write all outputs into a folder, which is created if necessary.

        The outputs are the cleaned file, BVH, subject, review file, reports and recording, and the formats in `options`. They are
        written to a temporary folder and moved together, so that no output is missing or incomplete.

        Args:
            folder: Where the outputs go.
            overwrite: Whether outputs that exist are replaced.
            report_progress: Called with the name of each stage when it begins.
            options: Which formats are written, and how; by default those with which the take was cleaned.

        Returns:
            The paths by suffix; with several subjects "Jim.bvh" and the like, and one cleaned file.

        Raises:
            WriteError: If a file exists (unless `overwrite`) or cannot be written.
        """
        options, folder = options or self.requested.output, Path(folder)
        stem, results = self._stem, self.subject_results or (self,)
        subject_stems = [result.input_take.output_stem for result in results]
        targets = check_outputs_free(folder, stem, overwrite, self.input_take.path, options, subject_stems)
        make_output_folder(folder)
        with replace_together(targets, folder) as temporary:
            self._write_files(temporary, folder, options, report_progress)
        paths = [path for result in results for path in result.get_written_paths(folder, options).values()]
        return {path.name.removeprefix(f"{stem}."): path for path in paths}

    def get_output_paths(self, folder: Path, options: OutputOptions = DEFAULT_OUTPUT_OPTIONS) -> dict[str, Path]:
        """Return the paths that `write` writes for a take of at most one subject, by suffix."""
        unavailable = {
            suffix for each in list_output_formats(options) if not self._can_write(each) for suffix in each.all_suffixes
        }
        unavailable -= set(get_source_suffixes(self.input_take.path))
        paths = build_output_paths(folder, self._stem, self.input_take.path, options, self.input_take.output_stem)
        return {suffix: path for suffix, path in paths.items() if suffix not in unavailable}

    def get_written_paths(self, folder: Path, options: OutputOptions = DEFAULT_OUTPUT_OPTIONS) -> dict[str, Path]:
        """Return those of the paths at which `write` has written a file."""
        return {suffix: path for suffix, path in self.get_output_paths(folder, options).items() if path.exists()}

    def describe_missing_outputs(self, folder: Path, options: OutputOptions = DEFAULT_OUTPUT_OPTIONS) -> list[str]:
        """Return a sentence for each output of a take of at most one subject that `write` could not write, by the report."""
        paths, written = self.get_output_paths(folder, options), self.get_written_paths(folder, options)
        missing = [path for suffix, path in paths.items() if suffix not in written]
        notes: list[str] = json.loads(written["report.json"].read_text(encoding="utf-8"))["notes"] if missing else []
        found = [next((note for note in notes if note.startswith(path.name)), "") for path in missing]
        return [note or f"{path} was not written; request it again." for path, note in zip(missing, found, strict=True)]

    def write_source_copy(self, target: Path) -> list[tuple[int, int]]:
        """Write a copy of the input file with the changed samples; return frame and marker of those that it cannot store."""
        unstorable = write_cleaned_copy(target, self.input_take, self.take)
        layout = self.input_take.layout
        if self.requested.contacts.write_events and isinstance(layout, C3dLayout):
            results = self.subject_results or (self,)
            events = {result.input_take.main_subject: result.contacts.events for result in results if result.contacts}
            add_c3d_events(target, layout.data_start_byte, events, self.input_take.first_frame, self.input_take.rate)
        return unstorable

    @property
    def output_take(self) -> Take:
        """The take that is written: the cleaned markers."""
        return self.take

    @property
    def subject_report(self) -> Report:
        """Report of a take of at most one subject."""
        if "people" in self.report:
            raise ValueError("a take of several subjects has a report for each of its subject_results")
        return self.report

    def _can_write(self, output_format: OutputFormat) -> bool:
        """Return whether the result has the body and the markers that a format needs, and a preview has the format."""
        is_wanted = output_format.is_in_preview or not self.requested.initialise.is_fast
        has_markers = self.subject is not None and len(self.subject.labels) > 0
        has_body = self.motion is not None
        return is_wanted and (has_markers or not output_format.needs_markers) and (has_body or not output_format.needs_body)

    @property
    def _stem(self) -> str:
        return self.input_take.path.stem if self.input_take.path else "take"

    def _write_files(
        self, folder: Path, final_folder: Path, options: OutputOptions, report_progress: ProgressCallback | None
    ) -> None:
        """Write the cleaned file of all subjects, then the other files of each, to be moved to the final folder."""
        arguments: list[str] = []
        if self.input_take.path:
            requested = replace(self.requested, output=options)
            arguments = list_clean_arguments(self.input_take.path, requested, final_folder, self._stem)
        results = self.subject_results or (self,)
        reports = [result.subject_report for result in results]
        timers = [StageTimer(dict(each["seconds"]), report_progress, dict(each["times"])) for each in reports]
        with timers[0]("write", "cleaned file"):
            target = folder / f"{self._stem}.{get_source_suffixes(self.input_take.path)[0]}"
            unstorable_samples = self.write_source_copy(target)

        def write_subject(result: CleaningResult, timer: StageTimer) -> None:
            index = {int(m): k for k, m in enumerate(self.input_take.find_marker_indices(result.input_take))}
            unstorable = [(frame, index[m]) for frame, m in unstorable_samples if m in index]
            result._write_subject_files(folder, options, timer, unstorable, arguments)

        list(map_in_threads(lambda each: write_subject(*each), zip(results, timers, strict=True)))

    def _write_subject_files(
        self, folder: Path, options: OutputOptions, timer: StageTimer, unstorable: Sequence[tuple[int, int]], arguments: list[str]
    ) -> None:
        """Write all files but the cleaned one, which could not store some samples (frame, marker)."""
        with timer("write", "resampling"):
            exported_motion = build_exported_motion(options, self.subject, self.motion, self.input_take.rate)
        report = self.subject_report
        notes = [*report["notes"], *build_output_notes(options, self.input_take, exported_motion is not None)]
        if self.requested.contacts.write_events and not isinstance(self.input_take.layout, C3dLayout):
            notes.append("The cleaned file has no events (--events), since only C3D has a place for them; use --also events.")
        elif self.requested.contacts.write_events and self.contacts is not None:
            moved = [each for each in self.contacts.event_disagreements if is_file_event_wrong(each)]
            what = "1 event of the file has" if len(moved) == 1 else f"{len(moved)} events of the file have"
            notes += [
                f"{what} the time of a force plate in the cleaned file; its description there tells the time before."
            ] * bool(moved)
        final_report: Report = {**report, "arguments": arguments, "seconds": timer.stage_seconds, "notes": notes}
        final_report["times"] = timer.part_times
        result = replace(self, report=final_report)._drop_samples(unstorable)
        written = result.contacts, result.changes, result.review, result.subject_report, result.comparison
        animation = getattr(self, "animation", None)  # of an animation
        content = OutputContent(self.input_take, result.output_take, exported_motion, *written, self.hands, animation)
        source_suffixes, default = get_source_suffixes(self.input_take.path), (BVH_FORMAT, *DEFAULT_FORMATS)
        formats = [each for each in list_output_formats(options) if self._can_write(each) and each.suffix not in source_suffixes]
        for each in (each for each in formats if each not in default):  # first, for the HTML report has their notes
            _write_format(each, folder, content, timer)
        if not self.requested.initialise.is_fast:
            figures = [each.figure for each in content.sheets]
            content = replace(content, recorded=compute_beside(record_cleaning, folder, content.comparison, figures))
        try:
            for each in (each for each in formats if each in default):
                _write_format(each, folder, content, timer)
        finally:
            if content.recorded:
                content.recorded.leave()  # it writes into the folder

    def _drop_samples(self, unstorable_samples: Sequence[tuple[int, int]]) -> "CleaningResult":
        """Return the result without the samples (frame, marker) that the cleaned file cannot store."""
        if not unstorable_samples:
            return self
        markers = self.take.markers.copy()
        markers[tuple(np.array(unstorable_samples).T)] = np.nan
        take = self.take.replace_markers(markers, self.take.sample_sd)
        reason = "its cleaned position is outside the range of the file format"
        runs = self.unfilled_runs + tuple(UnfilledRun(marker, frame, frame, reason) for frame, marker in unstorable_samples)
        fill = build_fill_section(self.input_take, self.relabelled_take, take, runs, self.fragment_donors)
        report: Report = {**self.subject_report, "fill": fill}
        return replace(self, take=take, unfilled_runs=runs, report=report)

    @cached_property
    def comparison(self) -> CleaningComparison:
        """The take before and after cleaning, as the HTML report and the recording show it."""
        skeleton, joints = self.subject.skeleton if self.subject else None, self.joint_position_world
        if skeleton is not None and joints is not None:
            skeleton, joints = add_hand_points(skeleton, joints, self.hands)
        takes, body = (self.input_take, self.relabelled_take, self.take), (skeleton, joints, self.residual_m)
        return CleaningComparison(*takes, self.faults, self.changes, *body, get_point_terms(self.take), self.contacts)


def _write_format(output: OutputFormat, folder: Path, content: OutputContent, timer: StageTimer) -> None:
    """Write the files of a format into a folder, and add to the report what their users must know."""
    target, usage = folder / f"{content.input_take.output_stem}.{output.suffix}", f"{output.suffix} {output.usage_note}"
    with timer(output.timer_stage, output.suffix):
        content.report["notes"].extend(output.write_file(target, content) or ())
    release_pages(content, content.input_take.frame_count if is_stored(content.input_take) else -1)
    if usage in content.report["notes"] and not target.exists():
        content.report["notes"].remove(usage)


def build_output_paths(
    folder: Path, stem: str, source_path: Path | None, options: OutputOptions, subject_stem: str = ""
) -> dict[str, Path]:
    """Return the paths of all possible outputs by suffix.

    Args:
        stem: Stem of the input, also of the cleaned file, which contains all subjects.
        subject_stem: Stem of the other outputs of one of several subjects; empty: that of the input.
    """
    source_suffixes = get_source_suffixes(source_path)
    others = [suffix for each in list_output_formats(options) for suffix in each.all_suffixes if suffix not in source_suffixes]
    paths = {suffix: folder / f"{stem}.{suffix}" for suffix in source_suffixes}
    return paths | {suffix: folder / f"{subject_stem or stem}.{suffix}" for suffix in others}


def check_outputs_free(
    folder: Path,
    stem: str,
    overwrite: bool,
    source_path: Path | None = None,
    options: OutputOptions = DEFAULT_OUTPUT_OPTIONS,
    subject_stems: Sequence[str] = ("",),
) -> tuple[Path, ...]:
    """Return the paths of all possible outputs of all subjects.

    Raises:
        WriteError: If an output exists (unless `overwrite`), would replace the input or the output of another subject, or if the
            folder is a file.
    """
    if folder.exists() and not folder.is_dir():
        raise WriteError(f"{folder}: the folder cannot be created (it is a file); choose another with --out.")
    if len({each.casefold() for each in subject_stems}) < len(subject_stems):
        raise WriteError(f"{source_path}: the output files of two subjects would have the same name; rename one of the subjects.")
    by_subject = (build_output_paths(folder, stem, source_path, options, each) for each in subject_stems)
    targets = tuple(dict.fromkeys(path for paths in by_subject for path in paths.values()))
    if source_path and any(path.exists() and path.samefile(source_path) for path in targets):
        raise WriteError(f"{source_path}: an output would replace the input file; choose another folder with --out.")
    check_outputs_absent(targets, overwrite)
    return targets


def list_clean_arguments(path: Path, options: CleanOptions, folder: Path, stem: str) -> list[str]:
    """Return the input and the arguments of `mocapfix clean` that clean it again in the same way, for the report.

    Files are named relative to the output folder. A subject without a file is the one that was written there.
    """

    def name_file(path: Path) -> str:
        try:
            return Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix()
        except ValueError:  # on another drive
            return path.resolve().as_posix()

    if options.subject.subject is not None and not isinstance(options.subject.subject, str | Path | tuple):
        options = options.change(subject=f"{stem}.subject.yaml")
    named = options.map_files(lambda name: name_file(Path(name)) if Path(name).is_file() else name)
    return [name_file(path), *format_arguments(named)]


def merge_results(exchanges: SubjectExchanges, subject_results: tuple[CleaningResult, ...]) -> CleaningResult:
    """Return the result of the whole take from those of its subjects, which it holds. It has no subject or motion of its own.

    The labels that subjects exchanged are changes of the take of the first marker of each exchange. Where two subjects took
    samples from the same unlabelled trajectory, the first one keeps them.
    """
    take = exchanges.original_take
    parts = [(take.find_marker_indices(each.input_take), each) for each in subject_results]
    residual_m = np.full(take.visible.shape, np.nan)
    faults, unfilled, donors = list(exchanges.faults), [], list[int]()
    for markers, each in parts:
        unlabelled_count = len(take.unlabelled.labels) if take.unlabelled else 0
        trajectories = [*markers.tolist(), *range(len(take.labels), len(take.labels) + unlabelled_count)]
        faults += [_map_fault_indices(fault, trajectories) for fault in each.faults.items]
        unfilled += [replace(run, marker=trajectories[run.marker]) for run in each.unfilled_runs]
        donors += [trajectories[donor] for donor in each.fragment_donors]
        if each.residual_m is not None:
            residual_m[:, markers] = each.residual_m
    cleaned = _insert_parts(exchanges.take, [(markers, each.take) for markers, each in parts])
    relabelled = exchanges.take
    if any(each.relabelled_take is not each.input_take for each in subject_results):
        relabelled = _insert_parts(relabelled, [(markers, each.relabelled_take) for markers, each in parts])
    changes = exchanges.build_changes(cleaned)
    with_exchanges: list[CleaningResult] = []
    for each in subject_results:
        if added := [change for change in changes if change.markers[0] in each.input_take.labels]:
            own = (*added, *each.changes)
            each = replace(each, changes=own, report={**each.subject_report, "changes": serialize_changes(own)})
        with_exchanges.append(each)
    subject_results = tuple(with_exchanges)
    return CleaningResult(
        input_take=take,
        relabelled_take=relabelled,
        take=cleaned,
        faults=Faults().add_faults(faults),
        changes=tuple(change for each in subject_results for change in each.changes),
        unfilled_runs=tuple(sorted(unfilled, key=lambda run: (run.marker, run.first))),
        fragment_donors=tuple(sorted(donors)),
        residual_m=residual_m,
        report={"people": {each.input_take.subject_name: each.subject_report for each in subject_results}},
        subject_results=subject_results,
    )


class CleanedSubject(NamedTuple):
    """What the stages return: the subject and marker set that were used, the body (None without a marker set), the take."""

    choice: SubjectChoice
    body: SolvedBody | None
    decided: Decided


def join_windows(
    take: Take, review: Review, parts: Sequence[tuple[Window, CleanedSubject]], folder: TemporaryDirectory[str]
) -> CleanedSubject:
    """Return what was found in the windows of a long take, in order, as what was found in the take.

    Args:
        take: As it was read.
        parts: What was found in each window, with 0 frames.
        folder: The arrays of the whole take, in files with the names of their fields.
    """
    whole = map_arrays(parts[0][1], 0, lambda path, array: open_array(folder, path, array, take.frame_count))
    cuts, count = {window.start for window, _ in parts[1:]}, take.frame_count

    def gather(get: Callable[[Decided], Iterable[Any]]) -> list[Any]:
        spans = ((get(each.decided), slice(-window.start, count - window.start)) for window, each in parts)
        return [item for items, span in spans for item in crop_intervals(items, span)]

    label_faults: list[Fault] = gather(lambda each: each.detected.label_faults)
    relabelled = replace(whole.decided.detected.take, part=None) if label_faults else take
    found: list[Fault] = gather(lambda each: each.detected.sample_faults.items)
    donors, marker_set = find_namesakes(relabelled), whole.choice.marker_set
    gaps = [fault for fault in detect_gaps(relabelled) if fault.marker not in donors]
    if marker_set and any(fault.kind == "segment lost" for fault in found):
        gaps += detect_lost_segments(relabelled, marker_set)
    others = [fault for fault in found if fault.kind not in (*MISSING_KINDS, "segment lost")]
    detected = replace(
        whole.decided.detected,
        take=relabelled,
        label_faults=tuple(join_at_cuts(label_faults, cuts, _identify_fault)),
        sample_faults=Faults().add_faults((*gaps, *join_at_cuts(others, cuts, _identify_fault))),
        notes=tuple(dict.fromkeys(note for _, each in parts for note in each.decided.detected.notes)),
    )
    points = whole.decided.take.relabelled_points if label_faults else take.relabelled_points
    runs: list[UnfilledRun] = gather(lambda each: each.unfilled_runs)
    joined_runs = sorted(join_at_cuts(runs, cuts, lambda run: (run.marker, run.reason)), key=lambda run: (run.marker, run.first))
    decided = Decided(
        detected=detected,
        take=replace(whole.decided.take, part=None, relabelled_points=points),
        changes=_join_changes(take, review, [change for _, each in parts for change in each.decided.changes], gaps, cuts),
        unfilled_runs=tuple(joined_runs),
        rigid_groups=tuple({group.markers: group for _, each in parts for group in each.decided.rigid_groups}.values()),
    )
    bodies = [(window, each.body) for window, each in parts if each.body]
    return CleanedSubject(whole.choice, whole.body and _join_bodies(take, bodies, whole.body), decided)


def _join_changes(
    take: Take, review: Review, changes: list[Change], gaps: Sequence[Fault], cuts: Collection[int]
) -> tuple[Change, ...]:
    """Return the changes of windows as those of the take, in the order of its markers; those of gaps are named by these."""
    not_found = {each.to_change() for each in review.declined}
    numbers = {take.get_frame_number(cut) for cut in cuts}
    found = (each for each in changes if each not in not_found)
    joined = join_at_cuts(found, numbers, lambda each: (each.kind, each.markers, each.decision))
    reasons = {(take.get_label(gap.marker), take.get_frame_number(gap.first), gap.kind): gap.reason for gap in gaps}
    end = take.get_frame_number(take.frame_count - 1)
    for n, each in enumerate(joined):
        why, last = (
            reasons.get((each.markers[0], each.first, each.kind), each.why),
            end if each.kind in SHIFT_KINDS else each.last,
        )
        joined[n] = replace(each, why=why, last=last)
    declined = [each for each in joined if each.decision != "accept"]
    for each in dict.fromkeys(change for change in changes if change in not_found):
        same = (x for x in declined if (x.kind, x.markers[0]) == (each.kind, each.markers[0]))
        joined += [each] * (not any(overlap_in_time(x, each) for x in same))
    order = {label: m for m, label in reversed(list(enumerate(take.labels)))}
    return tuple(sorted(joined, key=lambda each: (order.get(each.markers[0], len(order)), each.first)))


def _join_bodies(take: Take, bodies: Sequence[tuple[Window, SolvedBody]], whole: SolvedBody) -> SolvedBody:
    names, (count, marker_count) = whole.subject.skeleton.names, take.visible.shape
    toes = [joint for joint in CONTACT_JOINTS if "Toe" in joint]
    position = np.asarray(whole.joint_positions[:, [names.index(joint) for joint in toes]], float)
    is_standing = whole.contacts.is_contact[:, [CONTACT_JOINTS.index(joint) for joint in toes]]
    moved = [body.contacts.move_events(window.start / take.rate, count / take.rate) for window, body in bodies]
    held = [each.held_feet for each in moved]
    mode = next((each.mode for each in held if each.mode != FEET_OFF), FEET_OFF)
    contacts = replace(
        whole.contacts,
        floor=estimate_floor(position, is_standing, take.rate),
        events=tuple(event for each in moved for event in each.events),
        event_disagreements=tuple(pair for each in moved for pair in each.event_disagreements),
        held_feet=HeldFeet(mode, max(each.largest_displacement_m for each in held), sum(each.yielded_s for each in held)),
    )
    lost: dict[str, LostPart] = {}
    for window, part in ((window, part) for window, body in bodies for part in body.lost_parts):
        nothing = LostPart(part.name, np.zeros(count, bool), np.full(count, np.nan), np.zeros((count, marker_count), bool))
        joined, frames = lost.setdefault(part.name, nothing), slice(window.start, window.end)
        joined.frames[frames], joined.distance_m[frames], joined.markers[frames] = part.frames, part.distance_m, part.markers
    spans = ((body.remembered, slice(-window.start, count - window.start)) for window, body in bodies)
    remembered = [gap for gaps, span in spans for gap in crop_intervals(gaps, span)]
    return replace(
        whole,
        contacts=contacts,
        lost_parts=tuple(lost.values()),
        is_observed=np.any([body.is_observed for _, body in bodies], axis=0),
        carried_markers=tuple(sorted({marker for _, body in bodies for marker in body.carried_markers})),
        remembered=tuple(join_at_cuts(remembered, {window.start for window, _ in bodies}, lambda gap: gap.joints)),
    )


def _identify_fault(fault: Fault) -> Hashable:
    return fault.kind, fault.markers, fault.donor if isinstance(fault, Fragment) else -1


def _insert_parts(whole: Take, parts: Sequence[tuple[Int[np.ndarray, " _"], Take]]) -> Take:
    """Return the whole take with the markers of its parts, at their indices, and with the unlabelled trajectories of the last."""

    def insert(get: Callable[[Take], np.ndarray]) -> np.ndarray:
        merged = get(whole).copy()
        for marker_indices, part in parts:
            merged[:, marker_indices] = get(part)
        return merged

    computed_points = whole.computed_points
    for _, part in parts:
        computed_points = _merge_computed_points(computed_points, part.computed_points)
    return replace(
        whole,
        markers=insert(lambda take: take.markers),
        relabelled_points=insert(lambda take: take.source_points),
        sample_sd=insert(lambda take: take.estimated_sd),
        computed=insert(lambda take: take.visible & ~take.measured),
        unlabelled=parts[-1][1].unlabelled,
        computed_points=computed_points,
    )


def _merge_computed_points(whole: ComputedPoints | None, part: ComputedPoints | None) -> ComputedPoints | None:
    """Return the computed points of the whole take with those samples that were updated in a part of it."""
    if whole is None or part is None or part.take.sample_sd is None:
        return whole
    is_updated = ~np.isnan(part.take.sample_sd)
    markers = np.where(is_updated[..., None], part.take.markers, whole.take.markers)
    sample_sd = np.where(is_updated, part.take.sample_sd, whole.take.estimated_sd)
    return replace(whole, take=whole.take.replace_markers(markers, sample_sd))


def _map_fault_indices(fault: Fault, trajectories: list[int]) -> Fault:
    """Return a fault of a part as one of the whole take. `trajectories` are the indices of the part's trajectories there."""
    mapped = replace(fault, marker=trajectories[fault.marker], other_markers=tuple(trajectories[m] for m in fault.other_markers))
    if isinstance(mapped, Fragment) and isinstance(fault, Fragment) and fault.donor >= 0:
        return replace(mapped, donor=trajectories[fault.donor])
    return mapped
