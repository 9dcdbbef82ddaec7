"""Refinement: bones, marker offsets and the poses of many frames, fitted together.

Levenberg-Marquardt over the unknowns that the frames share (see `parameters`). At each step the poses of the frames are solved
again and eliminated exactly (variable projection; Golub & Pereyra 1973), so that the step accounts for the change of the poses.
The nominal marker offsets and bone lengths are the prior, which determines what the take leaves undetermined.

`kernels.schur` describes the unknowns and the elimination, `calibration_uncertainty` the errors that remain.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from mocapfix.calibrate.calibration_uncertainty import compute_response_sd, compute_shared_covariance, estimate_residual_sd
from mocapfix.calibrate.hip_regression import add_hip_regression
from mocapfix.calibrate.parameters import CalibratedBody, CalibrationParameters, build_calibration_parameters
from mocapfix.calibrate.shared_responses import (
    SharedResponses,
    compute_shared_responses,
    reduce_shared_curvature,
    reduce_shared_gradient,
)
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
from mocapfix.stats.sequences import sample_evenly
from mocapfix.subject import Subject

CALIBRATION_MARKER_SD_M = 0.010
"""Standard deviation per axis of a marker about its offset; skin moves less, but errors of neighbouring frames are correlated."""
CALIBRATION_ROBUST_SCALE_M = 0.050
"""Geman-McClure scale of the marker residuals."""
SELECTION_ROBUST_SCALES_M = (0.4, 0.2, 0.1)
"""The same scales, one after the other, for a body that is not yet calibrated."""
POSE_PRIOR_WEIGHT = 0.02
"""Weight of the prior of poses about the take's mean; more weight would favour longer bones, which need smaller rotations."""
MAX_SELECTION_ITERATIONS = 8
"""Iterations of a frame when an uncalibrated body is posed."""
MAX_CALIBRATION_POSE_ITERATIONS = 6
"""Iterations of a frame between two steps of the shared unknowns."""
MAX_REFINEMENT_ROUNDS = 25
"""Steps of the shared unknowns."""
MIN_RELATIVE_DECREASE = 1e-3
"""Relative decrease of the cost below which the refinement ends."""
MIN_CURVATURE_CHANGE_DECREASE = 0.02
"""Relative decrease of the cost above which the curvature is computed again; after smaller steps it is nearly the same."""
INITIAL_DAMPING = 1e-3
"""Marquardt damping at the start."""
MIN_DAMPING = 1e-6
"""Smallest damping after accepted steps."""
MAX_DAMPING = 1e3
"""Damping above which the refinement ends without an accepted step."""
FRAMES_PER_BLOCK = 10
"""Frames whose responses are held at a time: those of one frame take about a megabyte."""
MAX_UNCERTAINTY_FRAMES = 30
"""Frames from which the standard deviations are computed."""


@dataclass(frozen=True)
class RefinementState:
    """A body with the poses of N frames, and the cost and its gradient in the shared unknowns (Q,) there.

    parameters                      the definition of the unknowns
    root_position, local_rotations  (N, 3) m and (N, J, 3, 3): the poses
    cost                            half the sum of squares in standard deviations, priors included
    gradient                        (Q,) derivative of the cost with the poses eliminated
    """

    parameters: CalibrationParameters
    unknowns: np.ndarray
    problem: PoseProblem
    root_position: np.ndarray
    local_rotations: np.ndarray
    cost: float
    gradient: np.ndarray


def build_calibration_problem(
    start: Subject, body: BodyModel, prior: MeanPosePrior, markers: np.ndarray, calibrated: CalibratedBody
) -> PoseProblem:
    """Return the pose problem of frames (N, K, 3) on a body with calibrated offsets and mean pose."""
    tree = KinematicTree(start.skeleton.parents, calibrated.offsets, body.free_joints)
    prior_term = build_pose_prior_term(prior.build_within_take_prior().scale_information(POSE_PRIOR_WEIGHT))
    return PoseProblem(
        tree,
        MarkerAttachment(start.joints, calibrated.marker_offsets),
        markers,
        ~np.isnan(markers[..., 0]),
        CALIBRATION_MARKER_SD_M,
        prior_term._replace(mean_vectors=calibrated.mean_pose_vectors),
        build_no_joint_limits(len(calibrated.offsets)),
    )


