"""Initial poses by learned inverse kinematics: what no marker shows is inferred from the rest of the body."""

import numpy as np
from jaxtyping import Bool

from mocapfix.initialise.joint_positions import JointEstimate
from mocapfix.learned_ik.network import load_shipped_ik_network
from mocapfix.learned_ik.regressor import PoseRegressor
from mocapfix.motion import Motion
from mocapfix.solve.kinematics import compute_world_poses
from mocapfix.subject import Subject

LEARNED_START_PASSES = 2  # a third changes hardly anything
MIN_SEGMENT_TRUST = 0.25
"""Robust weight from which a marker shows the rotation of its segment."""


def infer_unseen_joints(motion: Motion, estimate: JointEstimate, subject: Subject, rate_hz: float) -> Motion:
    """Return poses whose joints without a visible marker have the rotations that the network infers; the others are unchanged.

    motion    closed-form poses of all frames
    estimate  the joint positions that they are made of
    """
    model = PoseRegressor(load_shipped_ik_network(), subject.skeleton, LEARNED_START_PASSES)
    joint_sd = np.nan_to_num(estimate.sd, nan=1.0)
    start = motion.root_position, motion.local_rotations
    is_seen = find_seen_segments(estimate, subject)
    positions = np.where(is_given_joint(is_seen, subject)[..., None], estimate.positions, np.nan)
    root, local = model.refine_take(start, positions, joint_sd, rate_hz)
    seen_world = compute_world_poses(subject.skeleton, motion)[1]
    learned = Motion(root, local, motion.status, motion.iterations, motion.marker_sd, motion.joint_sd)
    world = np.where(is_seen[..., None, None], seen_world, compute_world_poses(subject.skeleton, learned)[1])
    parents = subject.skeleton.parents
    combined = np.swapaxes(world[:, np.maximum(parents, 0)], 2, 3) @ world
    combined[:, 0] = world[:, 0]
    root = np.where(is_seen[:, :1], motion.root_position, root)
    return Motion(root, combined, motion.status, motion.iterations, motion.marker_sd, motion.joint_sd)


def find_seen_segments(estimate: JointEstimate, subject: Subject) -> Bool[np.ndarray, "T J"]:
    """Return in which frames a marker shows each joint's own segment."""
    is_seen = np.zeros(estimate.sd.shape, bool)
    for marker, joint in enumerate(subject.joints):
        is_seen[:, joint] |= estimate.marker_trust[:, marker] > MIN_SEGMENT_TRUST
    return is_seen


def is_given_joint(is_seen: Bool[np.ndarray, "T J"], subject: Subject) -> Bool[np.ndarray, "T J"]:
    """Return which joints have a position that markers determine: those at an end of a segment with markers."""
    parents = np.maximum(subject.skeleton.parents, 0)
    return is_seen | is_seen[:, parents]
