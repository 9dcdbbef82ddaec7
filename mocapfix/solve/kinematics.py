"""Forward kinematics of motions: world positions of joints and markers."""

from typing import TypeAlias

import numpy as np
from jaxtyping import Float

from mocapfix.kernels.forward_kinematics import KinematicTree, compute_marker_frames, compute_world_frames
from mocapfix.model.motion import Motion
from mocapfix.model.skeleton import Skeleton, find_common_joint
from mocapfix.model.subject import Subject
from mocapfix.solve.parallel import run_over_frames

Poses: TypeAlias = tuple[Float[np.ndarray, "T 3"], Float[np.ndarray, "T J 3 3"]]  # root positions in metres and local rotations

DISTANCE_BLOCK_FRAMES = 4096  # frames whose marker positions are held at a time where only their distances are needed


def build_kinematic_tree(skeleton: Skeleton) -> KinematicTree:
    """Return the skeleton for the kernels, all joints free."""
    return KinematicTree(skeleton.parents, skeleton.offsets, np.ones(len(skeleton.parents), bool))


def compute_world_poses(skeleton: Skeleton, motion: Motion) -> tuple[Float[np.ndarray, "T J 3"], Float[np.ndarray, "T J 3 3"]]:
    """Return joint positions in metres and rotations, in the world."""
    return compute_tree_poses(build_kinematic_tree(skeleton), motion.root_position, motion.local_rotations)


def compute_tree_poses(
    tree: KinematicTree, root_position: Float[np.ndarray, "T 3"], local_rotations: Float[np.ndarray, "T J 3 3"]
) -> tuple[Float[np.ndarray, "T J 3"], Float[np.ndarray, "T J 3 3"]]:
    """Return joint positions in metres and rotations, in the world, of poses of a tree."""
    position, rotation = np.empty(local_rotations.shape[:3]), np.empty(local_rotations.shape)
    run_over_frames(compute_world_frames, len(root_position), tree, root_position, local_rotations, position, rotation)
    return position, rotation


def compute_anchor_offset(tree: KinematicTree, local_rotations: Float[np.ndarray, "T J 3 3"]) -> Float[np.ndarray, "T 3"]:
    """Return the position relative to the root, in metres, of the joint nearest to it whose motion markers show.

    It is 0 for a whole body. The root of a part of a body may be far from all markers, so that a small rotation displaces it far.
    """
    origin, free_below_root = np.zeros((len(local_rotations), 3)), np.flatnonzero(tree.free)[1:].tolist()
    anchor = find_common_joint(tree.parents, free_below_root) if free_below_root else 0
    return compute_tree_poses(tree, origin, local_rotations)[0][:, anchor] if anchor else origin


def compute_joint_and_marker_positions(
    subject: Subject, motion: Motion
) -> tuple[Float[np.ndarray, "T J 3"], Float[np.ndarray, "T K 3"]]:
    """Return world positions of the joints and of the subject's markers, in metres."""
    return _compute_positions(subject, (motion.root_position, motion.local_rotations))


def predict_markers(subject: Subject, pose: Poses) -> Float[np.ndarray, "T K 3"]:
    """Return where the body carries the subject's markers, in metres."""
    return _compute_positions(subject, pose)[1]


def compute_marker_distances(subject: Subject, pose: Poses, markers: Float[np.ndarray, "T K 3"]) -> Float[np.ndarray, "T K"]:
    """Return the distances in metres of markers from where the body carries them, NaN where missing."""
    distance = np.empty(markers.shape[:2])
    for first in range(0, len(markers), DISTANCE_BLOCK_FRAMES):
        block = slice(first, first + DISTANCE_BLOCK_FRAMES)
        predicted = predict_markers(subject, (pose[0][block], pose[1][block]))
        distance[block] = np.linalg.norm(markers[block] - predicted, axis=-1)
    return distance


def _compute_positions(subject: Subject, pose: Poses) -> tuple[Float[np.ndarray, "T J 3"], Float[np.ndarray, "T K 3"]]:
    frames = len(pose[0])
    joints, markers = np.empty(pose[1].shape[:3]), np.empty((frames, len(subject.joints), 3))
    run_over_frames(
        compute_marker_frames, frames, build_kinematic_tree(subject.skeleton), subject.joints, subject.marker_offsets, *pose,
        joints, markers,
    )  # fmt: skip
    return joints, markers
