"""Refinement: bones, marker offsets and the poses of many frames, fitted together, and how uncertain the result is.

The calibration parameters, which frames share, are the size, the principal components of body shape, the scale of each bone
group, the length of each bone, the direction of each bone of the trunk, the marker offsets, and the take's mean pose. The prior
are the deviations of people from the average. Markers seldom determine the hip joints: in ordinary gait the thighs hardly move
sideways, and skin and muscle slide over them. Where markers are on the iliac spines, their distances predict the centres:
Harrington et al., "Prediction of the hip joint centre in adults, children, and patients with cerebral palsy based on magnetic
resonance imaging", J. Biomechanics 40 (2007) 595-602.

Levenberg-Marquardt over these unknowns, with the poses of the frames eliminated (see `solve.minimise`). The nominal marker
offsets and bone lengths are the prior, which determines what the take leaves undetermined.

Calibration uncertainty: how far bones and markers of a calibrated subject may lie from the true ones. A calibration error is the
same in every frame, so that no residual shows it. It is predicted from the normal equations of the calibration, with the actual
variation of markers about their places instead of the weights of the fit.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from mocapfix.model.skeleton import BodyModel, Skeleton
from mocapfix.model.subject import Subject
from mocapfix.solve import kinematics
from mocapfix.solve.initial_motion import register_poses
from mocapfix.solve.kinematics import Poses
from mocapfix.solve.mean_pose import MeanPosePrior
from mocapfix.solve.minimise import SharedResponses, compute_shared_responses, minimise_shared
from mocapfix.solve.parallel import map_in_threads
from mocapfix.solve.pose_problem import PoseProblem, build_marker_problem
from mocapfix.solve.terms import ShapeDeformations, build_no_joint_limits, build_pose_prior_term
from mocapfix.stats.gaussian_process import CHI2_MEDIAN_3_DOF, evaluate_matern
from mocapfix.stats.sequences import sample_evenly
from mocapfix.subject.library import find_landmark

BODY_SIZE_SD = 1e3  # relative standard deviation of the size: practically free, since the take determines it well
BONE_GROUP_SD = 0.05  # relative, of a bone group's length, left and right together; the most likely over the CMU subjects
INDIVIDUAL_BONE_LENGTH_SD = 0.03  # relative, within its group: the asymmetry of the CMU subjects
# Joints at the ends of bones whose direction differs from person to person. A limb's bone defines the axes of its segment.
LEANING_BONES = ("LeftUpLeg", "RightUpLeg", "Neck", "Neck1", "Head", "LeftArm", "RightArm")
FIRM_BONES = ("Spine", "Spine1")  # whose direction looks like a bend of the joint below: the fit hardly changes it
# Standard deviation of the direction of such a bone about each axis across it: that of each of CMU's subjects from the principal
# components of the others.
PEOPLE_LEAN_SD_RAD = 0.04
FIRM_BONE_LEAN_SD_RAD = 0.005  # the same as the fit assumes it for FIRM_BONES
MEAN_POSE_SD_RAD = 0.02  # standard deviation of a take's mean pose from the average about axes for which no variation is known
MIN_SCALED_BONE_LENGTH_M = 0.02  # length above which an offset counts as a bone with a length of its own


class CalibratedBody(NamedTuple):
    """A body given by calibration parameters: joint and marker offsets in metres, and the rotation vectors of its mean pose."""

    offsets: np.ndarray
    marker_offsets: np.ndarray
    mean_pose_vectors: np.ndarray


@dataclass(frozen=True)
class CalibrationParameters:
    """The definition of Q shared unknowns, all 0 at the start.

    They are P coefficients of deformations, the shifts of K markers (K, 3) in metres, and the rotation vectors (F, 3) in radians
    of the take's mean pose from the average, for the free joints below the root.
    """

    offsets: Float[np.ndarray, "J 3"]  # m: joint offsets at the start
    marker_offsets: Float[np.ndarray, "K 3"]  # m: marker offsets at the start
    free_joints: np.ndarray  # (J,) joints that turn
    deformations: ShapeDeformations  # change of the offsets with each of the P coefficients
    information: Float[np.ndarray, "Q Q"]  # inverse covariance of the unknowns about those expected, as the fit assumes it
    # (Q,) actual variance of people over that which the fit assumes: 1 unless the fit holds an unknown firmly.
    variance_ratio: Float[np.ndarray, " Q"]
    expected: Float[np.ndarray, " Q"]  # the most likely values before the take is seen: 0 unless landmarks predict joints

    @property
    def gradient_covariance(self) -> Float[np.ndarray, "Q Q"]:
        """The covariance of the prior's gradient at the true values, larger for unknowns that the fit holds firmly."""
        return self.information * np.sqrt(self.variance_ratio * self.variance_ratio[:, None])

    @cached_property
    def shape_basis(self) -> Float[np.ndarray, "U Q"]:
        """The change of all offsets of joints and markers, and of the mean pose, with each unknown (see `kernels.schur`)."""
        joint_offsets, marker_offsets = (each.reshape(len(each), -1) for each in self.deformations)
        basis = np.zeros((joint_offsets.shape[1] + len(self.information) - len(joint_offsets), len(self.information)))
        deformed = np.hstack([joint_offsets, marker_offsets]).T
        basis[: len(deformed), : len(joint_offsets)] = deformed
        basis[joint_offsets.shape[1] :, len(joint_offsets) :] = np.eye(len(basis) - joint_offsets.shape[1])
        return basis

    def compute_body(self, unknowns: Float[np.ndarray, " Q"]) -> CalibratedBody:
        """Return the body that the unknowns describe."""
        coefficient_count = len(self.deformations.marker_offsets)
        coefficients, shifts, vectors = np.split(unknowns, [coefficient_count, coefficient_count + self.marker_offsets.size])
        marker_offsets = (
            self.marker_offsets + np.tensordot(coefficients, self.deformations.marker_offsets, 1) + shifts.reshape(-1, 3)
        )
        mean_pose_vectors = np.zeros_like(self.offsets)
        mean_pose_vectors[np.flatnonzero(self.free_joints)[1:]] = vectors.reshape(-1, 3)
        offsets = self.offsets + np.tensordot(coefficients, self.deformations.joint_offsets, 1)
        return CalibratedBody(offsets, marker_offsets, mean_pose_vectors)