def pose_frames(start: Subject, body: BodyModel, prior: MeanPosePrior, markers: Float[np.ndarray, "N K 3"]) -> Motion:
    """Return robust poses of some frames on a body that is not yet calibrated, so that spikes do not look like varied poses."""
    motion = register_poses(start, body.free_joints, prior, markers)
    uncalibrated = CalibratedBody(start.skeleton.offsets, start.marker_offsets, np.zeros((len(body.free_joints), 3)))
    problem = build_calibration_problem(start, body, prior, markers, uncalibrated)
    no_tracking = build_no_tracking(len(body.free_joints))
    problem.solve(motion.root_position, motion.local_rotations, no_tracking, SELECTION_ROBUST_SCALES_M, MAX_SELECTION_ITERATIONS)
    return motion


def refine_subject(
    start: Subject,
    body: BodyModel,
    prior: MeanPosePrior,
    markers: Float[np.ndarray, "N K 3"],
    root_position: Float[np.ndarray, "N 3"],
    local_rotations: Float[np.ndarray, "N J 3 3"],
    unknowns: Float[np.ndarray, " Q"] | None = None,
    *,
    times_s: Float[np.ndarray, " N"],
) -> tuple[Subject, RefinementState, float]:
    """Return `start` with the bones and marker offsets that fit the frames best, the refined state, and the first state's cost.

    root_position, local_rotations  the first poses
    times_s                         of the frames: those near each other have similar errors
    unknowns                        the first values of the calibration parameters, by default 0
    """
    parameters = add_hip_regression(build_calibration_parameters(start, body, prior), start, body.skeleton)

    def fit(unknowns: np.ndarray, root_position: np.ndarray, local_rotations: np.ndarray) -> RefinementState:
        problem = build_calibration_problem(start, body, prior, markers, parameters.compute_body(unknowns))
        return solve_and_linearise(parameters, problem, unknowns, root_position.copy(), local_rotations.copy())

    unknowns = np.zeros(len(parameters.information)) if unknowns is None else unknowns
    state = fit(unknowns, root_position, local_rotations)
    first_cost = state.cost
    curvature, damping = compute_curvature(state), INITIAL_DAMPING
    for _ in range(MAX_REFINEMENT_ROUNDS):
        step = compute_damped_step(curvature, state.gradient, damping)
        trial = fit(state.unknowns + step, state.root_position, state.local_rotations)
        if trial.cost < state.cost:
            decrease = (state.cost - trial.cost) / trial.cost
            state, damping = trial, max(damping / 5, MIN_DAMPING)
            if decrease < MIN_RELATIVE_DECREASE:
                break
            if decrease > MIN_CURVATURE_CHANGE_DECREASE:
                curvature = compute_curvature(state)
        else:
            damping *= 10
            if damping > MAX_DAMPING:
                break
    return build_refined_subject(start, state, curvature, times_s), state, first_cost


def solve_and_linearise(
    parameters: CalibrationParameters,
    problem: PoseProblem,
    unknowns: np.ndarray,
    root_position: np.ndarray,
    local_rotations: np.ndarray,
) -> RefinementState:
    """Solve the poses from those given, which are overwritten, and return the state there."""
    no_tracking = build_no_tracking(local_rotations.shape[1])
    problem.solve(root_position, local_rotations, no_tracking, (CALIBRATION_ROBUST_SCALE_M,), MAX_CALIBRATION_POSE_ITERATIONS)
    return linearise_frames(parameters, problem, unknowns, root_position, local_rotations)


def linearise_frames(
    parameters: CalibrationParameters,
    problem: PoseProblem,
    unknowns: np.ndarray,
    root_position: np.ndarray,
    local_rotations: np.ndarray,
) -> RefinementState:
    """Return the state at given poses, without solving them."""
    frames, deviation = np.arange(len(root_position)), unknowns - parameters.expected
    prior_gradient = parameters.information @ deviation
    responses = respond_in_frames(parameters, problem, root_position, local_rotations, frames, only_errors=True)
    cost = float(responses.cost.sum() + 0.5 * deviation @ prior_gradient)
    gradient = reduce_shared_gradient(responses) + prior_gradient
    return RefinementState(parameters, unknowns, problem, root_position, local_rotations, cost, gradient)


