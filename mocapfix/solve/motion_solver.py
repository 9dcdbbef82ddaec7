"""The motion solver: the pose of every frame that best agrees with markers, a prior on poses, and the frames around it.

`solve_body` solves a take in windows (`window_solver`), and again only where it changed. Limbs that no marker shows are
interpolated at first, which is all that detection needs. `complete_body` infers them, once, when the faults are known: as leaves
of the body they cost nothing that a marker shows, so the other joints keep their poses.

`compute_pose_sd` gives the standard deviations of joints and markers, from the posterior covariance of the poses. The solver
weights its terms for robustness; the error of its result is computed from the same curvature with the actual uncertainty of each
term, and that of the calibration and of joints that are not solved.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.kernels import lie
from mocapfix.model.body_fit import BodyFit, RememberedGap, SubjectInTake
from mocapfix.model.motion import FrameStatus, Motion, PoseEvidence
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.model.subject import Subject
from mocapfix.options import PRIOR_EVERY_FRAME, CleanOptions
from mocapfix.solve import kinematics, occluded_joints, smoothing
from mocapfix.solve.initial_motion import PoseStart
from mocapfix.solve.kinematics import Poses
from mocapfix.solve.mean_pose import MeanPosePrior, load_joint_limits, load_mean_pose_prior
from mocapfix.solve.measured_segments import yield_to_markers
from mocapfix.solve.motion_prior import combine_rotations
from mocapfix.solve.occluded_joints import KnownMotion
from mocapfix.solve.person_memory import PersonMemory
from mocapfix.solve.pose_problem import (
    POSE_RATE_HZ,
    FrameChanges,
    MotionProblem,
    PoseProblem,
    build_motion_problem,
    find_key_frames,
    list_posed_frames,
    list_window_frames,
    select_windows,
)
from mocapfix.solve.prior_conditioner import PriorConditioner, apply_pose_prior
from mocapfix.solve.terms import TrackingTerm, build_pose_prior_term
from mocapfix.solve.window_solver import solve_window
from mocapfix.stats.gaussian_process import CHI2_MEDIAN_3_DOF
from mocapfix.stats.sequences import group_gaps, interpolate_rows

MIN_ESTIMATED_MARKER_SD_M = 0.001  # smallest estimate of the marker error per axis
MAX_ABSORBED_SHARE = 0.9  # share of its squared error that the pose absorbs above which a marker does not enter the estimate
MIN_TRACKING_SD_RAD = 0.01  # smallest standard deviation of a joint's smooth trajectory in the uncertainty of the result
LOCKED_INFORMATION_RATIO = 4.0
"""Information about locked axes in the uncertainty of joints, over that in the solve, which yields to markers. With 1, hands of
CMU's training subjects, whose skeletons lock such axes, were predicted to vary twice as much as they do."""
GAP_VARIANCE_INFLATION = 3.0
"""Variance with which the solve tracks a joint's trajectory across a gap, over the mean squared error of the result, measured on
CMU's training subjects: the solve must not trust a trajectory too much."""


def update_motion_sd(problem: MotionProblem, motion: Motion, evidence: PoseEvidence, frames: Int[np.ndarray, " N"]) -> Motion:
    """Return the motion with the deviations of some frames computed; others are kept, unless markers were added."""
    if not len(frames):
        return motion
    gap_variance = np.where(problem.is_unobserved, evidence.rotation_variance, evidence.gap_variance)
    actual_variance = np.maximum(gap_variance / GAP_VARIANCE_INFLATION, MIN_TRACKING_SD_RAD**2)
    actual_marker_sd = estimate_actual_marker_sd(
        problem.pose_problem, (motion.root_position, motion.local_rotations), problem.subject, evidence.marker_sd
    )
    marker_sd, joint_sd = motion.marker_sd.copy(), motion.joint_sd.copy()
    if marker_sd.shape != evidence.marker_sd.shape:
        frames, marker_sd = np.arange(motion.frame_count), np.empty(evidence.marker_sd.shape)
    known = frames[find_key_frames(frames, problem.pose_problem.solver_mask[frames], problem.rate)]
    pose = motion.root_position[known], motion.local_rotations[known]
    tracking = TrackingTerm(pose[1], problem.is_uncertain[known] / actual_variance[known], pose[0], evidence.root_weight[known])
    part = problem.pose_problem.select_frames(known)
    of_body, scale_m = (problem.subject, problem.prior, actual_marker_sd), problem.options.robust_scales_m[-1]
    found = compute_pose_sd(part, pose, *of_body, tracking, scale_m)
    marker_sd[frames], joint_sd[frames] = (interpolate_rows(each, known, frames) for each in found)
    return replace(motion, marker_sd=marker_sd, joint_sd=joint_sd)