def build_calibration_parameters(start: Subject, body: BodyModel, prior: MeanPosePrior) -> CalibrationParameters:
    """Return the parameters from `body` at the estimated size, whose marker spread is that of people's offsets."""
    offsets, marker_offsets = start.skeleton.offsets, start.marker_offsets
    shapes = body.shape_components * np.linalg.norm(offsets) / np.linalg.norm(body.skeleton.offsets)
    groups = np.zeros((len(body.bone_groups), *offsets.shape))
    for g, joints in enumerate(map(list, body.bone_groups.values())):
        groups[g, joints] = offsets[joints]
    bones = list_bones(start.skeleton)
    leans, firm_leans = (list_bone_leans(start.skeleton, names) for names in (LEANING_BONES, FIRM_BONES))
    joint_deformations = np.concatenate([offsets[None], shapes, groups, bones, leans, firm_leans])
    # the size alone moves the markers along
    marker_deformations = np.concatenate([marker_offsets[None], np.zeros((len(joint_deformations) - 1, *marker_offsets.shape))])
    length_sd = *[BONE_GROUP_SD] * len(groups), *[INDIVIDUAL_BONE_LENGTH_SD] * len(bones)
    lean_sd = *[PEOPLE_LEAN_SD_RAD] * len(leans), *[FIRM_BONE_LEAN_SD_RAD] * len(firm_leans)
    sd = (BODY_SIZE_SD, *[1.0] * len(shapes), *length_sd, *lean_sd, *np.repeat(start.marker_spread, 3))
    free_below_root = np.flatnonzero(body.free_joints)[1:]
    mean_pose_information = np.linalg.inv(prior.between_take_covariance[free_below_root] + MEAN_POSE_SD_RAD**2 * np.eye(3))
    information = np.diag(np.concatenate([1 / np.square(sd), np.zeros(3 * len(mean_pose_information))]))
    for first, block in zip(range(len(sd), len(information), 3), mean_pose_information, strict=True):
        information[first : first + 3, first : first + 3] = block
    variance_ratio = np.ones(len(information))
    variance_ratio[len(joint_deformations) - len(firm_leans) : len(joint_deformations)] = (
        PEOPLE_LEAN_SD_RAD / FIRM_BONE_LEAN_SD_RAD
    ) ** 2
    deformations = ShapeDeformations(joint_deformations, marker_deformations)
    expected = np.zeros(len(information))
    return CalibrationParameters(offsets, marker_offsets, body.free_joints, deformations, information, variance_ratio, expected)


