"""One frame with everything SCOPE measures on a body: 3-D keypoints, 2-D keypoints, part orientations, and shape parameters.

SCOPE (section 3.3, Eqs. 1-7): a joint lies in its parent's axes at S_j beta + l_j. All is linearised about beta = 0.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.kernels.forward_kinematics import FramePose, KinematicTree, compute_forward_kinematics
from mocapfix.kernels.terms import DirectionTerm, PointTerm, ReprojectionTerm, TrackingTerm

# MERGED: mocapfix.bench.scene
DIRECTION_DAMPING = 1e-9  # what both directions add to every unknown's curvature, so that none is open


class ScopeScene(NamedTuple):
    """A body in a pose, its world joints written, and what is measured of it."""

    tree: KinematicTree
    point_term: PointTerm
    reprojection_term: ReprojectionTerm
    direction_term: DirectionTerm
    tracking_term: TrackingTerm
    pose: FramePose

    @property
    def terms(self) -> tuple[PointTerm, ReprojectionTerm, DirectionTerm, TrackingTerm]:
        return self.point_term, self.reprojection_term, self.direction_term, self.tracking_term

    @property
    def measurement_count(self) -> int:
        """How many numbers are measured: rows of a Jacobian."""
        return 3 * len(self.point_term.joints) + 2 * len(self.reprojection_term.joints) + 3 * len(self.direction_term.joints)


def build_placed_pose(tree: KinematicTree, root: np.ndarray, local: np.ndarray) -> FramePose:
    """-> the pose root (3,), local (J, 3, 3), its joints where it puts them."""
    pose = FramePose(root, local, np.zeros(len(tree.shape_basis)), np.empty((len(local), 3)), np.empty(local.shape))
    compute_forward_kinematics(tree, pose)
    return pose


def build_empty_reprojection_term() -> ReprojectionTerm:
    """-> what no camera sees."""
    none = np.zeros(0, int)
    return ReprojectionTerm(
        none, np.zeros((0, 3)), none, np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros(0, bool), np.zeros((1, 0, 2)),
        np.zeros((1, 0)),
    )  # fmt: skip


def build_empty_direction_term() -> DirectionTerm:
    """-> no bone's direction."""
    return DirectionTerm(np.zeros(0, int), np.zeros((0, 3)), np.zeros((1, 0, 3)), np.zeros((1, 0)))


# MERGED: mocapfix.bench.scope
# SCOPE's three experiments: how long a Gauss-Newton direction takes as joints, measurements and shape parameters grow.
#
# SCOPE, section 5.6 and supplement B, on the trees of a body without hands (K = 23 joints) and with them (K = 51). N counts
# measured numbers, that is rows of the Jacobian (SCOPE, Table 6): a 3-D keypoint is three. Every joint has its pull.
# pelvis; hips and spine; knees, ankles, feet; neck, collars, head, shoulders, elbows, wrists
BODY_PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19)
WRIST_JOINTS, FINGERS_PER_HAND, JOINTS_PER_FINGER = (20, 21), 5, 3
SCOPE_JOINT_COUNTS = (23, 51)  # K: all but the pelvis
SCOPE_MEASUREMENT_COUNTS = tuple(range(120, 601, 120))  # N
SCOPE_SHAPE_COUNTS = tuple(range(11))  # P
NUMBERS_PER_JOINT = 3 + 2 + 3  # numbers: a 3-D keypoint, a 2-D keypoint, a part orientation
MEASUREMENT_SD = 0.01  # of a measurement: metres, radians, and the camera's focal length
JOINT_TARGET_SD_RAD = 0.5  # radians, of a joint from its target


def build_scope_parents(with_hands: bool) -> np.ndarray:
    """-> (K + 1,) the tree: one joint for each hand, or three for each of its fingers."""
    tree = [*BODY_PARENTS]
    for wrist in WRIST_JOINTS:
        for _ in range(FINGERS_PER_HAND if with_hands else 1):
            tree += [wrist, *range(len(tree), len(tree) + JOINTS_PER_FINGER - 1)] if with_hands else [wrist]
    return np.array(tree)


