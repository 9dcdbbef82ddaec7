"""What each joint turns: its children, the markers that ride on it, and joints beyond a child that does not turn itself."""

from typing import NamedTuple

import numpy as np

from mocapfix.kernels.hybrik import HybrikSkeleton
from mocapfix.kernels.joint_registration import RootPoints
from mocapfix.pose_prior.mean_pose import MeanPosePrior
from mocapfix.skeleton import Skeleton
from mocapfix.subject import Subject

SUBTREE_ROOTS = (
    "Head",
    "LeftHand",
    "RightHand",
)  # the roots of sub-trees, which are also the last of the body's (HybrIK-X, 3.2.3)
MIN_JOINT_DISTANCE_M = 1e-4  # metres: joints nearer to one another have no bone between them
STIFF_JOINT_SD_RAD = 0.1  # radians: how far a child turns that hardly does, as a clavicle
BONE_MARKER_SD_M = 0.01  # metres per axis: how far a marker strays from its place on the body
WEAK_TRUNK_SD_M = (
    10.0  # metres: as good as nothing beside what the hips carry; but where none of that is known, the trunk tells the root
)


class MarkedSubject(NamedTuple):
    """A subject, and whether its markers are seen."""

    subject: Subject
    has_markers: bool


def find_separate_joints(skeleton: Skeleton) -> np.ndarray:
    """-> (J,) bool: joints that lie away from their parents, so that there is a bone between."""
    return (np.linalg.norm(skeleton.offsets, axis=1) > MIN_JOINT_DISTANCE_M) & (skeleton.parents >= 0)


def find_stub_joints(skeleton: Skeleton, prior: MeanPosePrior) -> np.ndarray:
    """-> (J,) bool: joints that never turn and lie on the one before: the hips', whose turn would be the thighs' over again."""
    return find_stiff_joints(prior) & ~find_separate_joints(skeleton)


def find_stiff_joints(prior: MeanPosePrior) -> np.ndarray:
    """-> (J,) bool: joints that the mean pose holds about all axes."""
    return np.linalg.matrix_rank(prior.locked_information) == 3


def build_bones(
    skeleton: Skeleton, prior: MeanPosePrior, marked_subject: MarkedSubject, is_held: np.ndarray
) -> tuple[HybrikSkeleton, RootPoints]:
    """-> the bones, and what tells the root. Markers are points beyond the joints, in the subject's order.

    habits  the mean pose; a joint that it holds about all axes is stiff: what it carries goes with the joint before
    held    (J,) bool: joints that are left in the mean pose
    """
    joints, parents = len(skeleton.names), skeleton.parents
    rows = [list_bone_points(j, skeleton, prior, marked_subject) for j in range(joints)]
    of_root, rows[0] = rows[0], []
    source, place, child, spread = stack_columns([row for each in rows for row in each])
    ahead = np.full(joints, -1)
    for k in (skeleton.find_joint(name) for name in SUBTREE_ROOTS):
        ahead[parents[parents[k]]] = k
    first = np.cumsum([0, *map(len, rows)])
    turns = np.array([any(row[2] for row in each) for each in rows]) & ~is_held
    tells = np.concatenate([find_off_axis_points(each) for each in rows])
    bones = HybrikSkeleton(parents, skeleton.offsets, turns, first, source, place, child, tells, spread, ahead)
    carried = {row[0] for row in of_root}
    source, place, _, spread = stack_columns(
        of_root + [row for row in list_trunk_points(skeleton, prior) if row[0] not in carried]
    )
    twin = (np.linalg.norm(place[:, None] - place, axis=2) < MIN_JOINT_DISTANCE_M).argmax(axis=1)
    return bones, RootPoints(source, place, spread, twin)


def list_bone_points(j: int, skeleton: Skeleton, prior: MeanPosePrior, marked_subject: MarkedSubject) -> list[tuple]:
    """-> source, place, whether it is a child, and spread, of all points that joint `j` turns."""
    offsets, subject, found = skeleton.offsets, marked_subject.subject, []
    at_root = [(0, np.zeros(3), False, 0.0)] if j == 0 else []
    for c in np.flatnonzero(skeleton.parents == j):
        apart = find_separate_joints(skeleton)[c]
        if apart or j == 0:
            found.append((c, offsets[c], apart, 0.0))
        if find_stiff_joints(prior)[c]:
            for g in np.flatnonzero(skeleton.parents == c):
                beyond = prior.mean_rotations[c] @ offsets[g]
                spread = (STIFF_JOINT_SD_RAD * np.linalg.norm(offsets[g])) ** 2 if apart else 0.0
                found.append((g, offsets[c] + beyond, False, spread))
    worn = np.flatnonzero(subject.joints == j) if marked_subject.has_markers else []
    leaf = not len(found)
    return at_root + found + [(len(skeleton.names) + k, subject.marker_offsets[k], leaf, BONE_MARKER_SD_M**2) for k in worn]


def find_off_axis_points(rows: list[tuple]) -> np.ndarray:
    """-> (P,) bool: of a joint's points, all but children at the end of its one bone, who say nothing of its twist."""
    places, children = (np.array([row[at] for row in rows]) for at in (1, 2))
    if not children.any():
        return np.ones(len(rows), bool)
    return ~children | (np.linalg.norm(places - places[children].mean(axis=0), axis=1) > MIN_JOINT_DISTANCE_M)


def list_trunk_points(skeleton: Skeleton, prior: MeanPosePrior) -> list[tuple]:
    """-> all joints but the limbs', as the mean pose has them, AFAR from sure."""
    found, places, turned = [], {0: np.zeros(3)}, {0: np.eye(3)}
    for j in range(1, len(skeleton.parents)):
        p = int(skeleton.parents[j])
        if p in places and not skeleton.names[j].endswith(("UpLeg", "ForeArm")):
            places[j], turned[j] = places[p] + turned[p] @ skeleton.offsets[j], turned[p] @ prior.mean_rotations[j]
            found.append((j, places[j], False, WEAK_TRUNK_SD_M**2))
    return found


def stack_columns(rows: list[tuple]) -> tuple[np.ndarray, ...]:
    """-> sources, places, whether they are children, and spreads, each as the kernels want it."""
    source, place, child, spread = zip(*rows, strict=True)
    return np.array(source), np.ascontiguousarray(place, float), np.array(child, bool), np.array(spread, float)
