"""The pipeline: every stage of cleaning a take, in order.

`clean` cleans the take of each subject in a file: detect, calibrate, initialise, solve, detect again, find contacts and hold
feet, fill, apply decisions. Each stage takes values and returns a value of its own type. Animations: `mocapfix.animations`.
"""

import gc
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from operator import call
from pathlib import Path
from typing import NamedTuple, TypeAlias

from mocapfix.contacts.body_contacts import hold_standing_feet
from mocapfix.contacts.contacts import CONTACT_JOINTS, StandingBody
from mocapfix.detect.contradictions import check_contradictions, select_consistent_set
from mocapfix.detect.loop import check_visible_markers, detect_on_body, detect_on_hands, detect_on_trajectories
from mocapfix.errors import TakeError
from mocapfix.fill.gap_filling import fill_gaps
from mocapfix.hands.calibrated_hand import CalibratedHand
from mocapfix.hands.finger_labels import label_unlabelled_fingers, may_show_fingers
from mocapfix.hands.solve_hands import HandMotion, calibrate_hands, solve_hands
from mocapfix.io.capture import read_capture
from mocapfix.io.changes_file import Correction, Review, build_fault_review, reject_corrections
from mocapfix.io.files import return_free_memory
from mocapfix.labels import multi_subject
from mocapfix.labels.multi_subject import choose_subject_file, split_corrected_subjects
from mocapfix.labels.requested_labels import describe_missing_labels, label_capture, label_unlabelled
from mocapfix.model.animation import Animation
from mocapfix.model.body_fit import BodyFit, SubjectInTake
from mocapfix.model.changes import Filled
from mocapfix.model.detected import Detected
from mocapfix.model.faults import FaultReview, Faults
from mocapfix.model.marker_set import MarkerSet
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.model.stage_timer import PartTime, ProgressCallback, StageTimer
from mocapfix.model.subject import Subject
from mocapfix.model.take import Take
from mocapfix.model.windows import (
    ARRAY_FOLDER,
    MAX_PIECE_FRAMES,
    MAX_WINDOWS_AT_ONCE,
    Value,
    Window,
    build_survey,
    crop_intervals,
    extract_window,
    is_stored,
    map_arrays,
    plan_windows,
    release_pages,
    select_frames,
    select_marker_places,
    write_rows,
)
from mocapfix.options import FEET_OFF, CleanOptions, check_take_options
from mocapfix.report.build_report import build_inspection_report, build_report
from mocapfix.report.notes import SolvedBody, build_solved_body, describe_computed_points, describe_frame_steps, describe_up_axis
from mocapfix.report.report import InspectionReport
from mocapfix.result import CleanedSubject, CleaningResult, join_windows, merge_results
from mocapfix.review.apply_decisions import apply_decisions, update_computed_points
from mocapfix.solve.initial_motion import PREVIEW_POSE_RATE_HZ, initialise_between, initialise_body
from mocapfix.solve.motion_solver import apply_prior, complete_body, place_body, solve_body
from mocapfix.solve.parallel import compute_beside, map_in_threads
from mocapfix.solve.person_memory import (
    PersonMemory,
    RememberedTake,
    describe_other_person,
    digest_capture,
    read_memory,
    remember_motion,
)
from mocapfix.solve.pose_problem import find_unobserved_joints
from mocapfix.solve.prior_conditioner import PriorConditioner
from mocapfix.solve.trained_priors import build_pose_model_loader
from mocapfix.subject.calibration import Calibrated, calibrate_body, place_moved_markers
from mocapfix.subject.library import NO_BODY_NOTE, SubjectChoice, describe_marker_set_match, withdraw_marker_set
from mocapfix.surveys import DEFAULT_OPTIONS, calibrate_takes, identify_subject, limit_blas_threads


