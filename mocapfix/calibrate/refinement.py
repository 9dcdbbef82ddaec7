"""Bones, marker places and the poses of many frames fitted together.

Levenberg-Marquardt over the unknowns that the frames share (size, bones, marker places); at each step the
frames' poses are solved anew and eliminated exactly (variable projection; Golub & Pereyra 1973), so that the step sees
how the poses give way. The nominal places and lengths are the prior that settles what the take leaves open.
"""

from dataclasses import dataclass, replace

import numpy as np

from mocapfix.calibrate import parameters as freedom
from mocapfix.calibrate.parameters import CalibrationParameters
from mocapfix.calibrate.shape_responses import SharedResponses, compute_shared_responses, reduce_shared_equations
from mocapfix.initialise.segment_registration import register_poses
from mocapfix.kernels.forward_kinematics import KinematicTree
from mocapfix.motion import Motion
from mocapfix.pose_prior.mean_pose import MeanPosePrior
from mocapfix.skeleton import BodyModel
from mocapfix.solve import kinematics
from mocapfix.solve.pose_problem import (
    MarkerAttachment,
    PoseProblem,
    build_no_joint_limits,
    build_no_tracking,
    build_pose_prior_term,
)
from mocapfix.subject import Subject

CALIBRATION_MARKER_SD_M = 0.010  # metres: skin slides less, but neighbouring frames tell the same of it
CALIBRATION_ROBUST_SCALE_M = 0.050  # metres: Geman-McClure scale
POSE_PRIOR_WEIGHT = (
    0.02  # of how poses stray from their take's mean: with more, longer bones win, for on them all turns are smaller
)
MAX_REFINEMENT_ROUNDS = 25
MIN_RELATIVE_DECREASE = 1e-3  # relative fall of the cost under which calibration ends


@dataclass(frozen=True)
class RefinementState:
    """A body, the poses of N frames on it, and what they say of the shared unknowns (Q,) there.

    cost       half a sum of squares in standard deviations, priors included
    curvature  (Q, Q) its second derivative and (Q,) its slope, the poses giving way
    """

    unknowns: np.ndarray
    problem: PoseProblem
    root_position: np.ndarray
    local_rotations: np.ndarray
    responses: SharedResponses
    cost: float
    curvature: np.ndarray
    gradient: np.ndarray


def build_calibration_problem(
    start: Subject, body: BodyModel, prior: MeanPosePrior, markers: np.ndarray, offsets, marker_offsets, mean_pose_vectors
) -> PoseProblem:
    """-> the pose problem of frames (N, K, 3) on a body with these offsets (J, 3) and marker places (K, 3), their mean pose
    turned from people's by (J, 3) radians."""
    tree, pull = (
        KinematicTree(start.skeleton.parents, offsets, body.free_joints),
        build_pose_prior_term(prior.build_within_take_prior().scale_information(POSE_PRIOR_WEIGHT)),
    )
    listened, limits = ~np.isnan(markers[..., 0]), build_no_joint_limits(len(offsets))
    return PoseProblem(
        tree,
        MarkerAttachment(start.joints, marker_offsets),
        markers,
        listened,
        CALIBRATION_MARKER_SD_M,
        pull._replace(vectors=mean_pose_vectors),
        limits,
    )


def pose_frames(start: Subject, body: BodyModel, prior: MeanPosePrior, markers: np.ndarray) -> Motion:
    """-> poses of frames (N, K, 3) on a body not yet calibrated, robustly, so that spikes do not pass for variety."""
    motion = register_poses(start, body.free_joints, prior, markers)
    problem = build_calibration_problem(
        start, body, prior, markers, start.skeleton.offsets, start.marker_offsets, np.zeros((len(body.free_joints), 3))
    )
    problem.solve(motion.root_position, motion.local_rotations, build_no_tracking(len(body.free_joints)), (0.4, 0.2, 0.1), 8)
    return motion


