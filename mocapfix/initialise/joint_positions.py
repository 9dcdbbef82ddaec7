"""Joint positions from markers, estimated in every frame independently, with their standard deviations."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.initialise.bones import MIN_JOINT_DISTANCE_M
from mocapfix.initialise.hybrik import MIN_JOINT_SD_M
from mocapfix.kernels.belief_propagation import JointSegments, SegmentTree, propagate_segment_frames
from mocapfix.pose_prior import mean_pose
from mocapfix.pose_prior.mean_pose import MeanPosePrior
from mocapfix.skeleton import BodyModel, Skeleton
from mocapfix.solve import kinematics
from mocapfix.solve.parallel import run_over_frames
from mocapfix.subject import Subject
from mocapfix.take import Take

MIN_MARKER_SPREAD_M = 1e-7
"""Smallest marker spread, which bounds the weight of a marker."""
MAX_JOINT_SD_M = 0.5
"""Standard deviation of a joint position above which it counts as unknown."""


class JointEstimate(NamedTuple):
    """Joint positions estimated from markers.

    positions     (T, J, 3) m, NaN where practically unknown
    sd            (T, J) m per axis, likewise
    marker_trust  (T, K) between 0 and 1: robust weight of each marker, below 0.25 if it lies 5 cm off; 0 if not visible
    """

    positions: np.ndarray
    sd: np.ndarray
    marker_trust: np.ndarray


def estimate_joint_positions(take: Take, subject: Subject, body: BodyModel) -> JointEstimate:
    """Return the joint positions of every frame with their standard deviations.

    Each segment is registered to its own markers, weighted by the subject's marker spread, and to the estimates of its
    neighbouring segments: of the common joint, and of its axes, weighted by the variation about the mean pose. A limb without
    markers therefore takes the mean pose, with a correspondingly large standard deviation. Coincident joints get the same
    position.

    take  the markers in the subject's order, NaN if not visible or an outlier
    """
    prior = mean_pose.load_mean_pose_prior("mean-pose", subject.skeleton)
    rigid = build_rigid_skeleton(subject.skeleton, body.free_joints, prior)
    order = np.argsort(rigid.carrier_segment[subject.joints], kind="stable")
    positions, variance = (
        np.empty((take.frame_count, len(body.free_joints), 3)),
        np.empty((take.frame_count, len(body.free_joints))),
    )
    trust = np.empty(take.visible.shape)
    run_over_frames(
        propagate_segment_frames,
        take.frame_count,
        build_segments(subject, rigid, prior, order),
        build_meetings(rigid),
        np.ascontiguousarray(take.markers[:, order], float),
        positions,
        variance,
        trust,
    )
    is_unknown = ~(variance < MAX_JOINT_SD_M**2)
    sd = np.maximum(np.sqrt(variance + subject.joint_sd**2), MIN_JOINT_SD_M)
    positions[is_unknown], sd[is_unknown] = np.nan, np.nan
    return JointEstimate(positions, sd, trust[:, order.argsort()])


@dataclass(frozen=True)
class RigidSkeleton:
    """A skeleton as S rigid segments: each free joint with the fixed joints below it, which keep the mean pose.

    segment_joints       (S,) the free joint of each segment
    parent_segment       (J,) the segment to which each joint is attached; for the root its own
    position_in_parent   (J, 3) m: the joint in the axes of that segment
    parent_axes          (J, 3, 3): axes of the joint's parent to axes of that segment
    carrier_segment      (J,) the segment that turns with the joint: its own if it is free, else the parent segment
    position_in_carrier  (J, 3) m: the joint in the axes of the carrier segment
    axes_in_carrier      (J, 3, 3): joint axes to axes of the carrier segment
    """

    segment_joints: Int[np.ndarray, " S"]
    parent_segment: Int[np.ndarray, " J"]
    position_in_parent: Float[np.ndarray, "J 3"]
    parent_axes: Float[np.ndarray, "J 3 3"]
    carrier_segment: Int[np.ndarray, " J"]
    position_in_carrier: Float[np.ndarray, "J 3"]
    axes_in_carrier: Float[np.ndarray, "J 3 3"]


def build_rigid_skeleton(skeleton: Skeleton, free_joints: Bool[np.ndarray, " J"], prior: MeanPosePrior) -> RigidSkeleton:
    """Return the skeleton as rigid segments."""
    count, segment_joints = len(free_joints), np.flatnonzero(free_joints)
    parent_segment, carrier_segment = np.zeros(count, int), np.zeros(count, int)
    position_in_parent, position_in_carrier = np.zeros((count, 3)), np.zeros((count, 3))
    parent_axes, axes_in_carrier = np.tile(np.eye(3), (count, 1, 1)), np.tile(np.eye(3), (count, 1, 1))
    carrier_segment[segment_joints] = np.arange(len(segment_joints))
    for j in range(1, count):
        parent = skeleton.parents[j]
        parent_segment[j], parent_axes[j] = carrier_segment[parent], axes_in_carrier[parent]
        position_in_parent[j] = position_in_carrier[parent] + axes_in_carrier[parent] @ skeleton.offsets[j]
        if not free_joints[j]:
            carrier_segment[j], position_in_carrier[j] = parent_segment[j], position_in_parent[j]
            axes_in_carrier[j] = parent_axes[j] @ prior.mean_rotations[j]
    return RigidSkeleton(
        segment_joints,
        parent_segment,
        position_in_parent,
        parent_axes,
        carrier_segment,
        position_in_carrier,
        axes_in_carrier,
    )


def build_segments(subject: Subject, rigid: RigidSkeleton, prior: MeanPosePrior, order: Int[np.ndarray, " K"]) -> SegmentTree:
    """Return the segments for the kernel; `order` sorts the subject's markers by segment."""
    own, marker_joints, marker_offsets = rigid.segment_joints, subject.joints[order], subject.marker_offsets[order]
    parent_axes = rigid.parent_axes[own]
    standing_positions, standing_rotations = kinematics.compute_tree_poses(
        kinematics.build_kinematic_tree(subject.skeleton), np.zeros((1, 3)), prior.mean_rotations[None]
    )
    rotated = np.einsum("kab,kb->ka", rigid.axes_in_carrier[marker_joints], marker_offsets)
    standing_rotated = np.einsum("kab,kb->ka", standing_rotations[0, marker_joints], marker_offsets)
    return SegmentTree(
        parent=rigid.parent_segment[own],
        joint_offset=rigid.position_in_parent[own],
        mean_rotation=parent_axes @ prior.mean_rotations[own],
        rotation_information=parent_axes @ prior.information[own] @ np.swapaxes(parent_axes, 1, 2),
        first_marker=np.searchsorted(rigid.carrier_segment[marker_joints], np.arange(len(own) + 1)),
        marker_offset=rigid.position_in_carrier[marker_joints] + rotated,
        weight=1 / np.maximum(subject.marker_spread[order], MIN_MARKER_SPREAD_M) ** 2,
        standing_rotation=standing_rotations[0, own],
        standing_position=standing_positions[0, marker_joints] + standing_rotated,
    )


def build_meetings(rigid: RigidSkeleton) -> JointSegments:
    """Return the segments that share each joint: its parent segment, and the segments whose own joint coincides with it."""
    distance = np.linalg.norm(rigid.position_in_parent[:, None] - rigid.position_in_parent, axis=2)
    is_shared = (distance < MIN_JOINT_DISTANCE_M) & (rigid.parent_segment[:, None] == rigid.parent_segment)
    coincident = [[s for s, j in enumerate(rigid.segment_joints) if s and is_shared[i, j]] for i in range(len(is_shared))]
    segments: list[int] = []
    joint_offsets: list[np.ndarray] = []
    for parent, position, own in zip(rigid.parent_segment, rigid.position_in_parent, coincident, strict=True):
        segments += [parent, *own]
        joint_offsets += [position, *np.zeros((len(own), 3))]
    first_segment = np.cumsum([0] + [1 + len(own) for own in coincident])
    return JointSegments(first_segment, np.array(segments), np.array(joint_offsets))