@limit_blas_threads
def clean(
    path: str | Path,
    options: CleanOptions = DEFAULT_OPTIONS,
    *,
    progress: ProgressCallback | None = None,
    **changed_options: object,
) -> CleaningResult:
    """Clean a capture file: detect faults, correct labels, solve the body and fill what is missing.

    Args:
        path: A C3D, TRC, CSV, TSV, BVH or AMC file.
        options: What to do; see `CleanOptions`.
        progress: Called with the name of each stage when it begins.
        changed_options: Single options by name, in place of those in `options`: `clean(path, prior="none", max_gap_s=2.0)`.

    Returns:
        The cleaned take with its faults, changes, subject, motion and report. With several subjects in the file, a result for the
        whole take that holds one result for each subject.

    Raises:
        MocapfixError: With a sentence for a technician. Nothing is written.
    """
    options = options.change(**changed_options)
    timer = StageTimer(report_progress=progress)
    with timer("read"):
        capture = read_capture(path, options.read, has_windows=True)
    return clean_capture(capture, options, timer)


@limit_blas_threads
def clean_capture(capture: Take | Animation, options: CleanOptions, timer: StageTimer) -> CleaningResult:
    """Clean a capture that is read, as `clean` does; the timer has the seconds of reading it."""
    requested, load_pose_model = options, build_pose_model_loader(options.prior.name_used)
    if isinstance(capture, Animation):
        from mocapfix.animations.clean import clean_animation  # slow to import

        return replace(clean_animation(capture, options, load_pose_model, timer), requested=options)
    reject_animation_options(capture, options)
    with timer("label"):
        capture, options = label_or_load(capture, options)
    check_take_options(capture, options)
    if options.initialise.is_fast:
        options = options.change(max_rounds=1, feet=FEET_OFF)
    takes, reviews, exchanges = split_corrected_subjects(capture, options)
    results = clean_subjects(takes, reviews, options, timer)
    result = results[0] if len(results) == 1 else merge_results(exchanges, tuple(results))
    return replace(result, requested=requested)


def label_or_load(capture: Take, options: CleanOptions) -> tuple[Take, CleanOptions]:
    """Return what `label_markers` does; a long take that cannot be cleaned in windows is no longer stored."""
    capture, options = label_markers(capture, options)
    if capture.frame_count > MAX_PIECE_FRAMES and (len(set(capture.labels)) < len(capture.labels) or not is_stored(capture)):
        capture = select_frames(replace(capture, notes=(*capture.notes, ONE_PIECE_NOTE)), slice(0, None))
    return capture, options


NO_FINGER_SET_NOTE = "Unlabelled points near the hands are no finger set of the marker set, so they keep no label."


def label_markers(capture: Take, options: CleanOptions) -> tuple[Take, CleanOptions]:
    """Return what `label_capture` does, with labels of fingers near the hands of a body that alone is labelled."""
    capture, options = label_capture(capture, options, calibrate_takes)
    is_done = capture.labelled_file is not None or is_stored(capture)
    if is_done or capture.unlabelled is None or len(set(capture.marker_subjects)) > 1:
        return capture, options
    choice = identify_subject(capture, options.subject)
    if choice.marker_set is None or not may_show_fingers(capture, choice.marker_set):
        return capture, options
    quick = options.change(is_fast=True, max_rounds=1)  # the poses of a preview are near enough
    _, detected, body = detect_and_fit(capture, choice, FaultReview(), quick, StageTimer())
    found = label_unlabelled_fingers(detected.take, body.subject, body.motion) if body else None
    if found is None:
        return replace(capture, notes=(*capture.notes, NO_FINGER_SET_NOTE)), options
    return label_unlabelled(capture, *found, options.read), options


def reject_animation_options(take: Take, options: CleanOptions) -> None:
    """Raise TakeError if options are given that apply to animations only."""
    values = {"--hierarchy": options.subject.hierarchy, "--contacts": options.contacts.contacts_file}
    given = [flag for flag, value in values.items() if value is not None]
    if given:
        raise TakeError(f"{take.name}: has markers and no joints; clean it without {' and '.join(given)}.")


