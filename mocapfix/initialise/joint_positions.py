"""Joint positions from markers, every frame by itself, and how sure they are."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

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

CALIBRATION_ERROR_RATIO = (
    0.75  # of the deviation that calibration foretells of its own error: it allows for more than people differ
)
MIN_MARKER_SPREAD_M = 1e-7  # metres: no marker keeps its place better
MAX_JOINT_SD_M = 0.5  # metres: a joint known no better than this is not known


class JointEstimate(NamedTuple):
    """Where the joints are, as markers tell it.

    positions  (T, J, 3) metres, NaN where next to nothing tells
    deviation  (T, J) metres per axis, likewise
    trust      (T, K) between 0 and 1: how much each marker counted; less than a quarter where it lies 5 cm off, 0 if not seen
    """

    positions: np.ndarray
    sd: np.ndarray
    marker_trust: np.ndarray


def estimate_joint_positions(take: Take, subject: Subject, body: BodyModel) -> JointEstimate:
    """-> every frame's joint positions, and how sure they are.

    Each segment is registered to its own markers, each as near to its place as the subject's `spread` says, and to what its
    neighbours know: of the joint in common, and of its axes as far as people keep to the mean pose there. So a limb without
    markers hangs as people's do, and its joints say how unsure that is. Joints at the same place get the same position.

    worn  the take's markers in the subject's order, NaN where not seen or not believed
    """
    people = mean_pose.load_mean_pose_prior("mean-pose", subject.skeleton)
    rigid = build_rigid_skeleton(subject.skeleton, body.free_joints, people)
    order = np.argsort(rigid.carrier_segment[subject.joints], kind="stable")
    position, variance = np.empty((take.frame_count, len(body.free_joints), 3)), np.empty((take.frame_count, len(body.free_joints)))
    trust = np.empty(take.visible.shape)
    run_over_frames(
        propagate_segment_frames, take.frame_count, build_segments(subject, rigid, people, order), build_meetings(rigid),
        np.ascontiguousarray(take.markers[:, order], float), position, variance, trust,
    )  # fmt: skip
    unknown = ~(variance < MAX_JOINT_SD_M**2)
    deviation = np.maximum(np.sqrt(variance + (CALIBRATION_ERROR_RATIO * subject.joint_sd) ** 2), MIN_JOINT_SD_M)
    position[unknown], deviation[unknown] = np.nan, np.nan
    return JointEstimate(position, deviation, trust[:, order.argsort()])


@dataclass(frozen=True)
class RigidSkeleton:
    """A skeleton as S rigid segments: each free joint with those below it that are not free, which stay in the mean pose.

    own      (S,) the free joint of each segment
    above    (J,) the segment that each joint hangs on; the root's own for the root
    hung     (J, 3) metres: the joint in that segment's axes
    beside   (J, 3, 3): the axes of the joint's parent in that segment's
    carrier  (J,) the segment that a joint turns with: its own where it is free, else the one it hangs on
    place    (J, 3) metres: the joint in that one's axes
    axes     (J, 3, 3): its axes in that one's
    """

    segment_joints: np.ndarray
    parent_segment: np.ndarray
    position_in_parent: np.ndarray
    parent_axes: np.ndarray
    carrier_segment: np.ndarray
    position_in_carrier: np.ndarray
    axes_in_carrier: np.ndarray


def build_rigid_skeleton(skeleton: Skeleton, free_joints: np.ndarray, prior: MeanPosePrior) -> RigidSkeleton:
    """-> the skeleton as rigid segments, the joints that are `free` (J,) turning."""
    count, own = len(free_joints), np.flatnonzero(free_joints)
    above, hung, beside = np.zeros(count, int), np.zeros((count, 3)), np.tile(np.eye(3), (count, 1, 1))
    carrier, place, axes = np.zeros(count, int), hung.copy(), beside.copy()
    carrier[own] = np.arange(len(own))
    for j in range(1, count):
        parent = skeleton.parents[j]
        above[j], beside[j] = carrier[parent], axes[parent]
        hung[j] = place[parent] + axes[parent] @ skeleton.offsets[j]
        if not free_joints[j]:
            carrier[j], place[j], axes[j] = above[j], hung[j], beside[j] @ prior.mean_rotations[j]
    return RigidSkeleton(own, above, hung, beside, carrier, place, axes)


def build_segments(subject: Subject, rigid: RigidSkeleton, prior: MeanPosePrior, order: np.ndarray) -> SegmentTree:
    """-> the segments as the kernel sees them.

    order  (K,) the subject's markers, segment by segment
    """
    own, riding, places = rigid.segment_joints, subject.joints[order], subject.marker_offsets[order]
    beside = rigid.parent_axes[own]
    at, stance = kinematics.compute_tree_poses(
        kinematics.build_kinematic_tree(subject.skeleton), np.zeros((1, 3)), prior.mean_rotations[None]
    )
    return SegmentTree(
        parent=rigid.parent_segment[own],
        joint_offset=rigid.position_in_parent[own],
        mean_rotation=beside @ prior.mean_rotations[own],
        rotation_information=beside @ prior.information[own] @ np.swapaxes(beside, 1, 2),
        first_marker=np.searchsorted(rigid.carrier_segment[riding], np.arange(len(own) + 1)),
        marker_offset=rigid.position_in_carrier[riding] + np.einsum("kab,kb->ka", rigid.axes_in_carrier[riding], places),
        weight=1 / np.maximum(subject.marker_spread[order], MIN_MARKER_SPREAD_M) ** 2,
        standing_rotation=stance[0, own],
        standing_position=at[0, riding] + np.einsum("kab,kb->ka", stance[0, riding], places),
    )


def build_meetings(rigid: RigidSkeleton) -> JointSegments:
    """-> the segments that carry each joint: the one it hangs on and, in their own joints, those that hang at the same place."""
    together = np.linalg.norm(rigid.position_in_parent[:, None] - rigid.position_in_parent, axis=2) < MIN_JOINT_DISTANCE_M
    together &= rigid.parent_segment[:, None] == rigid.parent_segment
    at = [[s for s, j in enumerate(rigid.segment_joints) if s and together[i, j]] for i in range(len(together))]
    segment = [s for above, here in zip(rigid.parent_segment, at, strict=True) for s in (above, *here)]
    place = [p for hung, here in zip(rigid.position_in_parent, at, strict=True) for p in (hung, *np.zeros((len(here), 3)))]
    return JointSegments(np.cumsum([0] + [1 + len(here) for here in at]), np.array(segment), np.array(place))