def list_bones(skeleton: Skeleton) -> Float[np.ndarray, "B J 3"]:
    """Return for each of B bones the offsets in metres of the joints it carries, zero for all others.

    Joints at the same offset from one parent share a bone: the thorax carries the neck and both shoulders.
    """
    offsets, bones = skeleton.offsets, list[np.ndarray]()
    for j in np.flatnonzero(np.linalg.norm(offsets, axis=1) > MIN_SCALED_BONE_LENGTH_M):
        is_same = (skeleton.parents == skeleton.parents[j]) & np.isclose(offsets, offsets[j]).all(1)
        if np.flatnonzero(is_same)[0] == j:
            bones.append(np.where(is_same[:, None], offsets, 0.0))
    return np.array(bones)


def list_bone_leans(skeleton: Skeleton, joint_names: tuple[str, ...]) -> Float[np.ndarray, "L J 3"]:
    """Return the changes of the offsets in metres per radian of a rotation of each joint's bone about two axes across it."""
    offsets, leans = skeleton.offsets, list[np.ndarray]()
    for j in map(skeleton.find_joint, joint_names):
        is_same = (skeleton.parents == skeleton.parents[j]) & np.isclose(offsets, offsets[j]).all(1)
        length_m, across = np.linalg.norm(offsets[j]), np.linalg.svd(offsets[j][None])[2][1:]
        leans += [np.where(is_same[:, None], length_m * direction, 0.0) for direction in across]
    return np.array(leans)


# Standard deviation per axis of a predicted hip joint centre: 12.3 +- 5.9 mm in space in 67 adults whose landmarks and joints
# were found in computed tomography (Mantovani et al., Gait & Posture 44 (2016) 48-54).
HIP_REGRESSION_SD_M = 0.008
# Distance of the centre behind the middle of the anterior iliac spines: a share of the pelvis' depth, and metres more.
BACKWARD_PER_DEPTH, BACKWARD_M = 0.24, 0.0099
DOWNWARD_PER_WIDTH, DOWNWARD_M = 0.30, 0.0109  # the same for its distance below it, from the pelvis' width
SIDEWARD_PER_WIDTH, SIDEWARD_M = 0.33, 0.0073  # the same for its distance to the side
MAX_LANDMARK_DISTANCE_M = 0.001  # of a marker on a landmark of the average body: all sets give it one place
DERIVATIVE_STEP_M = 1e-4  # step of the numerical derivatives; the equations are nearly linear over centimetres
HIP_JOINTS = ("LeftUpLeg", "RightUpLeg")


class PelvisLandmarks(NamedTuple):
    """The markers of a subject on landmarks of the pelvis."""

    left_anterior: int  # left_anterior, right_anterior: indices of the markers on the anterior superior iliac spines
    right_anterior: int
    posterior: tuple[int, ...]  # those on the posterior ones, or the one on the sacrum between them


def add_hip_regression(parameters: CalibrationParameters, start: Subject) -> CalibrationParameters:
    """Return the parameters with the prediction of the hip joints in their prior, the very same ones if there is none."""
    evidence = build_hip_evidence(start, parameters)
    if evidence is None:
        return parameters
    error, jacobian = evidence
    precision = jacobian.T / HIP_REGRESSION_SD_M**2
    information = parameters.information + precision @ jacobian
    gradient = parameters.information @ parameters.expected - precision @ error
    return replace(parameters, information=information, expected=np.linalg.solve(information, gradient))


def find_pelvis_landmarks(subject: Subject) -> PelvisLandmarks | None:
    """Return the markers on the landmarks of the pelvis of an uncalibrated subject; None if one is missing."""
    ratio, pelvis = subject.skeleton.size_ratio, subject.skeleton.find_joint("Hips")

    def find_marker(landmark_name: str) -> list[int]:
        distance = np.linalg.norm(subject.marker_offsets / ratio - find_landmark(landmark_name).offset, axis=1)
        return np.flatnonzero((distance <= MAX_LANDMARK_DISTANCE_M) & (subject.joints == pelvis)).tolist()

    left, right = (find_marker(f"{side} anterior superior iliac spine") for side in ("left", "right"))
    pairs = [find_marker(f"{side} posterior superior iliac spine") for side in ("left", "right")]
    posterior = pairs[0][:1] + pairs[1][:1] if all(pairs) else find_marker("sacrum")[:1]
    return PelvisLandmarks(left[0], right[0], tuple(posterior)) if left and right and posterior else None


