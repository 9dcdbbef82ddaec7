"""Refinement: bones, marker offsets and the poses of many frames, fitted together, and how uncertain the result is.

Levenberg-Marquardt over the unknowns that the frames share (see `parameters`), with the poses of the frames eliminated (see
`solve.minimise`). The nominal marker offsets and bone lengths are the prior, which determines what the take leaves undetermined.

Calibration uncertainty: how far bones and markers of a calibrated subject may lie from the true ones. A calibration error is the
same in every frame, so that no residual shows it. It is predicted from the normal equations of the calibration, with the actual
variation of markers about their places instead of the weights of the fit.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from mocapfix.model.skeleton import BodyModel
from mocapfix.model.subject import Subject
from mocapfix.solve import kinematics
from mocapfix.solve.kinematics import Poses
from mocapfix.solve.mean_pose import MeanPosePrior
from mocapfix.solve.minimise import SharedResponses, compute_shared_responses, minimise_shared
from mocapfix.solve.parallel import map_in_threads
from mocapfix.solve.pose_problem import PoseProblem, build_marker_problem
from mocapfix.solve.segment_registration import register_poses
from mocapfix.solve.terms import build_no_joint_limits, build_pose_prior_term
from mocapfix.stats.gaussian_process import CHI2_MEDIAN_3_DOF, evaluate_matern
from mocapfix.stats.sequences import sample_evenly
from mocapfix.subject.parameters import CalibratedBody, CalibrationParameters, add_hip_regression, build_calibration_parameters

SKIN_CORRELATION_S = 0.3  # time after which the correlation of a marker's motion with the skin has fallen to 1/e
MIN_SKIN_SD_M = 0.001  # smallest estimate of the residual's standard deviation
MAX_POSE_ABSORBED_SHARE = 0.8  # largest share of the markers' error that the poses are assumed to absorb


def estimate_residual_sd(distance: Float[np.ndarray, "N K"], pose_freedom: int) -> float:
    """Return the standard deviation per axis, in metres, of a marker about its place on the calibrated body.

    Each frame's pose has absorbed a part of the markers' motion. The estimate is larger than the residuals accordingly.

    Args:
        distance: Of each marker to the body, in metres, NaN if not visible.
        pose_freedom: Number of coordinates of a pose that the markers determine.
    """
    measured = 3 * np.isfinite(distance).sum(1).mean()
    share = min(pose_freedom / max(measured, 1.0), MAX_POSE_ABSORBED_SHARE)
    return max(float(np.sqrt(np.nanmedian(distance**2) / CHI2_MEDIAN_3_DOF / (1 - share))), MIN_SKIN_SD_M)


def compute_shared_covariance(
    marker_response: Float[np.ndarray, "n K 3 U"],
    marker_weight: Float[np.ndarray, "n K"],
    basis: Float[np.ndarray, "U Q"],
    curvature: Float[np.ndarray, "Q Q"],
    prior_gradient_covariance: Float[np.ndarray, "Q Q"],
    times_s: Float[np.ndarray, " N"],
    residual_sd_m: float,
) -> Float[np.ndarray, "Q Q"]:
    """Return the covariance of the errors of the shared unknowns.

    The curvature weights every frame as if it were measured independently, with the marker error of the fit. Actually markers
    slide with the skin, by less, but for a part of a second, so that neighbouring frames have nearly the same error. The
    covariance of an estimate with these weights is H^-1 G H^-1, H the curvature and G the actual covariance of the gradient
    (Huber 1967, "The behavior of maximum likelihood estimates under nonstandard conditions").

    Args:
        marker_response, marker_weight: Of n of the N frames, each of which stands for an equal part of them (see
            `SharedResponses`).
        basis: Change of the U unknowns of the responses with each of the Q shared unknowns.
        prior_gradient_covariance: Of the gradient of the prior's cost: the prior's part of the curvature, larger for unknowns
            that vary more than the fit assumes.
        times_s: Of all frames, in rising order.
        residual_sd_m: Of a marker about its place on the body, per axis.
    """
    correlation = evaluate_matern(np.abs(times_s[:, None] - times_s) / SKIN_CORRELATION_S, 1)
    parts = np.linspace(0, len(times_s), len(marker_weight) + 1).astype(int)[:-1]
    summed = np.add.reduceat(np.add.reduceat(correlation, parts, axis=0), parts, axis=1)
    weighted = (marker_response * marker_weight[..., None, None]).reshape(len(marker_response), -1).astype(np.float32)
    smoothed = (summed.astype(np.float32) @ weighted).reshape(-1, len(basis))
    marker_gradient_covariance = residual_sd_m**2 * basis.T @ (smoothed.T @ weighted.reshape(smoothed.shape)) @ basis
    gradient_covariance = marker_gradient_covariance + prior_gradient_covariance
    covariance = np.linalg.solve(curvature, np.linalg.solve(curvature, gradient_covariance).T)
    return (covariance + covariance.T) / 2


def compute_response_sd(
    response: Float[np.ndarray, "n P 3 U"], half_covariance: Float[np.ndarray, "U Q"]
) -> Float[np.ndarray, " P"]:
    """Return the root mean square per axis, in metres, of the motion of points with uncertain unknowns.

    Args:
        half_covariance: Its product with its own transpose is the covariance of the unknowns.
    """
    half = half_covariance.astype(np.float32)
    squares = [np.square(each.astype(np.float32).reshape(-1, len(half)) @ half).sum(1) for each in response]
    return np.sqrt(np.mean(squares, axis=0, dtype=float).reshape(-1, 3).mean(1))


CALIBRATION_MARKER_SD_M = 0.010  # per axis about its offset; skin moves less, but neighbouring frames are correlated
CALIBRATION_ROBUST_SCALE_M = 0.050  # Geman-McClure scale of the marker residuals
SELECTION_ROBUST_SCALES_M = (0.4, 0.2, 0.1)  # the same scales, one after the other, for a body that is not yet calibrated
POSE_PRIOR_WEIGHT = 0.02  # of poses about the take's mean; more would favour longer bones, which need smaller rotations
MAX_SELECTION_ITERATIONS = 8  # iterations of a frame when an uncalibrated body is posed
MAX_CALIBRATION_POSE_ITERATIONS = 6  # iterations of a frame between two steps of the shared unknowns
CALIBRATION_DAMPING_RATIO = 1e-5  # of poses on a body that is not calibrated, as in `SolverSettings`
MAX_REFINEMENT_ROUNDS = 25  # steps of the shared unknowns
FRAMES_PER_BLOCK = 25  # frames summed in a thread, so that the sum does not depend on the number of threads
MAX_UNCERTAINTY_FRAMES = 30  # frames from which the standard deviations are computed


@dataclass(frozen=True)
class RefinementState:
    """A body with the poses of N frames, and the cost and its gradient in the shared unknowns there."""

    parameters: CalibrationParameters  # the definition of the unknowns
    unknowns: Float[np.ndarray, " Q"]
    problem: PoseProblem
    poses: Poses
    cost: float  # half the sum of squares in standard deviations, priors included
    gradient: Float[np.ndarray, " Q"]  # of the cost with the poses eliminated


def build_calibration_problem(
    start: Subject, body: BodyModel, prior: MeanPosePrior, markers: np.ndarray, calibrated: CalibratedBody
) -> PoseProblem:
    """Return the pose problem of frames (N, K, 3) on a body with calibrated offsets and mean pose."""
    skeleton = replace(start.skeleton, offsets=calibrated.offsets)
    subject = replace(start, skeleton=skeleton, marker_offsets=calibrated.marker_offsets)
    prior_term = build_pose_prior_term(prior.build_within_take_prior().scale_information(POSE_PRIOR_WEIGHT))
    prior_term = prior_term._replace(mean_vectors=calibrated.mean_pose_vectors)
    limits = build_no_joint_limits(len(calibrated.offsets))
    return build_marker_problem(subject, body.free_joints, markers, CALIBRATION_MARKER_SD_M, prior_term, limits)


def pose_frames(start: Subject, body: BodyModel, prior: MeanPosePrior, markers: Float[np.ndarray, "N K 3"]) -> Poses:
    """Return robust poses of some frames on a body that is not yet calibrated, so that spikes do not look like varied poses."""
    motion = register_poses(start, body.free_joints, prior, markers)
    uncalibrated = CalibratedBody(start.skeleton.offsets, start.marker_offsets, np.zeros((len(body.free_joints), 3)))
    problem = build_calibration_problem(start, body, prior, markers, uncalibrated)
    poses = motion.root_position, motion.local_rotations
    scales_m, count = SELECTION_ROBUST_SCALES_M, MAX_SELECTION_ITERATIONS
    return problem.minimise(poses, scales_m, max_iterations=count, damping_ratio=CALIBRATION_DAMPING_RATIO).poses


class Refinement(NamedTuple):
    """Bones, marker offsets and poses that fit some frames best."""

    state: RefinementState
    curvature: Float[np.ndarray, "Q Q"]  # of the cost there, or near it
    improvement: float  # by how much the refinement decreased its cost, relative to the result


def refine_body(
    start: Subject,
    body: BodyModel,
    prior: MeanPosePrior,
    markers: Float[np.ndarray, "N K 3"],
    poses: Poses,
    unknowns: Float[np.ndarray, " Q"] | None = None,
) -> Refinement:
    """Return the bones and marker offsets, beginning with those of `start`, that fit the frames best.

    Args:
        poses: The first ones.
        unknowns: The first values of the calibration parameters, by default 0.
    """

    def fit(unknowns: np.ndarray, poses: Poses) -> RefinementState:
        problem = build_calibration_problem(start, body, prior, markers, parameters.compute_body(unknowns))
        return solve_and_linearise(parameters, problem, unknowns, poses)

    parameters = add_hip_regression(build_calibration_parameters(start, body, prior), start)
    first = fit(np.zeros(len(parameters.information)) if unknowns is None else unknowns, poses)
    state, curvature = minimise_shared(lambda new, old: fit(new, old.poses), first, compute_curvature, MAX_REFINEMENT_ROUNDS)
    return Refinement(state, curvature, (first.cost - state.cost) / state.cost)


def solve_and_linearise(
    parameters: CalibrationParameters, problem: PoseProblem, unknowns: np.ndarray, start: Poses
) -> RefinementState:
    """Solve the poses from those given, and return the state there."""
    return linearise_frames(parameters, problem, unknowns, pose_calibrated_frames(problem, start))


def pose_calibrated_frames(problem: PoseProblem, start: Poses) -> Poses:
    """Return the poses of frames on a body that is nearly calibrated."""
    scales_m, count = (CALIBRATION_ROBUST_SCALE_M,), MAX_CALIBRATION_POSE_ITERATIONS
    return problem.minimise(start, scales_m, max_iterations=count, damping_ratio=CALIBRATION_DAMPING_RATIO).poses


def linearise_frames(
    parameters: CalibrationParameters, problem: PoseProblem, unknowns: np.ndarray, poses: Poses
) -> RefinementState:
    """Return the state at given poses, without solving them."""
    deviation = unknowns - parameters.expected
    prior_gradient = parameters.information @ deviation
    responses = respond_in_frames(problem, poses, np.arange(len(poses[0])), only_errors=True)
    cost = float(responses.cost.sum() + 0.5 * deviation @ prior_gradient)
    gradient = parameters.shape_basis.T @ responses.gradient + prior_gradient
    return RefinementState(parameters, unknowns, problem, poses, cost, gradient)


def compute_curvature(state: RefinementState) -> Float[np.ndarray, "Q Q"]:
    """Return the curvature of the cost in the shared unknowns, with the poses eliminated."""
    frame_count = len(state.poses[0])

    def reduce_block(first: int) -> Float[np.ndarray, "U U"]:
        frames = np.arange(first, min(first + FRAMES_PER_BLOCK, frame_count))
        return respond_in_frames(state.problem, state.poses, frames).curvature

    basis = state.parameters.shape_basis
    curvature = sum(map_in_threads(reduce_block, range(0, frame_count, FRAMES_PER_BLOCK)))
    return basis.T @ curvature @ basis + state.parameters.information


def respond_in_frames(
    problem: PoseProblem, poses: Poses, frames: Int[np.ndarray, " N"], *, only_errors: bool = False, has_responses: bool = False
) -> SharedResponses:
    """Return the responses of some of the frames to the unknowns of the body (see `compute_shared_responses`)."""
    part = replace(problem, marker_positions=problem.marker_positions[frames], solver_mask=problem.solver_mask[frames])
    scale, poses = part.normalise_robust_scales((CALIBRATION_ROBUST_SCALE_M,))[0], (poses[0][frames], poses[1][frames])
    arguments = part.tree, part.build_terms(), scale, poses
    return compute_shared_responses(*arguments, only_errors=only_errors, has_responses=has_responses)


def build_refined_subject(
    start: Subject, state: RefinementState, curvature: np.ndarray, times_s: Float[np.ndarray, " N"]
) -> Subject:
    """Return the subject of a refined state; the spread of a marker is its median distance per axis from the body."""
    tree = state.problem.tree
    size = np.linalg.norm(tree.offsets) / np.linalg.norm(start.skeleton.offsets)
    skeleton = replace(start.skeleton, offsets=tree.offsets, ends=start.skeleton.ends * size)
    offsets = state.problem.attachment.offsets
    subject = replace(start, skeleton=skeleton, marker_offsets=offsets, frame_count=len(state.poses[0]))
    distance = np.linalg.norm(state.problem.marker_positions - kinematics.predict_markers(subject, state.poses), axis=-1)
    visible = (~np.isnan(distance)).any(0)
    spread = start.marker_spread.copy()
    spread[visible] = np.sqrt(np.nanmedian(distance[:, visible] ** 2, axis=0) / 3)
    pose_freedom = 3 + 3 * int(np.isin(np.flatnonzero(tree.free), start.joints).sum())
    residual_sd_m = estimate_residual_sd(distance, pose_freedom)
    frames = sample_evenly(len(state.poses[0]), MAX_UNCERTAINTY_FRAMES)
    found, basis = respond_in_frames(state.problem, state.poses, frames, has_responses=True), state.parameters.shape_basis
    weighted, of_prior = (found.marker_response, found.marker_weight, basis), state.parameters.gradient_covariance
    covariance = compute_shared_covariance(*weighted, curvature, of_prior, times_s, residual_sd_m)
    half = basis @ np.linalg.cholesky(covariance)
    joint_sd, marker_sd = (compute_response_sd(each, half) for each in (found.joint_response, found.marker_response))
    return replace(subject, marker_spread=spread, joint_sd=joint_sd, marker_sd=marker_sd)
