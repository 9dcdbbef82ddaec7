"""Examples for the regressor of twists: people's poses on bodies that differ as people's do, some joints displaced and lost,
so that the network stays sane where joints are not quite where they should be."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.initialise.twist_regressor import build_twist_spans, compute_bone_vectors, compute_span_directions, compute_twists
from mocapfix.kernels.rigid_registration import compute_cross_covariance, fit_rotations
from mocapfix.skeleton import Skeleton, load_cmu31_body, load_cmu31_skeleton
from mocapfix.solve.kinematics import build_kinematic_tree, compute_tree_poses

BODIES_PER_EPOCH = 40  # in an epoch
MAX_DISPLACEMENT_M = 0.03  # metres: joints are displaced by up to this along each axis
UNDISPLACED_POSE_SHARE = 0.3  # of the poses, whose joints stay where they are
LOSSY_POSE_SHARE, LOST_JOINT_SHARE = 0.5, 0.15  # of the poses, that lose some joints, and of their joints
PELVIS_JOINTS = ("Hips", "LeftUpLeg", "RightUpLeg")  # what tells the root's turn where only joints are known

HAS_TWIST = ~np.isnan(compute_bone_vectors(load_cmu31_skeleton())[:, 0])  # (J,) which joints have a bone, and so a twist
INPUT_COUNT = 6 * len(build_twist_spans().start)


def compute_local_rotations(pose_vectors: np.ndarray, reference_rotations: np.ndarray) -> np.ndarray:
    """-> (N, J, 3, 3) single precision: local rotations, the root's none, of vectors (N, J, 3) from `middle` (J, 3, 3)."""
    away = Rotation.from_rotvec(pose_vectors.reshape(-1, 3)).as_matrix().astype(np.float32)
    local = away.reshape(*pose_vectors.shape, 3) @ reference_rotations.astype(np.float32)
    local[:, 0] = np.eye(3)
    return local


def build_epoch_examples(rotations: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """-> inputs (N, I) and targets (N, 2 B) of poses (N, J, 3, 3), BODIES of which share them."""
    parts = [build_examples(part, draw_body(rng), rng) for part in np.array_split(rotations, BODIES_PER_EPOCH) if len(part)]
    inputs, true = (np.concatenate(each) for each in zip(*parts, strict=True))
    return inputs, true.reshape(len(true), -1)


def draw_body(rng: np.random.Generator) -> Skeleton:
    """-> a body that differs from the average as people's do."""
    body = load_cmu31_body()
    away = np.tensordot(rng.normal(size=len(body.shape_components)), body.shape_components, 1)
    return replace(body.skeleton, offsets=body.skeleton.offsets + away)


def build_examples(rotations: np.ndarray, body: Skeleton, rng: np.random.Generator | None) -> tuple[np.ndarray, np.ndarray]:
    """-> inputs (N, I) and targets (N, B, 2) of poses (N, J, 3, 3) of a body; without `random` all joints are where they are."""
    places, _ = compute_tree_poses(
        build_kinematic_tree(body), np.zeros((len(rotations), 3)), np.ascontiguousarray(rotations, float)
    )
    if rng is None:
        return compute_span_directions(places, estimate_pelvis_rotation(places, body)), compute_twist_targets(rotations, body)
    displaced = (
        MAX_DISPLACEMENT_M * rng.random((len(rotations), 1, 1)) * (rng.random((len(rotations), 1, 1)) > UNDISPLACED_POSE_SHARE)
    )
    places += displaced * rng.uniform(-1, 1, places.shape)
    turns = estimate_pelvis_rotation(places, body)
    places[(rng.random(places.shape[:2]) < LOST_JOINT_SHARE) & (rng.random((len(rotations), 1)) < LOSSY_POSE_SHARE)] = np.nan
    return compute_span_directions(places, turns), compute_twist_targets(rotations, body)


def compute_twist_targets(rotations: np.ndarray, body: Skeleton) -> np.ndarray:
    """-> (N, B, 2) cosine and sine of all twists there are in local rotations (N, J, 3, 3)."""
    return compute_twists(rotations[:, HAS_TWIST], compute_bone_vectors(body)[HAS_TWIST]).astype(np.float32)


def estimate_pelvis_rotation(joint_positions: np.ndarray, body: Skeleton) -> np.ndarray:
    """-> (N, 3, 3) the root's turn, as the joints (N, J, 3) of the pelvis tell it."""
    pelvis = [body.find_joint(name) for name in PELVIS_JOINTS]
    cross, _, _ = compute_cross_covariance(
        joint_positions[:, pelvis], body.offsets[pelvis], np.ones((len(joint_positions), len(pelvis)))
    )
    return fit_rotations(cross)