def build_scope_scene(
    joint_count: int, keypoint_count: int, measure_every_joint: bool, shape_count: int, seed: int = 0
) -> ScopeScene:
    """-> a random body of K = `joints` joints with so many 3-D keypoints spread over it, seen nearly where they are.

    each  every joint also carries a 3-D keypoint, a 2-D keypoint and a part orientation
    """
    rng, parent = np.random.default_rng(seed), build_scope_parents(with_hands=joint_count == max(SCOPE_JOINT_COUNTS))
    bodies = np.arange(len(parent))
    alone = bodies if measure_every_joint else bodies[:0]
    local = Rotation.from_rotvec(rng.normal(0, 0.5, (len(parent), 3))).as_matrix()
    offsets, shape = rng.normal(0, 0.15, (len(parent), 3)), rng.normal(0, 0.01, (shape_count, len(parent), 3))
    tree = KinematicTree(parent, offsets, np.ones(len(parent), bool), shape)
    pose = build_placed_pose(tree, np.zeros(3), local)
    pull = TrackingTerm(
        local[None, rng.permutation(len(parent))],
        np.full((1, len(parent)), JOINT_TARGET_SD_RAD**-2),
        np.zeros((1, 3)),
        np.zeros(1),
    )
    points = draw_point_term(rng, pose, np.concatenate([np.arange(keypoint_count) % len(parent), alone]))
    return ScopeScene(tree, points, draw_reprojection_term(rng, pose, alone), draw_direction_term(rng, pose, alone), pull, pose)


def draw_point_term(rng: np.random.Generator, pose: FramePose, joints: np.ndarray) -> PointTerm:
    """-> 3-D keypoints on these joints (N,)."""
    places = rng.normal(0, 0.1, (len(joints), 3))
    return PointTerm(
        joints, places, draw_measurement(rng, place_points(pose, joints, places)), np.full((1, len(joints)), MEASUREMENT_SD**-2)
    )


def draw_reprojection_term(rng: np.random.Generator, pose: FramePose, joints: np.ndarray) -> ReprojectionTerm:
    """-> 2-D keypoints on these joints (N,), as a camera 4 m before the body sees them."""
    places, camera = rng.normal(0, 0.1, (len(joints), 3)), np.array([[0.0, 0.0, 4.0]])
    there = place_points(pose, joints, places) + camera
    seen, one = draw_measurement(rng, there[:, :2] / there[:, 2:]), np.zeros(len(joints), int)
    return ReprojectionTerm(
        joints, places, one, np.eye(3)[None], camera, np.ones(1, bool), seen, np.full((1, len(joints)), MEASUREMENT_SD**-2)
    )


def draw_direction_term(rng: np.random.Generator, pose: FramePose, joints: np.ndarray) -> DirectionTerm:
    """-> part orientations of these joints (N,)."""
    along = rng.normal(0, 1, (len(joints), 3))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    seen = draw_measurement(rng, np.einsum("nab,nb->na", pose.rotation[joints], along))
    return DirectionTerm(joints, along, seen, np.full((1, len(joints)), MEASUREMENT_SD**-2))


def place_points(pose: FramePose, joints: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """-> (N, 3) metres: where the joints carry these places."""
    return pose.position[joints] + np.einsum("nab,nb->na", pose.rotation[joints], offsets)


def draw_measurement(rng: np.random.Generator, true_values: np.ndarray) -> np.ndarray:
    """-> what is measured in the one frame, three standard deviations off."""
    return (true_values + rng.normal(0, 3 * MEASUREMENT_SD, true_values.shape))[None]


def build_scope_experiments(shape_counts: tuple[int, ...] = SCOPE_SHAPE_COUNTS) -> Iterator[tuple[dict[str, int], ScopeScene]]:
    """-> each experiment's settings at each point of its course, and the scene: experiments 1, 2, and 3 for these P."""
    for number, count in ((1, 0), (2, max(SCOPE_SHAPE_COUNTS))):
        for joints in SCOPE_JOINT_COUNTS:
            for numbers in SCOPE_MEASUREMENT_COUNTS:
                row = {"experiment": number, "joints": joints, "measured": numbers, "shapes": count}
                yield row, build_scope_scene(joints, numbers // 3, False, count)
    for joints in SCOPE_JOINT_COUNTS:
        for count in shape_counts:
            row = {"experiment": 3, "joints": joints, "measured": NUMBERS_PER_JOINT * (joints + 1), "shapes": count}
            yield row, build_scope_scene(joints, 0, True, count)
