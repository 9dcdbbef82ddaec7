"""A take's body: which set it wears, whose it is, and how it moves."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mocapfix import marker_sets
from mocapfix.calibrate import calibration, subject_file
from mocapfix.calibrate.calibration import add_moved_markers
from mocapfix.errors import TakeError
from mocapfix.initialise import initial_motion
from mocapfix.marker_sets import MarkerSet
from mocapfix.motion import Motion
from mocapfix.options import SolveOptions
from mocapfix.pose_prior import mean_pose
from mocapfix.pose_prior.joint_limits import load_joint_limits
from mocapfix.pose_prior.model import PoseModel
from mocapfix.repair import MarkerEpochs
from mocapfix.report.stage_timer import StageTimer
from mocapfix.skeleton import load_cmu31_body
from mocapfix.solve import kinematics, motion_solver
from mocapfix.subject import Subject
from mocapfix.take import Take


@dataclass(frozen=True)
class FitSettings:
    """How a body is found: what poses are like, what the solve believes, from which start, and the name of the poses' model."""

    load_pose_model: Callable[[], PoseModel] | None
    solve_options: SolveOptions
    init_method: str
    prior_name: str = "none"


@dataclass(frozen=True)
class BodyFit:
    """A body and its motion.

    person   the subject;  worn  the subject and a marker more for every new place of a moved one
    columns  (K,) the column among the take's parts of each of `worn`'s markers, -1 where it has none
    joints   (T, J, 3) metres;  markers (T, K, 3) metres, where the body has them
    """

    subject: Subject
    extended_subject: Subject
    motion: Motion
    marker_columns: np.ndarray
    joint_positions: np.ndarray
    marker_positions: np.ndarray

    def expand_to_take(self, parts: MarkerEpochs) -> np.ndarray:
        """-> (T, M, 3) metres: where the body has the take's markers, NaN where it has none."""
        there = self.marker_columns >= 0
        out = np.full(parts.take.markers.shape, np.nan)
        out[:, self.marker_columns[there]] = self.marker_positions[:, there]
        return parts.merge_columns(out)


def select_subject(
    take: Take, marker_set_name: str | Path | None, subject: str | Path | Subject | None
) -> tuple[Subject | None, MarkerSet | None, list[str]]:
    """-> the subject where one is given, the marker set that the take wears (None where none fits), and notes on that.

    Raises TakeError where the set or subject that was named does not fit the take.
    """
    known, worn_set = load_requested_subject(marker_set_name, subject)
    if worn_set is None:
        choice = marker_sets.choose_marker_set(take.labels)
        without = [] if choice.marker_set else [choice.reason, "The take was cleaned without a skeleton: there is no BVH."]
        return None, choice.marker_set, without
    found = worn_set.match_labels(take.labels)
    if lack := worn_set.describe_missing_body(found):
        raise TakeError(f"{take.name}: {worn_set.name} does not fit: {len(found)} of its {len(worn_set.labels)} markers, {lack}.")
    return known, worn_set, []


def load_requested_subject(
    marker_set_name: str | Path | None, subject: str | Path | Subject | None
) -> tuple[Subject | None, MarkerSet | None]:
    """-> the subject and the marker set that were named, None where none was."""
    if subject is not None:
        known = subject if isinstance(subject, Subject) else subject_file.read_subject(subject)
        return known, marker_sets.build_subject_marker_set(known)
    return None, None if marker_set_name is None else marker_sets.load_marker_set(marker_set_name)


def fit_body(
    epochs: MarkerEpochs,
    solver_mask: np.ndarray,
    marker_set: MarkerSet,
    subject: Subject | None,
    settings: FitSettings,
    timer: StageTimer,
) -> BodyFit:
    """-> the take's body: the subject, calibrated where it is not known yet, and its motion; a moved marker's new place is
    found on the body that the others show, and then tells as well.

    heard  (T, C) bool: the samples of the parts' columns that the body listens to
    """
    columns = marker_set.find_columns(epochs.take.labels)
    worn = epochs.take.select(columns, solver_mask)
    if subject is None:
        with timer("calibrate"):
            subject = calibration.calibrate_subject(
                worn, marker_set, load_cmu31_body(), mean_pose.load_mean_pose_prior("mean-pose", load_cmu31_body().skeleton)
            )
    person, motion = subject, fit_motion(worn, subject, settings, timer)
    which = {int(column): k for k, column in enumerate(columns)}
    more = np.array([column for column in epochs.added_columns if int(epochs.column_marker[column]) in which], int)
    if len(more):
        shown = epochs.take.select(more, solver_mask).markers
        subject, enough = add_moved_markers(subject, motion, shown, np.array([which[int(epochs.column_marker[c])] for c in more]))
        columns = np.r_[columns, more[enough]]
        motion = fit_motion(epochs.take.select(columns, solver_mask), subject, settings, timer)
    joints, markers = kinematics.compute_joint_and_marker_positions(subject, motion)
    return BodyFit(person, subject, motion, columns, joints, markers)


def fit_motion(take: Take, subject: Subject, settings: FitSettings, timer: StageTimer) -> Motion:
    """-> the subject's motion in a take of its markers, in the subject's order."""
    average = load_cmu31_body()
    poses = mean_pose.load_mean_pose_prior("mean-pose", average.skeleton)
    with timer("initialise"):
        start = initial_motion.initialise_motion(take, subject, average, poses, settings.init_method)
    with timer("solve"):
        return motion_solver.solve_motion(
            take,
            subject,
            average,
            poses,
            load_joint_limits(average.skeleton),
            start,
            settings.solve_options,
            settings.load_pose_model,
        )
