"""A first pose for every frame in closed form, from the segments' rigid registration to their seen markers."""

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.motion import Motion
from mocapfix.prior import Prior
from mocapfix.skeleton import Skeleton
from mocapfix.subject import Subject

MEAN_WEIGHT = 3e-3  # m^2: how much the mean pose's rotation counts beside markers (a marker counts its squared lever)
PELVIS_WEIGHT = 3.0  # the pelvis says more of the root than the chest does


def fitted(cross: np.ndarray) -> np.ndarray:
    """-> the rotations (T, 3, 3) that maximise trace(R' cross), never a reflection (Kabsch 1976).

    cross  (T, 3, 3) sums of outer products, measured by model
    """
    u, _, vt = np.linalg.svd(cross)
    u[..., 2] *= np.linalg.det(u @ vt)[..., None]
    return u @ vt


def centred(seen: np.ndarray, places: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """-> cross (T, 3, 3) of markers (T, K, 3) against places (K, 3) about their weighted means (T, 3), and the means."""
    total = np.maximum(weight.sum(1), 1e-12)[:, None]
    here = np.einsum("tk,tka->ta", weight, seen) / total
    there = np.einsum("tk,ka->ta", weight, places) / total
    cross = np.einsum("tk,tka,tkb->tab", weight, seen - here[:, None], places[None] - there[:, None])
    return cross, here, there


def poses(subject: Subject, free: np.ndarray, prior: Prior, markers: np.ndarray) -> Motion:
    """-> every frame's pose from its own markers alone.

    The root from pelvis and chest in the mean pose; then down the tree each joint that carries markers is turned about
    its own place to fit them, and the joints between it and the last such joint share the turn. What no marker says,
    the mean pose does; a frame with fewer than three markers on the trunk takes its root from its neighbours in time.

    free     (J,) bool: the joints that may turn
    markers  (T, K, 3) metres, in the subject's order, NaN where not believed
    """
    skeleton, joints, places = subject.skeleton, subject.joints, subject.places
    believed = ~np.isnan(markers[..., 0])
    seen = np.where(believed[..., None], markers, 0.0)
    weight = believed.astype(float)
    root, local = trunk(skeleton, joints, places, prior, seen, weight)
    position, rotation = np.empty(local.shape[:2] + (3,)), np.empty(local.shape)
    position[:, 0], rotation[:, 0] = root, local[:, 0]
    carrying = set(joints.tolist()) | {0}
    for j in range(1, len(skeleton.parents)):
        chain = [j]
        while int(skeleton.parents[chain[-1]]) not in carrying:
            chain.append(int(skeleton.parents[chain[-1]]))
        if j in carrying:
            for c in reversed(chain):
                place_joint(skeleton, c, local, position, rotation)
            if not free[j]:
                continue  # its markers cannot turn it
            mine = joints == j
            target = turned_to(seen[:, mine], places[mine], weight[:, mine], position[:, j], rotation[:, j])
            share(skeleton, [c for c in chain[::-1] if free[c]], target, local, position, rotation)
        else:
            place_joint(skeleton, j, local, position, rotation)
    zeros = np.zeros(len(root), int)
    return Motion(root, local, zeros, zeros, np.full(weight.shape, np.nan), np.full(local.shape[:2], np.nan))


def trunk(skeleton, joints, places, prior, seen, weight) -> tuple[np.ndarray, np.ndarray]:
    """-> root (T, 3) and local rotations (T, J, 3, 3): the mean pose, its root fitted to the pelvis and the chest."""
    local = np.tile(prior.rotations, (len(seen), 1, 1, 1))
    chest = trunk_chain(skeleton, joints)
    model = np.full(places.shape, np.nan)
    position, rotation = np.zeros(3), np.eye(3)
    model[joints == 0] = places[joints == 0]
    for j in chest:
        position, rotation = position + rotation @ skeleton.offsets[j], rotation @ prior.rotations[j]
        model[joints == j] = position + places[joints == j] @ rotation.T
    used = ~np.isnan(model[:, 0])
    weight = weight[:, used] * np.where(joints[used] == 0, PELVIS_WEIGHT, 1.0)
    cross, here, there = centred(seen[:, used], model[used], weight)
    turn = fitted(cross)
    root = here - np.einsum("tab,tb->ta", turn, there)
    known = np.flatnonzero((weight > 0).sum(1) >= 3)
    if len(known) == 0:
        known = np.flatnonzero((weight > 0).any(1))[:1]
    if len(known) == 0:
        return np.zeros((len(seen), 3)), local
    frames = np.arange(len(seen))
    nearest = known[np.rint(np.interp(frames, known, np.arange(len(known)))).astype(int)]
    for a in range(3):
        root[:, a] = np.interp(frames, known, root[known, a])
    local[:, 0] = turn[nearest]
    return root, local


def trunk_chain(skeleton: Skeleton, joints: np.ndarray) -> list[int]:
    """-> the joints from below the root to the first one up the spine that carries three markers or more."""
    for j in range(1, len(skeleton.parents)):
        if (joints == j).sum() >= 3:
            chain = [j]
            while skeleton.parents[chain[0]] > 0:
                chain.insert(0, int(skeleton.parents[chain[0]]))
            if not any((joints == c).any() for c in chain[:-1]):
                return chain
    return []


def place_joint(skeleton, j, local, position, rotation) -> None:
    """Write the world place of one joint from its parent's."""
    p = skeleton.parents[j]
    rotation[:, j] = rotation[:, p] @ local[:, j]
    position[:, j] = position[:, p] + rotation[:, p] @ skeleton.offsets[j]


def turned_to(seen, places, weight, centre, mean) -> np.ndarray:
    """-> world rotations (T, 3, 3) of a joint at `centre` (T, 3), near `mean` where the markers leave it open."""
    cross = np.einsum("tk,tka,kb->tab", weight, seen - centre[:, None], places) + MEAN_WEIGHT * mean
    if places.shape[0] >= 3:  # markers enough to tell the turn without trusting the joint's place
        free = weight.sum(1) >= 3
        cross[free] = centred(seen[free], places, weight[free])[0] + MEAN_WEIGHT * mean[free]
    return fitted(cross)


def share(skeleton, chain, target, local, position, rotation) -> None:
    """Turn the joints of `chain` by equal parts so that the last one's world rotation becomes `target`."""
    step = Rotation.from_matrix(np.swapaxes(rotation[:, chain[-1]], 1, 2) @ target)
    part = Rotation.from_rotvec(step.as_rotvec() / len(chain)).as_matrix()
    for j in range(chain[0], chain[-1] + 1):
        if j in chain:
            local[:, j] = local[:, j] @ part
        place_joint(skeleton, j, local, position, rotation)
    last, p = chain[-1], skeleton.parents[chain[-1]]
    rotation[:, last] = target
    local[:, last] = np.swapaxes(rotation[:, p], 1, 2) @ target
