"""The points that each joint's rotation moves, for HybrIK: child joints, markers, and joints beyond a stiff child."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from mocapfix.kernels.hybrik import HybrikSkeleton
from mocapfix.kernels.joint_registration import RootPoints
from mocapfix.pose_prior.mean_pose import MeanPosePrior
from mocapfix.skeleton import Skeleton
from mocapfix.subject import Subject

SUBTREE_ROOTS = ("Head", "LeftHand", "RightHand")
"""The roots of the sub-trees, which are also the end joints of the body (HybrIK-X, 3.2.3)."""
MIN_JOINT_DISTANCE_M = 1e-4
"""Distance below which two joints count as coincident, with no bone between them."""
STIFF_JOINT_SD_RAD = 0.1
"""Standard deviation of the rotation of a joint that hardly turns, such as a clavicle."""
BONE_MARKER_SD_M = 0.01
"""Standard deviation per axis of a marker about its offset."""
WEAK_TRUNK_SD_M = 10.0
"""Standard deviation of trunk joints in the registration of the root: negligible weight unless no point at the hips is known."""


class MarkedSubject(NamedTuple):
    """A subject, and whether marker positions are given for it."""

    subject: Subject
    has_markers: bool


@dataclass(frozen=True)
class BonePoint:
    """A point that a joint's rotation moves.

    point_index    index among J joints and K markers
    rest_position  (3,) m in the joint's axes
    is_child       whether it is a child joint, which determines the swing
    variance       m^2 per axis about the rest position
    """

    point_index: int
    rest_position: np.ndarray
    is_child: bool
    variance: float


class BonePointArrays(NamedTuple):
    """P bone points as arrays for the kernels."""

    point_index: np.ndarray
    rest_position: np.ndarray
    is_child: np.ndarray
    variance: np.ndarray


def find_separate_joints(skeleton: Skeleton) -> Bool[np.ndarray, " J"]:
    """Find the joints that do not coincide with their parents, so that there is a bone between the two."""
    return (np.linalg.norm(skeleton.offsets, axis=1) > MIN_JOINT_DISTANCE_M) & (skeleton.parents >= 0)


def find_stub_joints(skeleton: Skeleton, prior: MeanPosePrior) -> Bool[np.ndarray, " J"]:
    """Find the stiff joints that coincide with their parents: the hip stubs, which are redundant with the thighs."""
    return find_stiff_joints(prior) & ~find_separate_joints(skeleton)


def find_stiff_joints(prior: MeanPosePrior) -> Bool[np.ndarray, " J"]:
    """Find the joints that the mean pose locks about all axes."""
    return np.linalg.matrix_rank(prior.locked_information) == 3


def build_bones(
    skeleton: Skeleton, prior: MeanPosePrior, marked_subject: MarkedSubject, is_held: Bool[np.ndarray, " J"]
) -> tuple[HybrikSkeleton, RootPoints]:
    """Return the bones for HybrIK, and the points that determine the root. Markers follow the joints in the subject's order.

    prior    the mean pose; a joint that it locks about all axes is stiff, and what it carries moves with its parent
    is_held  joints that keep the mean pose
    """
    joint_count, parents = len(skeleton.names), skeleton.parents
    points = [list_bone_points(j, skeleton, prior, marked_subject) for j in range(joint_count)]
    root_points, points[0] = points[0], []
    arrays = stack_points([point for each in points for point in each])
    conflict_joint = np.full(joint_count, -1)
    for k in (skeleton.find_joint(name) for name in SUBTREE_ROOTS):
        conflict_joint[parents[parents[k]]] = k
    bones = HybrikSkeleton(
        parents,
        skeleton.offsets,
        np.array([any(point.is_child for point in each) for each in points]) & ~is_held,
        np.cumsum([0, *map(len, points)]),
        arrays.point_index,
        arrays.rest_position,
        arrays.is_child,
        np.concatenate([find_off_axis_points(each) for each in points]),
        arrays.variance,
        conflict_joint,
    )
    near_root = {point.point_index for point in root_points}
    trunk = [point for point in list_trunk_points(skeleton, prior) if point.point_index not in near_root]
    arrays = stack_points(root_points + trunk)
    distance = np.linalg.norm(arrays.rest_position[:, None] - arrays.rest_position, axis=2)
    first_coincident = (distance < MIN_JOINT_DISTANCE_M).argmax(axis=1)
    return bones, RootPoints(arrays.point_index, arrays.rest_position, arrays.variance, first_coincident)


def list_bone_points(j: int, skeleton: Skeleton, prior: MeanPosePrior, marked_subject: MarkedSubject) -> list[BonePoint]:
    """List all points that the rotation of joint `j` moves."""
    offsets, subject = skeleton.offsets, marked_subject.subject
    root = [BonePoint(0, np.zeros(3), False, 0.0)] if j == 0 else []
    joints: list[BonePoint] = []
    for c in np.flatnonzero(skeleton.parents == j):
        is_separate = find_separate_joints(skeleton)[c]
        if is_separate or j == 0:
            joints.append(BonePoint(int(c), offsets[c], bool(is_separate), 0.0))
        if find_stiff_joints(prior)[c]:
            for g in np.flatnonzero(skeleton.parents == c):
                position = offsets[c] + prior.mean_rotations[c] @ offsets[g]
                variance = (STIFF_JOINT_SD_RAD * np.linalg.norm(offsets[g])) ** 2 if is_separate else 0.0
                joints.append(BonePoint(int(g), position, False, float(variance)))
    own_markers = np.flatnonzero(subject.joints == j) if marked_subject.has_markers else []
    is_leaf = not joints
    markers = [
        BonePoint(len(skeleton.names) + int(k), subject.marker_offsets[k], is_leaf, BONE_MARKER_SD_M**2) for k in own_markers
    ]
    return root + joints + markers


def find_off_axis_points(points: list[BonePoint]) -> Bool[np.ndarray, " P"]:
    """Find the points of a joint that determine its twist: all but children at the end of its only bone."""
    positions = np.array([point.rest_position for point in points])
    is_child = np.array([point.is_child for point in points], bool)
    if not is_child.any():
        return np.ones(len(points), bool)
    return ~is_child | (np.linalg.norm(positions - positions[is_child].mean(axis=0), axis=1) > MIN_JOINT_DISTANCE_M)


def list_trunk_points(skeleton: Skeleton, prior: MeanPosePrior) -> list[BonePoint]:
    """List all joints but those of the limbs in the mean pose, with a variance of WEAK_TRUNK_SD_M squared."""
    points: list[BonePoint] = []
    positions, rotations = {0: np.zeros(3)}, {0: np.eye(3)}
    for j in range(1, len(skeleton.parents)):
        p = int(skeleton.parents[j])
        if p in positions and not skeleton.names[j].endswith(("UpLeg", "ForeArm")):
            positions[j] = positions[p] + rotations[p] @ skeleton.offsets[j]
            rotations[j] = rotations[p] @ prior.mean_rotations[j]
            points.append(BonePoint(j, positions[j], False, WEAK_TRUNK_SD_M**2))
    return points


def stack_points(points: list[BonePoint]) -> BonePointArrays:
    """Return points as contiguous arrays."""
    return BonePointArrays(
        np.array([point.point_index for point in points]),
        np.array([point.rest_position for point in points], float),
        np.array([point.is_child for point in points], bool),
        np.array([point.variance for point in points], float),
    )