def compute_curvature(state: RefinementState) -> Float[np.ndarray, "Q Q"]:
    """Return the curvature of the cost in the shared unknowns, with the poses eliminated.

    The frames are summed block by block: the responses of all of them together would take a hundred megabytes.
    """
    curvature, frame_count = state.parameters.information.copy(), len(state.root_position)
    for first in range(0, frame_count, FRAMES_PER_BLOCK):
        frames = np.arange(first, min(first + FRAMES_PER_BLOCK, frame_count))
        responses = respond_in_frames(state.parameters, state.problem, state.root_position, state.local_rotations, frames)
        curvature += reduce_shared_curvature(responses)
    return curvature


def respond_in_frames(
    parameters: CalibrationParameters,
    problem: PoseProblem,
    root_position: np.ndarray,
    local_rotations: np.ndarray,
    frames: Int[np.ndarray, " N"],
    *,
    only_errors: bool = False,
) -> SharedResponses:
    """Return the responses of some of the frames to the shared unknowns of the calibration (see `compute_shared_responses`)."""
    part = replace(problem, marker_positions=problem.marker_positions[frames], solver_mask=problem.solver_mask[frames])
    return compute_shared_responses(
        part.tree,
        part.build_terms(build_no_tracking(local_rotations.shape[1])),
        parameters.deformations,
        part.normalise_robust_scales((CALIBRATION_ROBUST_SCALE_M,))[0],
        root_position[frames],
        local_rotations[frames],
        only_errors=only_errors,
    )


def compute_damped_step(
    curvature: Float[np.ndarray, "Q Q"], gradient: Float[np.ndarray, " Q"], damping: float
) -> Float[np.ndarray, " Q"]:
    """Return the damped Gauss-Newton step (Marquardt 1963)."""
    return np.linalg.solve(curvature + damping * np.diag(np.diag(curvature)), -gradient)


def compute_calibration_sd(
    state: RefinementState,
    curvature: Float[np.ndarray, "Q Q"],
    times_s: Float[np.ndarray, " N"] | None = None,
    residual_sd_m: float = CALIBRATION_MARKER_SD_M,
) -> tuple[Float[np.ndarray, " J"], Float[np.ndarray, " K"]]:
    """Return the standard deviation per axis, in metres, of joints and markers due to the uncertainty of the shared unknowns.

    The pose of each frame adapts to the unknowns. The values are root mean squares over at most MAX_UNCERTAINTY_FRAMES frames.

    times_s        of the frames; None if each is measured independently
    residual_sd_m  of a marker about its place on the body, per axis
    """
    frames = sample_evenly(len(state.root_position), MAX_UNCERTAINTY_FRAMES)
    responses = respond_in_frames(state.parameters, state.problem, state.root_position, state.local_rotations, frames)
    if times_s is None:
        covariance = np.linalg.inv(curvature)
    else:
        covariance = compute_shared_covariance(
            responses.marker_response,
            responses.marker_weight,
            curvature,
            state.parameters.gradient_covariance,
            times_s,
            residual_sd_m,
        )
    return compute_response_sd(responses.joint_response, responses.marker_response, covariance)


def build_refined_subject(
    start: Subject, state: RefinementState, curvature: np.ndarray, times_s: Float[np.ndarray, " N"]
) -> Subject:
    """Return the subject of a refined state; the spread of a marker is its median distance per axis from the body."""
    tree = state.problem.tree
    size = np.linalg.norm(tree.offsets) / np.linalg.norm(start.skeleton.offsets)
    subject = replace(
        start,
        skeleton=replace(start.skeleton, offsets=tree.offsets, ends=start.skeleton.ends * size),
        marker_offsets=state.problem.attachment.offsets,
        frame_count=len(state.root_position),
    )
    zeros = np.zeros(len(state.root_position), int)
    motion = Motion(state.root_position, state.local_rotations, zeros, zeros, np.zeros(0), np.zeros(0))
    _, predicted = kinematics.compute_joint_and_marker_positions(subject, motion)
    distance = np.linalg.norm(state.problem.marker_positions - predicted, axis=-1)
    visible = (~np.isnan(distance)).any(0)
    spread = start.marker_spread.copy()
    spread[visible] = np.sqrt(np.nanmedian(distance[:, visible] ** 2, axis=0) / 3)
    pose_freedom = 3 + 3 * int(np.isin(np.flatnonzero(tree.free), start.joints).sum())
    residual_sd_m = estimate_residual_sd(distance, pose_freedom)
    joint_sd, marker_sd = compute_calibration_sd(state, curvature, times_s, residual_sd_m)
    return replace(subject, marker_spread=spread, joint_sd=joint_sd, marker_sd=marker_sd)
