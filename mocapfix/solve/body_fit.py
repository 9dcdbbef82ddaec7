"""The stages that fit the body: calibrate the subject, initialise its poses, solve its motion, place moved markers."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from mocapfix.calibrate import calibration
from mocapfix.calibrate.calibration import add_moved_markers
from mocapfix.initialise import initial_motion
from mocapfix.options import CleanOptions, SolveOptions
from mocapfix.pose_prior import mean_pose
from mocapfix.pose_prior.joint_limits import load_joint_limits
from mocapfix.pose_prior.model import PoseModel
from mocapfix.skeleton import load_cmu31_body
from mocapfix.solve import kinematics, motion_solver
from mocapfix.state import BodyFit, CleaningState
from mocapfix.subject import Subject
from mocapfix.take import Take


@dataclass(frozen=True)
class FitSettings:
    """The prior and the solver options with which occluded joints of an animation are estimated."""

    load_pose_model: Callable[[], PoseModel] | None
    solve_options: SolveOptions
    init_method: str
    prior_name: str = "none"


def calibrate_body(state: CleaningState, options: CleanOptions) -> CleaningState:
    """Take the known subject, or calibrate the subject from the inliers of the take. Fills `subject` and `marker_columns`.

    Raises TakeError where the markers do not allow a calibration.
    """
    assert state.marker_set is not None
    epochs = state.detection.epochs
    columns = state.marker_set.find_columns(epochs.take.labels)
    subject = state.known_subject
    if subject is None:
        body = load_cmu31_body()
        prior = mean_pose.load_mean_pose_prior("mean-pose", body.skeleton)
        take = epochs.take.select(columns, epochs.split_mask(state.detection.solver_mask))
        subject = calibration.calibrate_subject(take, state.marker_set, body, prior)
    return replace(state, subject=subject, extended_subject=subject, marker_columns=columns)


def initialise_body(state: CleaningState, options: CleanOptions) -> CleaningState:
    """Compute a first pose for every frame in closed form. Fills `initial_motion`."""
    take, subject = _select_solver_take(state)
    body = load_cmu31_body()
    prior = mean_pose.load_mean_pose_prior("mean-pose", body.skeleton)
    motion = initial_motion.initialise_motion(take, subject, body, prior, options.initialise.method)
    return replace(state, initial_motion=motion)


def solve_body(state: CleaningState, options: CleanOptions) -> CleaningState:
    """Solve the motion from the initial poses. Fills `body`."""
    assert state.subject is not None and state.initial_motion is not None and state.marker_columns is not None
    take, extended_subject = _select_solver_take(state)
    body = load_cmu31_body()
    prior = mean_pose.load_mean_pose_prior("mean-pose", body.skeleton)
    limits = load_joint_limits(body.skeleton)
    motion = motion_solver.solve_motion(
        take,
        extended_subject,
        body,
        prior,
        limits,
        state.initial_motion,
        options.solve,
        load_pose_model=state.load_pose_model,
    )
    joints, markers = kinematics.compute_joint_and_marker_positions(extended_subject, motion)
    return replace(state, body=BodyFit(state.subject, extended_subject, motion, state.marker_columns, joints, markers))


def place_moved_markers(state: CleaningState, options: CleanOptions) -> CleaningState:
    """Find where the solved body carries each marker after it moved, and add these places to `extended_subject`.

    The poses must be solved again if any was added. Returns the very same state where no marker moved.
    """
    assert state.body is not None and state.marker_columns is not None
    epochs, columns = state.detection.epochs, state.marker_columns
    marker_of_column = {int(column): k for k, column in enumerate(columns)}
    added = np.array([c for c in epochs.added_columns if int(epochs.column_marker[c]) in marker_of_column], int)
    if not len(added):
        return state
    markers = epochs.take.select(added, epochs.split_mask(state.detection.solver_mask)).markers
    subject_markers = np.array([marker_of_column[int(epochs.column_marker[column])] for column in added])
    extended, is_placed = add_moved_markers(state.body.subject, state.body.motion, markers, subject_markers)
    return replace(state, extended_subject=extended, marker_columns=np.r_[columns, added[is_placed]])


def _select_solver_take(state: CleaningState) -> tuple[Take, Subject]:
    """Return the samples that the solver uses, in the order of the extended subject's markers, and that subject."""
    assert state.extended_subject is not None and state.marker_columns is not None
    epochs = state.detection.epochs
    mask = epochs.split_mask(state.detection.solver_mask)
    return epochs.take.select(state.marker_columns, mask), state.extended_subject
