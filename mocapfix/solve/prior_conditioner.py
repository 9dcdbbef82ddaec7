"""What a trained pose model adds to the solved poses of a take.

In every frame (`apply_pose_prior`): the poses that are most probable under the model and the markers where the solved body places
them. The model makes all joints depend on each other, while the solver's prior term treats each joint by itself. So the most
probable poses are computed in sampled frames, by dense Gauss-Newton steps in which the code is eliminated. Each joint gets the
mean and the information with which the prior term has the model's gradient at these poses, and the curvature that the model has
for the joint if the others are given. The minimum of the solver's cost is then that of the cost with the model.

For joints that no marker shows (`PriorConditioner`): what the model predicts from the observed joints. The code is estimated by
least squares from the tilt of the root and the observed joints. Code dimensions in which the decoder is linear have the same
derivatives in every frame, so that they are eliminated beforehand: they correlate the errors of the observed joints, and what
these errors show of them is added to the prediction.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.kernels import lie
from mocapfix.solve.kinematics import Poses, compute_tree_poses, interpolate_poses
from mocapfix.solve.mean_pose import MeanPosePrior
from mocapfix.solve.minimise import minimise
from mocapfix.solve.motion_prior import GapContext, GapPrediction
from mocapfix.solve.parallel import run_in_parallel
from mocapfix.solve.pose_prior import PoseModel, compute_pose_vectors
from mocapfix.solve.pose_problem import PoseProblem
from mocapfix.solve.terms import PointTerm, PosePriorTerm, build_no_tracking
from mocapfix.stats.rigid_alignment import build_cross_matrices, compute_rotation_vectors, compute_rotations
from mocapfix.stats.sequences import interpolate_rows, sample_evenly

OBSERVED_JOINT_SD_RAD = 0.05  # standard deviation of the rotation of a joint with markers
CODE_ITERATIONS = 4  # gauss-Newton iterations of the code; the decoder of a network is nearly linear among people's poses
MAX_CONDITIONING_FRAMES = 64  # frames per batch; the derivatives of one frame take about 20 kB


class ObservedErrors(NamedTuple):
    """The errors of O observed joints over their standard deviations, as the linear dimensions of the code correlate them."""

    joints: np.ndarray  # (O,) the observed joints and the root
    sd: np.ndarray  # (3 O,) rad: standard deviations without these dimensions
    whitening: np.ndarray  # (3 O, 3 O): makes the errors independent, of unit variance
    occluded_gain: np.ndarray  # (3 L, 3 O) rad: expected errors of L occluded joints

    def scale(self, values: Float[np.ndarray, "N J 3 C"]) -> Float[np.ndarray, "N E C"]:
        """Return values of the observed joints in radians over the standard deviations."""
        return values[:, self.joints].reshape(len(values), len(self.sd), values.shape[3]) / self.sd[:, None]


@dataclass(frozen=True)
class PriorConditioner:
    """A trained pose model as the solver uses it."""

    # returns the model; called only when it is needed, since its weights are read from a file
    load_pose_model: Callable[[], PoseModel]
    prior_scale: float  # factor of the model's standard deviations (2: weaker prior)
    # predicts the 31 joints of a body in a gap, given the motion around it and the size of the body relative to the average
    # one: the motion prior; None: it is not used
    predict_motion: Callable[[GapContext, float], GapPrediction | None] | None = None

    def predict_gap(self, context: GapContext, joints: Int[np.ndarray, " L"]) -> GapPrediction | None:
        """Return what the motion prior predicts for some joints in a gap; None without one or if it cannot predict the gap."""
        predicted = self.predict_motion(context.crop(), 1.0) if self.predict_motion else None
        return predicted and predicted.select_joints(joints)

    def predict_rotations(
        self,
        local_rotations: Float[np.ndarray, "T J 3 3"],
        observed_joints: Int[np.ndarray, " O"],
        occluded_joints: Int[np.ndarray, " L"],
        frames: Int[np.ndarray, " N"],
        reference: Float[np.ndarray, "N Q"],
    ) -> Float[np.ndarray, "N Q"]:
        """Return predicted quaternions of L occluded joints, multiplied by 2, as rows of Q = 4 L numbers.

        Args:
            reference: Quaternions that determine the sign: of two for the same rotation, the nearer one is returned.
        """
        model = self.load_pose_model()
        errors = self.build_observed_errors(model, observed_joints, occluded_joints)
        poses = compute_pose_vectors(local_rotations[frames], model.reference_rotations)
        batches = np.array_split(poses, max(1, -(-len(frames) // MAX_CONDITIONING_FRAMES)))
        vectors = np.concatenate([self.estimate_rotation_vectors(model, each, errors, occluded_joints) for each in batches])
        predicted = np.empty((len(frames), len(occluded_joints), 4))
        for i, j in enumerate(occluded_joints):
            rotation = compute_rotations(vectors[:, i]) @ model.reference_rotations[j]
            predicted[:, i] = 2 * lie.extract_joint_quaternions(rotation[:, None], 0, np.ones(len(rotation), bool))
        is_opposite = (predicted * reference.reshape(predicted.shape)).sum(axis=2) < 0
        return np.where(is_opposite[..., None], -predicted, predicted).reshape(reference.shape)

    def estimate_rotation_vectors(
        self,
        model: PoseModel,
        pose_vectors: Float[np.ndarray, "N J 3"],
        errors: ObservedErrors,
        occluded_joints: Int[np.ndarray, " L"],
    ) -> Float[np.ndarray, "N L 3"]:
        """Return the decoded rotation vectors, in radians, of the occluded joints at the most likely code."""
        vectors, codes = pose_vectors.copy(), np.zeros((len(pose_vectors), model.code_size))
        vectors[:, occluded_joints] = 0.0
        size = model.nonlinear_code_size
        for iteration in range(CODE_ITERATIONS):
            selected = model.select_components(vectors)
            is_common = iteration == 0 and selected is model  # all codes are zero, so that one linearisation holds for all frames
            decoded, jacobian = selected.linearise(codes[:1] if is_common else codes)
            slopes = errors.scale(jacobian[:, :, :, :size])
            whitened = errors.whitening @ slopes
            transposed = np.swapaxes(whitened, 1, 2)
            curvature = transposed @ whitened + np.eye(size) / self.prior_scale**2
            residual = errors.scale((vectors - decoded)[..., None]) + slopes @ codes[:, :size, None]
            codes[:, :size] = np.linalg.solve(curvature, transposed @ (errors.whitening @ residual))[..., 0]
            if selected is not model or iteration == CODE_ITERATIONS - 1:  # a component is selected by all joints
                remaining = (residual - slopes @ codes[:, :size, None])[..., 0] @ errors.occluded_gain.T
                vectors[:, occluded_joints] = selected.decode(codes)[:, occluded_joints] + remaining.reshape(len(vectors), -1, 3)
        return vectors[:, occluded_joints]

    def build_observed_errors(
        self, model: PoseModel, observed_joints: Int[np.ndarray, " O"], occluded_joints: Int[np.ndarray, " L"]
    ) -> "ObservedErrors":
        """Return the errors of the observed joints and the root that the linear dimensions of the code explain."""
        joints, size = np.r_[0, observed_joints], model.nonlinear_code_size
        sd = np.repeat(np.hypot(OBSERVED_JOINT_SD_RAD, self.prior_scale * model.residual_sd_rad[joints]), 3)
        directions = np.zeros((len(model.joint_names), 3, 0))
        if size < model.code_size:
            directions = self.prior_scale * model.linearise(np.zeros((1, model.code_size)))[1][0, ..., size:]
        count = directions.shape[-1]
        observed = directions[joints].reshape(len(sd), count) / sd[:, None]
        factor = np.linalg.cholesky(observed @ observed.T + np.eye(len(sd)))
        whitening = np.tril(np.linalg.inv(factor))
        occluded = directions[occluded_joints].reshape(3 * len(occluded_joints), count)
        return ObservedErrors(joints, sd, whitening, occluded @ observed.T @ whitening.T @ whitening)


MIN_ROOT_CURVATURE = 1.0  # curvature, in 1/m^2 and 1/rad^2, that keeps the root where it is in frames without markers
SMALL_ANGLE_RAD = 1e-4  # angle below which the derivative of the exponential is given by its series


class WorldPoses(NamedTuple):
    """Poses of N frames: joint positions (N, J, 3) in metres and rotations (N, J, 3, 3) in the world; local rotations."""

    position: np.ndarray
    rotation: np.ndarray
    local_rotations: np.ndarray


def compute_marker_curvature(
    problem: PoseProblem, pose: WorldPoses, jacobian: Float[np.ndarray, "N F 3 3"]
) -> Float[np.ndarray, "N D D"]:
    """Return the curvature of the cost of all markers where poses place them, in root position, root rotation and pose vectors.

    Args:
        jacobian: Rotation of each of F free joints, in its parent's axes, by its pose vector; D = 6 + 3 F.
    """
    (carried, offsets), parents = problem.attachment, problem.tree.parents
    joints, (position, rotation, _) = np.flatnonzero(problem.tree.free)[1:], pose
    markers = position[:, carried] + (rotation[:, carried] @ offsets[..., None])[..., 0]
    slopes = np.zeros((*markers.shape, 6 + 3 * len(joints)))
    slopes[..., :3] = np.eye(3)
    arm = markers - position[:, :1]
    slopes[..., 3:6] = cross_columns(np.broadcast_to(np.eye(3), (*arm.shape, 3)), arm)
    is_below = find_moved_joints(parents)
    for n, j in enumerate(joints.tolist()):
        moved = np.flatnonzero(is_below[j, carried])
        axes = rotation[:, parents[j]] @ jacobian[:, n]
        arm = markers[:, moved] - position[:, j : j + 1]
        slopes[:, moved, :, 6 + 3 * n : 9 + 3 * n] = cross_columns(axes[:, None], arm)
    flat = slopes.reshape(len(slopes), -1, slopes.shape[-1]) / problem.marker_sd
    curvature = np.swapaxes(flat, 1, 2) @ flat
    curvature[:, range(6), range(6)] += MIN_ROOT_CURVATURE
    return curvature


def cross_columns(axes: Float[np.ndarray, "... 3 3"], arm: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 3 3"]:
    """Return the cross product of each column of `axes` with an arm: the velocity at its end for rotations about the columns."""
    x, y, z = arm[..., 0, None], arm[..., 1, None], arm[..., 2, None]
    a, b, c = axes[..., 0, :], axes[..., 1, :], axes[..., 2, :]
    return np.stack([b * z - c * y, c * x - a * z, a * y - b * x], axis=-2)


def find_moved_joints(parents: Int[np.ndarray, " J"]) -> Bool[np.ndarray, "J J"]:
    """Return for each joint which joints it moves: itself and those below it."""
    is_below = np.eye(len(parents), dtype=bool)
    for j in range(1, len(parents)):
        is_below[:, j] |= is_below[:, parents[j]]
    return is_below


def compute_left_jacobian(vectors: Float[np.ndarray, "N F 3"]) -> Float[np.ndarray, "N F 3 3"]:
    """Return the derivative of rotations by their rotation vectors in radians: exp(v + dv) = exp(J dv) exp(v)."""
    angle2 = (vectors**2).sum(-1)
    angle = np.sqrt(np.maximum(angle2, SMALL_ANGLE_RAD**2))
    first, second = (1 - np.cos(angle)) / angle**2, (angle - np.sin(angle)) / angle**3
    cross = build_cross_matrices(vectors)
    return np.eye(3) + first[..., None, None] * cross + second[..., None, None] * (cross @ cross)


HELD_JOINT_SD_M = 0.0003  # of a joint that keeps its position
MAX_SAMPLE_INTERVAL_S = 0.2  # largest time between the frames in which the model is evaluated
GAUSS_NEWTON_STEPS = 2  # towards the most probable pose; the model is linearised in each, where markers are in the first only
BATCH_FRAMES = 32  # sampled frames per batch; the derivatives of one frame take about 80 kB
MAX_DEVIATION_SD = 1.0  # of a joint from what the model expects, beyond which its force no longer grows
MAX_CHANGE_RAD = 2.0  # largest change, about an axis, of a rotation from the frame's own solution


def build_frame_prior_term(
    model: PoseModel, weight: float, problem: PoseProblem, base: MeanPosePrior, pose: Poses, frames: Int[np.ndarray, " N"]
) -> PosePriorTerm:
    """Return the prior term of every frame of a problem, whose markers are where the poses place them.

    Args:
        weight: Inverse square of the factor of the model's standard deviations.
        base: The mean pose; fixed joints keep it, and all joints keep its information about locked axes.
        frames: Sampled frames, the first and the last among them.
    """
    means, information = problem.pose_prior.rotations[0], problem.pose_prior.information[0]
    sampled = PosePriorTerm(np.tile(means, (len(frames), 1, 1, 1)), np.tile(information, (len(frames), 1, 1, 1)))
    joints = np.flatnonzero(problem.tree.free)[1:]
    local_rotations = pose[1][frames]
    position, rotation = compute_tree_poses(problem.tree, pose[0][frames], local_rotations)

    def compute_batch(rows: Int[np.ndarray, " B"]) -> None:
        part = WorldPoses(position[rows], rotation[rows], local_rotations[rows])
        batch = compute_sampled_prior(model, weight, problem, base, part)
        sampled.rotations[np.ix_(rows, joints)], sampled.information[np.ix_(rows, joints)] = batch[:2]

    run_in_parallel(compute_batch, np.array_split(np.arange(len(frames)), -(-len(frames) // BATCH_FRAMES)))
    rotations = interpolate_poses((position[:, 0], sampled.rotations), frames, len(pose[0]))[1]
    return PosePriorTerm(rotations, interpolate_rows(sampled.information, frames, np.arange(len(pose[0]))))


def compute_sampled_prior(
    model: PoseModel, weight: float, problem: PoseProblem, base: MeanPosePrior, pose: WorldPoses
) -> PosePriorTerm:
    """Return means and information of the F free joints below the root in some frames."""
    joints = np.flatnonzero(problem.tree.free)[1:]
    size = 3 * len(joints)
    vectors = compute_pose_vectors(pose.local_rotations, model.reference_rotations)
    start, jacobian = vectors[:, joints], compute_left_jacobian(vectors[:, joints])
    marker_curvature = compute_marker_curvature(problem, pose, jacobian)
    locked_force, locked_information = compute_locked_prior(base, pose.local_rotations[:, joints], joints)
    transposed = np.swapaxes(jacobian, -1, -2)
    for n, block in enumerate(np.moveaxis(transposed @ locked_information @ jacobian, 1, 0)):
        part = slice(6 + 3 * n, 9 + 3 * n)  # after the six numbers of the root
        marker_curvature[:, part, part] += block
    locked_gradient = (transposed @ locked_force[..., None]).reshape(-1, size)
    has_root_markers = bool((problem.attachment.joints == 0).any())
    rows = np.r_[0, joints] if has_root_markers else joints  # the markers of a part of a body do not show the root's tilt
    codes, step = np.zeros((len(vectors), model.code_size)), np.zeros((len(vectors), size))
    residual_information = compute_residual_information(model, rows)
    prior = linearise_model(model, vectors, codes, rows, residual_information)
    for n in range(GAUSS_NEWTON_STEPS):
        if n:
            prior = linearise_model(model, vectors, codes, rows, residual_information)
        information = prior.information[:, -size:, -size:]
        curvature, gradient = marker_curvature.copy(), np.zeros(marker_curvature.shape[:2])
        curvature[:, 6:, 6:] += weight * information
        force = prior.compute_force(vectors[:, rows])[:, -size:] - (information @ step[..., None])[..., 0]  # at the start
        gradient[:, 6:] = locked_gradient + weight * force
        step = np.linalg.solve(curvature, -gradient[..., None])[:, 6:, 0].clip(-MAX_CHANGE_RAD, MAX_CHANGE_RAD)
        vectors[:, joints] = start + step.reshape(start.shape)
        codes[:, : model.nonlinear_code_size] = prior.estimate_codes(vectors[:, rows])
    force = prior.compute_force(vectors[:, rows])[:, -size:].reshape(start.shape)
    blocks = prior.information[:, -size:, -size:]
    information = np.stack([blocks[:, n : n + 3, n : n + 3] for n in range(0, size, 3)], axis=1)
    rotations = compute_rotations(vectors[:, joints]) @ model.reference_rotations[joints]
    inverse = np.linalg.inv(compute_left_jacobian(vectors[:, joints]))  # vectors by rotations of the joint
    force = (np.swapaxes(inverse, -1, -2) @ force[..., None])[..., 0]
    information = np.swapaxes(inverse, -1, -2) @ information @ inverse
    deviation = np.sqrt(weight * (force * np.linalg.solve(information, force[..., None])[..., 0]).sum(-1))
    share = weight * np.minimum(1.0, MAX_DEVIATION_SD / np.maximum(deviation, 1e-9))
    locked_force, locked_information = compute_locked_prior(base, rotations, joints)
    information = share[..., None, None] * information + locked_information
    offset = np.linalg.solve(information, (share[..., None] * force + locked_force)[..., None])[..., 0]
    return PosePriorTerm(compute_rotations(-offset) @ rotations, information)


class LinearisedModel(NamedTuple):
    """A pose model near the codes of N frames: a Gaussian of R numbers of the pose, in radians.

    Where all frames have the same code, information and gain have one row for all.
    """

    mean: np.ndarray  # (N, R) of poses whose codes are distributed as in the model
    information: np.ndarray  # (N, R, R) inverse covariance of poses
    code_gain: np.ndarray  # (N, A, R) expected nonlinear dimensions of the code for a pose's deviation from the mean

    def compute_force(self, vectors: Float[np.ndarray, "N O 3"]) -> Float[np.ndarray, "N R"]:
        """Return the gradient of the cost, half the squared deviation in standard deviations, at poses."""
        return (self.information @ (vectors.reshape(len(vectors), -1) - self.mean)[..., None])[..., 0]

    def estimate_codes(self, vectors: Float[np.ndarray, "N O 3"]) -> Float[np.ndarray, "N A"]:
        """Return the most probable nonlinear dimensions of the codes of poses."""
        return (self.code_gain @ (vectors.reshape(len(vectors), -1) - self.mean)[..., None])[..., 0]


def compute_residual_information(model: PoseModel, joints: Int[np.ndarray, " O"]) -> Float[np.ndarray, "R R"]:
    """Return the inverse covariance in 1/rad^2 of the vectors of some joints about poses for all linear dimensions."""
    sd_rad = model.residual_sd_rad[joints]
    sd_rad = np.where(joints == 0, np.hypot(sd_rad, OBSERVED_JOINT_SD_RAD), sd_rad)
    covariance = np.diag(np.repeat(sd_rad, 3) ** 2)
    if model.nonlinear_code_size < model.code_size:
        jacobian = model.linearise(np.zeros((1, model.code_size)))[1][0, joints, :, model.nonlinear_code_size :]
        directions = jacobian.reshape(len(covariance), -1)
        covariance += directions @ directions.T
    return np.linalg.inv(covariance)


def linearise_model(
    model: PoseModel,
    vectors: Float[np.ndarray, "N J 3"],
    codes: Float[np.ndarray, "N P"],
    joints: Int[np.ndarray, " O"],
    residual_information: Float[np.ndarray, "R R"],
) -> LinearisedModel:
    """Return the model near given codes, whose linear dimensions are 0, for the vectors of some joints."""
    selected, size = model.select_components(vectors), model.nonlinear_code_size
    is_common = selected is model and not codes.any()
    decoded, jacobian = selected.linearise(codes[:1] if is_common else codes)
    slopes = jacobian[:, joints, :, :size].reshape(len(decoded), len(residual_information), size)
    mean = decoded[:, joints].reshape(len(decoded), -1) - (slopes @ codes[: len(decoded), :size, None])[..., 0]
    weighted = residual_information @ slopes
    code_gain = np.linalg.solve(np.swapaxes(slopes, 1, 2) @ weighted + np.eye(size), np.swapaxes(weighted, 1, 2))
    return LinearisedModel(mean, residual_information - weighted @ code_gain, code_gain)


def compute_locked_prior(
    base: MeanPosePrior, rotations: Float[np.ndarray, "N F 3 3"], joints: Int[np.ndarray, " F"]
) -> tuple[Float[np.ndarray, "N F 3"], Float[np.ndarray, "N F 3 3"]]:
    """Return force and information of the prior about locked axes, whose force is bounded."""
    error = rotations @ np.swapaxes(base.mean_rotations[joints], 1, 2)
    vectors = compute_rotation_vectors(error)
    force = (base.locked_information[joints] @ vectors[..., None])[..., 0]
    share = np.minimum(1.0, MAX_DEVIATION_SD / np.sqrt(np.maximum((force * vectors).sum(-1), 1e-12)))[..., None]
    return share * force, share[..., None] * base.locked_information[joints]


def apply_pose_prior(
    problem: PoseProblem, base: MeanPosePrior, prior: PriorConditioner, poses: Poses, held: Int[np.ndarray, " H"], rate: float
) -> Poses:
    """Return the poses that are most probable under the trained prior and the markers where solved poses place them.

    Args:
        problem: Of any frames: the body, its mean pose and its joint limits.
        base: The mean pose.
        prior: The trained prior.
        poses: The solved poses.
        held: Joints that keep their positions.
        rate: Poses per second.
    """
    tree, attachment = problem.tree, problem.attachment
    sampled = sample_evenly(len(poses[0]), 1 + math.ceil((len(poses[0]) - 1) / (MAX_SAMPLE_INTERVAL_S * rate)))
    term = build_frame_prior_term(prior.load_pose_model(), prior.prior_scale**-2, problem, base, poses, sampled)
    position, rotation = compute_tree_poses(tree, *poses)
    joints, offsets = np.r_[attachment.joints, held], np.r_[attachment.offsets, np.zeros((len(held), 3))]
    placed = position[:, joints] + (rotation[:, joints] @ offsets[..., None])[..., 0]
    sd_m = np.repeat([problem.marker_sd, HELD_JOINT_SD_M], [len(attachment.joints), len(held)])
    points = PointTerm(joints, offsets, np.ascontiguousarray(placed), np.tile(sd_m**-2, (len(placed), 1)))
    return minimise(tree, (points, build_no_tracking(len(tree.parents)), term, problem.joint_limits), poses).poses
