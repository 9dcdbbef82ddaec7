"""The stages in order: the map of the whole program."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from mocapfix import marker_sets as sets
from mocapfix import multi_subject, repair
from mocapfix.animation import Animation
from mocapfix.animations import clean as animated
from mocapfix.animations.joint_points import convert_to_take
from mocapfix.changes import expand_unfilled_reasons, find_unfilled_runs
from mocapfix.detect import loop
from mocapfix.detect.loop import DetectionState, FaultFilter
from mocapfix.errors import TakeError
from mocapfix.fill import gap_filling
from mocapfix.marker_sets import MarkerSet
from mocapfix.options import CleanOptions, FillOptions, InitialiseOptions
from mocapfix.pose_prior import io
from mocapfix.pose_prior import mean_pose as priors
from mocapfix.pose_prior.model import PoseModel
from mocapfix.read import capture
from mocapfix.repair import MarkerEpochs, apply_decisions
from mocapfix.report import notes, report_data, review_file
from mocapfix.report.review_file import ReviewedChange
from mocapfix.report.stage_timer import ProgressCallback, StageTimer
from mocapfix.result import CleaningResult
from mocapfix.skeleton import load_cmu31_body
from mocapfix.solve import body_fit
from mocapfix.solve.body_fit import BodyFit, FitSettings, load_requested_subject, select_subject
from mocapfix.subject import Subject
from mocapfix.take import Take

# The matrices are small and the kernels have threads of their own: BLAS's only stand in the way where cores are busy.
ONE_THREAD = threadpool_limits.wrap(limits=1, user_api="blas")


@ONE_THREAD
def clean(
    path: str | Path, options: CleanOptions | None = None, *, progress: ProgressCallback | None = None, **values: object
) -> CleaningResult:
    """Clean the take or animation at `path`: detect faults, repair labels, fit the body, fill gaps.

    options   every option of every stage; None for the defaults
    progress  called with the name of each stage as it begins
    values    single options by name, which replace those of `options`: `clean(path, prior="none", max_gap_s=2.0)`

    Raises MocapfixError with a sentence for a technician; nothing is written.
    """
    options = (options or CleanOptions()).change(**values)
    subject, marker_set, subject_prefix = options.subject.subject, options.subject.marker_set, options.subject.subject_prefix
    hierarchy, only = options.subject.hierarchy, options.detect.repair_kinds
    how, clock = build_settings(options), StageTimer(report_progress=progress)
    with clock("read"):
        take = convert_to_take(capture.read_capture(path, options.read.up_axis))
    gap_filling.check_fill_options(take, options.fill)
    files = options.review.review_files
    about_markers = {"--marker-set": marker_set, "--subject": subject, "--subject-prefix": subject_prefix}
    animated.check_animation_options(
        take, about_markers | {"--init": options.initialise != InitialiseOptions(), "--refill": options.fill.refill}, hierarchy
    )
    if isinstance(take.layout, Animation):
        return animated.clean_animation(take.layout, how, hierarchy, options.fill, only, files, clock)
    bodies = split_subjects_of_take(take, marker_set, subject, subject_prefix)
    decided = review_file.read_review_files(files, bodies)
    cleaned: list[CleaningResult] = []
    for body, decisions_on in zip(bodies, decided, strict=True):
        if cleaned:  # what one took over of the unlabelled is not there for the next
            body = replace(body, unlabelled=cleaned[-1].take.unlabelled)
        worn = resolve_subject(body, marker_set, subject)
        cleaned.append(
            clean_subject(body, *worn, how, options.fill, only, decisions_on, StageTimer(dict(clock.stage_seconds), progress))
        )
    return cleaned[0] if len(cleaned) == 1 else multi_subject.merge_results(take, tuple(cleaned))


def split_subjects_of_take(
    take: Take, marker_set: str | Path | None, subject: str | Path | Subject | None, prefix: str | None
) -> tuple[Take, ...]:
    """-> the takes to be cleaned by themselves: one for each of several people, else the take as it is.

    Raises TakeError where one subject is given for several people.
    """
    _, worn_set = load_requested_subject(marker_set, subject)
    bodies = multi_subject.split_subjects(take, worn_set, prefix)
    if subject is not None and len(bodies) > 1:
        shown = multi_subject.format_subject_names(bodies)
        raise TakeError(f"{take.name}: shows {shown}, and a subject is one person; say whose it is with --subject-prefix.")
    return bodies


def resolve_subject(
    body: Take, marker_set: str | Path | None, subject: str | Path | Subject | None
) -> tuple[Subject | None, MarkerSet | None, list[str]]:
    """-> who and what a take shows, as `solved.wearing`; what is nobody's among several people is no body."""
    if body.subject_name == multi_subject.UNASSIGNED_SUBJECT:
        return None, None, ["What is no whole body's: cleaned without a skeleton, from how markers move together."]
    return select_subject(body, marker_set, subject)