@limit_blas_threads
def label(path: str | Path, options: CleanOptions = DEFAULT_OPTIONS, *, progress: ProgressCallback | None = None) -> Take:
    """Return a take without labels with those of a marker set, in whose `labelled_file` are the bytes of the labelled file.

    Args:
        path: The take.
        options: `options.read` and `options.subject`, which may name a marker set, a subject or a labelled take.
        progress: Called with the name of each stage when it begins.

    Raises:
        TakeError: If the take has labels with a meaning, or no person with these markers is found in it.
    """
    timer = StageTimer(report_progress=progress)
    with timer("read"):
        capture = read_capture(path, options.read)
    if isinstance(capture, Animation):
        raise TakeError(f"{capture.name}: is an animation without markers; there is nothing to label.")
    with timer("label"):
        labelled, _ = label_markers(capture, options)
    if labelled.labelled_file is None:
        raise TakeError(describe_missing_labels(capture, labelled))
    return labelled


def clean_subjects(
    takes: Sequence[Take], reviews: Sequence[Review], options: CleanOptions, timer: StageTimer
) -> list[CleaningResult]:
    """Run all stages on the takes of several subjects, side by side.

    An unlabelled trajectory assigned to one subject is not available to the next: those after it are then cleaned again. So the
    results are those of cleaning one after the other.
    """
    results: list[CleaningResult] = []
    unlabelled = takes[0].unlabelled
    while len(results) < len(takes):
        calls: list[partial[CleaningResult]] = []
        for index in range(len(results), len(takes)):
            take = takes[index] if takes[index].unlabelled is unlabelled else replace(takes[index], unlabelled=unlabelled)
            progress = timer.report_progress if len(takes) == 1 else None
            own_timer = StageTimer(dict(timer.stage_seconds), progress, dict(timer.part_times))
            calls.append(partial(clean_subject, take, reviews[index], options, own_timer))
        for result in map(call, calls) if is_stored(takes[0]) else map_in_threads(call, calls, is_shared=True):
            results.append(result)
            if timer.report_progress and len(takes) > 1:
                timer.report_progress(f"{len(results)} of {len(takes)} subjects")
            if not multi_subject.is_same_data(result.take.unlabelled, unlabelled):
                unlabelled = result.take.unlabelled
                break
    return results


def clean_subject(take: Take, review: Review, options: CleanOptions, timer: StageTimer) -> CleaningResult:
    """Run all stages on the take of one subject. Raises TakeError if the take contradicts its body as a whole."""
    cleaned = clean_windows(take, review, options, timer) if is_stored(take) else None
    if cleaned is None:
        cleaned = run_stages(take, identify_subject(take, options.subject), review, options, timer)
    (choice, body, decided), detected = cleaned, cleaned.decided.detected
    report = build_report(take, choice, body, decided, options, timer)
    report["corrections"], report["notes"][:0] = review.report_corrections(options.fill)
    return CleaningResult(
        input_take=take,
        relabelled_take=detected.take,
        take=decided.take,
        faults=detected.faults,
        changes=decided.changes,
        unfilled_runs=decided.unfilled_runs,
        fragment_donors=detected.donor_markers,
        subject=body.subject if body else None,
        motion=body.motion if body else None,
        joint_position_world=body.joint_positions if body else None,
        contacts=body.contacts if body else None,
        hands=body.hands if body else (),
        residual_m=body.residual_m if body else None,
        report=report,
        review=review,
    )


def run_stages(
    take: Take,
    choice: SubjectChoice,
    review: Review,
    options: CleanOptions,
    timer: StageTimer,
    kept: slice | None = None,
    hands: Sequence[CalibratedHand] | None = None,
) -> CleanedSubject:
    """Run all stages on the take of one subject, or on a part of a long take, of which the frames `kept` are returned."""
    fitted = fit_stages(take, choice, review, options, timer, hands)
    with timer("fill"):
        filled = next(fitted.fill_gaps([review.corrections], options))
        solved = build_solved_body(fitted.detected, fitted.standing, fitted.hands) if fitted.standing else None
        if kept is not None:
            filled, solved = crop_stages(take, filled, solved, kept)
            take, review = select_frames(take, kept), review.select_frames(kept)
        marker_set = fitted.choice.marker_set
        is_smoothed = options.fill.smooth_keypoints and marker_set is not None and bool(marker_set.point_sd)
        decided = apply_decisions(take, filled, review, options, is_smoothed=is_smoothed)
        decided = replace(decided, take=update_computed_points(take, decided.take, options.fill))
    return CleanedSubject(fitted.choice, solved, decided)


