"""SCOPE's experiments: the time of a Gauss-Newton direction by number of joints, measurements and shape parameters.

SCOPE, section 5.6 and supplement B, uses the trees of a body without hands (K = 23 joints) and with hands (K = 51). N is the
number of measured values, which are the rows of the Jacobian (SCOPE, Table 6): a 3-D keypoint has three. Every joint has a target
rotation. A joint is at S_j beta + l_j in the axes of its parent (section 3.3, Eqs. 1-7); everything is linearised at beta = 0.
"""

from collections.abc import Iterator
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from mocapfix.kernels.forward_kinematics import FramePose, KinematicTree, compute_forward_kinematics
from mocapfix.kernels.terms import DirectionTerm, PointTerm, ReprojectionTerm, TrackingTerm

DIRECTION_DAMPING = 1e-9  # added to the curvature of every unknown by both directions, so that none is undetermined
# pelvis; hips and spine; knees, ankles, feet; neck, collars, head, shoulders, elbows, wrists
BODY_PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19)
WRIST_JOINTS = (20, 21)
FINGERS_PER_HAND = 5
JOINTS_PER_FINGER = 3
SCOPE_JOINT_COUNTS = (23, 51)  # K: all joints except the pelvis
SCOPE_MEASUREMENT_COUNTS = tuple(range(120, 601, 120))  # N
SCOPE_SHAPE_COUNTS = tuple(range(11))  # P
NUMBERS_PER_JOINT = 3 + 2 + 3  # values of a 3-D keypoint, a 2-D keypoint and a part orientation
MEASUREMENT_SD = 0.01  # of a measurement in metres, radians, or multiples of the focal length
JOINT_TARGET_SD_RAD = 0.5  # of a joint around its target rotation

SceneTerms: TypeAlias = tuple[PointTerm, ReprojectionTerm, DirectionTerm, TrackingTerm]
"""the terms of a scene; a tuple, since the kernels are compiled for the classes in it"""


class ScopeScene(NamedTuple):
    """A body in a pose with known joint positions, and its measurements."""

    tree: KinematicTree
    point_term: PointTerm
    reprojection_term: ReprojectionTerm
    direction_term: DirectionTerm
    tracking_term: TrackingTerm
    pose: FramePose

    @property
    def terms(self) -> SceneTerms:
        """All terms, in the order of the Jacobian's rows."""
        return self.point_term, self.reprojection_term, self.direction_term, self.tracking_term

    @property
    def measurement_count(self) -> int:
        """The number of measured values, which are the rows of the Jacobian."""
        return 3 * len(self.point_term.joints) + 2 * len(self.reprojection_term.joints) + 3 * len(self.direction_term.joints)


def build_placed_pose(tree: KinematicTree, root: Float[np.ndarray, "3"], local: Float[np.ndarray, "J 3 3"]) -> FramePose:
    """Return a pose with the world positions and rotations of its joints."""
    pose = FramePose(root, local, np.zeros(len(tree.shape_basis)), np.empty((len(local), 3)), np.empty(local.shape))
    compute_forward_kinematics(tree, pose)
    return pose


def build_empty_reprojection_term() -> ReprojectionTerm:
    """Return a term without 2-D keypoints."""
    empty = np.zeros(0, int)
    return ReprojectionTerm(
        empty, np.zeros((0, 3)), empty, np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros(0, bool), np.zeros((1, 0, 2)),
        np.zeros((1, 0)),
    )  # fmt: skip


def build_empty_direction_term() -> DirectionTerm:
    """Return a term without bone directions."""
    return DirectionTerm(np.zeros(0, int), np.zeros((0, 3)), np.zeros((1, 0, 3)), np.zeros((1, 0)))


def build_scope_parents(*, with_hands: bool) -> Int[np.ndarray, " J"]:
    """Return the parents of the pelvis and the K joints: one joint for each hand, or three for each of its fingers."""
    tree = [*BODY_PARENTS]
    for wrist in WRIST_JOINTS:
        for _ in range(FINGERS_PER_HAND if with_hands else 1):
            tree += [wrist, *range(len(tree), len(tree) + JOINTS_PER_FINGER - 1)] if with_hands else [wrist]
    return np.array(tree)


