"""The average body at a size, with the markers of a set, and its coarse fit to the markers of single frames.

Only the size of the average body is estimated from a take: from the distances between its markers.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from mocapfix.model.marker_set import MarkerSet
from mocapfix.model.skeleton import BodyModel, load_cmu31_body
from mocapfix.model.subject import Subject
from mocapfix.solve import kinematics
from mocapfix.solve.initial_motion import register_poses
from mocapfix.solve.kinematics import Poses
from mocapfix.solve.mean_pose import JointLimits, MeanPosePrior, load_joint_limits, load_mean_pose_prior
from mocapfix.solve.pose_problem import PoseProblem, build_marker_problem
from mocapfix.solve.terms import build_joint_limit_term, build_pose_prior_term
from mocapfix.stats.rigid_alignment import compute_lengths, compute_rotations, scale_rotations

MIN_PAIR_DISTANCE_M = 0.12  # of a pair that is used to estimate the size; nearer ones depend on marker placement
MIN_PAIR_FRAMES = 10  # frames in which both markers of a pair must be visible
MAX_DISTANCE_VARIATION = 0.03  # median absolute deviation per median; a pair that varies more spans a bending joint
MIN_SIZE_RATIO = 0.3  # smallest accepted size relative to the average body: a baby
MAX_SIZE_RATIO = 1.6  # largest accepted size relative to the average body: larger than any person


def estimate_body_size_ratio(
    marker_set: MarkerSet, markers: Float[np.ndarray, "T K 3"], min_frames: int = MIN_PAIR_FRAMES
) -> float:
    """Return the subject's size relative to the average body, from marker distances that stay constant during the motion.

    Pairs of markers on one joint, or on a joint and its parent (a knee and an ankle marker), are used. The result is the weighted
    median over pairs of each pair's median over frames, limited to MIN_SIZE_RATIO..MAX_SIZE_RATIO; 1 if no pair qualifies.

    Args:
        markers: Metres, NaN if not visible or an outlier.
        min_frames: Frames in which both markers of a pair must be visible.
    """
    nominal = compute_rest_marker_positions(marker_set)
    ratios: list[float] = []
    weights: list[float] = []
    for a, b in zip(*find_near_pairs(marker_set.joints), strict=True):
        expected = np.linalg.norm(nominal[a] - nominal[b])
        distance = compute_lengths(markers[:, a] - markers[:, b])
        distance = distance[~np.isnan(distance)]
        if expected < MIN_PAIR_DISTANCE_M or len(distance) < min_frames:
            continue
        median = np.median(distance)
        if np.median(np.abs(distance - median)) <= MAX_DISTANCE_VARIATION * median:  # true if all lie at one point, too
            ratios.append(float(median / expected))
            weights.append(float(expected))
    if not ratios:
        return 1.0
    order = np.argsort(ratios)
    middle = np.searchsorted(np.cumsum(np.array(weights)[order]), 0.5 * np.sum(weights))
    return float(np.clip(np.array(ratios)[order][middle], MIN_SIZE_RATIO, MAX_SIZE_RATIO))


def find_near_pairs(joints: Int[np.ndarray, " K"]) -> tuple[Int[np.ndarray, " P"], Int[np.ndarray, " P"]]:
    """Return the pairs of markers on the same joint, or on a joint and its parent, by their indices, the larger first."""
    parents = load_cmu31_body().skeleton.parents
    second, first = np.tril_indices(len(joints), -1)
    i, j = joints[second], joints[first]
    is_near = (i == j) | (parents[i] == j) | (parents[j] == i)
    return second[is_near], first[is_near]


def compute_rest_marker_positions(marker_set: MarkerSet) -> Float[np.ndarray, "K 3"]:
    """Return the markers of a set on the average body in the rest pose, in metres."""
    return load_cmu31_body().skeleton.rest_positions[marker_set.joints] + marker_set.marker_offsets


ARM_RAISE_SHARES = (0.0, 0.5, 1.0)  # arm positions in which a body is placed: 0 hanging, 1 as in a T-pose


def scale_subject(subject: Subject, size: float) -> Subject:
    """Return a subject `size` times as large."""
    skeleton = replace(subject.skeleton, offsets=subject.skeleton.offsets * size, ends=subject.skeleton.ends * size)
    return replace(subject, skeleton=skeleton, marker_offsets=subject.marker_offsets * size)


def build_average_subject(marker_set: MarkerSet, size: float = 1.0) -> Subject:
    """Return the average body at a size, with the markers of a set."""
    places = marker_set.joints, marker_set.marker_offsets, marker_set.marker_spread
    return scale_subject(Subject(load_cmu31_body().skeleton, marker_set.name, marker_set.labels, *places), size)


@dataclass(frozen=True)
class PosedBody:
    """A subject with all markers of its set, and what is assumed of its poses."""

    subject: Subject
    body: BodyModel
    prior: MeanPosePrior
    limits: JointLimits

    def change_subject(self, subject: Subject) -> "PosedBody":
        return replace(self, subject=subject)

    def fit_height(self, height_m: float) -> "PosedBody":
        """Return the body at the size at which its markers in the mean pose have this height."""
        mean_pose = np.zeros((1, 3)), self.prior.mean_rotations[None].copy()
        return self.change_subject(scale_subject(self.subject, height_m / float(np.ptp(self.predict(mean_pose)[0, :, 1]))))

    def turn_around(self, heading_count: int) -> Float[np.ndarray, "H J 3 3"]:
        """Return the local rotations of the mean pose in all headings, with hanging, half raised and raised arms."""
        angles = np.linspace(0, 2 * np.pi, heading_count, endpoint=False)
        headings = compute_rotations(angles[:, None] * [0.0, 1.0, 0.0])
        arms = [self.subject.skeleton.find_joint(s + bone) for s in ("Left", "Right") for bone in ("Shoulder", "Arm", "ForeArm")]
        poses: list[np.ndarray] = []
        for share in ARM_RAISE_SHARES:
            raised = np.tile(self.prior.mean_rotations, (heading_count, 1, 1, 1))
            raised[:, arms] = scale_rotations(self.prior.mean_rotations[arms], 1 - share)
            raised[:, 0] = headings
            poses.append(raised)
        return np.concatenate(poses)

    def register(self, markers: Float[np.ndarray, "S K 3"]) -> Poses:
        """Return closed-form first poses from markers in metres, NaN where missing."""
        motion = register_poses(self.subject, self.body.free_joints, self.prior, markers)
        return motion.root_position, motion.local_rotations

    def solve(
        self,
        start: Poses,
        markers: Float[np.ndarray, "S K 3"],
        marker_sd_m: float,
        robust_scales_m: tuple[float, ...],
        max_iterations: int,
    ) -> Poses:
        """Return the most likely poses given markers in metres, NaN where missing."""
        return self._build_problem(markers, marker_sd_m).minimise(start, robust_scales_m, max_iterations=max_iterations).poses

    def fit(
        self, markers: Float[np.ndarray, "S K 3"], marker_sd_m: float, robust_scales_m: tuple[float, ...], max_iterations: int
    ) -> Poses:
        """Return the most likely poses from closed-form first ones."""
        return self.solve(self.register(markers), markers, marker_sd_m, robust_scales_m, max_iterations)

    def compute_costs(
        self, poses: Poses, markers: Float[np.ndarray, "S K 3"], marker_sd_m: float, robust_scale_m: float
    ) -> Float[np.ndarray, " S"]:
        """Return half the sum of squares of each frame in standard deviations, of markers, prior and joint limits."""
        return self._build_problem(markers, marker_sd_m).compute_costs(poses, robust_scale_m)

    def predict(self, poses: Poses) -> Float[np.ndarray, "S K 3"]:
        """Return where the body carries its markers, in metres."""
        return kinematics.predict_markers(self.subject, poses)

    def _build_problem(self, markers: Float[np.ndarray, "S K 3"], marker_sd_m: float) -> PoseProblem:
        prior, limits = build_pose_prior_term(self.prior), build_joint_limit_term(self.limits)
        return build_marker_problem(self.subject, self.body.free_joints, markers, marker_sd_m, prior, limits)


def build_posed_body(subject: Subject) -> PosedBody:
    """Return the body of a subject, posed as far as its markers show it."""
    body = subject.body_model
    return PosedBody(subject, body, load_mean_pose_prior("mean-pose", body.skeleton), load_joint_limits(body.skeleton))
