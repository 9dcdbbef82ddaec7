"""A body with markers whose poses are solved in the sampled frames of a take."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.labels.tracklets import TrackletDistances
from mocapfix.model.marker_set import MarkerSet
from mocapfix.model.motion import Motion
from mocapfix.model.skeleton import BodyModel, load_cmu31_body, restrict_body
from mocapfix.model.subject import Subject
from mocapfix.solve import kinematics
from mocapfix.solve.kinematics import Poses
from mocapfix.solve.mean_pose import JointLimits, MeanPosePrior, load_joint_limits, load_mean_pose_prior
from mocapfix.solve.pose_problem import PoseProblem, build_marker_problem
from mocapfix.solve.segment_registration import register_poses
from mocapfix.solve.terms import build_joint_limit_term, build_pose_prior_term
from mocapfix.subject.body_size import scale_skeleton
from mocapfix.subject.marker_set_fit import measure_marker_offsets

FINAL_OFFSET_WEIGHT = 0.8
"""Weight of the measured offset of a marker; that of the offset of the set is the rest."""
POSING_SCALES_M = (0.2, 0.1)
"""Robust scales of the poses."""
POSING_ITERATIONS = 8
"""Solver iterations at each scale."""
POSING_MARKER_SD_M = 0.02
"""Standard deviation of a marker about the body per axis."""


@dataclass(frozen=True)
class PosedBody:
    """A subject with all markers of its set, and what is assumed of its poses."""

    subject: Subject
    body: BodyModel
    prior: MeanPosePrior
    limits: JointLimits

    def change_subject(self, subject: Subject) -> "PosedBody":
        """Return the same with another subject."""
        return replace(self, subject=subject)

    def register(self, markers: Float[np.ndarray, "S K 3"]) -> Poses:
        """Return closed-form first poses from markers in metres, NaN where missing."""
        motion = register_poses(self.subject, self.body.free_joints, self.prior, markers)
        return motion.root_position, motion.local_rotations

    def solve(
        self,
        poses: Poses,
        markers: Float[np.ndarray, "S K 3"],
        marker_sd_m: float,
        robust_scales_m: tuple[float, ...],
        max_iterations: int,
    ) -> None:
        """Move poses in place to their most likely ones given markers in metres, NaN where missing."""
        problem = self._build_problem(markers, marker_sd_m)
        solution = problem.minimise(poses, robust_scales_m, max_iterations=max_iterations)
        poses[0][:], poses[1][:] = solution.poses

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


def build_average_body(marker_set: MarkerSet) -> PosedBody:
    """Return the average body with the markers of a set."""
    body = restrict_body(load_cmu31_body(), set(marker_set.joints.tolist()))
    subject = Subject(
        body.skeleton, marker_set.name, marker_set.labels, marker_set.joints, marker_set.marker_offsets, marker_set.marker_spread
    )
    return build_subject_body(subject, body)


def build_subject_body(subject: Subject, body: BodyModel | None = None) -> PosedBody:
    """Return the body of a known subject."""
    body = subject.body_model if body is None else body
    return PosedBody(subject, body, load_mean_pose_prior("mean-pose", body.skeleton), load_joint_limits(body.skeleton))


def scale_subject(subject: Subject, size: float) -> Subject:
    """Return a subject `size` times as large."""
    return replace(subject, skeleton=scale_skeleton(subject.skeleton, size), marker_offsets=subject.marker_offsets * size)


@dataclass(frozen=True)
class ExtendedBody:
    """A body with the labels of those tracklets that it was extended to.

    Attributes:
        body: The body with its marker offsets.
        markers: The marker of each of the N tracklets, -1 for none.
        cost: Its cost per frame: half the sum of squares in standard deviations.
        frames: Indices of the sampled frames.
    """

    body: PosedBody
    markers: Int[np.ndarray, " N"]
    cost: float
    frames: Int[np.ndarray, " E"]


@dataclass(frozen=True)
class PropagatedLabels:
    """The labels of all tracklets.

    Attributes:
        body: The body with the offsets of this take.
        markers: The marker of each of the N tracklets, -1 for none.
        distances: The distances of the tracklets from the markers.
        is_posed: The sampled frames in which the body has a pose.
        poses: Root positions (S, 3) in metres and local rotations of the frames.
    """

    body: PosedBody
    markers: Int[np.ndarray, " N"]
    distances: TrackletDistances
    is_posed: Bool[np.ndarray, " S"]
    poses: Poses


def adapt_offsets(
    nominal: Subject, poses: Poses, positions: Float[np.ndarray, "S K 3"], weight: float = FINAL_OFFSET_WEIGHT
) -> Subject:
    """Return the subject with its marker offsets moved towards where the posed body has the markers, all the way by weight 1."""
    zeros = np.zeros(len(positions), int)
    motion = Motion(*poses, zeros, zeros, np.zeros(0), np.zeros(0))
    joint_positions, joint_rotations = kinematics.compute_world_poses(nominal.skeleton, motion)
    offsets = nominal.marker_offsets.copy()
    for k, joint in enumerate(nominal.joints):
        own = slice(k, k + 1)
        measured = measure_marker_offsets(positions[:, own], joint_positions[:, [joint]], joint_rotations[:, [joint]])[0][0, 0]
        if not np.isnan(measured[0]):
            offsets[k] += weight * (measured - offsets[k])
    return replace(nominal, marker_offsets=offsets)


def predict_in_posed_frames(labels: PropagatedLabels, subject: Subject) -> Float[np.ndarray, "S K 3"]:
    """Return where the body carries the markers of a subject, in metres; NaN in frames without a pose."""
    predicted = np.full((len(labels.is_posed), len(subject.labels), 3), np.nan)
    frames = np.flatnonzero(labels.is_posed)
    poses = labels.poses[0][frames], labels.poses[1][frames]
    predicted[frames] = labels.body.change_subject(subject).predict(poses)
    return predicted


def scale_nominal_subject(subject: Subject, marker_set: MarkerSet) -> Subject:
    """Return a subject of the size of another one with the marker offsets of the set."""
    average = build_average_body(marker_set).subject
    return scale_subject(average, subject.skeleton.total_length_m / average.skeleton.total_length_m)