def refine_subject(start: Subject, body: BodyModel, prior: MeanPosePrior, markers: np.ndarray, motion: Motion) -> Subject:
    """-> `start` with the bones and places that fit the frames `markers` (N, K, 3), posed by `motion`, best."""
    free = freedom.build_calibration_parameters(start, body, prior)

    def fit(unknowns: np.ndarray, root: np.ndarray, local: np.ndarray) -> RefinementState:
        return solve_and_linearise(
            free,
            build_calibration_problem(start, body, prior, markers, *free.compute_body(unknowns)),
            unknowns,
            root.copy(),
            local.copy(),
        )

    best, damping = fit(np.zeros(len(free.information)), motion.root_position, motion.local_rotations), 1e-3
    for _ in range(MAX_REFINEMENT_ROUNDS):
        trial = fit(
            best.unknowns + compute_damped_step(best.curvature, best.gradient, damping), best.root_position, best.local_rotations
        )
        if trial.cost < best.cost:
            enough = best.cost - trial.cost < MIN_RELATIVE_DECREASE * trial.cost
            best, damping = trial, max(damping / 5, 1e-6)
            if enough:
                break
        else:
            damping *= 10
            if damping > 1e3:
                break
    return build_refined_subject(start, best)


def solve_and_linearise(
    parameters: CalibrationParameters,
    problem: PoseProblem,
    unknowns: np.ndarray,
    root_position: np.ndarray,
    local_rotations: np.ndarray,
) -> RefinementState:
    """-> the frames solved anew from the poses given, which are spoilt, and what they and the priors say together."""
    problem.solve(root_position, local_rotations, build_no_tracking(local_rotations.shape[1]), (CALIBRATION_ROBUST_SCALE_M,), 6)
    return linearise_frames(parameters, problem, unknowns, root_position, local_rotations)


def linearise_frames(
    parameters: CalibrationParameters,
    problem: PoseProblem,
    unknowns: np.ndarray,
    root_position: np.ndarray,
    local_rotations: np.ndarray,
) -> RefinementState:
    """-> what frames and priors say together at these poses, as they are."""
    still = build_no_tracking(local_rotations.shape[1])
    found = compute_shared_responses(
        problem, parameters.deformations, still, CALIBRATION_ROBUST_SCALE_M, root_position, local_rotations
    )
    curvature, gradient = reduce_shared_equations(found)
    habit = parameters.information @ unknowns
    cost = float(found.cost.sum() + 0.5 * unknowns @ habit)
    return RefinementState(
        unknowns, problem, root_position, local_rotations, found, cost, curvature + parameters.information, gradient + habit
    )


def compute_damped_step(curvature: np.ndarray, gradient: np.ndarray, damping: float) -> np.ndarray:
    """-> (Q,) the damped Gauss-Newton step (Marquardt 1963)."""
    return np.linalg.solve(curvature + damping * np.diag(np.diag(curvature)), -gradient)


def compute_calibration_sd(responses: SharedResponses, curvature: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """-> standard deviations per axis, metres, by which what is left open of the shared unknowns displaces the joints (J,)
    and the markers (K,), each frame's pose giving way; root mean squares over the frames.

    curvature  (Q, Q) of the shared unknowns, priors included: their inverse covariance
    """
    half = np.linalg.inv(np.linalg.cholesky(curvature))  # half' half is the covariance
    displaced = (
        half @ moved.reshape(*moved.shape[:2], -1) for moved in (responses.joint_response, responses.marker_response[:, :-1])
    )
    joints, markers = (np.sqrt((d**2).sum(1).mean(0).reshape(-1, 3).mean(1)) for d in displaced)
    return joints, markers


def build_refined_subject(start: Subject, state: RefinementState) -> Subject:
    """-> the subject of a fit; a marker's spread is the median of its distances, per axis."""
    tree, places = state.problem.tree, state.problem.attachment.offsets
    size = np.linalg.norm(tree.offsets) / np.linalg.norm(start.skeleton.offsets)
    skeleton = replace(start.skeleton, offsets=tree.offsets, ends=start.skeleton.ends * size)
    joint_sd, marker_sd = compute_calibration_sd(state.responses, state.curvature)
    subject = replace(
        start,
        skeleton=skeleton,
        marker_offsets=places,
        frame_count=len(state.root_position),
        joint_sd=joint_sd,
        marker_sd=marker_sd,
    )
    nothing = np.zeros(len(state.root_position), int)
    motion = Motion(state.root_position, state.local_rotations, nothing, nothing, np.zeros(0), np.zeros(0))
    _, placed = kinematics.compute_joint_and_marker_positions(subject, motion)
    distance = np.linalg.norm(state.problem.marker_positions - placed, axis=-1)
    seen = (~np.isnan(distance)).any(0)
    spread = start.marker_spread.copy()
    spread[seen] = np.sqrt(np.nanmedian(distance[:, seen] ** 2, axis=0) / 3)
    return replace(subject, marker_spread=spread)
