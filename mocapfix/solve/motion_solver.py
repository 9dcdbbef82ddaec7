"""The motion solver: the pose of every frame that best agrees with markers, a prior on poses, and the frames around it.

A take is solved in windows (`window_solver`), and again only where it changed. Limbs that no marker shows are interpolated at
first, which is all that detection needs. They are inferred from the rest of the take once the faults are known.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.files.option_choices import PRIOR_EVERY_FRAME
from mocapfix.motion import FrameStatus, Motion, PoseEvidence
from mocapfix.options import CleanOptions, SolveOptions
from mocapfix.pose_prior.mean_pose import JointLimits, MeanPosePrior, load_joint_limits, load_mean_pose_prior
from mocapfix.skeleton import BodyModel
from mocapfix.solve import kinematics
from mocapfix.solve.frame_windows import FrameChanges, FrameWindow, change_all_frames, list_window_frames, select_windows
from mocapfix.solve.measured_segments import yield_to_markers
from mocapfix.solve.motion_uncertainty import update_motion_sd
from mocapfix.solve.pose_problem import MotionProblem, build_motion_problem
from mocapfix.solve.prior_conditioner import PriorConditioner
from mocapfix.solve.unobserved_joints import infer_unobserved_joints
from mocapfix.solve.window_solver import solve_window
from mocapfix.state import BodyFit, CleaningState
from mocapfix.subject import Subject
from mocapfix.take import Take

MAX_MEAN_MARKER_DISTANCE_M = 0.03
"""Mean distance of a frame's markers from the body above which the frame's status is POOR_FIT."""
PLACED_JOINT_SD_M = 0.015
"""Standard deviation per axis of joints and markers of poses that were not solved: measured on composed takes."""
UNSEEN_JOINT_SD_M = 0.05
"""The same on segments that no visible marker shows."""
MIN_FRAME_MARKERS = 3
"""Visible markers below which the status of a frame is GUESSED."""


def solve_motion(
    take: Take,
    subject: Subject,
    body: BodyModel,
    prior: MeanPosePrior,
    limits: JointLimits,
    initial_motion: Motion,
    options: SolveOptions,
    *,
    conditioner: PriorConditioner | None = None,
) -> Motion:
    """Return the poses of all frames, with the standard deviations of every joint and of every marker as the body places it.

    take             the markers in the subject's order, NaN if not visible or an outlier
    prior            the mean pose of independent joints, which makes every frame determinate
    initial_motion   the start of each frame's first solve; NaN where it starts from the frame before
    conditioner      a trained pose model; used only if a limb is occluded for so long that the take itself does not determine it
    """
    problem = build_motion_problem(take, subject, body, prior, limits, options)
    start = replace(
        initial_motion,
        root_position=initial_motion.root_position.copy(),
        local_rotations=initial_motion.local_rotations.copy(),
    )
    motion, evidence = solve_changed_frames(problem, start, change_all_frames(take.frame_count))
    return complete_motion(problem, motion, evidence, conditioner)


def complete_motion(
    problem: MotionProblem, motion: Motion, evidence: PoseEvidence, conditioner: PriorConditioner | None
) -> Motion:
    """Return the motion with the joints that no marker shows inferred from the rest of the take, and their uncertainty."""
    frames = np.flatnonzero(problem.is_unobserved.any(1))
    if not len(frames):
        return motion
    inferred, evidence = infer_unobserved_joints(problem, motion, evidence, conditioner)
    inferred = yield_to_markers(problem.subject, problem.pose_problem.marker_positions, motion, inferred, problem.rate)
    return update_motion_sd(problem, inferred, evidence, frames)


def solve_changed_frames(
    problem: MotionProblem, start: Motion, changes: FrameChanges, evidence: PoseEvidence | None = None
) -> tuple[Motion, PoseEvidence]:
    """Solve the frames that changes affect, from the poses in `start`; the others keep these.

    start     the solution before, except for the poses of restarted frames; its poses are overwritten with the new solution
    evidence  of the solution before; without it all frames are solved

    Unobserved joints follow interpolations, until `complete_motion` finds better poses for them.
    """
    frame_count, joint_count = start.local_rotations.shape[:2]
    marker_count = len(problem.subject.joints)
    root_position, local_rotations = start.root_position, start.local_rotations
    status, iterations = start.status.copy(), start.iterations.copy()
    if evidence is None:
        evidence = PoseEvidence(
            np.zeros((frame_count, marker_count)),
            np.zeros((frame_count, joint_count)),
            np.zeros((frame_count, joint_count)),
            np.zeros(frame_count),
        )
    else:
        evidence = evidence.copy(marker_count)
    windows = select_windows(changes.is_affected, problem.rate)
    if np.isnan(root_position).any():  # frames that start from the solution of the frame before
        windows = [FrameWindow(0, frame_count, 0, frame_count)]
    for window in windows:
        outer, inner, frames = window.outer_frames, window.inner_frames, window.frames
        pose = root_position[outer].copy(), local_rotations[outer].copy()
        solution = solve_window(problem.select_frames(outer), pose, changes.is_restarted[outer])
        root_position[frames], local_rotations[frames] = pose[0][inner], pose[1][inner]
        status[frames], iterations[frames] = solution.status[inner], solution.iterations[inner]
        for values, new_values in zip(vars(evidence).values(), vars(solution.evidence).values(), strict=True):
            values[frames] = new_values[inner]
    solved = list_window_frames(windows)
    motion = Motion(root_position, local_rotations, status, iterations, start.marker_sd, start.joint_sd)
    motion = update_motion_sd(problem, motion, evidence, solved)
    status[solved] = classify_frames(motion, problem.subject, problem.pose_problem.marker_positions)[solved]
    return motion, evidence


def classify_frames(motion: Motion, subject: Subject, markers: Float[np.ndarray, "T K 3"]) -> Int[np.ndarray, " T"]:
    """Return the FrameStatus of every frame: that of the solve, unless too few markers are visible or they lie off the body.

    markers  in metres in the subject's order, NaN if not visible or an outlier
    """
    distance = kinematics.compute_marker_distances(subject, (motion.root_position, motion.local_rotations), markers)
    visible_count = (~np.isnan(distance)).sum(1)
    mean_distance = np.nansum(distance, axis=1) / np.maximum(visible_count, 1)
    is_guessed: Bool[np.ndarray, " T"] = visible_count < MIN_FRAME_MARKERS
    is_poor = mean_distance > MAX_MEAN_MARKER_DISTANCE_M
    return np.where(is_guessed, int(FrameStatus.GUESSED), np.where(is_poor, int(FrameStatus.POOR_FIT), motion.status))


def solve_body(state: CleaningState, options: CleanOptions) -> CleaningState:
    """Solve the motion in the frames that changed, from the initial poses. Sets `body` of the state.

    Unobserved joints follow interpolations, until `complete_body` finds better poses for them.
    """
    assert state.subject is not None
    assert state.extended_subject is not None
    assert state.initial_motion is not None
    assert state.marker_columns is not None
    assert state.frame_changes is not None
    problem = _build_body_problem(state, options)
    evidence = state.body.evidence if state.body else None
    motion, evidence = solve_changed_frames(problem, state.initial_motion, state.frame_changes, evidence)
    joints, markers = kinematics.compute_joint_and_marker_positions(state.extended_subject, motion)
    body = BodyFit(
        state.subject, state.extended_subject, motion, state.marker_columns, joints, markers, state.detection, evidence
    )
    return replace(state, body=body, initial_motion=None, frame_changes=None)


def place_body(state: CleaningState) -> CleaningState:
    """Take the initial poses as the motion, without a solve. Sets `body` of the state, whose uncertainty is not computed."""
    assert state.subject is not None
    assert state.extended_subject is not None
    assert state.initial_motion is not None
    assert state.marker_columns is not None
    initial, subject = state.initial_motion, state.extended_subject
    is_seen = np.zeros(initial.local_rotations.shape[:2], bool)
    for marker, joint in enumerate(subject.joints):
        is_seen[:, joint] |= state.solver_take.visible[:, marker]
    joint_sd = np.where(is_seen, PLACED_JOINT_SD_M, UNSEEN_JOINT_SD_M)
    motion = replace(initial, marker_sd=np.ascontiguousarray(joint_sd[:, subject.joints]), joint_sd=joint_sd)
    motion = replace(motion, status=classify_frames(motion, subject, state.solver_take.markers))
    joints, markers = kinematics.compute_joint_and_marker_positions(subject, motion)
    note = (
        "Preview: the poses are first estimates of each frame, without iterations and without fault detection on the body. "
        f"Expect errors per axis of about {1e3 * PLACED_JOINT_SD_M:.0f} mm where markers are visible, and of about "
        f"{1e3 * UNSEEN_JOINT_SD_M:.0f} mm on segments without markers. For the final result, clean without --fast."
    )
    body = BodyFit(state.subject, subject, motion, state.marker_columns, joints, markers, state.detection)
    return replace(state, body=body, initial_motion=None, frame_changes=None, notes=(*state.notes, note))


def complete_body(state: CleaningState, options: CleanOptions) -> CleaningState:
    """Infer the joints that no marker shows from the rest of the solved motion. Advances `body` of the state."""
    body = state.body
    if body is None or body.evidence is None:
        return state
    problem = _build_body_problem(state, options)
    motion = complete_motion(problem, body.motion, body.evidence, state.prior_conditioner)
    body = replace(body, detection=None, evidence=None)  # which are needed for a further solve only
    if motion is body.motion:
        return replace(state, body=body)
    joints, markers = kinematics.compute_joint_and_marker_positions(body.extended_subject, motion)
    status = classify_frames(motion, body.extended_subject, problem.pose_problem.marker_positions)
    motion = replace(motion, status=status)
    return replace(state, body=replace(body, motion=motion, joint_positions=joints, marker_positions=markers))


def _build_body_problem(state: CleaningState, options: CleanOptions) -> MotionProblem:
    """Return the motion problem of the samples that the solver uses."""
    assert state.extended_subject is not None
    body = state.extended_subject.body_model
    prior = load_mean_pose_prior("mean-pose", body.skeleton)
    limits = load_joint_limits(body.skeleton)
    problem = build_motion_problem(state.solver_take, state.extended_subject, body, prior, limits, options.solve)
    is_in_every_frame = options.prior.prior_scope == PRIOR_EVERY_FRAME
    return replace(problem, conditioner=state.prior_conditioner if is_in_every_frame else None)
