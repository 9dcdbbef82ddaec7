"""A first pose for every frame in closed form, from the segments' rigid registration to their seen markers."""

import numpy as np

from mocapfix.kernels.joint_registration import register_limb_frames
from mocapfix.kernels.rigid_registration import compute_cross_covariance, fit_rotations
from mocapfix.motion import Motion
from mocapfix.pose_prior.mean_pose import MeanPosePrior
from mocapfix.skeleton import Skeleton
from mocapfix.solve.parallel import run_over_frames
from mocapfix.subject import Subject

PELVIS_MARKER_WEIGHT = 3.0  # the pelvis says more of the root than the chest does


def register_poses(subject: Subject, free: np.ndarray, prior: MeanPosePrior, markers: np.ndarray) -> Motion:
    """-> every frame's pose from its own markers alone.

    The root from pelvis and chest in the mean pose; then down the tree each joint that carries markers is turned about
    its own place to fit them, and the joints between it and the last such joint share the turn. What no marker says,
    the mean pose does; a frame with fewer than three markers on the trunk takes its root from its neighbours in time.

    free     (J,) bool: the joints that may turn
    markers  (T, K, 3) metres, in the subject's order, NaN where not believed
    """
    skeleton, frames = subject.skeleton, len(markers)
    root, local = register_trunk(subject, prior, markers)
    turning = find_shared_rotations(skeleton, subject.joints, free)
    run_over_frames(
        register_limb_frames, frames, skeleton.parents, skeleton.offsets, turning, subject.joints, subject.marker_offsets,
        np.ascontiguousarray(markers), root, local,
    )  # fmt: skip
    zeros = np.zeros(frames, int)
    return Motion(root, local, zeros, zeros, np.full(markers.shape[:2], np.nan), np.full(local.shape[:2], np.nan))


def register_trunk(subject: Subject, prior: MeanPosePrior, markers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """-> root (T, 3) and local rotations (T, J, 3, 3): the mean pose, its root fitted to the pelvis and the chest."""
    skeleton, joints, places = subject.skeleton, subject.joints, subject.marker_offsets
    local = np.tile(prior.mean_rotations, (len(markers), 1, 1, 1))
    model = np.full(places.shape, np.nan)
    position, rotation = np.zeros(3), np.eye(3)
    model[joints == 0] = places[joints == 0]
    for j in find_trunk_chain(skeleton, joints):
        position, rotation = position + rotation @ skeleton.offsets[j], rotation @ prior.mean_rotations[j]
        model[joints == j] = position + places[joints == j] @ rotation.T
    used = ~np.isnan(model[:, 0])
    weight = ~np.isnan(markers[:, used, 0]) * np.where(joints[used] == 0, PELVIS_MARKER_WEIGHT, 1.0)
    cross, here, there = compute_cross_covariance(markers[:, used], model[used], weight)
    turn = fit_rotations(cross)
    root = here - np.einsum("tab,tb->ta", turn, there)
    known = np.flatnonzero((weight > 0).sum(1) >= 3)
    if len(known) == 0:
        known = np.flatnonzero((weight > 0).any(1))[:1]
    if len(known) == 0:
        return np.zeros((len(markers), 3)), local
    frames = np.arange(len(markers))
    nearest = known[np.rint(np.interp(frames, known, np.arange(len(known)))).astype(int)]
    for a in range(3):
        root[:, a] = np.interp(frames, known, root[known, a])
    local[:, 0] = turn[nearest]
    return root, local


def find_trunk_chain(skeleton: Skeleton, joints: np.ndarray) -> list[int]:
    """-> the joints from below the root to the first one up the spine that carries three markers or more."""
    for j in range(1, len(skeleton.parents)):
        if (joints == j).sum() >= 3:
            chain = [j]
            while skeleton.parents[chain[0]] > 0:
                chain.insert(0, int(skeleton.parents[chain[0]]))
            if not any((joints == c).any() for c in chain[:-1]):
                return chain
    return []


def find_shared_rotations(skeleton: Skeleton, joints: np.ndarray, free: np.ndarray) -> np.ndarray:
    """-> (J, J) bool: row j holds the joints that share the turn of j, itself among them; none where j is not turned.

    These are the free ones between j and the last joint above it that carries markers.
    """
    turning = np.zeros((len(free), len(free)), bool)
    carrying = set(joints.tolist()) | {0}
    for j in carrying - {0}:
        chain = [j]
        while int(skeleton.parents[chain[-1]]) not in carrying:
            chain.append(int(skeleton.parents[chain[-1]]))
        turning[j, chain] = free[chain] & free[j]
    return turning