def compute_pose_sd(
    problem: PoseProblem,
    pose: Poses,
    subject: Subject,
    prior: MeanPosePrior,
    actual_marker_sd: float,
    tracking: TrackingTerm,
    robust_scale_m: float,
) -> tuple[Float[np.ndarray, "T K"], Float[np.ndarray, "T J"]]:
    """Return the standard deviations per axis, in metres, of the markers as the body places them, and of the joints.

    That of a joint that the subject's markers do not show is NaN.

    Args:
        actual_marker_sd: Standard deviation of a measured marker about its place, see `estimate_actual_marker_sd`, in metres.
        tracking: The trajectories of the root and of joints that lack a marker, weighted by their actual uncertainty.
        robust_scale_m: The last robust scale of the solve.
    """
    firm = replace(prior, information=prior.information + (LOCKED_INFORMATION_RATIO - 1) * prior.locked_information)
    of_markers, of_joints = (
        replace(problem, marker_sd=actual_marker_sd, pose_prior=build_pose_prior_term(each)).compute_uncertainty(
            pose, robust_scale_m, tracking
        )
        for each in (prior, firm)
    )
    constant_variance = subject.joint_sd**2 + compute_unsolved_joint_variance(subject, prior, load_cmu31_body().free_joints)
    joint_sd = np.where(subject.solved_joints, np.sqrt(of_joints.joint_sd**2 + constant_variance), np.nan)
    return np.hypot(of_markers.marker_sd, subject.marker_sd), joint_sd


def estimate_actual_marker_sd(
    problem: PoseProblem, pose: Poses, subject: Subject, nominal_marker_sd: Float[np.ndarray, "T K"]
) -> float:
    """Return the standard deviation per axis, in metres, of a measured marker about its place on the solved body.

    Args:
        nominal_marker_sd: Standard deviation of the markers predicted with the weights of the solve, in metres.
    """
    absorbed_share = (nominal_marker_sd / problem.marker_sd) ** 2
    distance = kinematics.compute_marker_distances(subject, pose, problem.marker_positions)
    is_usable = problem.solver_mask & (absorbed_share < MAX_ABSORBED_SHARE)
    return estimate_marker_sd(distance, absorbed_share, is_usable, problem.marker_sd)


def compute_unsolved_joint_variance(
    subject: Subject, prior: MeanPosePrior, free_joints: Bool[np.ndarray, " J"]
) -> Float[np.ndarray, " J"]:
    """Return the variance per axis, in square metres, of joints whose parent rotates in people but not in the solve.

    No marker shows the rotation of a finger's base, so that it varies as in the prior. Axes about which the skeleton does not
    rotate do not count.
    """
    variance = np.zeros(len(free_joints))
    for j, parent in enumerate(subject.skeleton.parents):
        if parent < 1 or free_joints[parent]:
            continue
        rotated = np.eye(3) - np.linalg.pinv(prior.locked_information[parent]) @ prior.locked_information[parent]
        covariance = rotated @ np.linalg.inv(prior.information[parent]) @ rotated
        x, y, z = subject.skeleton.offsets[j]
        lever = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        variance[j] = variance[parent] + np.trace(lever @ covariance @ lever.T) / 3
    return variance


def estimate_marker_sd(
    distance: Float[np.ndarray, "T K"],
    absorbed_share: Float[np.ndarray, "T K"],
    is_usable: Bool[np.ndarray, "T K"],
    default_sd: float,
) -> float:
    """Return the error of markers in metres per axis, from their distances to the body that was fitted to them.

    Args:
        absorbed_share: Part of a marker's squared error that the pose absorbed: 0 none, 1 all.
        is_usable: Samples that enter the estimate; without any, `default_sd` is returned.
    """
    if not is_usable.any():
        return default_sd
    corrected = distance[is_usable] ** 2 / (1 - absorbed_share[is_usable])
    return max(float(np.sqrt(np.median(corrected) / CHI2_MEDIAN_3_DOF)), MIN_ESTIMATED_MARKER_SD_M)


