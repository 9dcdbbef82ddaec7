"""The window solver: the poses of consecutive frames, without the inference of limbs that no marker shows.

Each frame is solved on its own first. The joints' smooth trajectories through these solutions, weighted by their uncertainty,
then enter a second solve as tracking terms, which couple the frames.

Limbs that this leaves although their markers are visible are recovered. A solve goes to the nearest minimum: from a start with a
limb far away, the narrow robust scale makes outliers of all the limb's markers. So frames in which a limb is lost although its
markers keep their distances (`lost_in_sight`), and those that fit their markers worse than the frame's own solution did, are
solved again from other starts, from wide robust scales to narrow ones; the solution of least marker cost is kept.

A trained pose model as a prior of every frame makes all joints depend on each other, while the solver's prior term treats each
joint by itself. So the most probable poses under markers and model are computed here, in sampled frames, by dense Gauss-Newton
steps in which the code is eliminated; in between, poses are interpolated. Each joint gets the mean and the information with which
the prior term has the model's gradient at these poses, and the curvature that the model has for the joint if the others are
given. The minimum of the solver's cost is then that of the cost with the model.

Unlike the mean pose, the model has its full weight in every frame. Its errors persist from frame to frame, but so do those of
markers about their places on the skin, and it does not attract a person to the pose of others. On people that were not trained
on, a tenth and a hundredth of the weight gave greater errors with all sets of markers, and three times the weight with most.
"""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.kernels import lie
from mocapfix.model.motion import PoseEvidence, PoseUncertainty
from mocapfix.model.subject import Subject
from mocapfix.options import SolveOptions
from mocapfix.solve import kinematics, smoothing
from mocapfix.solve.kinematics import Poses, compute_tree_poses, predict_markers
from mocapfix.solve.lost_in_sight import find_lost_parts
from mocapfix.solve.mean_pose import MeanPosePrior
from mocapfix.solve.parallel import order_from_gap_ends, order_independently, run_in_parallel
from mocapfix.solve.pose_prior import PoseModel, compute_pose_vectors
from mocapfix.solve.pose_problem import MotionProblem, PoseProblem, find_key_frames, list_posed_frames
from mocapfix.solve.prior_conditioner import OBSERVED_JOINT_SD_RAD, PriorConditioner
from mocapfix.solve.segment_registration import register_poses
from mocapfix.solve.terms import PosePriorTerm, TrackingTerm, compute_robust_costs, compute_robust_weights
from mocapfix.stats.rigid_alignment import compute_lengths, compute_rotation_vectors, compute_rotations
from mocapfix.stats.sequences import find_runs, interpolate_rows, sample_evenly

MIN_ROOT_CURVATURE = 1.0  # curvature, in 1/m^2 and 1/rad^2, that keeps the root where it is in frames without markers
SMALL_ANGLE_RAD = 1e-4  # angle below which the derivative of the exponential is given by its series


class WorldPoses(NamedTuple):
    """Poses of N frames: joint positions (N, J, 3) in metres and rotations (N, J, 3, 3) in the world; local rotations."""

    position: np.ndarray
    rotation: np.ndarray
    local_rotations: np.ndarray


def compute_marker_equations(
    problem: PoseProblem, pose: WorldPoses, jacobian: Float[np.ndarray, "N F 3 3"], robust_scale_m: float
) -> tuple[Float[np.ndarray, "N D D"], Float[np.ndarray, "N D"]]:
    """Return curvature and gradient of the cost of the markers about poses, in root position, root rotation and pose vectors.

    Args:
        jacobian: Rotation of each of F free joints, in its parent's axes, by its pose vector; D = 6 + 3 F.
    """
    tree, attachment = problem.tree, problem.attachment
    joints = np.flatnonzero(tree.free)[1:]
    position, rotation, _ = pose
    carried = attachment.joints
    markers = position[:, carried] + (rotation[:, carried] @ attachment.offsets[..., None])[..., 0]
    error = np.where(problem.solver_mask[..., None], markers - problem.marker_positions, 0.0)
    scale2 = (robust_scale_m / problem.marker_sd) ** 2
    square = (error**2).sum(-1) / problem.marker_sd**2
    weight = problem.solver_mask * compute_robust_weights(square, scale2) / problem.marker_sd**2
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
    return curvature, ((weighted @ error.reshape(len(error), -1, 1))[..., 0])


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


