"""The solve: the pose of every frame that agrees best with markers, prior and time; and single poses, of whatever is known."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from mocapfix.kernels.forward_kinematics import KinematicTree
from mocapfix.motion import Motion
from mocapfix.options import SolveOptions
from mocapfix.pose_prior.joint_limits import JointLimits
from mocapfix.pose_prior.mean_pose import MeanPosePrior
from mocapfix.pose_prior.model import PoseModel
from mocapfix.skeleton import BodyModel
from mocapfix.solve import kinematics, observability, occluded_joints, smoothing
from mocapfix.solve.pose_problem import (
    MarkerAttachment,
    PoseProblem,
    PoseUncertainty,
    build_joint_limit_term,
    build_no_tracking,
    build_pose_prior_term,
)
from mocapfix.solve.pose_uncertainty import compute_pose_sd
from mocapfix.solve.prior_conditioner import PriorConditioner
from mocapfix.subject import Subject
from mocapfix.take import Take

FAR_OFF_STATUS, GUESSED_STATUS = 2, 3  # indices into motion.STATUS
MAX_MEAN_MARKER_DISTANCE_M = 0.03  # metres: a frame whose markers lie farther from the body on average is a poor one
MIN_TRACKING_SD_RAD = 0.01  # radians: no course is surer


def solve_motion(
    take: Take,
    subject: Subject,
    body: BodyModel,
    prior: MeanPosePrior,
    limits: JointLimits,
    initial_motion: Motion,
    options: SolveOptions,
    load_pose_model: Callable[[], PoseModel] | None = None,
) -> Motion:
    """-> poses, and the standard deviations of every joint and of every marker the body places.

    Each frame is solved alone first; the joints' smooth courses through what that says, and how surely, then pull the
    frames to each other in a second solve.

    worn   the take's markers in the subject's order, NaN where not seen or not believed
    prior  the independent joints' mean pose, which breaks ties in every frame
    start  where each frame is first solved from; NaN where it goes on from the one before it
    model  gives a trained model of poses, and is called where a limb is lost for so long that the take and time cannot tell;
           None asks them alone
    """
    rate, narrow = take.rate, options.robust_scales_m[-1]
    problem = build_pose_problem(take, subject, body, prior, limits, options)
    gone = observability.find_unobserved_joints(problem.solver_mask, subject, body.free_joints)
    unsure = (observability.find_partly_observed_joints(problem.solver_mask, subject) | gone) & body.free_joints

    root, local = initial_motion.root_position.copy(), initial_motion.local_rotations.copy()
    alone, known, left_open = solve_frames_independently(problem, root, local, unsure, gone, rate, options)
    people = PriorConditioner(load_pose_model, options.prior_scale) if load_pose_model else None
    occluded_joints.infer_occluded_joints(root, local, known.rotation_variance, gone, body.free_joints, rate, people)
    course = smoothing.smooth_poses(root, local, known, body.free_joints, rate, options)
    root, local = course.root.copy(), course.rotations.copy()
    status, together = problem.solve(root, local, course, (narrow,))
    certain = unsure / np.maximum(np.where(gone, known.rotation_variance, left_open), MIN_TRACKING_SD_RAD**2)
    course = course._replace(weight=certain)
    root = smoothing.remove_pose_jitter(root, local, body.free_joints, rate, options)
    solved = Motion(root, local, status, alone + together, known.marker_sd, known.joint_sd)
    markers, joints = compute_pose_sd(problem, solved, subject, prior, known.marker_sd, course, narrow)
    solved = replace(solved, marker_sd=markers, joint_sd=joints)
    return replace(solved, status=classify_frames(solved, subject, take.markers))


def build_pose_problem(
    take: Take, subject: Subject, body: BodyModel, prior: MeanPosePrior, limits: JointLimits, options: SolveOptions
) -> PoseProblem:
    """-> the pose problem of the take, as `motion` is given it: markers, people's habits and how far joints turn."""
    gone = observability.find_unobserved_joints(take.visible, subject, body.free_joints)
    listened = take.visible & ~observability.find_gap_borders(
        take.visible, gone[:, subject.joints], take.rate, options.gap_border_s
    )
    said_once = build_pose_prior_term(prior.scale_information(1 / (options.pose_persistence_s * take.rate)))
    walls = build_joint_limit_term(limits, options.limit_sd_rad * np.sqrt(options.pose_persistence_s * take.rate))
    tree = KinematicTree(subject.skeleton.parents, subject.skeleton.offsets, body.free_joints)
    return PoseProblem(
        tree,
        MarkerAttachment(subject.joints, subject.marker_offsets),
        take.markers,
        listened,
        options.marker_sd_m,
        said_once,
        walls,
    )


def solve_frames_independently(
    problem: PoseProblem,
    root: np.ndarray,
    local_rotations: np.ndarray,
    is_uncertain: np.ndarray,
    is_unobserved: np.ndarray,
    rate: float,
    options: SolveOptions,
) -> tuple[np.ndarray, PoseUncertainty, np.ndarray]:
    """Solve each frame alone, or as its start says, then those with joints that are unsure or gone (T, J) from their neighbours
    and as far as the course through the others says; root (T, 3) and local (T, J, 3, 3) in place. -> (T,) iterations, how far
    poses are known, and the variance (T, J) of the courses of unsure joints, rad^2
    """
    none, narrow = build_no_tracking(local_rotations.shape[1]), options.robust_scales_m[-1]
    _, iterations = problem.solve(root, local_rotations, none, options.robust_scales_m)
    variance = problem.compute_uncertainty(root, local_rotations, none, narrow).rotation_variance
    bridges, left_open = smoothing.track_across_gaps(local_rotations, variance, is_uncertain, rate, options)
    problem.solve_from_neighbours(root, local_rotations, bridges, is_uncertain, narrow)
    known = problem.compute_uncertainty(root, local_rotations, none, narrow)
    told = np.where(
        is_unobserved,
        np.minimum(known.rotation_variance, left_open + options.rotation_tracking_sd_rad**2),
        known.rotation_variance,
    )
    return iterations, known._replace(rotation_variance=told), left_open


def classify_frames(motion: Motion, subject: Subject, markers: np.ndarray) -> np.ndarray:
    """-> (T,) the status of every frame, as motion.STATUS words it.

    markers  (T, K, 3) metres, the subject's markers, NaN where not believed
    """
    _, placed = kinematics.compute_joint_and_marker_positions(subject, motion)
    distance = np.linalg.norm(markers - placed, axis=-1)
    seen = (~np.isnan(distance)).sum(1)
    mean = np.nansum(distance, axis=1) / np.maximum(seen, 1)
    return np.where(seen < 3, GUESSED_STATUS, np.where(mean > MAX_MEAN_MARKER_DISTANCE_M, FAR_OFF_STATUS, motion.status))