FIXED_JOINT_WEIGHT = 1e5  # in 1/rad^2 or 1/m^2, keeps solved joints and the root where they are against prior and limits


def _solve_inferred_joints(
    problem: MotionProblem, pose: Poses, variance: Float[np.ndarray, "T J"], frames: Int[np.ndarray, " N"]
) -> Float[np.ndarray, "N J 3 3"]:
    """Return local rotations in which unobserved joints track smooth paths through `pose`, whose `variance` is in rad^2."""
    root_position, start = pose[0][frames], pose[1][frames]
    weight = np.full(start.shape[:2], FIXED_JOINT_WEIGHT)
    for j in np.flatnonzero(problem.is_unobserved.any(0)).tolist():
        is_gap = problem.is_unobserved[:, j]
        trajectory = smoothing.smooth_joint_rotations(pose[1], j, variance[:, j], problem.is_uncertain[:, j], problem.rate)
        rotations = np.empty((int(is_gap.sum()), 1, 3, 3))
        lie.store_joint_quaternions(trajectory[is_gap], 0, rotations)
        start[is_gap[frames], j] = rotations[:, 0]
        weight[is_gap[frames], j] = smoothing.compute_tracking_weight(variance[is_gap, j])
    tracking = TrackingTerm(start, weight, root_position, np.full(len(frames), FIXED_JOINT_WEIGHT))
    part = problem.pose_problem.select_frames(frames)
    unmarked = replace(part, solver_mask=np.zeros_like(part.solver_mask))
    return unmarked.minimise((root_position, start), problem.options.robust_scales_m[-1:], tracking).local_rotations


MAX_MEAN_MARKER_DISTANCE_M = 0.03  # mean distance of a frame's markers from the body above which the frame's status is POOR_FIT
PLACED_JOINT_SD_M = 0.015  # per axis, of joints and markers of poses that were not solved: measured on composed takes
UNSEEN_JOINT_SD_M = 0.05  # the same on segments that no visible marker shows
MIN_FRAME_MARKERS = 3  # visible markers below which the status of a frame is GUESSED


def complete_motion(
    problem: MotionProblem,
    motion: Motion,
    evidence: PoseEvidence,
    conditioner: PriorConditioner | None,
    memory: PersonMemory | None = None,
) -> tuple[Motion, PoseEvidence, list[RememberedGap]]:
    """Return the motion with the unobserved joints inferred from the rest of the take and the memory of the person, the evidence
    with their variance, and the gaps that are inferred from the memory.
    """
    frames = np.flatnonzero(problem.is_unobserved.any(1))
    if not len(frames):
        return motion, evidence, []
    local_rotations, variance = motion.local_rotations.copy(), evidence.rotation_variance.copy()
    joints = np.flatnonzero(problem.pose_problem.tree.free)[1:]
    known = KnownMotion(motion.root_position, local_rotations, variance, problem.is_unobserved, joints, problem.rate, memory)
    remembered = occluded_joints.infer_occluded_joints(known, conditioner)
    solved = _solve_inferred_joints(problem, (motion.root_position, local_rotations), variance, frames)
    local_rotations[:] = motion.local_rotations
    rows, joints = np.nonzero(problem.is_unobserved[frames])
    local_rotations[frames[rows], joints] = solved[rows, joints]
    inferred, evidence = replace(motion, local_rotations=local_rotations), replace(evidence, rotation_variance=variance)
    inferred = yield_to_markers(problem.subject, problem.pose_problem.marker_positions, motion, inferred, problem.rate)
    return update_motion_sd(problem, inferred, evidence, frames), evidence, remembered


