"""The pipeline: every stage of cleaning a take, in order.

`clean` cleans the take of each subject in a file: detect, calibrate, initialise, solve, detect again, fill, apply decisions. Each
stage takes a `CleaningState` and the `CleanOptions` and returns it with more fields filled. Animations: `mocapfix.animations`.
"""

import os
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

from threadpoolctl import threadpool_limits

from mocapfix.animations.clean import clean_animation, inspect_animation, reject_hierarchy
from mocapfix.contacts.body_contacts import hold_standing_feet
from mocapfix.detect.contradictions import check_contradictions, try_learned_set
from mocapfix.detect.loop import check_visible_markers, detect_on_body, detect_on_trajectories
from mocapfix.errors import TakeError, join_names
from mocapfix.fill.computed_points import update_computed_points
from mocapfix.fill.gap_filling import check_fill_options, fill_gaps
from mocapfix.io.capture import read_capture
from mocapfix.io.changes_file import NO_REVIEW, Review, build_review_filter
from mocapfix.labels import multi_subject
from mocapfix.labels.multi_subject import choose_subject, split_corrected_subjects, split_known_subjects
from mocapfix.labels.requested_labels import describe_missing_labels, label_capture, label_take
from mocapfix.model.animation import Animation
from mocapfix.model.skeleton import load_cmu31_body, restrict_body
from mocapfix.model.subject import Subject
from mocapfix.model.take import Take
from mocapfix.options import CleanOptions, SubjectOptions
from mocapfix.report.build_report import build_inspection_report, build_report
from mocapfix.report.notes import describe_computed_points, describe_up_axis
from mocapfix.report.report import InspectionReport
from mocapfix.report.stage_timer import ProgressCallback, StageTimer
from mocapfix.result import CleaningResult
from mocapfix.review.apply_decisions import apply_decisions
from mocapfix.solve.initial_motion import initialise_body
from mocapfix.solve.mean_pose import load_mean_pose_prior
from mocapfix.solve.motion_solver import complete_body, place_body, solve_body
from mocapfix.solve.parallel import map_in_processes
from mocapfix.solve.pose_prior import PoseModel
from mocapfix.solve.prior_conditioner import build_prior_conditioner
from mocapfix.solve.prior_files import build_pose_model_loader
from mocapfix.state import CleaningState, DetectionState
from mocapfix.subject.calibration import CalibrationFrames, calibrate_body, place_moved_markers, select_calibration_frames
from mocapfix.subject.library import choose_marker_set, describe_marker_set_match, load_requested_subject, resolve_subject
from mocapfix.subject.person_calibration import calibrate_person

DEFAULT_OPTIONS = CleanOptions()
# The matrices are small and the kernels have their own threads: threads of the BLAS library only slow them down.
limit_blas_threads = threadpool_limits.wrap(limits=1, user_api="blas")


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
        path: a C3D, TRC, CSV, TSV, BVH or AMC file.
        options: what to do; see `CleanOptions`.
        progress: called with the name of each stage when it begins.
        changed_options: single options by name, in place of those in `options`: `clean(path, prior="none", max_gap_s=2.0)`.

    Returns:
        The cleaned take with its faults, changes, subject, motion and report. With several subjects in the file, a result for the
        whole take that holds one result for each subject.

    Raises:
        MocapfixError: with a sentence for a technician. Nothing is written.
    """
    options = requested = options.change(**changed_options)
    load_pose_model = build_pose_model_loader(options.prior.name_used)
    timer = StageTimer(report_progress=progress)
    with timer("read"):
        capture = read_capture(path, options.read)
    if isinstance(capture, Animation):
        return replace(clean_animation(capture, options, load_pose_model, timer), requested=options)
    reject_hierarchy(capture, options.subject)
    with timer("label"):
        capture, options = label_capture(capture, options, calibrate_takes)
    check_fill_options(capture, options.fill)
    takes, reviews, exchanges = split_corrected_subjects(capture, options)
    results = clean_subjects(takes, reviews, options, load_pose_model, timer)
    result = results[0] if len(results) == 1 else multi_subject.merge_results(exchanges, tuple(results))
    return replace(result, requested=requested)


@limit_blas_threads
def label(path: str | Path, options: CleanOptions = DEFAULT_OPTIONS, *, progress: ProgressCallback | None = None) -> Take:
    """Return a take without labels with those of a marker set, in whose `labelled_file` are the bytes of the labelled file.

    Args:
        path: the take.
        options: `options.read` and `options.subject`, which may name a marker set, a subject or a labelled take.
        progress: called with the name of each stage when it begins.

    Raises:
        TakeError: if the take has labels with a meaning, or no person with these markers is found in it.
    """
    timer = StageTimer(report_progress=progress)
    with timer("read"):
        capture = read_capture(path, options.read)
    if isinstance(capture, Animation):
        raise TakeError(f"{capture.name}: is an animation without markers; there is nothing to label.")
    with timer("label"):
        labelled, _ = label_capture(capture, options, calibrate_takes)
    if labelled.labelled_file is None:
        raise TakeError(describe_missing_labels(capture, labelled))
    return labelled


def start_cleaning(take: Take, options: SubjectOptions, review: Review = NO_REVIEW) -> CleaningState:
    """Return the state in which the cleaning of one subject's take begins. Raises TakeError if the marker set does not fit it."""
    choice = resolve_subject(take, choose_subject(take, options))
    if choice.marker_set is None and not options.known_sets_only:
        from mocapfix.subject.own_set import find_own_marker_set  # few takes need it

        choice = find_own_marker_set(take, choice)
    known = choice.marker_set, choice.is_learned, choice.subject
    return CleaningState(take, DetectionState(take), *known, None, review, build_review_filter(take, review), choice.notes)


