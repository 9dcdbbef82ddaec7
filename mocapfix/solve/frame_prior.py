"""The frame prior: a trained pose model as a prior of every frame of a motion.

Under the model a pose is normally distributed about the decoded pose of its code, so that all its joints depend on each other.
The solver's prior term treats each joint by itself. So the most probable poses under markers and model are computed here, in
sampled frames, by dense Gauss-Newton steps in which the code is eliminated; in between, poses are interpolated. Each joint
gets the mean and the information with which the prior term has the model's gradient at these poses, and the curvature that the
model has for the joint if the others are given. The minimum of the solver's cost is then that of the cost with the model: joints
that markers determine are hardly affected, and those that they do not determine follow the rest of the body.

Unlike the mean pose, the model has its full weight in every frame. Its errors persist from frame to frame, but so do those of
markers about their places on the skin, and it does not attract a person to the pose of others. On people that were not trained
on, a tenth and a hundredth of the weight gave greater errors with all sets of markers, and three times the weight with most.
"""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from mocapfix.kernels import quaternions
from mocapfix.kernels.terms import PosePriorTerm
from mocapfix.pose_prior.mean_pose import MeanPosePrior
from mocapfix.pose_prior.model import PoseModel, compute_pose_vectors
from mocapfix.solve.kinematics import Poses, compute_tree_poses
from mocapfix.solve.marker_equations import (
    WorldPoses,
    compute_left_jacobian,
    compute_marker_equations,
    exponentiate_vectors,
)
from mocapfix.solve.parallel import run_in_parallel
from mocapfix.solve.prior_conditioner import OBSERVED_JOINT_SD_RAD

if TYPE_CHECKING:  # to keep the import layers few
    from mocapfix.solve.pose_problem import PoseProblem

MAX_SAMPLE_INTERVAL_S = 0.1
"""Largest time between the frames in which the model is evaluated."""
GAUSS_NEWTON_STEPS = 2
"""Steps towards the most probable pose; the model is linearised in each, the markers in the first only."""
BATCH_FRAMES = 32
"""Sampled frames per batch; the derivatives of one frame take about 80 kB."""
MAX_DEVIATION_SD = 1.0
"""Deviation of a joint from what the model expects of it, in standard deviations, beyond which its force no longer grows."""
MAX_CHANGE_RAD = 2.0
"""Largest change, about an axis, of a rotation from the frame's own solution."""


class SampledPrior(NamedTuple):
    """The prior of N sampled frames: mean rotations (N, J, 3, 3), and information (N, J, 3, 3) in 1/rad^2."""

    mean_rotations: np.ndarray
    information: np.ndarray


