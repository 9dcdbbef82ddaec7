"""The calibration of a person from several takes: the subjects of each take, the best frames of each, and their bones together.

A subject is identified in the same way as for a cleaning: by the options, by the labels, or by a marker set of the take's own.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from threadpoolctl import threadpool_limits

from mocapfix.detect.loop import detect_on_trajectories
from mocapfix.errors import TakeError, join_names
from mocapfix.io.capture import read_capture
from mocapfix.labels.multi_subject import choose_subject_file, split_known_subjects
from mocapfix.labels.requested_labels import label_take
from mocapfix.model.animation import Animation
from mocapfix.model.faults import FaultReview
from mocapfix.model.marker_set import MarkerSet
from mocapfix.model.skeleton import load_cmu31_body, restrict_body
from mocapfix.model.subject import Subject
from mocapfix.model.take import Take
from mocapfix.options import CleanOptions, SubjectOptions
from mocapfix.solve.mean_pose import load_mean_pose_prior
from mocapfix.subject.calibration import CalibrationFrames, select_calibration_frames
from mocapfix.subject.library import SubjectChoice, load_requested_subject, resolve_subject
from mocapfix.subject.person_calibration import calibrate_person

DEFAULT_OPTIONS = CleanOptions()
# The matrices are small and the kernels have their own threads: threads of the BLAS library only slow them down.
limit_blas_threads = threadpool_limits.wrap(limits=1, user_api="blas")


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
        paths: The takes.
        options: `options.read` and `options.subject`; the others are not used.
        mean_pose_prior: The name of the mean pose prior.

    Raises:
        TakeError: If there is no take, no marker set fits, marker sets differ, or one of several subjects is to be named.
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
    return [survey_subject(body, options, take_id) for body in find_bodies_to_calibrate(path, options)]


class BodyToCalibrate(NamedTuple):
    """The take of one subject, its marker set, whether that was learned from the take, and the subject if it is known."""

    take: Take
    marker_set: MarkerSet
    is_learned: bool
    subject: Subject | None


def find_bodies_to_calibrate(path: str | Path, options: CleanOptions) -> list[BodyToCalibrate]:
    """Return each subject in a take that has a marker set. Raises TakeError if none has."""
    capture = read_capture(path, options.read)
    if isinstance(capture, Animation):
        raise TakeError(f"{capture.name}: is an animation without markers; calibrate from a marker take.")
    capture = label_take(capture, load_requested_subject(options.subject), options.read)
    takes = split_known_subjects(capture, options.subject)
    choices = [identify_subject(take, options.subject) for take in takes]
    found = [
        BodyToCalibrate(take, each.marker_set, each.is_learned, each.subject)
        for take, each in zip(takes, choices, strict=True)
        if each.marker_set is not None
    ]
    if not found:
        raise TakeError(f"{capture.name}: {choices[0].notes[0]} There is no body to calibrate.")
    return found


@limit_blas_threads
def survey_subject(body: BodyToCalibrate, options: CleanOptions, take_id: str) -> CalibrationFrames:
    """Return the best frames of one subject: its sound samples in frames that differ in pose. Raises TakeError."""
    marker_set = body.marker_set
    detected = detect_on_trajectories(body.take, marker_set, body.subject, FaultReview(), options)
    shown = detected.take.select(marker_set.find_columns(detected.take.labels), detected.inlier_mask)
    model = restrict_body(load_cmu31_body(), set(marker_set.joints.tolist()))
    prior = load_mean_pose_prior("mean-pose", model.skeleton)
    return select_calibration_frames(take_id, shown, marker_set, model, prior)


def identify_subject(take: Take, options: SubjectOptions) -> SubjectChoice:
    """Return the subject and the marker set of one subject's take. Raises TakeError if the given marker set does not fit it."""
    if isinstance(options.subject, tuple):
        options = replace(options, subject=choose_subject_file(take, options.subject))
    choice = resolve_subject(take, options)
    if choice.marker_set is None and not options.known_sets_only:
        from mocapfix.subject.learning import find_own_marker_set

        choice = find_own_marker_set(take, choice)
    return choice