MAX_SAMPLE_INTERVAL_S = 0.1  # largest time between the frames in which the model is evaluated
GAUSS_NEWTON_STEPS = 2  # steps towards the most probable pose; the model is linearised in each, the markers in the first only
BATCH_FRAMES = 32  # sampled frames per batch; the derivatives of one frame take about 80 kB
MAX_DEVIATION_SD = 1.0  # of a joint from what the model expects, beyond which its force no longer grows
MAX_CHANGE_RAD = 2.0  # largest change, about an axis, of a rotation from the frame's own solution


class SampledPrior(NamedTuple):
    """The prior of N sampled frames: mean rotations (N, J, 3, 3), and information (N, J, 3, 3) in 1/rad^2."""

    mean_rotations: np.ndarray
    information: np.ndarray


def build_frame_prior_term(
    model: PoseModel,
    weight: float,
    problem: PoseProblem,
    base: MeanPosePrior,
    pose: Poses,
    is_unobserved: Bool[np.ndarray, "T J"],
    *,
    frames: Int[np.ndarray, " N"],
    robust_scale_m: float,
) -> PosePriorTerm:
    """Return the prior term of every frame, from the poses of the frames' own solution.

    Args:
        weight: Inverse square of the factor of the model's standard deviations.
        base: The mean pose; unobserved and fixed joints keep it, and all joints keep its information about locked axes.
        frames: Sampled frames, the first and the last among them.
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
        sequence = lie.extract_joint_quaternions(sampled.mean_rotations, j, known)
        lie.store_joint_quaternions((1 - part) * sequence[before] + part * sequence[after], j, means)
        values = sampled.information[:, j]
        information[:, j] = (1 - part[..., None]) * values[before] + part[..., None] * values[after]
    return PosePriorTerm(means, information)


def compute_sampled_prior(
    model: PoseModel, weight: float, problem: PoseProblem, base: MeanPosePrior, pose: WorldPoses, *, robust_scale_m: float
) -> SampledPrior:
    """Return means and information of the F free joints below the root in the frames of a problem."""
    joints = np.flatnonzero(problem.tree.free)[1:]
    size = 3 * len(joints)
    vectors = compute_pose_vectors(pose.local_rotations, model.reference_rotations)
    start, jacobian = vectors[:, joints], compute_left_jacobian(vectors[:, joints])
    marker_curvature, marker_gradient = compute_marker_equations(problem, pose, jacobian, robust_scale_m)
    locked_force, locked_information = compute_locked_prior(base, pose.local_rotations[:, joints], joints)
    transposed = np.swapaxes(jacobian, -1, -2)
    for n, block in enumerate(np.moveaxis(transposed @ locked_information @ jacobian, 1, 0)):
        part = slice(6 + 3 * n, 9 + 3 * n)  # after the six numbers of the root
        marker_curvature[:, part, part] += block
    marker_gradient[:, 6:] += (transposed @ locked_force[..., None]).reshape(-1, size)
    has_root_markers = bool((problem.attachment.joints == 0).any())
    rows = np.r_[0, joints] if has_root_markers else joints  # the markers of a part of a body do not show the root's tilt
    codes, step = np.zeros((len(vectors), model.code_size)), np.zeros((len(vectors), size))
    residual_information = compute_residual_information(model, rows)
    prior = linearise_model(model, vectors, codes, rows, residual_information)
    for n in range(GAUSS_NEWTON_STEPS):
        if n:
            prior = linearise_model(model, vectors, codes, rows, residual_information)
        information = prior.information[:, -size:, -size:]
        curvature, gradient = marker_curvature.copy(), marker_gradient.copy()
        curvature[:, 6:, 6:] += weight * information
        force = prior.compute_force(vectors[:, rows])[:, -size:] - (information @ step[..., None])[..., 0]  # at the start
        gradient[:, 6:] += weight * force
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
    return SampledPrior(compute_rotations(-offset) @ rotations, information)


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


MIN_RECOVERED_DISTANCE_M = 0.04  # mean, of a limb's markers, above which its frame is solved again
MAX_COST_INCREASE = 10.0
"""Increase of a frame's marker cost over that of its own solution above which it is solved again. The tracking of smooth
trajectories increases it by up to 3."""
MIN_COST_IMPROVEMENT = 1.0  # decrease of the marker cost that another solution needs to replace the present one
RECOVERY_ROBUST_SCALES_M = (0.4, 0.2)  # robust scales before those of the options
COMPARED_ROBUST_SCALE_M = 0.2  # of marker costs: wide, so that a limb's markers count when they are far away


def recover_lost_limbs(
    problem: PoseProblem,
    subject: Subject,
    prior: MeanPosePrior,
    pose: Poses,
    *,
    own_pose: Poses,
    tracking: TrackingTerm,
    is_uncertain: Bool[np.ndarray, "T J"],
    options: SolveOptions,
) -> None:
    """Overwrite the poses of frames in which a limb was lost, where another start gives a better one.

    Args:
        pose: The solution with tracking; overwritten.
        own_pose: The solution of each frame on its own.
        is_uncertain: Joints that lack a marker; only these keep following their smooth trajectories.
    """
    predicted = predict_markers(subject, pose)
    cost = compute_marker_cost(problem, predicted)
    is_worse = cost > compute_marker_cost(problem, predict_markers(subject, own_pose)) + MAX_COST_INCREASE
    measured, limit_m = (problem.marker_positions, problem.solver_mask), MIN_RECOVERED_DISTANCE_M
    lost_parts = find_lost_parts(*measured, subject, predicted, min_distance_m=limit_m, min_off_share=0.0)
    is_lost = np.logical_or.reduce([is_worse, *(part.frames for part in lost_parts)])
    frames = np.flatnonzero(is_lost)
    if not len(frames):
        return
    part = problem.select_frames(frames)
    rows = np.minimum(frames, len(tracking.root) - 1)  # the tracked pose is one for each frame, or one for all
    weight = np.where(is_uncertain[frames], tracking.weight[rows], 0.0)
    part_tracking = TrackingTerm(tracking.rotations[rows], weight, tracking.root[rows], np.zeros(len(frames)))
    registered = register_poses(subject, problem.tree.free, prior, part.marker_positions)
    starts = [
        (own_pose[0][frames], own_pose[1][frames]),
        (registered.root_position, registered.local_rotations),
        *((pose[0][neighbours], pose[1][neighbours]) for neighbours in find_neighbours(is_lost, frames)),
    ]
    least_cost = cost[frames] - MIN_COST_IMPROVEMENT
    for start in starts:
        found = part.minimise(start, RECOVERY_ROBUST_SCALES_M + options.robust_scales_m, part_tracking)
        new_cost = compute_marker_cost(part, predict_markers(subject, found.poses))
        is_better = new_cost < least_cost
        for values, new_values in zip(pose, found.poses, strict=True):
            values[frames[is_better]] = new_values[is_better]
        least_cost = np.minimum(least_cost, new_cost)


def find_neighbours(is_lost: Bool[np.ndarray, " T"], frames: Int[np.ndarray, " N"]) -> list[Int[np.ndarray, " N"]]:
    """Return for each of some frames the last frame before it and the first after it in which no limb is lost.

    At an end of the take both are on the same side. If a limb is lost in all frames, there are none.
    """
    sound = np.flatnonzero(~is_lost)
    if not len(sound):
        return []
    position = np.searchsorted(sound, frames)
    return [sound[np.maximum(position - 1, 0)], sound[np.minimum(position, len(sound) - 1)]]


def compute_marker_cost(problem: PoseProblem, predicted: Float[np.ndarray, "T K 3"]) -> Float[np.ndarray, " T"]:
    """Return the cost of each frame's visible markers, half the sum of squares in standard deviations, at a wide robust scale."""
    square = (compute_lengths(problem.marker_positions - predicted) / problem.marker_sd) ** 2
    scale2 = (COMPARED_ROBUST_SCALE_M / problem.marker_sd) ** 2
    return np.where(problem.solver_mask, compute_robust_costs(square, scale2), 0.0).sum(1)