class FittedSubject(NamedTuple):
    """The take of one subject before it is filled; `standing` has the body and its held feet, None without a body."""

    choice: SubjectChoice
    detected: Detected
    standing: StandingBody | None
    hands: tuple[HandMotion, ...]  # those whose fingers markers show

    def fill_gaps(self, alternatives: Sequence[Sequence[Correction]], options: CleanOptions) -> Iterator[Filled]:
        """Yield the take filled with each of some lists of corrections, which differ in requested methods only."""
        # markers are filled from feet that are held in full, without the prior; changes are compared with the body of the outputs
        body = replace(self.standing.fit, motion=self.standing.filling_motion) if self.standing else None
        props = self.choice.marker_set.props if self.choice.marker_set else {}
        hands = [hand.carry_markers(self.detected.take) for hand in self.hands]
        return fill_gaps(self.detected, body, props, alternatives, options.fill, hands)


class SubjectWindow(NamedTuple):
    """A window in which the take of a subject is cleaned, that of all frames if it is short, and what is known of the subject."""

    whole: Take
    window: Window
    choice: SubjectChoice
    review: Review  # of the whole take
    options: CleanOptions
    hands: tuple[CalibratedHand, ...] | None = None  # None: those that the window shows

    def extract(self) -> tuple[Take, SubjectChoice, Review]:
        """Return the window as a take of its own, and what is known of it."""
        if not is_stored(self.whole):
            return self.whole, self.choice, self.review
        whole = replace(self.whole)  # what it keeps of itself ends with the window
        take = extract_window(whole, self.window)
        release_pages(whole, whole.frame_count)
        return take, self.choice, self.review.select_frames(slice(self.window.first, self.window.stop))

    @limit_blas_threads
    def fit(self) -> FittedSubject:
        """Return it as it is fitted in `clean`."""
        return fit_stages(*self.extract(), self.options, StageTimer(), self.hands)


@limit_blas_threads
def plan_subject(path: Path, options: CleanOptions, name: str) -> list[SubjectWindow]:
    """Return the windows in which `clean` cleans a subject of a file, by its take's name. Raises as `clean`."""
    capture = read_capture(path, options.read, has_windows=True)
    assert isinstance(capture, Take)
    capture, options = label_or_load(capture, options)
    takes, reviews, _ = split_corrected_subjects(capture, options)
    take, review = next(pair for pair in zip(takes, reviews, strict=True) if pair[0].name == name)
    if is_stored(take):
        return plan_take(take, review, options)[2]
    window = Window(0, take.frame_count, 0, take.frame_count)
    return [SubjectWindow(take, window, identify_subject(take, options.subject), review, options)]


def fit_stages(
    take: Take,
    choice: SubjectChoice,
    review: Review,
    options: CleanOptions,
    timer: StageTimer,
    calibrated: Sequence[CalibratedHand] | None = None,
) -> FittedSubject:
    """Run the stages before the fill on the take of one subject, or on a part of a long take, whose hands are calibrated."""
    memory = load_memory(take, options)
    if choice.marker_set and choice.marker_set.point_sd:
        reject_corrections(review, take.name, "these are keypoints")
    choice, detected, body = detect_and_fit(take, choice, build_fault_review(take, review), options, timer)
    if take.part is None:
        check_contradictions(detected, body, options)
    standing, hands = None, tuple[HandMotion, ...]()
    if body:
        with timer("solve", "limbs and feet"):
            load_pose_model = build_pose_model_loader(options.prior.name_used)
            conditioner = PriorConditioner(load_pose_model, options.solve.prior_scale) if load_pose_model else None
            if memory and (difference := describe_other_person(memory, body.subject.skeleton)):
                choice, memory = replace(choice, notes=(*choice.notes, difference)), None
            body = complete_body(body, conditioner, options, memory)
            are_written = options.contacts.write_events or "events" in options.output.extra_formats
            has_events = are_written or not options.initialise.is_fast
            standing = hold_standing_feet(body, take, options.contacts.feet, has_events=has_events)
            if conditioner:
                standing = replace(standing, fit=apply_prior(standing.fit, CONTACT_JOINTS, conditioner, options))
        if not options.initialise.is_fast:
            with timer("solve", "hands"):
                hands = solve_hands(detected.take, detected.solver_mask, body.subject, standing.fit.motion, calibrated)
    return FittedSubject(choice, detected, standing, hands)


