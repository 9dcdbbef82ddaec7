"""A body laid on some frames: where it would have the markers that are seen.

A person's own, where it is known, or the average body. Then nothing of the take is learnt but the size, so that a label that
is wrong all along cannot teach the body to expect it there.
"""

from dataclasses import dataclass, replace

import numpy as np

from mocapfix.initialise.segment_registration import register_poses
from mocapfix.kernels.forward_kinematics import KinematicTree
from mocapfix.marker_sets import MarkerSet
from mocapfix.motion import Motion
from mocapfix.pose_prior import mean_pose
from mocapfix.pose_prior.joint_limits import JointLimits, load_joint_limits
from mocapfix.pose_prior.mean_pose import MeanPosePrior
from mocapfix.skeleton import BodyModel, Skeleton, load_cmu31_body
from mocapfix.solve import kinematics
from mocapfix.solve.pose_problem import (
    MarkerAttachment,
    PoseProblem,
    build_joint_limit_term,
    build_no_tracking,
    build_pose_prior_term,
)
from mocapfix.subject import Subject

BODY_MARKER_SD_M = 0.030  # metres per axis: a marker's place, people's proportions and skin together
JOINT_LIMIT_SD_RAD = 0.1  # radians, beyond people's joint limits
ROBUST_SCALES_M = (0.4, 0.2, 0.1)  # metres (Geman-McClure)
MAX_BODY_FIT_ITERATIONS = 8  # iterations at each scale
MIN_SIZE_DISTANCE_M = 0.12  # metres: nearer pairs say more of where markers were stuck than of the body's size


@dataclass(frozen=True)
class BodyFitter:
    """A body that wears K markers, and what its poses are like."""

    body: BodyModel
    subject: Subject
    prior: MeanPosePrior
    limits: JointLimits

    def predict_markers(self, markers: np.ndarray) -> np.ndarray:
        """-> (N, K, 3) metres: where the body has its K markers in N frames (N, K, 3), each laid for itself; NaN not seen."""
        start = register_poses(self.subject, self.body.free_joints, self.prior, markers)
        tree = KinematicTree(self.body.skeleton.parents, self.subject.skeleton.offsets, self.body.free_joints)
        problem = PoseProblem(
            tree, MarkerAttachment(self.subject.joints, self.subject.marker_offsets), markers, ~np.isnan(markers[..., 0]), BODY_MARKER_SD_M,
            build_pose_prior_term(self.prior), build_joint_limit_term(self.limits, JOINT_LIMIT_SD_RAD),
        )  # fmt: skip
        problem.solve(
            start.root_position,
            start.local_rotations,
            build_no_tracking(len(self.body.free_joints)),
            ROBUST_SCALES_M,
            MAX_BODY_FIT_ITERATIONS,
        )
        return kinematics.compute_joint_and_marker_positions(self.subject, start)[1]


def build_body_fitter(subject: Subject) -> BodyFitter:
    """-> the body of a subject."""
    body = load_cmu31_body()
    return BodyFitter(
        body, subject, mean_pose.load_mean_pose_prior("mean-pose", body.skeleton), load_joint_limits(body.skeleton)
    )


def build_average_body_fitter(marker_set: MarkerSet, markers: np.ndarray) -> BodyFitter:
    """-> the average body at the size that markers (N, K, 3) in metres, NaN where not seen, tell."""
    skeleton, ratio = load_cmu31_body().skeleton, estimate_size_ratio(marker_set, markers)
    grown = replace(skeleton, offsets=skeleton.offsets * ratio, ends=skeleton.ends * ratio)
    return build_body_fitter(build_nominal_subject(marker_set, grown, marker_set.marker_offsets * ratio))


def build_nominal_subject(marker_set: MarkerSet, skeleton: Skeleton, marker_offsets: np.ndarray) -> Subject:
    """-> somebody of these bones with the set's markers at places (K, 3) in metres."""
    return Subject(skeleton, marker_set.name, marker_set.labels, marker_set.joints, marker_offsets, marker_set.marker_spread)


def estimate_size_ratio(marker_set: MarkerSet, markers: np.ndarray) -> float:
    """-> the subject's size over the average body's: the median over the distances within segments, 1 where none is seen."""
    first, second = np.triu_indices(len(marker_set.joints), 1)
    nominal = np.linalg.norm(marker_set.marker_offsets[first] - marker_set.marker_offsets[second], axis=1)
    together = marker_set.joints[first] == marker_set.joints[second]
    seen = ~np.isnan(markers[..., 0])
    known = together & (nominal > MIN_SIZE_DISTANCE_M) & (seen[:, first] & seen[:, second]).any(0)
    if not known.any():
        return 1.0
    real = np.nanmedian(np.linalg.norm(markers[:, first[known]] - markers[:, second[known]], axis=-1), axis=0)
    return float(np.median(real / nominal[known]))


def compute_marker_misfit(markers: np.ndarray, predicted: np.ndarray) -> np.ndarray:
    """-> half a squared distance (...,) in standard deviations, robust (Geman & McClure 1987); 0 where not seen."""
    square = ((markers - predicted) ** 2).sum(-1)
    return np.nan_to_num(0.5 * square / (1 + square / ROBUST_SCALES_M[-1] ** 2)) / BODY_MARKER_SD_M**2


def compute_rest_markers(marker_set: MarkerSet) -> np.ndarray:
    """-> (K, 3) metres: the set's markers on the average body as it rests."""
    skeleton = load_cmu31_body().skeleton
    still = np.tile(np.eye(3), (1, len(skeleton.names), 1, 1))
    nothing = np.zeros((1, 0))
    pose = Motion(np.zeros((1, 3)), still, np.zeros(1, int), np.zeros(1, int), nothing, nothing)
    return kinematics.compute_joint_and_marker_positions(
        build_nominal_subject(marker_set, skeleton, marker_set.marker_offsets), pose
    )[1][0]