class WindowSolution(NamedTuple):
    """The solution of T consecutive frames: poses, status and iterations (T,), and the evidence."""

    poses: Poses
    status: np.ndarray
    iterations: np.ndarray
    evidence: PoseEvidence


def solve_window(window: MotionProblem, start: Poses, is_restarted: Bool[np.ndarray, " T"]) -> WindowSolution:
    """Return the solution of all frames of a window; `is_restarted` are those whose start may be far from it."""
    poses, iterations = solve_from_starts(window, start, is_restarted)
    if window.conditioner is not None:
        window = set_frame_prior(window, window.conditioner, poses)
        poses, more_iterations = solve_from_starts(window, poses, np.zeros(len(poses[0]), bool))
        iterations = iterations + more_iterations
    problem, options, rate = window.pose_problem, window.options, window.rate
    own_pose, known, gap_variance = solve_uncertain_frames(window, poses)
    root_position, local_rotations = own_pose
    tracking = smoothing.smooth_poses(root_position, local_rotations.copy(), known, window.is_uncertain, problem.tree.free, rate)
    tracked = np.where(window.is_unobserved[..., None, None], tracking.rotations, local_rotations)
    solution = problem.minimise((root_position, tracked), options.robust_scales_m[-1:], tracking)
    body, is_uncertain = (window.subject, window.prior), window.is_uncertain
    recover_lost_limbs(
        problem, *body, solution.poses, own_pose=own_pose, tracking=tracking, is_uncertain=is_uncertain, options=options
    )
    root_position, local_rotations = solution.poses
    anchor_position = root_position + kinematics.compute_anchor_offset(problem.tree, local_rotations)
    anchor_position = smoothing.remove_pose_jitter(
        anchor_position, local_rotations, window.is_uncertain, window.is_unobserved, problem.tree, rate
    )
    root_position[:] = anchor_position - kinematics.compute_anchor_offset(problem.tree, local_rotations)
    evidence = PoseEvidence(known.marker_sd, known.rotation_variance, gap_variance, tracking.root_weight)
    return WindowSolution(solution.poses, solution.status, iterations + solution.iterations, evidence)