def build_scope_scene(
    joint_count: int, keypoint_count: int, shape_count: int, *, measure_every_joint: bool, seed: int = 0
) -> ScopeScene:
    """Return a random body of K joints with 3-D keypoints distributed over it and measured with noise.

    measure_every_joint  whether every joint also has a 3-D keypoint, a 2-D keypoint and a part orientation
    """
    rng, parents = np.random.default_rng(seed), build_scope_parents(with_hands=joint_count == max(SCOPE_JOINT_COUNTS))
    bodies = np.arange(len(parents))
    measured = bodies if measure_every_joint else bodies[:0]
    local = Rotation.from_rotvec(rng.normal(0, 0.5, (len(parents), 3))).as_matrix()
    offsets = rng.normal(0, 0.15, (len(parents), 3))
    shape_basis = rng.normal(0, 0.01, (shape_count, len(parents), 3))
    tree = KinematicTree(parents, offsets, np.ones(len(parents), bool), shape_basis)
    pose = build_placed_pose(tree, np.zeros(3), local)
    target_weight = np.full((1, len(parents)), JOINT_TARGET_SD_RAD**-2)
    tracking = TrackingTerm(local[None, rng.permutation(len(parents))], target_weight, np.zeros((1, 3)), np.zeros(1))
    points = draw_point_term(rng, pose, np.concatenate([np.arange(keypoint_count) % len(parents), measured]))
    reprojection = draw_reprojection_term(rng, pose, measured)
    return ScopeScene(tree, points, reprojection, draw_direction_term(rng, pose, measured), tracking, pose)


def draw_point_term(rng: np.random.Generator, pose: FramePose, joints: Int[np.ndarray, " N"]) -> PointTerm:
    """Return random 3-D keypoints on these joints."""
    offsets = rng.normal(0, 0.1, (len(joints), 3))
    measured = draw_measurement(rng, place_points(pose, joints, offsets))
    return PointTerm(joints, offsets, measured, np.full((1, len(joints)), MEASUREMENT_SD**-2))


def draw_reprojection_term(rng: np.random.Generator, pose: FramePose, joints: Int[np.ndarray, " N"]) -> ReprojectionTerm:
    """Return random 2-D keypoints on these joints, seen by a camera 4 m in front of the body."""
    offsets, translation = rng.normal(0, 0.1, (len(joints), 3)), np.array([[0.0, 0.0, 4.0]])
    in_camera = place_points(pose, joints, offsets) + translation
    measured = draw_measurement(rng, in_camera[:, :2] / in_camera[:, 2:])
    weight = np.full((1, len(joints)), MEASUREMENT_SD**-2)
    cameras, is_perspective = np.zeros(len(joints), int), np.ones(1, bool)
    return ReprojectionTerm(joints, offsets, cameras, np.eye(3)[None], translation, is_perspective, measured, weight)


def draw_direction_term(rng: np.random.Generator, pose: FramePose, joints: Int[np.ndarray, " N"]) -> DirectionTerm:
    """Return random part orientations of these joints."""
    bone_axes = rng.normal(0, 1, (len(joints), 3))
    bone_axes /= np.linalg.norm(bone_axes, axis=1, keepdims=True)
    measured = draw_measurement(rng, np.einsum("nab,nb->na", pose.rotation[joints], bone_axes))
    return DirectionTerm(joints, bone_axes, measured, np.full((1, len(joints)), MEASUREMENT_SD**-2))


def place_points(pose: FramePose, joints: Int[np.ndarray, " N"], offsets: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    """Return the world positions in metres of points at these offsets from joints."""
    return pose.position[joints] + np.einsum("nab,nb->na", pose.rotation[joints], offsets)


def draw_measurement(rng: np.random.Generator, true_values: Float[np.ndarray, "N d"]) -> Float[np.ndarray, "1 N d"]:
    """Return measurements of one frame, with noise of three times their assumed standard deviation."""
    return (true_values + rng.normal(0, 3 * MEASUREMENT_SD, true_values.shape))[None]


def build_scope_experiments(shape_counts: tuple[int, ...] = SCOPE_SHAPE_COUNTS) -> Iterator[tuple[dict[str, int], ScopeScene]]:
    """Yield the settings and the scene of each measurement of experiments 1, 2, and 3 (the last for these P)."""
    for number, shape_count in ((1, 0), (2, max(SCOPE_SHAPE_COUNTS))):
        for joint_count in SCOPE_JOINT_COUNTS:
            for measured in SCOPE_MEASUREMENT_COUNTS:
                row = {"experiment": number, "joints": joint_count, "measured": measured, "shapes": shape_count}
                yield row, build_scope_scene(joint_count, measured // 3, shape_count, measure_every_joint=False)
    for joint_count in SCOPE_JOINT_COUNTS:
        for shape_count in shape_counts:
            measured = NUMBERS_PER_JOINT * (joint_count + 1)
            row = {"experiment": 3, "joints": joint_count, "measured": measured, "shapes": shape_count}
            yield row, build_scope_scene(joint_count, 0, shape_count, measure_every_joint=True)
