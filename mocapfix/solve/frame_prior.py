"""The frame prior: a trained pose model as a prior of every frame of a motion.

Under the model a pose is normally distributed about the decoded pose of its code, so that all its joints depend on each other.
The solver's prior term treats each joint by itself. So the most probable poses under markers and model are computed here, in
sampled frames, by dense Gauss-Newton steps in which the code is eliminated; in between, poses are interpolated. Each joint
gets the mean and the information with which the prior term has the model's gradient at these poses, and the curvature that the
model has for the joint if the others are given. The minimum of the solver's cost is then that of the cost with the model: joints
that markers determine are hardly affected, and those that they do not determine follow the rest of the body.

Errors of the model persist from frame to frame like those of the mean pose, so it has the same small weight in each.
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
from mocapfix.solve.parallel import run_in_parallel
from mocapfix.solve.prior_conditioner import OBSERVED_JOINT_SD_RAD

if TYPE_CHECKING:  # to keep the import layers few
    from mocapfix.solve.pose_problem import PoseProblem

MAX_SAMPLE_INTERVAL_S = 0.1
"""Largest time between the frames in which the model is evaluated."""
GAUSS_NEWTON_STEPS = 3
"""Steps towards the most probable pose; the model is linearised in each, the markers in the first."""
BATCH_FRAMES = 32
"""Sampled frames per batch; the derivatives of one frame take about 80 kB."""
MAX_DEVIATION_SD = 1.0
"""Deviation of a joint from what the model expects of it, in standard deviations, beyond which its force no longer grows."""
MAX_CHANGE_RAD = 2.0
"""Largest change, about an axis, of a rotation from the frame's own solution."""
MIN_ROOT_CURVATURE = 1.0
"""Curvature, in 1/m^2 and 1/rad^2, that keeps the root where it is in frames without markers."""
SMALL_ANGLE_RAD = 1e-4
"""Angle below which the derivative of the exponential is given by its series."""


class SampledPrior(NamedTuple):
    """The prior of N sampled frames: mean rotations (N, J, 3, 3), and information (N, J, 3, 3) in 1/rad^2."""

    mean_rotations: np.ndarray
    information: np.ndarray


class WorldPoses(NamedTuple):
    """Poses of N frames: joint positions (N, J, 3) in metres and rotations (N, J, 3, 3) in the world; local rotations."""

    position: np.ndarray
    rotation: np.ndarray
    local_rotations: np.ndarray


class MarkerEquations(NamedTuple):
    """The quadratic cost of the markers of N frames about their poses, in root position, root rotation and pose vectors.

    curvature  (N, 6 + 3 F, 6 + 3 F)
    gradient   (N, 6 + 3 F)
    """

    curvature: np.ndarray
    gradient: np.ndarray


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

    weight         of the model in a frame; less than 1, since neighbouring frames show the same pose
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
    for _ in range(GAUSS_NEWTON_STEPS):
        prior = linearise_model(model, vectors, codes, rows)
        curvature, gradient = equations.curvature.copy(), equations.gradient.copy()
        information = prior.information[:, -size:, -size:]
        curvature[:, 6:, 6:] += weight * information
        force = prior.compute_force(vectors[:, rows])[:, -size:] - (information @ step[..., None])[..., 0]  # at the start
        gradient[:, 6:] += weight * force
        step = np.linalg.solve(curvature, -gradient[..., None])[:, 6:, 0].clip(-MAX_CHANGE_RAD, MAX_CHANGE_RAD)
        vectors[:, joints] = start + step.reshape(start.shape)
        codes = prior.estimate_codes(vectors[:, rows])
    prior = linearise_model(model, vectors, codes, rows)
    force = prior.compute_force(vectors[:, rows])[:, -size:].reshape(start.shape)
    information = extract_diagonal_blocks(prior.information[:, -size:, -size:])
    rotations = convert_to_rotations(vectors[:, joints]) @ model.reference_rotations[joints]
    inverse = np.linalg.inv(compute_left_jacobian(vectors[:, joints]))  # vectors by rotations of the joint
    force = (np.swapaxes(inverse, -1, -2) @ force[..., None])[..., 0]
    information = np.swapaxes(inverse, -1, -2) @ information @ inverse
    deviation = np.sqrt(weight * (force * np.linalg.solve(information, force[..., None])[..., 0]).sum(-1))
    share = weight * np.minimum(1.0, MAX_DEVIATION_SD / np.maximum(deviation, 1e-9))
    locked_force, locked_information = compute_locked_prior(base, rotations, joints)
    information = share[..., None, None] * information + locked_information
    offset = np.linalg.solve(information, (share[..., None] * force + locked_force)[..., None])[..., 0]
    return SampledPrior(convert_to_rotations(-offset) @ rotations, information)


class LinearisedModel(NamedTuple):
    """A pose model near the codes of N frames: a Gaussian of R numbers of the pose, in radians.

    mean         (N, R) of poses, the code being distributed as in the model
    information  (N, R, R) inverse covariance of poses
    code_gain    (N, P, R) expected code for a pose's deviation from the mean
    """

    mean: np.ndarray
    information: np.ndarray
    code_gain: np.ndarray

    def compute_force(self, vectors: Float[np.ndarray, "N O 3"]) -> Float[np.ndarray, "N R"]:
        """Return the gradient of the cost, half the squared deviation in standard deviations, at poses."""
        return (self.information @ (vectors.reshape(self.mean.shape) - self.mean)[..., None])[..., 0]

    def estimate_codes(self, vectors: Float[np.ndarray, "N O 3"]) -> Float[np.ndarray, "N P"]:
        """Return the most probable codes of poses."""
        return (self.code_gain @ (vectors.reshape(self.mean.shape) - self.mean)[..., None])[..., 0]


