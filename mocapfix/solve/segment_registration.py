"""Closed-form initial poses by rigid registration of the body's segments to their visible markers."""

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.kernels.joint_registration import register_limb_frames
from mocapfix.model.motion import Motion
from mocapfix.model.skeleton import Skeleton, find_common_joint, list_path
from mocapfix.model.subject import Subject
from mocapfix.solve.mean_pose import MeanPosePrior
from mocapfix.solve.parallel import run_over_frames
from mocapfix.stats.rigid_alignment import compute_cross_covariance, fit_rotations

PELVIS_MARKER_WEIGHT = 3.0  # of a pelvis marker relative to a chest marker, as the chest moves relative to the root
MIN_TRUNK_MARKERS = 3  # in a frame that determines the root, and on the joint of the chest


def register_poses(
    subject: Subject, free: Bool[np.ndarray, " J"], prior: MeanPosePrior, markers: Float[np.ndarray, "T K 3"]
) -> Motion:
    """Return every frame's pose from its own markers alone.

    The root is fitted to pelvis and chest in the mean pose, or, without pelvis markers, to the segments nearest to it. Then, down
    the tree, each joint that carries markers is rotated about its own position to fit them, and the joints between it and the
    last such joint share the rotation. Without markers, the mean pose is kept; a frame with fewer than three markers on the
    trunk takes its root from its neighbours in time.

    Args:
        free: Joints that may rotate.
        markers: Metres, in the subject's order, NaN where missing or rejected.
    """
    skeleton, frames = subject.skeleton, len(markers)
    root, local = register_trunk(subject, prior, markers)
    shared_rotations = find_shared_rotations(skeleton, subject.joints, free)
    run_over_frames(
        register_limb_frames, frames, skeleton.parents, skeleton.offsets, shared_rotations, subject.joints,
        subject.marker_offsets, np.ascontiguousarray(markers), root, local,
    )  # fmt: skip
    zeros = np.zeros(frames, int)
    return Motion(root, local, zeros, zeros, np.full(markers.shape[:2], np.nan), np.full(local.shape[:2], np.nan))


def register_trunk(
    subject: Subject, prior: MeanPosePrior, markers: Float[np.ndarray, "T K 3"]
) -> tuple[Float[np.ndarray, "T 3"], Float[np.ndarray, "T J 3 3"]]:
    """Return root positions and local rotations: the mean pose, its root fitted to the markers of pelvis and chest."""
    skeleton, joints, offsets = subject.skeleton, subject.joints, subject.marker_offsets
    local = np.tile(prior.mean_rotations, (len(markers), 1, 1, 1))
    model = np.full(offsets.shape, np.nan)
    position, rotation = np.zeros(3), np.eye(3)
    marker_weight = np.where(joints == 0, PELVIS_MARKER_WEIGHT, 1.0)
    if (joints == 0).any():
        model[joints == 0] = offsets[joints == 0]
        for j in find_trunk_chain(skeleton, joints):
            position, rotation = position + rotation @ skeleton.offsets[j], rotation @ prior.mean_rotations[j]
            model[joints == j] = position + offsets[joints == j] @ rotation.T
    else:
        model, marker_weight = place_mean_pose_markers(subject, prior)
    used = ~np.isnan(model[:, 0])
    weight = ~np.isnan(markers[:, used, 0]) * marker_weight[used]
    cross, mean_markers, mean_model = compute_cross_covariance(markers[:, used], model[used], weight)
    root_rotation = fit_rotations(cross)
    root = mean_markers - np.einsum("tab,tb->ta", root_rotation, mean_model)
    known = np.flatnonzero((weight > 0).sum(1) >= MIN_TRUNK_MARKERS)
    if len(known) == 0:
        known = np.flatnonzero((weight > 0).any(1))[:1]
    if len(known) == 0:
        return np.zeros((len(markers), 3)), local
    frames = np.arange(len(markers))
    nearest = known[np.rint(np.interp(frames, known, np.arange(len(known)))).astype(int)]
    for a in range(3):
        root[:, a] = np.interp(frames, known, root[known, a])
    local[:, 0] = root_rotation[nearest]
    return root, local


def place_mean_pose_markers(subject: Subject, prior: MeanPosePrior) -> tuple[Float[np.ndarray, "K 3"], Float[np.ndarray, " K"]]:
    """Return the markers of a body without pelvis markers in the mean pose, in metres in the axes of the root, and their weights.

    The segment nearest to the root keeps its place relative to it (see `restrict_body`), those beyond turn.
    """
    skeleton, joints = subject.skeleton, subject.joints
    top = find_common_joint(skeleton.parents, set(joints.tolist()))
    positions, rotations = np.zeros((len(skeleton.parents), 3)), np.tile(np.eye(3), (len(skeleton.parents), 1, 1))
    depth = np.zeros(len(skeleton.parents))
    for j in range(1, len(skeleton.parents)):
        p = skeleton.parents[j]
        positions[j] = positions[p] + rotations[p] @ skeleton.offsets[j]
        rotations[j] = rotations[p] @ prior.mean_rotations[j]
        depth[j] = 0 if j == top else depth[p] + 1
    model = positions[joints] + np.einsum("kab,kb->ka", rotations[joints], subject.marker_offsets)
    return model, PELVIS_MARKER_WEIGHT ** -depth[joints]


def find_trunk_chain(skeleton: Skeleton, joints: Int[np.ndarray, " K"]) -> list[int]:
    """Return the joints from below the root to the first joint up the spine that carries three markers or more."""
    for j in range(1, len(skeleton.parents)):
        if (joints == j).sum() >= MIN_TRUNK_MARKERS:
            chain = list_path(j, 0, skeleton.parents)
            if not any((joints == c).any() for c in chain[:-1]):
                return chain
    return []


def find_shared_rotations(
    skeleton: Skeleton, joints: Int[np.ndarray, " K"], free: Bool[np.ndarray, " J"]
) -> Bool[np.ndarray, "J J"]:
    """Return a mask whose row j marks the joints that share the rotation of j, itself included; empty if j is not rotated.

    These are the free joints between j and the last joint above it that carries markers.
    """
    shared_rotations = np.zeros((len(free), len(free)), bool)
    carrying: set[int] = set(joints.tolist()) | {0}
    for j in carrying - {0}:
        chain = [j]
        while int(skeleton.parents[chain[-1]]) not in carrying:
            chain.append(int(skeleton.parents[chain[-1]]))
        shared_rotations[j, chain] = free[chain] & free[j]
    return shared_rotations