def clean_subjects(
    takes: Sequence[Take],
    reviews: Sequence[Review],
    options: CleanOptions,
    load_pose_model: Callable[[], PoseModel] | None,
    timer: StageTimer,
) -> list[CleaningResult]:
    """Run all stages on the takes of several subjects, side by side.

    An unlabelled trajectory assigned to one subject is not available to the next: those after it are then cleaned again. So the
    results are those of cleaning one after the other.
    """
    results: list[CleaningResult] = []
    unlabelled, report_progress = takes[0].unlabelled, report_in_this_process(timer.report_progress)

    def clean_one(index: int) -> CleaningResult:
        take = takes[index] if takes[index].unlabelled is unlabelled else replace(takes[index], unlabelled=unlabelled)
        conditioner = build_prior_conditioner(load_pose_model, options.solve.prior_scale)
        state = replace(start_cleaning(take, options.subject, reviews[index]), prior_conditioner=conditioner)
        return clean_subject(state, options, StageTimer(dict(timer.stage_seconds), report_progress))

    while len(results) < len(takes):
        for result in map_in_processes(clean_one, range(len(results), len(takes)), multi_subject.list_shared_data(takes)):
            results.append(result)
            if len(takes) > 1:
                report_progress(f"{len(results)} of {len(takes)} subjects")
            if not multi_subject.is_same_data(result.take.unlabelled, unlabelled):
                unlabelled = result.take.unlabelled
                break
    return results


def report_in_this_process(progress: ProgressCallback | None) -> ProgressCallback:
    """Return a progress callback that does nothing in copies of this process: a terminal shows the stages of one of them."""
    process = os.getpid()

    def report_stage(stage: str) -> None:
        if progress and os.getpid() == process:
            progress(stage)

    return report_stage


def clean_subject(state: CleaningState, options: CleanOptions, timer: StageTimer) -> CleaningResult:
    """Run all stages on the take of one subject. Raises TakeError if the take contradicts its body as a whole."""
    state = detect_and_fit(state, options, timer)
    check_contradictions(state, options)
    with timer("solve"):
        state = hold_standing_feet(complete_body(state, options), options)
    with timer("fill"):
        state = fill_gaps(state, options)
        state = apply_decisions(state, options)
        assert state.cleaned_take is not None
        state = replace(state, cleaned_take=update_computed_points(state.original_take, state.cleaned_take, options.fill))
    assert state.cleaned_take is not None
    detection, body = state.detection, state.body
    return CleaningResult(
        input_take=state.original_take,
        relabelled_take=detection.take,
        take=state.cleaned_take,
        faults=detection.faults,
        changes=state.changes,
        unfilled_runs=state.unfilled_runs,
        fragment_donors=detection.donor_markers,
        subject=body.subject if body else None,
        motion=body.motion if body else None,
        joint_position_world=body.solved_joint_positions if body else None,
        contacts=body.contacts if body else None,
        residual_m=state.residual_m,
        report=build_report(state, options, timer.stage_seconds),
        review=state.review,
    )


def detect_and_fit(state: CleaningState, options: CleanOptions, timer: StageTimer) -> CleaningState:
    """Detect faults and fit the body, in rounds: each detection compares the take with the body of its round, which was
    fitted to the inliers known before. A learned marker set that contradicts the take is withdrawn.

    Raises TakeError where too few markers are visible.
    """
    first = state
    with timer("detect"):
        state = detect_on_trajectories(state, options)
    check_visible_markers(state)
    if state.marker_set is None:
        return state
    max_rounds = 1 if options.initialise.is_fast else options.solve.max_solve_rounds
    for solve_round in range(1, max_rounds + 1):
        state = fit_body(state, options, timer)
        if solve_round == max_rounds:
            break
        detection = state.detection
        with timer("detect"):
            state = detect_on_body(state, options)
        if state.detection is detection:
            break
    return try_learned_set(first, state, options, timer, detect_and_fit) if state.has_learned_set else state


def fit_body(state: CleaningState, options: CleanOptions, timer: StageTimer) -> CleaningState:
    """Calibrate the body and solve its poses, with the markers that moved on it at each of their places."""
    with timer("calibrate") if state.known_subject is None else nullcontext():
        state = calibrate_body(state, options)
    state = initialise_and_solve(state, options, timer)
    if options.initialise.is_fast:
        return state
    extended = place_moved_markers(state, options)
    return state if extended is state else initialise_and_solve(extended, options, timer)