def predict_hip_joints(
    left_anterior: Float[np.ndarray, "3"], right_anterior: Float[np.ndarray, "3"], posterior: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "2 3"]:
    """Return the centres of both hips, in metres, from the iliac spines; `posterior` is the middle of the posterior ones."""
    middle, across = (left_anterior + right_anterior) / 2, left_anterior - right_anterior
    width_m, depth_m = float(np.linalg.norm(across)), float(np.linalg.norm(middle - posterior))
    to_left = across / width_m
    forward = middle - posterior - (middle - posterior) @ to_left * to_left
    forward /= np.linalg.norm(forward)
    up = np.cross(forward, to_left)
    centre = middle - (BACKWARD_PER_DEPTH * depth_m + BACKWARD_M) * forward - (DOWNWARD_PER_WIDTH * width_m + DOWNWARD_M) * up
    sideward = (SIDEWARD_PER_WIDTH * width_m + SIDEWARD_M) * to_left
    return np.array([centre + sideward, centre - sideward])


def build_hip_evidence(
    start: Subject, parameters: CalibrationParameters
) -> tuple[Float[np.ndarray, "6"], Float[np.ndarray, "6 Q"]] | None:
    """Return the hip joints, left and right, relative to the predicted ones in metres at the start, and the derivatives with
    respect to the unknowns; None if the subject has no markers on the landmarks.
    """
    landmarks = find_pelvis_landmarks(start)
    if landmarks is None:
        return None
    skeleton, posterior = start.skeleton, list(landmarks.posterior)
    hips = [skeleton.find_joint(name) for name in HIP_JOINTS]
    stubs = skeleton.parents[hips]  # between the pelvis and a hip joint
    places, of_hips = start.marker_offsets, skeleton.offsets[hips] + skeleton.offsets[stubs]
    points = np.array([*of_hips, *places[list(landmarks[:2])], places[posterior].mean(0)])

    def compute_error(flat_points: np.ndarray) -> np.ndarray:
        hip_joints, spines = np.split(flat_points.reshape(-1, 3), [2])
        return (hip_joints - predict_hip_joints(*spines)).ravel()

    steps = DERIVATIVE_STEP_M * np.eye(points.size)
    flat = points.ravel()
    derivative = np.array(
        [(compute_error(flat + step) - compute_error(flat - step)) / (2 * DERIVATIVE_STEP_M) for step in steps]
    ).T
    joint_deformations, marker_deformations = parameters.deformations
    coefficient_count, unknown_count = len(marker_deformations), len(parameters.information)
    motion = np.zeros((len(points), 3, unknown_count))  # of the points with the unknowns
    joint_motion = joint_deformations[:, hips] + joint_deformations[:, stubs]
    motion[:2, :, :coefficient_count] = joint_motion.transpose(1, 2, 0)
    for point, indices in enumerate(((landmarks.left_anterior,), (landmarks.right_anterior,), landmarks.posterior), start=2):
        for k in indices:
            motion[point, :, :coefficient_count] += marker_deformations[:, k].T / len(indices)
            shift = coefficient_count + 3 * k
            motion[point, :, shift : shift + 3] += np.eye(3) / len(indices)
    return compute_error(flat), derivative @ motion.reshape(points.size, unknown_count)


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
        return linearise_frames(parameters, problem, unknowns, pose_calibrated_frames(problem, poses))

    parameters = add_hip_regression(build_calibration_parameters(start, body, prior), start)
    first = fit(np.zeros(len(parameters.information)) if unknowns is None else unknowns, poses)
    state, curvature = minimise_shared(lambda new, old: fit(new, old.poses), first, compute_curvature, MAX_REFINEMENT_ROUNDS)
    return Refinement(state, curvature, (first.cost - state.cost) / state.cost)


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
    # Errors of markers look like motion of the joints, which then seem to show their centres. As much error again makes a
    # curvature H (1 + r) H; that by the true motion is H / (1 + r). This is simulation extrapolation: Cook and Stefanski,
    # "Simulation-extrapolation estimation in parametric measurement error models", J. Am. Stat. Assoc. 89 (1994) 1314-1328.
    markers = state.problem.marker_positions + np.random.default_rng(0).normal(0, residual_sd_m, (*distance.shape, 3))
    noisy = replace(state.problem, marker_positions=markers)
    growth = respond_in_frames(noisy, pose_calibrated_frames(noisy, state.poses), frames).curvature - found.curvature
    half = np.linalg.cholesky(covariance)
    half += np.linalg.solve(curvature, basis.T @ growth @ basis @ half) * (len(state.poses[0]) / len(frames))
    joint_sd, marker_sd = (compute_response_sd(each, basis @ half) for each in (found.joint_response, found.marker_response))
    return replace(subject, marker_spread=spread, joint_sd=joint_sd, marker_sd=marker_sd)
