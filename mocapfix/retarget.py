"""Poses of a file's body as poses of the 31 joints, and back into the file's joints."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.animation import Animation
from mocapfix.fitted import Fitted
from mocapfix.hierarchies import ancestor, below, way
from mocapfix.skeleton import Skeleton

SHARING = ("LowerBack", "Spine", "Spine1", "Neck", "Neck1", "Head")  # of a bend between two known ones each takes its part


def to_cmu31(animation: Animation, fit: Fitted) -> tuple[np.ndarray, np.ndarray]:
    """-> root (T, 3) in metres and local rotations (T, 31, 3, 3) of `fit.skeleton`, in its axes: a T-pose facing +Z at rest.

    Joints without a counterpart rest on their parent, but those of the trunk and the neck, which share evenly in the turn
    between the two known joints they lie between.
    """
    positions, rotations = animation.world()
    return positions[:, fit.joints[0]], ours(rotations, fit)


def ours(rotations: np.ndarray, fit: Fitted) -> np.ndarray:
    """-> (T, 31, 3, 3) local rotations as `to_cmu31`, of the file's joints turned as rotations (T, J, 3, 3) in the world say."""
    parents, known = fit.skeleton.parents, fit.joints >= 0
    world = np.tile(np.eye(3), (len(rotations), len(parents), 1, 1))
    world[:, known] = rotations[:, fit.joints[known]] @ fit.turns[known]
    local = np.tile(np.eye(3), (len(rotations), len(parents), 1, 1))
    for joint in np.flatnonzero(known).tolist():
        above = ancestor(joint, parents, known)
        turn = np.swapaxes(world[:, above], 1, 2) @ world[:, joint] if above >= 0 else world[:, joint]
        chain = _sharing(joint, above, fit.skeleton)
        part = turn if len(chain) == 1 else _power(turn, 1 / len(chain))
        local[:, chain] = part[:, None]
    return local


def from_cmu31(
    animation: Animation, fit: Fitted, joints: Sequence[int], frames: np.ndarray, rotations: np.ndarray
) -> np.ndarray:
    """-> (T, C) the animation's values with some of the 31 joints (n,) in some frames (m,) turned as local rotations
    (m, 31, 3, 3) say; the inverse of `to_cmu31` for these.

    A joint without a counterpart turns the next below it that has one, if there is one. What lies between two counterparts in
    the file's tree stays as it is, and the lower of them takes the whole turn: its orientation in the world is exact.
    """
    known = fit.joints >= 0
    local = animation.with_values(animation.values[frames]).rotations()
    turned = sorted({each for joint in joints for each in below(int(joint), fit.skeleton.parents, known)})
    new = np.empty((len(frames), len(turned), 3, 3))
    for at, joint in enumerate(turned):
        new[:, at] = theirs(animation.parents, local, fit, joint, rotations)
    return animation.with_rotations(fit.joints[turned], frames, new)


def theirs(parents: np.ndarray, local: np.ndarray, fit: Fitted, joint: int, rotations: np.ndarray) -> np.ndarray:
    """-> (m, 3, 3) the local rotation of the file's joint for one of ours, where ours turn as rotations (m, 31, 3, 3) and the
    file's, in a tree parents (J,), as local (m, J, 3, 3) say."""
    above, own = ancestor(joint, fit.skeleton.parents, fit.joints >= 0), fit.joints[joint]
    turn = _product(rotations, way(joint, above, fit.skeleton.parents))
    lead = fit.turns[above] if above >= 0 else np.eye(3)
    between = way(int(parents[own]), fit.joints[above] if above >= 0 else -1, parents)
    return np.swapaxes(_product(local, between), 1, 2) @ lead @ turn @ fit.turns[joint].T


def _product(local: np.ndarray, joints: list[int]) -> np.ndarray:
    """-> (m, 3, 3) the product of local rotations (m, J, 3, 3) along a way."""
    turn = np.tile(np.eye(3), (len(local), 1, 1))
    for joint in joints:
        turn = turn @ local[:, joint]
    return turn


def _sharing(joint: int, above: int, skeleton: Skeleton) -> list[int]:
    """-> the joints that share in the turn from a known joint above to `joint`: those of the trunk, or it alone."""
    between = way(joint, above, skeleton.parents)
    return between if all(skeleton.names[each] in SHARING for each in between) else [joint]


def _power(rotations: np.ndarray, part: float) -> np.ndarray:
    """-> (T, 3, 3) of rotations (T, 3, 3) the part of their angle, NaN where they are."""
    parts, there = rotations.copy(), np.isfinite(rotations).all((1, 2))
    parts[there] = Rotation.from_rotvec(Rotation.from_matrix(rotations[there]).as_rotvec() * part).as_matrix()
    return parts