def solve_changed_frames(
    problem: MotionProblem, start: Motion, changes: FrameChanges, evidence: PoseEvidence | None = None
) -> tuple[Motion, PoseEvidence]:
    """Solve the frames that changes affect, from the poses in `start`; the others keep these.

    Unobserved joints follow interpolations, until `complete_motion` finds better poses for them.

    Args:
        start: The solution before, except for the poses of restarted frames; its poses are overwritten with the new solution.
        evidence: Of the solution before; without it all frames are solved.
    """
    frame_count, joint_count = start.local_rotations.shape[:2]
    marker_count = len(problem.subject.joints)
    root_position, local_rotations = start.root_position, start.local_rotations
    status, iterations = start.status.copy(), start.iterations.copy()
    if evidence is None:
        of_markers, of_joints = (frame_count, marker_count), (frame_count, joint_count)
        evidence = PoseEvidence(np.zeros(of_markers), np.zeros(of_joints), np.zeros(of_joints), np.zeros(frame_count))
    else:
        evidence = evidence.copy(marker_count)
    windows = select_windows(changes.is_affected, problem.rate)
    for window in windows:
        outer, inner, frames = window.outer_frames, window.inner_frames, window.frames
        pose = root_position[outer], local_rotations[outer]
        solution = solve_window(problem.select_frames(outer), pose, changes.is_restarted[outer])
        root_position[frames], local_rotations[frames] = solution.poses[0][inner], solution.poses[1][inner]
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

    Args:
        markers: In metres in the subject's order, NaN if not visible or an outlier.
    """
    distance = kinematics.compute_marker_distances(subject, (motion.root_position, motion.local_rotations), markers)
    visible_count = (~np.isnan(distance)).sum(1)
    mean_distance = np.nansum(distance, axis=1) / np.maximum(visible_count, 1)
    is_guessed, is_poor = visible_count < MIN_FRAME_MARKERS, mean_distance > MAX_MEAN_MARKER_DISTANCE_M
    return np.where(is_guessed, int(FrameStatus.GUESSED), np.where(is_poor, int(FrameStatus.POOR_FIT), motion.status))


PREVIEW_NOTE = (
    "Preview: first estimates of poses and gaps. On composed takes short gaps are 10 mm off (after a full clean 1.5 mm), joints "
    "14 mm (11 mm); faults that only the body shows are missed. For the final result, clean without --fast."
)


def solve_body(subject: SubjectInTake, start: PoseStart, solved: BodyFit | None, options: CleanOptions) -> BodyFit:
    """Solve the motion in the frames that changed, from the initial poses.

    Unobserved joints follow interpolations, until `complete_body` finds better poses for them.

    Args:
        subject: The subject and the samples that the solver uses.
        start: The initial poses.
        solved: The body as it was solved before, if it was.
        options: Those of the solve.
    """
    problem = _build_body_problem(subject, options)
    motion, evidence = solve_changed_frames(problem, start.motion, start.changes, solved.evidence if solved else None)
    return _build_body_fit(subject, motion, evidence)


def place_body(subject: SubjectInTake, initial: Motion) -> BodyFit:
    """Return the body with the initial poses as its motion, without a solve. Their uncertainty is a usual one."""
    extended, visible = subject.extended_subject, subject.take.visible
    joints = np.arange(len(extended.skeleton.names))
    shown = np.stack([visible[:, extended.joints == joint].sum(1) for joint in joints], axis=1)
    of_parent = shown[:, np.maximum(extended.skeleton.parents, 0)]  # two markers on a foot show its toes, which need none
    is_seen = np.where(np.isin(joints, extended.joints), shown > 0, of_parent > 1)
    joint_sd = np.where(is_seen, PLACED_JOINT_SD_M, UNSEEN_JOINT_SD_M)
    motion = replace(initial, marker_sd=np.ascontiguousarray(joint_sd[:, extended.joints]), joint_sd=joint_sd)
    motion = replace(motion, status=classify_frames(motion, extended, subject.take.markers))
    return _build_body_fit(subject, motion, None)


def complete_body(
    body: BodyFit, conditioner: PriorConditioner | None, options: CleanOptions, memory: PersonMemory | None = None
) -> BodyFit:
    """Infer the joints that no marker shows: from the solved motion, the memory of the person, and the motion prior."""
    if body.evidence is None:
        return body
    problem = _build_body_problem(body, options)
    motion, evidence, remembered = complete_motion(problem, body.motion, body.evidence, conditioner, memory)
    if motion is body.motion:
        return body
    if conditioner:
        motion = add_motion_prior(problem, motion, evidence)
    status = classify_frames(motion, body.extended_subject, problem.pose_problem.marker_positions)
    completed = _build_body_fit(body, replace(motion, status=status), evidence)
    return replace(completed, remembered=tuple(remembered), has_motion_prior=conditioner is not None)


def add_motion_prior(problem: MotionProblem, motion: Motion, evidence: PoseEvidence) -> Motion:
    """Return the motion with the lost limbs, whose variances are in the evidence, combined with the motion prior's predictions.

    It yields to visible markers. The standard deviations are those without it.
    """
    parts, rate, size_ratio = (motion.root_position, motion.local_rotations), problem.rate, problem.subject.skeleton.size_ratio
    joints = np.flatnonzero(problem.pose_problem.tree.free)[1:]
    known = KnownMotion(*parts, evidence.rotation_variance, problem.is_unobserved, joints, rate)
    local_rotations = motion.local_rotations.copy()
    for (first, last), lost in group_gaps(problem.is_unobserved & known.has_body[:, None]).items():
        frames = np.arange(first, last + 1)
        if prediction := occluded_joints.predict_hidden_joints(known, frames, lost, size_ratio):
            samples = np.ix_(frames, lost)
            estimate = motion.local_rotations[samples], evidence.rotation_variance[samples]
            local_rotations[samples] = combine_rotations(*estimate, prediction)[0]
    if (local_rotations == motion.local_rotations).all():
        return motion
    inferred = replace(motion, local_rotations=local_rotations)
    return yield_to_markers(problem.subject, problem.pose_problem.marker_positions, motion, inferred, rate)


def apply_prior(body: BodyFit, held_joints: Sequence[str], conditioner: PriorConditioner, options: CleanOptions) -> BodyFit:
    """Return the body under the pose prior in every frame, which yields to visible markers. Standard deviations are those before.

    What it changes is computed at POSE_RATE_HZ, and interpolated in between. It is weighed against the actual errors of markers:
    the solve assumes larger ones, to be robust.

    Args:
        body: The solved body; without evidence it is returned as it is, and so it is without this prior in its options.
        held_joints: Names of joints that keep their positions, if markers show them.
    """
    if body.evidence is None or options.prior.prior_scope != PRIOR_EVERY_FRAME:
        return body
    problem, held = _build_body_problem(body, options), [body.subject.skeleton.find_joint(name) for name in held_joints]
    subject, motion, poses = problem.subject, body.motion, (body.motion.root_position, body.motion.local_rotations)
    frames, rate = list_posed_frames(motion.frame_count, problem.rate), min(problem.rate, POSE_RATE_HZ)
    marker_sd = estimate_actual_marker_sd(problem.pose_problem, poses, subject, body.evidence.marker_sd)
    pose_problem = replace(problem.pose_problem, marker_sd=marker_sd)
    known = motion.select_frames(frames)
    before, held = (known.root_position, known.local_rotations), np.array([j for j in held if body.subject.solved_joints[j]], int)
    found = apply_pose_prior(pose_problem, problem.prior, conditioner, before, held, rate)
    inferred = replace(known, root_position=found[0], local_rotations=found[1])
    inferred = yield_to_markers(subject, pose_problem.marker_positions[frames], known, inferred, rate)
    changes = inferred.root_position - before[0], before[1].swapaxes(-1, -2) @ inferred.local_rotations
    step, turn = kinematics.interpolate_poses(changes, frames, motion.frame_count)
    motion = replace(motion, root_position=poses[0] + step, local_rotations=poses[1] @ turn)
    result = _build_body_fit(body, motion, body.evidence)
    return replace(result, remembered=body.remembered, has_motion_prior=body.has_motion_prior)


def _build_body_fit(subject: SubjectInTake, motion: Motion, evidence: PoseEvidence | None) -> BodyFit:
    joints, markers = kinematics.compute_joint_and_marker_positions(subject.extended_subject, motion)
    in_take = subject.subject, subject.extended_subject, subject.marker_columns, subject.take
    return BodyFit(*in_take, motion, joints, markers, evidence)


def _build_body_problem(subject: SubjectInTake, options: CleanOptions) -> MotionProblem:
    """Return the motion problem of the samples that the solver uses."""
    body = subject.extended_subject.body_model
    prior, limits = load_mean_pose_prior("mean-pose", body.skeleton), load_joint_limits(body.skeleton)
    return build_motion_problem(subject.take, subject.extended_subject, body, prior, limits, options.solve)