def initialise_and_solve(state: CleaningState, options: CleanOptions, timer: StageTimer) -> CleaningState:
    """Solve the poses of the calibrated subject: those of all frames, or those that changed since the body was solved."""
    with timer("initialise"):
        state = initialise_body(state, options)
    with timer("solve"):
        return place_body(state) if options.initialise.is_fast else solve_body(state, options)


@limit_blas_threads
def inspect(
    path: str | Path,
    options: CleanOptions = DEFAULT_OPTIONS,
    *,
    progress: ProgressCallback | None = None,
    **changed_options: object,
) -> list[InspectionReport]:
    """Return what `clean` would detect, one report for each subject in the file. Nothing is written. Raises as `clean`."""
    options, timer = options.change(**changed_options), StageTimer(report_progress=report_in_this_process(progress))
    load_pose_model = build_pose_model_loader(options.prior.name_used)
    capture = read_capture(path, options.read)
    if isinstance(capture, Animation):
        return [inspect_animation(capture, options)]
    reject_hierarchy(capture, options.subject)
    capture, options = label_capture(capture, options, calibrate_takes)

    def inspect_one(take: Take) -> InspectionReport:
        conditioner = build_prior_conditioner(load_pose_model, options.solve.prior_scale)
        state = replace(start_cleaning(take, options.subject), prior_conditioner=conditioner)
        faults = detect_and_fit(state, options, timer).detection.faults
        marker_set = state.marker_set
        reason = describe_marker_set_match(marker_set, take.labels) if marker_set else choose_marker_set(take.labels).reason
        notes = [*take.notes, *describe_up_axis(take), *describe_computed_points(take), reason]
        return build_inspection_report(take, marker_set and marker_set.name, take, faults, notes)

    return list(map_in_processes(inspect_one, split_corrected_subjects(capture, options)[0]))


@limit_blas_threads
def calibrate_takes(
    paths: Sequence[str | Path],
    options: CleanOptions = DEFAULT_OPTIONS,
    *,
    mean_pose_prior: str = "mean-pose",
    **changed_options: object,
) -> Subject:
    """Calibrate one person's bones and marker offsets from the best frames of one or several takes together.

    Args:
        paths: the takes.
        options: `options.read` and `options.subject`; the others are not used.
        mean_pose_prior: the name of the mean pose prior.

    Raises:
        TakeError: if there is no take, no marker set fits, marker sets differ, or one of several subjects is to be named.
    """
    surveys = survey_person(paths, [Path(path).name for path in paths], options.change(**changed_options))
    return calibrate_person(surveys, mean_pose_prior=mean_pose_prior).subject


def survey_person(paths: Sequence[str | Path], ids: Sequence[str], options: CleanOptions) -> list[CalibrationFrames]:
    """Return the best frames of each take of one person. Raises TakeError as `calibrate_takes`."""
    if not paths:
        raise TakeError("There is no take to calibrate from; name at least one.")
    surveys: list[CalibrationFrames] = []
    for path, take_id in zip(paths, ids, strict=True):
        found = survey_take(path, options, take_id)
        if len(found) > 1:
            names = join_names([frames.subject_name for frames in found])
            raise TakeError(f"{Path(path).name}: shows {names}; name the subject to calibrate with --subject-prefix.")
        surveys += found
    return surveys


@limit_blas_threads
def survey_take(path: str | Path, options: CleanOptions = DEFAULT_OPTIONS, take_id: str = "") -> list[CalibrationFrames]:
    """Return the best frames of each subject in a take, from which persons are calibrated. Raises TakeError without a body."""
    return [survey_subject(state, options, take_id) for state in find_bodies_to_calibrate(path, options)]


def find_bodies_to_calibrate(path: str | Path, options: CleanOptions) -> list[CleaningState]:
    """Return the state of each subject in a take before its cleaning. Raises TakeError if none has a marker set."""
    capture = read_capture(path, options.read)
    if isinstance(capture, Animation):
        raise TakeError(f"{capture.name}: is an animation without markers; calibrate from a marker take.")
    capture = label_take(capture, load_requested_subject(options.subject))
    states = [start_cleaning(take, options.subject) for take in split_known_subjects(capture, options.subject)]
    found = [state for state in states if state.marker_set is not None]
    if not found:
        raise TakeError(f"{capture.name}: {states[0].notes[0]} There is no body to calibrate.")
    return found


@limit_blas_threads
def survey_subject(state: CleaningState, options: CleanOptions, take_id: str) -> CalibrationFrames:
    """Return the best frames of one subject: its sound samples in frames that differ in pose. Raises TakeError."""
    assert state.marker_set is not None
    detection = detect_on_trajectories(state, options).detection
    shown = detection.take.select(state.marker_set.find_columns(detection.take.labels), detection.inlier_mask)
    body = restrict_body(load_cmu31_body(), set(state.marker_set.joints.tolist()))
    prior = load_mean_pose_prior("mean-pose", body.skeleton)
    return select_calibration_frames(take_id, shown, state.marker_set, body, prior)
