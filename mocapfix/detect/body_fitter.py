"""A coarse fit of a body to single frames: where the body would have the visible markers.

The body is a known subject's, or the average one. Of the average body only the size is estimated from the take, so that a label
that is wrong throughout cannot shift the expected position of its marker.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from mocapfix.initialise.segment_registration import register_poses
from mocapfix.kernels.forward_kinematics import KinematicTree
from mocapfix.marker_set import MarkerSet
from mocapfix.motion import Motion
from mocapfix.pose_prior import mean_pose
from mocapfix.pose_prior.mean_pose import JointLimits, MeanPosePrior, load_joint_limits
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

# Standard deviation per axis of a marker: its placement, the subject's proportions and skin motion together.
BODY_MARKER_SD_M = 0.030
# Standard deviation of a joint angle beyond its limits.
JOINT_LIMIT_SD_RAD = 0.1
# Scales of the robust loss (Geman & McClure 1987), from coarse to fine.
ROBUST_SCALES_M = (0.4, 0.2, 0.1)
# Number of iterations at each scale.
MAX_BODY_FIT_ITERATIONS = 8
# The distance of a nearer pair of markers depends more on their placement than on the subject's size.
MIN_SIZE_DISTANCE_M = 0.12


@dataclass(frozen=True)
class BodyFitter:
    """A subject with K markers and the prior on its poses."""

    body: BodyModel
    subject: Subject
    prior: MeanPosePrior
    limits: JointLimits

    def predict_markers(self, markers: Float[np.ndarray, "N K 3"]) -> Float[np.ndarray, "N K 3"]:
        """Fit the body to each frame separately and return the world positions of all its markers in metres.

        Args:
            markers: Measured world positions in metres, NaN where missing.
        """
        poses = register_poses(self.subject, self.body.free_joints, self.prior, markers)
        tree = KinematicTree(self.body.skeleton.parents, self.subject.skeleton.offsets, self.body.free_joints)
        problem = PoseProblem(
            tree,
            MarkerAttachment(self.subject.joints, self.subject.marker_offsets),
            markers,
            ~np.isnan(markers[..., 0]),
            BODY_MARKER_SD_M,
            build_pose_prior_term(self.prior),
            build_joint_limit_term(self.limits, JOINT_LIMIT_SD_RAD),
        )
        no_tracking = build_no_tracking(len(self.body.free_joints))
        problem.solve(poses.root_position, poses.local_rotations, no_tracking, ROBUST_SCALES_M, MAX_BODY_FIT_ITERATIONS)
        return kinematics.compute_joint_and_marker_positions(self.subject, poses)[1]


def build_body_fitter(subject: Subject) -> BodyFitter:
    """Build the fitter of a known subject."""
    body = subject.body_model
    return BodyFitter(body, subject, mean_pose.load_mean_pose_prior("mean-pose", body.skeleton), load_joint_limits(body.skeleton))


def build_average_body_fitter(marker_set: MarkerSet, markers: Float[np.ndarray, "N K 3"]) -> BodyFitter:
    """Build the fitter of the average body at the size of the measured markers.

    Args:
        marker_set: The set with K markers.
        markers: Measured world positions in metres, NaN where missing.
    """
    skeleton, ratio = load_cmu31_body().skeleton, estimate_size_ratio(marker_set, markers)
    scaled = replace(skeleton, offsets=skeleton.offsets * ratio, ends=skeleton.ends * ratio)
    return build_body_fitter(build_nominal_subject(marker_set, scaled, marker_set.marker_offsets * ratio))


def build_nominal_subject(marker_set: MarkerSet, skeleton: Skeleton, marker_offsets: Float[np.ndarray, "K 3"]) -> Subject:
    """Build a subject with this skeleton and the set's markers at these offsets in metres in their joints' axes."""
    return Subject(skeleton, marker_set.name, marker_set.labels, marker_set.joints, marker_offsets, marker_set.marker_spread)


def estimate_size_ratio(marker_set: MarkerSet, markers: Float[np.ndarray, "N K 3"]) -> float:
    """Estimate the subject's size relative to the average body.

    This is the median ratio of the distances between markers of the same segment, 1 if none is visible.
    """
    first, second = np.triu_indices(len(marker_set.joints), 1)
    nominal_m = np.linalg.norm(marker_set.marker_offsets[first] - marker_set.marker_offsets[second], axis=1)
    is_same_segment = marker_set.joints[first] == marker_set.joints[second]
    visible = ~np.isnan(markers[..., 0])
    is_known = is_same_segment & (nominal_m > MIN_SIZE_DISTANCE_M) & (visible[:, first] & visible[:, second]).any(0)
    if not is_known.any():
        return 1.0
    distance_m = np.linalg.norm(markers[:, first[is_known]] - markers[:, second[is_known]], axis=-1)
    return float(np.median(np.nanmedian(distance_m, axis=0) / nominal_m[is_known]))


def compute_marker_misfit(markers: Float[np.ndarray, "... 3"], predicted: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "..."]:
    """Compute half the robust squared distance in standard deviations (Geman & McClure 1987), 0 where missing."""
    square = ((markers - predicted) ** 2).sum(-1)
    return np.nan_to_num(0.5 * square / (1 + square / ROBUST_SCALES_M[-1] ** 2)) / BODY_MARKER_SD_M**2


def compute_rest_markers(marker_set: MarkerSet) -> Float[np.ndarray, "K 3"]:
    """Compute the positions in metres of the set's markers on the average body in its rest pose."""
    skeleton = load_cmu31_body().skeleton
    identity = np.tile(np.eye(3), (1, len(skeleton.names), 1, 1))
    empty = np.zeros((1, 0))
    motion = Motion(np.zeros((1, 3)), identity, np.zeros(1, int), np.zeros(1, int), empty, empty)
    subject = build_nominal_subject(marker_set, skeleton, marker_set.marker_offsets)
    return kinematics.compute_joint_and_marker_positions(subject, motion)[1][0]