def clean_subject(
    take: Take,
    known: Subject | None,
    worn_set: MarkerSet | None,
    said: Sequence[str],
    how: FitSettings,
    options: FillOptions,
    only: Sequence[str],
    decided: tuple[ReviewedChange, ...],
    clock: StageTimer,
) -> CleaningResult:
    """-> a take of one person, or of none, cleaned; `known`, `worn_set` and `said` as from `dressed`."""
    looked, parts, body = detect_and_fit(
        take, worn_set, known, how, review_file.build_fault_filter(take, decided), clock, options.refill
    )
    with clock("fill"):
        whole, why, ways = fill_gaps(looked, parts, body, options)
        placed, touch = body.expand_to_take(parts) if body else None, gap_filling.compute_editable_mask(take, options)
        after, made = apply_decisions.apply_decisions(take, looked, whole, placed, ways, touch, only, decided)
        left = find_unfilled_runs(after, np.where(whole.visible, "its change was not to be made", why))
    error = None if placed is None else np.linalg.norm(looked.inlier_take.markers - placed, axis=-1)
    report = {
        "take": report_data.build_take_section(take, worn_set.name if worn_set else None),
        "faults": report_data.build_fault_entries(take, looked.faults),
        "changes": review_file.serialize_changes(made),
        "subject": report_data.build_subject_section(body.subject) if body else None,
        "solve": None,
        "fill": report_data.build_fill_section(take, looked.take, after, left, looked.donor_markers),
        "seconds": clock.stage_seconds,
        "notes": [*take.notes, *said, *notes.describe_uncertain_fills(after)],
    }
    if body and error is not None:
        report["solve"] = report_data.build_solve_section(
            take, body.subject, body.motion, error, how.prior_name, how.solve_options.prior_scale, how.init_method
        )
        report["notes"] = [
            *take.notes,
            *said,
            *notes.build_body_notes(looked, parts, body, error),
            *notes.describe_uncertain_fills(after),
        ]
    found = (body.subject, body.motion, body.joint_positions) if body else (None, None, None)
    return CleaningResult(take, looked.take, after, looked.faults, made, left, looked.donor_markers, *found, error, report)


@ONE_THREAD
def inspect(
    path: str | Path, options: CleanOptions | None = None, *, progress: ProgressCallback | None = None, **values: object
) -> list[dict]:
    """Return the take, faults and notes of the report of `clean`, for each of several subjects; nothing is written.

    Arguments and errors as of `clean`; the stages after the body fit have no effect.
    """
    options = (options or CleanOptions()).change(**values)
    subject, marker_set, subject_prefix = options.subject.subject, options.subject.marker_set, options.subject.subject_prefix
    hierarchy = options.subject.hierarchy
    clock, how, found = StageTimer(report_progress=progress), build_settings(options), []
    take = convert_to_take(capture.read_capture(path, options.read.up_axis))
    animated.check_animation_options(
        take, {"--marker-set": marker_set, "--subject": subject, "--subject-prefix": subject_prefix}, hierarchy
    )
    if isinstance(take.layout, Animation):
        return [animated.inspect_animation(take.layout, hierarchy)]
    for body in split_subjects_of_take(take, marker_set, subject, subject_prefix):
        known, worn_set, _ = resolve_subject(body, marker_set, subject)
        looked, _, _ = detect_and_fit(body, worn_set, known, how, lambda fault: True, clock)
        said = sets.describe_marker_set_match(worn_set, body.labels) if worn_set else sets.choose_marker_set(body.labels).reason
        found.append(
            report_data.build_inspection_report(
                body, worn_set.name if worn_set else None, body, looked.faults, [*body.notes, said]
            )
        )
    return found


def build_settings(options: CleanOptions) -> FitSettings:
    """Return how the body is fitted. Raises SceneError if there is no such prior."""
    prior = options.prior.prior
    return FitSettings(load_prior_lazily(prior), options.solve, options.initialise.method, prior)


def load_prior_lazily(name: str) -> Callable[[], PoseModel] | None:
    """-> what loads a trained prior when it is first asked for, for not every take needs one; None for "none".

    Raises SceneError where there is no such prior.
    """
    if name == "none":
        return None
    io.find_pose_model(name)
    return cache(lambda: io.load_pose_model(name, load_cmu31_body().skeleton))