def load_memory(take: Take, options: CleanOptions) -> PersonMemory | None:
    """Return the memory of a take's person, without the take itself; None without one. Raises SceneError."""
    path = choose_subject_file(take, options.prior.person_memory)
    return read_memory(Path(path), load_cmu31_body().skeleton).leave_out(digest_capture(take.path)) if path else None


@limit_blas_threads
def remember_take(path: str | Path, take_id: str, options: CleanOptions = DEFAULT_OPTIONS) -> dict[str, PersonMemory]:
    """Return how the people of a take move in it, by the name of the subject, for `clean` with `person_memory`.

    Args:
        path: The take.
        take_id: Its name in the memory.
        options: Those with which it is cleaned; `options.subject` may have its subject.

    Raises:
        MocapfixError: If the file or its subject cannot be used, or it shows no body.
    """
    capture = read_capture(path, options.read)
    if isinstance(capture, Animation):
        raise TakeError(f"{capture.name}: is an animation without markers; remember marker takes.")
    reject_animation_options(capture, options)
    capture, options = label_markers(capture, options)
    remembered, memories = RememberedTake(take_id, digest_capture(Path(path))), dict[str, PersonMemory]()
    for take in split_corrected_subjects(capture, options)[0]:
        body = detect_and_fit(take, identify_subject(take, options.subject), FaultReview(), options, StageTimer()).body
        if body:
            is_shown = body.subject.body_model.free_joints
            is_inferred = find_unobserved_joints(body.take.visible, body.extended_subject, is_shown)
            body_in_take = remembered, body.subject.skeleton, body.motion, is_shown, is_inferred, take.rate
            memories[take.subject_name] = remember_motion(*body_in_take)
    if not memories:
        raise TakeError(f"{capture.name}: shows no body that could be remembered.")
    return memories


def crop_stages(take: Take, filled: Filled, body: SolvedBody | None, frames: slice) -> tuple[Filled, SolvedBody | None]:
    """Return some frames of what the stages found in a window."""

    def crop(value: Value) -> Value:
        return map_arrays(value, take.frame_count, lambda _, array: array[frames])

    faults = Faults(tuple(crop_intervals(filled.detected.sample_faults.items, frames)))
    labels, filled = tuple(crop_intervals(filled.detected.label_faults, frames)), crop(filled)
    if body:
        contacts = body.contacts.move_events(-frames.start / take.rate, (frames.stop - frames.start) / take.rate)
        parts = tuple(part for part in map(crop, body.lost_parts) if part.frame_count)
        remembered = tuple(crop_intervals(body.remembered, frames))
        body = crop(replace(body, contacts=contacts, lost_parts=parts, remembered=remembered))
    return replace(filled, detected=replace(filled.detected, label_faults=labels, sample_faults=faults)), body


ONE_PIECE_NOTE = "Cleaned in one piece, which takes much memory for so long a take: it had no labels, or has some of them twice."
WindowResult: TypeAlias = tuple[CleanedSubject, dict[str, PartTime]]