def set_frame_prior(window: MotionProblem, conditioner: PriorConditioner, pose: Poses) -> MotionProblem:
    """Return the window with the trained prior in every frame, from the poses of each frame's own solution."""
    model, weight, scale_m = conditioner.load_pose_model(), conditioner.prior_scale**-2, window.options.robust_scales_m[-1]
    sample_count = 1 + math.ceil((len(pose[0]) - 1) / (MAX_SAMPLE_INTERVAL_S * window.rate))
    frames, start = sample_evenly(len(pose[0]), sample_count), (window.prior, pose, window.is_unobserved)
    term = build_frame_prior_term(model, weight, window.pose_problem, *start, frames=frames, robust_scale_m=scale_m)
    return replace(window, pose_problem=replace(window.pose_problem, pose_prior=term))


def solve_uncertain_frames(window: MotionProblem, poses: Poses) -> tuple[Poses, PoseUncertainty, np.ndarray]:
    """Solve frames with uncertain joints again from their neighbours, tracking an interpolation of each frame's own solution.

    Return poses, their uncertainty, and the variance (T, J) in rad^2 of the interpolated rotations of uncertain joints.
    """
    problem, is_uncertain, robust_scale_m = window.pose_problem, window.is_uncertain, window.options.robust_scales_m[-1]
    tracking, gap_variance = smoothing.track_across_gaps(poses[1], is_uncertain, window.rate)
    gaps = find_runs(np.any(is_uncertain, axis=1))
    if gaps:
        poses = problem.minimise(poses, (robust_scale_m,), tracking, order=order_from_gap_ends(gaps, is_uncertain)).poses
    frames = np.arange(len(poses[0]))
    known = np.flatnonzero(find_key_frames(frames, problem.solver_mask, window.rate))
    found = problem.select_frames(known).compute_uncertainty((poses[0][known], poses[1][known]), robust_scale_m)
    uncertainty = PoseUncertainty(*(interpolate_rows(each, known, frames) for each in found))
    tracked_variance = gap_variance + smoothing.ROTATION_TRACKING_SD_RAD**2
    rotation_variance = np.where(
        window.is_unobserved, np.minimum(uncertainty.rotation_variance, tracked_variance), uncertainty.rotation_variance
    )
    return poses, uncertainty._replace(rotation_variance=rotation_variance), gap_variance


