"""Calibration of a hand: what is the same in all frames of a take.

That is lengths, the bases of the rays, the place of the palm on the body, the mean pose, and the places of the markers. They are
minimised together, the poses of the frames adapting (Gauss-Newton with the poses eliminated; `solve.minimise.minimise_shared`),
with the logarithm of the determinant of the poses' curvature added to the cost (Laplace's approximation).
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.hands.calibrated_hand import (
    MARKER_SD_M,
    POSE_ITERATIONS,
    ROBUST_SCALES_M,
    CalibratedHand,
    PalmPath,
    linearise_hand_prior,
    minimise_hand_poses,
)
from mocapfix.hands.finger_markers import FingerMarkers
from mocapfix.hands.hand_model import HAND_JOINTS, RAY_BASES, RAY_ROOTS, TIP_JOINTS, load_hand
from mocapfix.solve.kinematics import Poses, compute_tree_poses
from mocapfix.solve.minimise import compute_costs, minimise_shared
from mocapfix.solve.terms import MarkerAttachment, compute_robust_weights
from mocapfix.stats.rigid_alignment import build_cross_matrices, compute_rotation_vectors, compute_rotations
from mocapfix.stats.sequences import sample_evenly

MAX_CALIBRATION_FRAMES = 40
MIN_CALIBRATION_SHARE = 0.6  # of a hand's markers that a frame of the calibration shows
MAX_INDEPENDENT_FRAMES = 5  # that a calibration counts: hands that are not the model's differ in the same way in similar poses
SKIN_PERSISTENCE_S = 0.3  # time in which a marker's displacement on the skin counts once
MAX_CALIBRATION_ROUNDS = 8


class _Linearisation(NamedTuple):
    """Residuals or points of N frames, and their derivatives to the poses and to the unknowns."""

    values: np.ndarray
    of_pose: np.ndarray
    of_unknowns: np.ndarray  # of residuals only the first, which depend on them


class _CalibrationState(NamedTuple):
    """Unknowns of a hand, in standard deviations of their prior, with the poses of the frames solved."""

    unknowns: np.ndarray
    cost: float
    gradient: np.ndarray
    poses: Poses
    points: _Linearisation  # in the world, metres: the markers, the 15 joints and the five tips
    rows: _Linearisation  # all residuals over their standard deviations


@dataclass(frozen=True)
class _HandCalibration:
    """The problem of calibration: N frames of a hand, and its unknowns.

    They are the hand's length, its 15 bones and five tips, the bases of its rays on the palm, place and rotation of the palm, the
    mean code of the take, the mean angles of its joints, and the places of K markers.
    """

    start: CalibratedHand  # the average hand of a person of this size
    markers: Float[np.ndarray, "N K 3"]
    is_used: Bool[np.ndarray, "N K"]
    palm: PalmPath
    frame_weight: float
    robust_scale_m: float

    @property
    def splits(self) -> Int[np.ndarray, "7"]:
        bones, codes = len(HAND_JOINTS) + len(TIP_JOINTS), self.start.model.prior.code_size
        return np.cumsum([1, bones, 3 * len(RAY_BASES), 3, 3, codes, 3 * len(HAND_JOINTS)])

    @property
    def size(self) -> int:
        return int(self.splits[-1]) + self.start.marker_offsets.size

    @property
    def pose_size(self) -> int:
        return 6 + 3 * len(HAND_JOINTS) + self.start.model.prior.code_size

    def build_hand(self, unknowns: np.ndarray) -> CalibratedHand:
        """Return the hand with these unknowns."""
        length, bones, bases, position, rotation, code, angles, offsets = np.split(unknowns, self.splits)
        start, model = self.start, self.start.model
        factors = (1 + model.length_relative_sd * length) * (1 + model.bone_relative_sd * bones)
        mean_angles = np.zeros(model.prior.mean_vectors.shape)
        mean_angles[HAND_JOINTS] = angles.reshape(-1, 3)
        prior = model.prior.condition_on_take(code, mean_angles)
        spread = start.markers.markers.marker_spread[:, None]
        return replace(
            start,
            model=replace(model.scale(factors, model.base_sd_m * bases.reshape(-1, 3)), prior=prior),
            palm_position=start.palm_position + model.palm_position_sd_m * position,
            palm_rotation=compute_rotations(model.palm_rotation_sd_rad * rotation),
            marker_offsets=start.marker_offsets + spread * offsets.reshape(-1, 3),
        )

    def minimise(self, unknowns: np.ndarray, poses: Poses) -> _CalibrationState:
        """Return the state of least cost, from these unknowns and poses."""
        return minimise_shared(
            lambda trial, state: self.fit(trial, state.poses), self.fit(unknowns, poses),
            lambda state: self.eliminate_poses(state)[0], MAX_CALIBRATION_ROUNDS,
        )[0]  # fmt: skip

    def fit(self, unknowns: np.ndarray, start: Poses) -> _CalibrationState:
        """Return the state at these unknowns; the poses start from others."""
        hand = self.build_hand(unknowns)
        terms = hand.build_terms(self.markers, self.is_used, hand.track_palm(self.palm))
        poses, codes = minimise_hand_poses(hand, terms, start, (self.robust_scale_m,), POSE_ITERATIONS)
        latent = linearise_hand_prior(hand, len(codes))
        costs = compute_costs(hand.tree, (*terms, latent), poses, (self.robust_scale_m / MARKER_SD_M) ** 2, codes=codes)
        points = self._differentiate_points(hand, unknowns, poses)
        rows = self._linearise(hand, poses, codes, points)
        volume, of_volume = self._measure_volume(hand, poses, points, rows)
        of_rows = np.tensordot(rows.values[:, : rows.of_unknowns.shape[1]], rows.of_unknowns, 2)
        gradient = self.frame_weight * (of_rows + of_volume) + unknowns
        cost = self.frame_weight * (float(costs.sum()) + volume) + 0.5 * float(unknowns @ unknowns)
        return _CalibrationState(unknowns, cost, gradient, poses, points, rows)

    def _measure_volume(
        self, hand: CalibratedHand, poses: Poses, points: _Linearisation, rows: _Linearisation
    ) -> tuple[float, Float[np.ndarray, " Q"]]:
        """Return half the logarithm of the determinant of the poses' curvature, and its gradient, with the poses fixed.

        With it the cost is that of the unknowns whatever the poses (Laplace's approximation). Without it, longer fingers would
        always be better: they bend less.
        """
        curvature = rows.of_pose.swapaxes(-1, -2) @ rows.of_pose
        joints, (count, markers) = hand.attachment.joints, self.is_used.shape
        rotation, moves = compute_tree_poses(hand.tree, *poses)[1], points.of_unknowns
        leverage = np.linalg.solve(curvature, rows.of_pose[:, : 3 * markers].swapaxes(-1, -2)).swapaxes(-1, -2)
        leverage = leverage.reshape(count, -1, 3, self.pose_size) * self._weigh_markers(hand, points)[..., None, None]
        gradient = np.zeros(self.size)
        columns: list[tuple[int, int | None, Int[np.ndarray, " N"]]] = [(3, None, np.arange(markers))]
        for index, joint in enumerate(HAND_JOINTS):
            last = RAY_ROOTS[index // 3] + 3
            columns.append((6 + 3 * index, index, np.flatnonzero((joints >= joint) & (joints <= last))))
        for first, index, beyond in columns:
            part = leverage[:, beyond, :, first : first + 3]
            if index is not None:
                part = part @ rotation[:, None, hand.model.skeleton.parents[HAND_JOINTS[index]]].swapaxes(-1, -2)
            turn = [part[..., 1, 2] - part[..., 2, 1], part[..., 2, 0] - part[..., 0, 2], part[..., 0, 1] - part[..., 1, 0]]
            turns = np.stack(turn, axis=-1)
            gradient += np.tensordot(turns, moves[:, beyond], 3)
            gradient -= 0.0 if index is None else np.tensordot(turns.sum(1), moves[:, markers + index], 2)
        return float(np.linalg.slogdet(curvature)[1].sum()) / 2, gradient

    def _weigh_markers(self, hand: CalibratedHand, points: _Linearisation) -> Float[np.ndarray, "N K"]:
        """Return one over the standard deviation of each sample, 0 for one that is not used; robust."""
        distance2 = ((points.values[:, : self.markers.shape[1]] - self.markers) ** 2).sum(-1)
        scale2 = (self.robust_scale_m / MARKER_SD_M) ** 2
        return np.sqrt(compute_robust_weights(distance2 / hand.marker_sd_m**2, scale2)) * self.is_used / hand.marker_sd_m

    def _linearise(self, hand: CalibratedHand, poses: Poses, codes: np.ndarray, points: _Linearisation) -> _Linearisation:
        """Return all residuals of the frames over their standard deviations, and their derivatives.

        A pose has the root's position and rotation in the world, the turns of the 15 joints in their parents' axes, and the code.
        """
        model, palm, prior, count, (root, local) = self.start.model, self.palm, hand.model.prior, len(codes), poses
        weight = self._weigh_markers(hand, points)
        error, *derivatives = (each[:, : weight.shape[1]] for each in points)
        weighted = (each * weight.reshape(*weight.shape, *[1] * (each.ndim - 2)) for each in (error - self.markers, *derivatives))
        markers = [each.reshape(count, -1, *each.shape[3:]) for each in weighted]
        target_root, target = hand.place_palm(palm)
        turn = compute_rotation_vectors(local[:, 0] @ target[:, 0].swapaxes(-1, -2))
        inverse_sd = np.repeat(np.stack([1 / palm.sd_m, 1 / palm.sd_rad], axis=1), 3, axis=1)
        of_palm, of_pose = np.zeros((2, count, 6, self.size)), np.zeros((count, 6, self.pose_size))
        places = slice(*self.splits[2:4]), slice(*self.splits[3:5])
        of_palm[0, :, :3, places[0]] = -model.palm_position_sd_m * palm.rotation
        of_palm[0, :, 3:, places[1]] = -model.palm_rotation_sd_rad * palm.hand_rotation
        of_pose[:, range(6), range(6)] = 1.0
        tracked = [each * inverse_sd.reshape(*inverse_sd.shape, *[1] * (each.ndim - 2))
                   for each in (np.concatenate([root - target_root, turn], axis=1), of_pose, of_palm[0])]  # fmt: skip
        vectors, free = compute_rotation_vectors(local[:, HAND_JOINTS]), slice(6, 6 + 3 * len(HAND_JOINTS))
        jacobian = _compute_logarithm_derivative(vectors)
        deviation, limit = vectors - prior.decode(codes)[:, HAND_JOINTS], hand.model.limits
        excess = vectors - np.clip(vectors, limit.lower_rad[HAND_JOINTS], limit.upper_rad[HAND_JOINTS])
        modes = prior.components[:, HAND_JOINTS].reshape(prior.code_size, -1)
        of_vectors = np.zeros((count, 3 * len(HAND_JOINTS), self.pose_size))
        for j in range(len(HAND_JOINTS)):
            of_vectors[:, 3 * j : 3 * j + 3, 6 + 3 * j : 9 + 3 * j] = jacobian[:, j]
        of_deviation, of_mean = of_vectors.copy(), np.zeros((count, 3 * len(HAND_JOINTS), self.size))
        of_deviation[..., free.stop :] = -modes.T
        of_mean[..., slice(*self.splits[4:6])] = -np.sqrt(1 / prior.within_share - 1) * modes.T
        of_mean[..., slice(*self.splits[5:7])] = -np.diag(prior.mean_axis_sd_rad[HAND_JOINTS].ravel())
        sd = prior.axis_sd_rad[HAND_JOINTS].ravel()
        joints = [deviation.reshape(count, -1) / sd, of_deviation / sd[:, None], of_mean / sd[:, None]]
        is_beyond = (excess != 0).reshape(count, -1) / hand.model.limit_sd_rad
        limits = [excess.reshape(count, -1) / hand.model.limit_sd_rad, of_vectors * is_beyond[..., None]]
        of_code = np.zeros((count, prior.code_size, self.pose_size))
        of_code[..., free.stop :] = np.eye(prior.code_size)
        parts = zip(markers, tracked, joints, [*limits, of_mean[:, :0]], [codes, of_code, of_mean[:, :0]], strict=True)
        return _Linearisation(*(np.concatenate(each, axis=1) for each in parts))

    def _differentiate_points(self, hand: CalibratedHand, unknowns: np.ndarray, poses: Poses) -> _Linearisation:
        """Return markers, joints and tips (N, K + 20, 3) in the world, and their derivatives to the poses and to the unknowns."""
        position, rotation = compute_tree_poses(hand.tree, *poses)
        offsets = np.concatenate([hand.marker_offsets, np.zeros((len(HAND_JOINTS), 3)), hand.model.tips])
        points = MarkerAttachment(np.concatenate([hand.attachment.joints, HAND_JOINTS, TIP_JOINTS]), offsets)
        place = position[:, points.joints] + (rotation[:, points.joints] @ points.offsets[..., None])[..., 0]
        of_pose = np.zeros((*place.shape, self.pose_size))
        of_unknowns, of_bones = np.zeros((*place.shape, self.size)), np.zeros((*place.shape, len(HAND_JOINTS) + len(TIP_JOINTS)))
        of_pose[..., :3] = np.eye(3)
        of_pose[..., 3:6] = -build_cross_matrices(place - position[:, :1])
        length, bones, *_ = np.split(unknowns, self.splits)
        model, parents = self.start.model, hand.model.skeleton.parents
        factors = (1 + model.length_relative_sd * length) * (1 + model.bone_relative_sd * bones)
        for index, joint in enumerate(HAND_JOINTS):
            last = RAY_ROOTS[index // 3] + 3
            beyond = np.flatnonzero((points.joints >= joint) & (points.joints <= last))
            lever = build_cross_matrices(place[:, beyond] - position[:, joint, None])
            of_pose[:, beyond, :, 6 + 3 * index : 9 + 3 * index] = -lever @ rotation[:, None, parents[joint]]
            parent = 0 if index == 0 else parents[joint]  # the root of the thumb's ray moves with its first joint
            of_bones[..., index][:, beyond] = ((position[:, joint] - position[:, parent]) / factors[index])[:, None]
        for ray, joint in enumerate(TIP_JOINTS):
            along = place[:, -len(TIP_JOINTS) + ray] - position[:, joint]
            of_bones[:, -len(TIP_JOINTS) + ray, :, len(HAND_JOINTS) + ray] = along / factors[len(HAND_JOINTS) + ray]
        for ray, base in enumerate(RAY_BASES):
            beyond = np.flatnonzero((points.joints > RAY_ROOTS[ray]) & (points.joints <= RAY_ROOTS[ray] + 3))
            own = self.splits[1] + 3 * ray
            of_unknowns[:, beyond, :, own : own + 3] = model.base_sd_m * factors[3 * ray] * rotation[:, parents[base], None]
        of_unknowns[..., 0] = of_bones @ (model.length_relative_sd * (1 + model.bone_relative_sd * bones))
        of_unknowns[..., 1 : self.splits[1]] = of_bones * model.bone_relative_sd * (1 + model.length_relative_sd * length)
        for k, spread in enumerate(hand.markers.markers.marker_spread):
            own = self.splits[-1] + 3 * k
            of_unknowns[:, k, :, own : own + 3] = spread * rotation[:, points.joints[k]]
        return _Linearisation(place, of_pose, of_unknowns)

    def eliminate_poses(self, state: _CalibrationState) -> tuple[Float[np.ndarray, "Q Q"], Float[np.ndarray, "N D Q"]]:
        """Return the curvature of the cost, and how the poses adapt to the unknowns (Gauss-Newton)."""
        rows = state.rows
        by_pose = rows.of_pose.swapaxes(-1, -2)
        mixed = by_pose[..., : rows.of_unknowns.shape[1]] @ rows.of_unknowns
        response = -np.linalg.solve(by_pose @ rows.of_pose, mixed)
        rows_of_frames = [0, 1], [0, 1]
        reduced = np.tensordot(rows.of_unknowns, rows.of_unknowns, rows_of_frames) + np.tensordot(mixed, response, rows_of_frames)
        return self.frame_weight * reduced + np.eye(self.size), response

    def compute_point_sd(self, state: _CalibrationState) -> Float[np.ndarray, "20"]:
        """Return what the uncertainty of the unknowns adds to that of joints and tips, per axis, in metres."""
        curvature, response = self.eliminate_poses(state)
        _, of_pose, of_unknowns = (each[:, self.markers.shape[1] :] for each in state.points)
        changes = of_unknowns + of_pose @ response[:, None]
        deviations = changes @ np.linalg.cholesky(np.linalg.inv(curvature))
        return np.sqrt((deviations**2).sum(-1).mean((0, 2)))


def _compute_logarithm_derivative(vectors: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3 3"]:
    """Return the derivatives of rotation vectors to a further turn about their parents' axes (Sola et al. 2018, Eq. 146)."""
    half = np.maximum(np.linalg.norm(vectors, axis=-1), 1e-4)[..., None, None] / 2
    cross = build_cross_matrices(vectors)
    return np.eye(3) - cross / 2 + (1 - half / np.tan(half)) / (2 * half) ** 2 * (cross @ cross)


def build_average_hand(finger_markers: FingerMarkers, size_ratio: float) -> CalibratedHand:
    """Return the average hand of a person of a size relative to the average one."""
    model, count = load_hand(finger_markers.side), len(HAND_JOINTS) + len(TIP_JOINTS)
    usual, place = model.scale(np.full(count, size_ratio)), model.palm_position * size_ratio
    offsets = finger_markers.markers.marker_offsets * size_ratio
    return CalibratedHand(usual, place, np.eye(3), finger_markers, offsets, np.zeros(count))


def calibrate_hand(
    finger_markers: FingerMarkers,
    markers: Float[np.ndarray, "T K 3"],
    is_used: Bool[np.ndarray, "T K"],
    palm: PalmPath,
    rate: float,
    size_ratio: float,
) -> CalibratedHand:
    """Return the hand of a take.

    Args:
        markers: In metres, NaN where missing.
        is_used: The samples that the solver may use.
        palm: What the body says of the palm.
        rate: Frames per second.
        size_ratio: Of the person's body to the average one.
    """
    average = build_average_hand(finger_markers, size_ratio)
    shown = np.flatnonzero(is_used.mean(1) >= MIN_CALIBRATION_SHARE * min(1.0, is_used.mean(1).max()))
    frames = shown[sample_evenly(len(shown), MAX_CALIBRATION_FRAMES)]
    weight = min(MAX_INDEPENDENT_FRAMES, len(shown) / rate / SKIN_PERSISTENCE_S, len(frames)) / len(frames)
    part = np.where(is_used[frames, :, None], markers[frames], 0.0), is_used[frames], palm.select_frames(frames)
    problem = _HandCalibration(average, *part, weight, ROBUST_SCALES_M[0])
    state = problem.minimise(np.zeros(problem.size), average.place_palm(part[2]))
    problem = replace(problem, robust_scale_m=ROBUST_SCALES_M[1])
    state = problem.minimise(state.unknowns, state.poses)
    return replace(problem.build_hand(state.unknowns), point_sd_m=problem.compute_point_sd(state))