def build_frame_prior_term(
    model: PoseModel,
    weight: float,
    problem: "PoseProblem",
    base: MeanPosePrior,
    pose: Poses,
    is_unobserved: Bool[np.ndarray, "T J"],
    *,
    frames: Int[np.ndarray, " N"],
    robust_scale_m: float,
) -> PosePriorTerm:
    """Return the prior term of every frame, from the poses of the frames' own solution.

    weight         inverse square of the factor of the model's standard deviations
    base           the mean pose; unobserved and fixed joints keep it, and all joints keep its information about locked axes
    frames         sampled frames, the first and the last among them
    """
    tree = problem.tree
    means, information = problem.pose_prior.rotations[0], problem.pose_prior.information[0]
    sampled = SampledPrior(np.tile(means, (len(frames), 1, 1, 1)), np.tile(information, (len(frames), 1, 1, 1)))
    joints = np.flatnonzero(tree.free)[1:]

    local_rotations = pose[1][frames]
    position, rotation = compute_tree_poses(tree, pose[0][frames], local_rotations)

    def compute_batch(rows: Int[np.ndarray, " B"]) -> None:
        part, batch_pose = problem.select_frames(frames[rows]), WorldPoses(position[rows], rotation[rows], local_rotations[rows])
        batch = compute_sampled_prior(model, weight, part, base, batch_pose, robust_scale_m=robust_scale_m)
        sampled.mean_rotations[np.ix_(rows, joints)], sampled.information[np.ix_(rows, joints)] = batch

    run_in_parallel(compute_batch, np.array_split(np.arange(len(frames)), -(-len(frames) // BATCH_FRAMES)))
    term = interpolate_sampled_prior(sampled, frames, joints)
    rows, unobserved = np.nonzero(is_unobserved)
    term.rotations[rows, unobserved], term.information[rows, unobserved] = means[unobserved], information[unobserved]
    return term


def interpolate_sampled_prior(
    sampled: SampledPrior, frames: Int[np.ndarray, " N"], joints: Int[np.ndarray, " F"]
) -> PosePriorTerm:
    """Return the prior of all frames between the first and the last sampled one, as a term."""
    every_frame = np.arange(frames[-1] + 1)
    after = np.clip(np.searchsorted(frames, every_frame), 1, max(len(frames) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(frames) - 1)
    share = (every_frame - frames[before]) / np.maximum(frames[after] - frames[before], 1)
    means = np.tile(sampled.mean_rotations[:1], (len(every_frame), 1, 1, 1))
    information = np.tile(sampled.information[:1], (len(every_frame), 1, 1, 1))
    known, part = np.ones(len(frames), bool), share[:, None]
    for j in joints.tolist():
        sequence = quaternions.extract_joint_quaternions(sampled.mean_rotations, j, known)
        quaternions.store_joint_quaternions((1 - part) * sequence[before] + part * sequence[after], j, means)
        values = sampled.information[:, j]
        information[:, j] = (1 - part[..., None]) * values[before] + part[..., None] * values[after]
    return PosePriorTerm(means, information)


def compute_sampled_prior(
    model: PoseModel, weight: float, problem: "PoseProblem", base: MeanPosePrior, pose: WorldPoses, *, robust_scale_m: float
) -> SampledPrior:
    """Return means and information of the F free joints below the root in the frames of a problem."""
    joints = np.flatnonzero(problem.tree.free)[1:]
    size = 3 * len(joints)
    vectors = compute_pose_vectors(pose.local_rotations, model.reference_rotations)
    start, jacobian = vectors[:, joints], compute_left_jacobian(vectors[:, joints])
    equations = compute_marker_equations(problem, pose, jacobian, robust_scale_m)
    locked_force, locked_information = compute_locked_prior(base, pose.local_rotations[:, joints], joints)
    transposed = np.swapaxes(jacobian, -1, -2)
    add_diagonal_blocks(equations.curvature, transposed @ locked_information @ jacobian)
    equations.gradient[:, 6:] += (transposed @ locked_force[..., None]).reshape(-1, size)
    has_root_markers = bool((problem.attachment.joints == 0).any())
    rows = np.r_[0, joints] if has_root_markers else joints  # the markers of a part of a body do not show the root's tilt
    codes, step = np.zeros((len(vectors), model.code_size)), np.zeros((len(vectors), size))
    residual_information = compute_residual_information(model, rows)
    prior = linearise_model(model, vectors, codes, rows, residual_information)
    for n in range(GAUSS_NEWTON_STEPS):
        if n:
            prior = linearise_model(model, vectors, codes, rows, residual_information)
        information = prior.information[:, -size:, -size:]
        curvature, gradient = equations.curvature.copy(), equations.gradient.copy()
        curvature[:, 6:, 6:] += weight * information
        force = prior.compute_force(vectors[:, rows])[:, -size:] - (information @ step[..., None])[..., 0]  # at the start
        gradient[:, 6:] += weight * force
        step = np.linalg.solve(curvature, -gradient[..., None])[:, 6:, 0].clip(-MAX_CHANGE_RAD, MAX_CHANGE_RAD)
        vectors[:, joints] = start + step.reshape(start.shape)
        codes[:, : model.nonlinear_code_size] = prior.estimate_codes(vectors[:, rows])
    force = prior.compute_force(vectors[:, rows])[:, -size:].reshape(start.shape)
    information = extract_diagonal_blocks(prior.information[:, -size:, -size:])
    rotations = exponentiate_vectors(vectors[:, joints]) @ model.reference_rotations[joints]
    inverse = np.linalg.inv(compute_left_jacobian(vectors[:, joints]))  # vectors by rotations of the joint
    force = (np.swapaxes(inverse, -1, -2) @ force[..., None])[..., 0]
    information = np.swapaxes(inverse, -1, -2) @ information @ inverse
    deviation = np.sqrt(weight * (force * np.linalg.solve(information, force[..., None])[..., 0]).sum(-1))
    share = weight * np.minimum(1.0, MAX_DEVIATION_SD / np.maximum(deviation, 1e-9))
    locked_force, locked_information = compute_locked_prior(base, rotations, joints)
    information = share[..., None, None] * information + locked_information
    offset = np.linalg.solve(information, (share[..., None] * force + locked_force)[..., None])[..., 0]
    return SampledPrior(exponentiate_vectors(-offset) @ rotations, information)


class LinearisedModel(NamedTuple):
    """A pose model near the codes of N frames: a Gaussian of R numbers of the pose, in radians.

    mean         (N, R) of poses whose codes are distributed as in the model
    information  (N, R, R) inverse covariance of poses
    code_gain    (N, A, R) expected nonlinear dimensions of the code for a pose's deviation from the mean

    Where all frames have the same code, information and gain have one row for all.
    """

    mean: np.ndarray
    information: np.ndarray
    code_gain: np.ndarray

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
    error = (rotations @ np.swapaxes(base.mean_rotations[joints], 1, 2)).reshape(-1, 3, 3)
    vectors = Rotation.from_matrix(error).as_rotvec().reshape(rotations.shape[:3])
    force = (base.locked_information[joints] @ vectors[..., None])[..., 0]
    share = np.minimum(1.0, MAX_DEVIATION_SD / np.sqrt(np.maximum((force * vectors).sum(-1), 1e-12)))[..., None]
    return share * force, share[..., None] * base.locked_information[joints]


def add_diagonal_blocks(matrices: Float[np.ndarray, "N D D"], blocks: Float[np.ndarray, "N F 3 3"]) -> None:
    """Add blocks to the diagonal of matrices, after the six numbers of the root."""
    for n in range(blocks.shape[1]):
        part = slice(6 + 3 * n, 9 + 3 * n)
        matrices[:, part, part] += blocks[:, n]


def extract_diagonal_blocks(matrices: Float[np.ndarray, "N R R"]) -> Float[np.ndarray, "N F 3 3"]:
    """Return the 3 x 3 blocks on the diagonal of matrices."""
    return np.stack([matrices[:, n : n + 3, n : n + 3] for n in range(0, matrices.shape[1], 3)], axis=1)