def solve_from_starts(
    window: MotionProblem, start: Poses, is_restarted: Bool[np.ndarray, " T"]
) -> tuple[Poses, Int[np.ndarray, " T"]]:
    """Solve each frame on its own. Restarted frames whose markers are far from the body pass through all robust scales.

    Of a take whose frames are all restarted, those at POSE_RATE_HZ are solved first. The others start from the interpolation of
    these, or from their own start if that is nearer to their markers. Return poses and iterations.
    """
    problem, subject, scales_m = window.pose_problem, window.subject, window.options.robust_scales_m
    posed = list_posed_frames(len(start[0]), window.rate)
    if len(posed) == len(start[0]) or not is_restarted.all():
        return solve_independently(problem, subject, scales_m, is_restarted, start)
    between, iterations = np.delete(np.arange(len(start[0])), posed), np.empty(len(start[0]), int)
    parts = [(problem.select_frames(each), subject, scales_m, is_restarted[each]) for each in (posed, between)]
    known, iterations[posed] = solve_independently(*parts[0], (start[0][posed], start[1][posed]))
    poses = kinematics.interpolate_poses(known, posed, len(start[0]))
    start_cost, cost = (compute_marker_cost(problem, predict_markers(subject, each)) for each in (start, poses))
    nearer = between[(start_cost < cost)[between]]
    poses[0][nearer], poses[1][nearer] = start[0][nearer], start[1][nearer]
    found, iterations[between] = solve_independently(*parts[1], (poses[0][between], poses[1][between]))
    poses[0][between], poses[1][between] = found
    return poses, iterations


def solve_independently(
    problem: PoseProblem, subject: Subject, scales_m: tuple[float, ...], is_restarted: Bool[np.ndarray, " T"], start: Poses
) -> tuple[Poses, Int[np.ndarray, " T"]]:
    """Solve each frame from its start; return poses and iterations (see `solve_from_starts`)."""
    distance = compute_lengths(problem.marker_positions - predict_markers(subject, start))
    is_far = is_restarted & (distance > scales_m[-1]).any(1, where=problem.solver_mask)
    poses, iterations = start, np.zeros(len(is_far), int)
    for is_chosen, chosen_scales_m in ((is_far, scales_m), (~is_far, scales_m[-1:])):
        if is_chosen.any():
            order = order_independently(np.flatnonzero(is_chosen), start[1].shape[1])
            solution = problem.minimise(poses, chosen_scales_m, order=order)
            poses, iterations = solution.poses, iterations + solution.iterations
    return poses, iterations