def clean_windows(take: Take, review: Review, options: CleanOptions, timer: StageTimer) -> CleanedSubject:
    """Clean a long take of one subject window by window, two at a time, with labels, marker set and body of the whole take."""
    folder = tempfile.TemporaryDirectory(**ARRAY_FOLDER)
    with timer("survey"):
        choice, body, windows = plan_take(take, review, options)
    jobs = [partial(clean_window, each, Path(folder.name)) for each in windows]
    parts: list[CleanedSubject] = []
    with timer("windows"):
        for cleaned, times in map_in_threads(call, jobs, is_shared=True, most=MAX_WINDOWS_AT_ONCE):
            parts.append(cleaned)
            timer.add_part_times("windows/", times)
            if timer.report_progress:
                timer.report_progress(f"window {len(parts)} of {len(windows)}")
    compute_beside(return_free_memory)
    return_free_memory()
    with timer("join"):
        joined = join_windows(take, review, [(each.window, part) for each, part in zip(windows, parts, strict=True)], folder)
        return CleanedSubject(choice, joined.body and body and replace(joined.body, subject=body.subject), joined.decided)


def plan_take(take: Take, review: Review, options: CleanOptions) -> tuple[SubjectChoice, BodyFit | None, list[SubjectWindow]]:
    """Return what a survey of a long take shows of its subject, the body in it, and the windows in which the take is cleaned."""
    windows, memory, (survey, frames) = plan_windows(take.visible, take.rate), load_memory(take, options), build_survey(take)
    choice = identify_subject(survey, options.subject)
    choice, detected, body = detect_and_fit(survey, choice, FaultReview(), options, StageTimer())
    check_contradictions(detected, body, options)
    with_body = f", with one body, calibrated from {len(frames) / take.rate:.0f} s of the take" if body else ""
    others = [describe_other_person(memory, body.subject.skeleton)] if memory and body else []
    notes = (*choice.notes, f"Cleaned in {len(windows)} windows, which overlap{with_body}.", *filter(None, others))
    choice = replace(choice, notes=notes, is_learned=False)
    subjects = [body and select_marker_places(detected, body, int((frames >= each.first).argmax())) for each in windows]
    known = [replace(choice, subject=each) for each in subjects]
    hands = tuple[CalibratedHand, ...]()
    if body and not options.initialise.is_fast:
        hands = calibrate_hands(detected.take, detected.solver_mask, body.subject, body.motion)
    return choice, body, [SubjectWindow(take, *pair, review, options, hands) for pair in zip(windows, known, strict=True)]


@limit_blas_threads
def clean_window(planned: SubjectWindow, folder: Path) -> WindowResult:
    """Run all stages on a window. Arrays are written into a folder: the result has 0 frames."""
    gc.collect()  # what earlier windows left: commands do without the collector, which takes a tenth of the time of a short take
    (first, _, start, end), timer = planned.window, StageTimer()
    kept = slice(start - first, end - first)
    choice, body, decided = run_stages(*planned.extract(), planned.options, timer, kept, planned.hands)
    relabelled = decided.detected.take
    relabelled = replace(relabelled, relabelled_points=relabelled.source_points)  # in all windows, if labels change in one
    decided = replace(decided, detected=replace(decided.detected, take=relabelled))
    body = body and replace(body, contacts=body.contacts.add_other_joints())
    cleaned = CleanedSubject(choice, body, decided)
    return map_arrays(cleaned, end - start, lambda path, array: write_rows(folder / path, start, array)), timer.part_times


class FittedTake(NamedTuple):
    """A take with its faults, the subject and marker set that were used, and the body; None without a marker set."""

    choice: SubjectChoice
    detected: Detected
    body: BodyFit | None


def detect_and_fit(
    take: Take, choice: SubjectChoice, review: FaultReview, options: CleanOptions, timer: StageTimer
) -> FittedTake:
    """Detect faults and fit the body, in rounds: each detection compares the take with the body of its round, which was
    fitted to the inliers known before. A learned marker set that contradicts the take is withdrawn.
    """
    with timer("detect", "trajectories"):
        detected = detect_on_trajectories(take, choice.marker_set, choice.subject, review, options)
    if take.part is None:
        check_visible_markers(detected)
    if choice.marker_set is None:
        return FittedTake(choice, detected, None)
    calibrated, body = fit_body(detected, choice.marker_set, choice.subject, None, options, timer)
    for _ in range(0 if options.initialise.is_fast else options.solve.max_solve_rounds - 1):
        with timer("detect", "body"):
            found = detect_on_body(detected, body, calibrated.marker_set, review, options.detect)
        if found is detected:
            break
        detected, known = found, (calibrated, body)
        calibrated, body = fit_body(detected, calibrated.marker_set, choice.subject, known, options, timer)
    if choice.is_learned:
        with timer("detect"):
            without_set = detect_on_trajectories(take, None, None, review, options)
        marker_set = select_consistent_set(choice.marker_set, without_set, detected)
        if marker_set is None:
            return FittedTake(withdraw_marker_set(choice), without_set, None)
        if marker_set is not choice.marker_set:
            return detect_and_fit(take, replace(choice, marker_set=marker_set), review, options, timer)
    elif take.part is None:
        with timer("detect", "hands"):
            detected = detect_on_hands(detected, body, calibrated.marker_set, review, options.detect)
    return FittedTake(replace(choice, marker_set=calibrated.marker_set), detected, body)