def linearise_model(
    model: PoseModel, vectors: Float[np.ndarray, "N J 3"], codes: Float[np.ndarray, "N P"], joints: Int[np.ndarray, " O"]
) -> LinearisedModel:
    """Return the model near given codes, for the vectors of some joints."""
    decoded, jacobian = model.select_components(vectors).linearise(codes)
    sd_rad = np.where(joints == 0, np.hypot(model.residual_sd_rad[joints], OBSERVED_JOINT_SD_RAD), model.residual_sd_rad[joints])
    sd = np.repeat(sd_rad, 3)
    slopes = jacobian[:, joints].reshape(len(codes), len(sd), -1)
    mean = decoded[:, joints].reshape(len(codes), -1) - (slopes @ codes[..., None])[..., 0]
    scaled = slopes / sd[:, None]
    transposed = np.swapaxes(scaled, 1, 2)
    code_gain = np.linalg.solve(transposed @ scaled + np.eye(scaled.shape[2]), transposed)
    information = (np.eye(len(sd)) - scaled @ code_gain) / np.outer(sd, sd)
    return LinearisedModel(mean, information, code_gain / sd)


def compute_locked_prior(
    base: MeanPosePrior, rotations: Float[np.ndarray, "N F 3 3"], joints: Int[np.ndarray, " F"]
) -> tuple[Float[np.ndarray, "N F 3"], Float[np.ndarray, "N F 3 3"]]:
    """Return force and information of the prior about locked axes, whose force is bounded."""
    error = (rotations @ np.swapaxes(base.mean_rotations[joints], 1, 2)).reshape(-1, 3, 3)
    vectors = Rotation.from_matrix(error).as_rotvec().reshape(rotations.shape[:3])
    force = (base.locked_information[joints] @ vectors[..., None])[..., 0]
    share = np.minimum(1.0, MAX_DEVIATION_SD / np.sqrt(np.maximum((force * vectors).sum(-1), 1e-12)))[..., None]
    return share * force, share[..., None] * base.locked_information[joints]


def compute_marker_equations(
    problem: "PoseProblem", pose: WorldPoses, jacobian: Float[np.ndarray, "N F 3 3"], robust_scale_m: float
) -> MarkerEquations:
    """Return the cost of the markers of a problem's frames about poses.

    jacobian  rotation of each free joint, in its parent's axes, by its pose vector
    """
    tree, attachment = problem.tree, problem.attachment
    joints = np.flatnonzero(tree.free)[1:]
    position, rotation, _ = pose
    carried = attachment.joints
    markers = position[:, carried] + (rotation[:, carried] @ attachment.offsets[..., None])[..., 0]
    error = np.where(problem.solver_mask[..., None], markers - problem.marker_positions, 0.0)
    scale2 = (robust_scale_m / problem.marker_sd) ** 2
    square = (error**2).sum(-1) / problem.marker_sd**2
    weight = problem.solver_mask * (scale2 / (scale2 + square)) ** 2 / problem.marker_sd**2
    slopes = np.zeros((*markers.shape, 6 + 3 * len(joints)))
    slopes[..., :3] = np.eye(3)
    arm = markers - position[:, :1]
    slopes[..., 3:6] = cross_columns(np.broadcast_to(np.eye(3), (*arm.shape, 3)), arm)
    is_below = find_moved_joints(tree.parents)
    for n, j in enumerate(joints.tolist()):
        moved = np.flatnonzero(is_below[j, carried])
        axes = rotation[:, tree.parents[j]] @ jacobian[:, n]
        arm = markers[:, moved] - position[:, j : j + 1]
        slopes[:, moved, :, 6 + 3 * n : 9 + 3 * n] = cross_columns(axes[:, None], arm)
    flat = slopes.reshape(len(slopes), -1, slopes.shape[-1])
    weighted = np.swapaxes(flat * np.repeat(weight, 3, axis=1)[..., None], 1, 2)
    curvature = weighted @ flat
    curvature[:, range(6), range(6)] += MIN_ROOT_CURVATURE
    return MarkerEquations(curvature, (weighted @ error.reshape(len(error), -1, 1))[..., 0])


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
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*vectors.shape, 3)
    return np.eye(3) + first[..., None, None] * cross + second[..., None, None] * (cross @ cross)


def convert_to_rotations(vectors: Float[np.ndarray, "N F 3"]) -> Float[np.ndarray, "N F 3 3"]:
    """Return the rotations of rotation vectors in radians."""
    return Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(*vectors.shape, 3)


def add_diagonal_blocks(matrices: Float[np.ndarray, "N D D"], blocks: Float[np.ndarray, "N F 3 3"]) -> None:
    """Add blocks to the diagonal of matrices, after the six numbers of the root."""
    for n in range(blocks.shape[1]):
        part = slice(6 + 3 * n, 9 + 3 * n)
        matrices[:, part, part] += blocks[:, n]


def extract_diagonal_blocks(matrices: Float[np.ndarray, "N R R"]) -> Float[np.ndarray, "N F 3 3"]:
    """Return the 3 x 3 blocks on the diagonal of matrices."""
    return np.stack([matrices[:, n : n + 3, n : n + 3] for n in range(0, matrices.shape[1], 3)], axis=1)