def detect_and_fit(
    take: Take,
    worn_set: MarkerSet | None,
    subject: Subject | None,
    how: FitSettings,
    stands: FaultFilter,
    clock: StageTimer,
    refill: bool = False,
) -> tuple[DetectionState, MarkerEpochs, BodyFit | None]:
    """-> what is wrong with a take, its parts, and its body (None where no marker set fits).

    The first look is at the trajectories, each other at the body that was solved from what was believed until then.
    """
    with clock("detect"):
        looked = loop.detect_on_trajectories(take, worn_set, subject, stands, refill)
    if not looked.inlier_take.visible.sum(1).max() >= 3:
        raise TakeError(f"{take.name}: no frame shows three markers, so nothing can be placed; check the labels and the export.")
    parts = repair.split_moved_markers(looked.take, looked.faults.items)
    if worn_set is None:
        return looked, parts, None
    for solves in range(1, how.solve_options.max_solve_rounds + 1):
        body = body_fit.fit_body(parts, parts.split_mask(looked.solver_mask), worn_set, subject, how, clock)
        if solves == how.solve_options.max_solve_rounds:
            break
        with clock("detect"):
            more = loop.detect_on_body(looked, parts, body, worn_set, stands)
        if more is None:
            break
        looked, parts = more, repair.split_moved_markers(more.take, more.faults.items)
    return looked, parts, body


def fill_gaps(
    looked: DetectionState, parts: MarkerEpochs, body: BodyFit | None, options: FillOptions
) -> tuple[Take, np.ndarray, np.ndarray]:
    """-> the take with all that is missing or doubted filled or emptied, and (T, M) sentences: why what is empty is so, and how
    what was filled was found.

    What a program filled before stays as it is, and a label that only names pieces of another marker is not filled.
    """
    take, believed = looked.take, looked.inlier_take.visible
    given = (body.marker_columns, body.extended_subject, body.motion) if body else (np.zeros(0, int), None, None)
    lasting = gap_filling.compute_gap_durations(believed, take.rate)[:, parts.column_marker]
    after, left, way = gap_filling.fill_take(parts.take, parts.split_mask(believed), lasting, *given, options)
    stays = take.visible & ~take.measured
    stays[:, list(looked.donor_markers)] = True
    stays |= believed  # also while a marker slides from place to place
    sure = np.full(after.visible.shape, np.nan) if after.sample_sd is None else after.sample_sd
    markers = np.where(stays[..., None], take.markers, parts.merge_columns(after.markers))
    why = parts.merge_columns(expand_unfilled_reasons(left, after.visible.shape))
    ways = np.where(stays, "", parts.merge_columns(np.array([*gap_filling.FILL_METHODS, ""], object)[way]))
    return take.replace_markers(markers, np.where(stays, np.nan, parts.merge_columns(sure))), why, ways


@ONE_THREAD
def calibrate(
    paths: Sequence[str | Path],
    options: CleanOptions | None = None,
    *,
    mean_pose_prior: str = "mean-pose",
    **values: object,
) -> Subject:
    """Return one person's subject from one or several takes; of the subject prefix in `options` if the takes have several.

    Of the options, the up axis, the marker set and the subject prefix have an effect; `values` replace them by name.

    Raises TakeError if no marker set fits, if the takes have different ones, or if one has several subjects and none is named.
    """
    options = (options or CleanOptions()).change(**values)
    name, subject_prefix = options.subject.marker_set, options.subject.subject_prefix
    takes = []
    for path in paths:
        whole = capture.read_take(path, options.read.up_axis)
        take, *more = split_subjects_of_take(whole, name, None, subject_prefix)
        if more:
            raise TakeError(
                f"{whole.name}: shows {multi_subject.format_subject_names((take, *more))}; say whose bones are wanted with --subject-prefix."
            )
        takes.append(take)
    worn, sets = [], []
    for take in takes:
        _, worn_set, notes = select_subject(take, name, None)
        if worn_set is None:
            raise TakeError(f"{take.name}: {notes[0]} There is no body to calibrate.")
        sets.append(worn_set)
        looked = loop.detect_on_trajectories(take, worn_set, None, lambda fault: True)
        worn.append(looked.take.select(worn_set.find_columns(take.labels), looked.inlier_take.visible))
    if len({each.name for each in sets}) > 1:
        names = ", ".join(f"{take.name} ({each.name})" for take, each in zip(takes, sets, strict=True))
        raise TakeError(f"The takes wear different marker sets: {names}; calibrate them apart, or name one with --marker-set.")
    together = worn[0].replace_markers(np.concatenate([each.markers for each in worn]))
    body = load_cmu31_body()
    return calibrate.calibrate_subject(together, sets[0], body, priors.load_mean_pose_prior(mean_pose_prior, body.skeleton))