def fit_body(
    detected: Detected,
    marker_set: MarkerSet,
    subject: Subject | None,
    previous: tuple[Calibrated, BodyFit] | None,
    options: CleanOptions,
    timer: StageTimer,
) -> tuple[Calibrated, BodyFit]:
    """Calibrate the body, unless its subject is known, and solve its poses: all of them, or those that changed since the previous
    round. Markers that moved on the body are then placed on it where they were moved to, and it is solved again.
    """
    calibrated, body = previous or (None, None)
    with timer("calibrate") if subject is None else nullcontext():
        calibrated = calibrate_body(detected, marker_set, subject, calibrated, options.initialise.is_fast)
    body = initialise_and_solve(calibrated, body, options, timer)
    if options.initialise.is_fast:
        return calibrated, body
    extended = place_moved_markers(calibrated, body)
    if extended is calibrated:
        return calibrated, body
    return extended, initialise_and_solve(extended, body, options, timer)


def initialise_and_solve(
    calibrated: SubjectInTake, previous: BodyFit | None, options: CleanOptions, timer: StageTimer
) -> BodyFit:
    """Solve the poses of a calibrated subject: those of all frames, or those that changed since the body was solved."""
    if options.initialise.is_fast:
        with timer("initialise"):
            return place_body(calibrated, initialise_between(calibrated, options.initialise.method_used, PREVIEW_POSE_RATE_HZ))
    with timer("initialise"):
        start = initialise_body(calibrated, previous, options.initialise.method_used)
    with timer("solve", "poses"):
        return solve_body(calibrated, start, previous, options)


@limit_blas_threads
def inspect(
    path: str | Path,
    options: CleanOptions = DEFAULT_OPTIONS,
    *,
    progress: ProgressCallback | None = None,
    **changed_options: object,
) -> list[InspectionReport]:
    """Return what `clean` would detect, one report for each subject in the file. Nothing is written.

    A take that `clean` refuses because it contradicts its body as a whole is inspected, and so is one without the markers or
    frames that the options of filling name.

    Raises:
        MocapfixError: If the file or its subject cannot be used.
    """
    options = options.change(**changed_options)
    build_pose_model_loader(options.prior.name_used)  # an unknown prior is an error before the file is read
    capture = read_capture(path, options.read)
    if isinstance(capture, Animation):
        from mocapfix.animations.clean import inspect_animation  # slow to import

        return [inspect_animation(capture, options)]
    reject_animation_options(capture, options)
    capture, options = label_markers(capture, options)

    def inspect_one(take: Take) -> InspectionReport:
        choice = identify_subject(take, options.subject)
        choice, detected, _ = detect_and_fit(take, choice, FaultReview(), options, StageTimer(report_progress=progress))
        notes = [*take.notes, *describe_up_axis(take), *describe_computed_points(take), *describe_frame_steps(take)]
        if marker_set := choice.marker_set:
            notes.append(describe_marker_set_match(marker_set, take.labels))
        else:
            notes += [note for note in choice.notes if note != NO_BODY_NOTE]
        return build_inspection_report(take, marker_set and marker_set.name, take, detected.faults, notes)

    return list(map_in_threads(inspect_one, split_corrected_subjects(capture, options)[0]))
