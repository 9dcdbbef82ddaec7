"""Training examples of the twist regressor: poses on bodies of different proportions, with displaced and missing joints.

The displaced joints make the network robust to inaccurate joint positions.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from mocapfix.initialise.twist_regressor import build_twist_spans, compute_bone_vectors, compute_span_directions, compute_twists
from mocapfix.skeleton import Skeleton, load_cmu31_body, load_cmu31_skeleton
from mocapfix.solve.kinematics import build_kinematic_tree, compute_tree_poses
from mocapfix.stats.rigid_alignment import compute_cross_covariance, fit_rotations

BODIES_PER_EPOCH = 40
MAX_DISPLACEMENT_M = 0.03  # maximum displacement of a joint along each axis
UNDISPLACED_POSE_SHARE = 0.3  # fraction of the poses whose joints are not displaced
LOSSY_POSE_SHARE = 0.5  # fraction of the poses that have missing joints
LOST_JOINT_SHARE = 0.15  # fraction of the joints of these poses that are missing
PELVIS_JOINTS = ("Hips", "LeftUpLeg", "RightUpLeg")  # their positions determine the root's rotation

HAS_TWIST = ~np.isnan(compute_bone_vectors(load_cmu31_skeleton())[:, 0])  # (J,) the joints that have a bone, and so a twist
INPUT_COUNT = 6 * len(build_twist_spans().start)


def compute_local_rotations(
    pose_vectors: Float[np.ndarray, "N J 3"], reference_rotations: Float[np.ndarray, "J 3 3"]
) -> Float[np.ndarray, "N J 3 3"]:
    """Return the local rotations of poses in single precision, the root's as the identity."""
    difference = Rotation.from_rotvec(pose_vectors.reshape(-1, 3)).as_matrix().astype(np.float32)
    local = difference.reshape(*pose_vectors.shape, 3) @ reference_rotations.astype(np.float32)
    local[:, 0] = np.eye(3)
    return local


def build_epoch_examples(
    rotations: Float[np.ndarray, "N J 3 3"], rng: np.random.Generator
) -> tuple[Float[np.ndarray, "N I"], Float[np.ndarray, "N O"]]:
    """Return inputs and targets of poses, shared among BODIES_PER_EPOCH random bodies."""
    parts = [build_examples(part, draw_body(rng), rng) for part in np.array_split(rotations, BODIES_PER_EPOCH) if len(part)]
    inputs, targets = (np.concatenate(each) for each in zip(*parts, strict=True))
    return inputs, targets.reshape(len(targets), -1)


def draw_body(rng: np.random.Generator) -> Skeleton:
    """Return the average body with random shape components."""
    body = load_cmu31_body()
    offsets = np.tensordot(rng.normal(size=len(body.shape_components)), body.shape_components, 1)
    return replace(body.skeleton, offsets=body.skeleton.offsets + offsets)


def build_examples(
    rotations: Float[np.ndarray, "N J 3 3"], body: Skeleton, rng: np.random.Generator | None
) -> tuple[Float[np.ndarray, "N I"], Float[np.ndarray, "N B 2"]]:
    """Return inputs and targets of the poses of a body. Without a random generator, all joints are at their true positions."""
    zeros, local = np.zeros((len(rotations), 3)), np.ascontiguousarray(rotations, float)
    positions, _ = compute_tree_poses(build_kinematic_tree(body), zeros, local)
    if rng is None:
        pelvis_rotation = estimate_pelvis_rotation(positions, body)
        return compute_span_directions(positions, pelvis_rotation), compute_twist_targets(rotations, body)
    amplitude = rng.random((len(rotations), 1, 1))
    displacement = MAX_DISPLACEMENT_M * amplitude * (rng.random((len(rotations), 1, 1)) > UNDISPLACED_POSE_SHARE)
    positions += displacement * rng.uniform(-1, 1, positions.shape)
    pelvis_rotation = estimate_pelvis_rotation(positions, body)
    joint_draw, pose_draw = rng.random(positions.shape[:2]), rng.random((len(rotations), 1))
    positions[(joint_draw < LOST_JOINT_SHARE) & (pose_draw < LOSSY_POSE_SHARE)] = np.nan
    return compute_span_directions(positions, pelvis_rotation), compute_twist_targets(rotations, body)


def compute_twist_targets(rotations: Float[np.ndarray, "N J 3 3"], body: Skeleton) -> Float[np.ndarray, "N B 2"]:
    """Return cosine and sine of the twists of all bones in local rotations."""
    return compute_twists(rotations[:, HAS_TWIST], compute_bone_vectors(body)[HAS_TWIST]).astype(np.float32)


def estimate_pelvis_rotation(joint_positions: Float[np.ndarray, "N J 3"], body: Skeleton) -> Float[np.ndarray, "N 3 3"]:
    """Return the rotation of the root, estimated from the positions of the pelvis joints."""
    pelvis = [body.find_joint(name) for name in PELVIS_JOINTS]
    weights = np.ones((len(joint_positions), len(pelvis)))
    cross_covariance, _, _ = compute_cross_covariance(joint_positions[:, pelvis], body.offsets[pelvis], weights)
    return fit_rotations(cross_covariance)
