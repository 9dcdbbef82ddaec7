"""What each joint turns: its children, the markers that ride on it, and joints beyond a child that does not turn itself."""

from typing import NamedTuple

import numpy as np

from mocapfix.kernels.hybrik import Bones
from mocapfix.kernels.root import Carried
from mocapfix.prior import Prior
from mocapfix.skeleton import Skeleton
from mocapfix.subject import Subject

CONFLICT = ("Head", "LeftHand", "RightHand")  # the roots of sub-trees, which are also the last of the body's (HybrIK-X, 3.2.3)
BONE = 1e-4  # metres: joints nearer to one another have no bone between them
STIFF = 0.1  # radians: how far a child turns that hardly does, as a clavicle
MARKER = 0.01  # metres per axis: how far a marker strays from its place on the body
AFAR = 10.0  # metres: as good as nothing beside what the hips carry; but where none of that is known, the trunk tells the root


class Wearing(NamedTuple):
    """A subject, and whether its markers are seen."""

    subject: Subject
    seen: bool


def away(skeleton: Skeleton) -> np.ndarray:
    """-> (J,) bool: joints that lie away from their parents, so that there is a bone between."""
    return (np.linalg.norm(skeleton.offsets, axis=1) > BONE) & (skeleton.parents >= 0)


def stubs(skeleton: Skeleton, habits: Prior) -> np.ndarray:
    """-> (J,) bool: joints that never turn and lie on the one before: the hips', whose turn would be the thighs' over again."""
    return stiff(habits) & ~away(skeleton)


def stiff(habits: Prior) -> np.ndarray:
    """-> (J,) bool: joints that the mean pose holds about all axes."""
    return np.linalg.matrix_rank(habits.held) == 3


def bones_of(skeleton: Skeleton, habits: Prior, wearing: Wearing, held: np.ndarray) -> tuple[Bones, Carried]:
    """-> the bones, and what tells the root. Markers are points beyond the joints, in the subject's order.

    habits  the mean pose; a joint that it holds about all axes is stiff: what it carries goes with the joint before
    held    (J,) bool: joints that are left in the mean pose
    """
    joints, parents = len(skeleton.names), skeleton.parents
    rows = [points(j, skeleton, habits, wearing) for j in range(joints)]
    of_root, rows[0] = rows[0], []
    source, place, child, spread = columns([row for each in rows for row in each])
    ahead = np.full(joints, -1)
    for k in (skeleton.index(name) for name in CONFLICT):
        ahead[parents[parents[k]]] = k
    first = np.cumsum([0, *map(len, rows)])
    turns = np.array([any(row[2] for row in each) for each in rows]) & ~held
    tells = np.concatenate([off_axis(each) for each in rows])
    bones = Bones(parents, skeleton.offsets, turns, first, source, place, child, tells, spread, ahead)
    carried = {row[0] for row in of_root}
    source, place, _, spread = columns(of_root + [row for row in trunk(skeleton, habits) if row[0] not in carried])
    twin = (np.linalg.norm(place[:, None] - place, axis=2) < BONE).argmax(axis=1)
    return bones, Carried(source, place, spread, twin)


def points(j: int, skeleton: Skeleton, habits: Prior, wearing: Wearing) -> list[tuple]:
    """-> source, place, whether it is a child, and spread, of all points that joint `j` turns."""
    offsets, subject, found = skeleton.offsets, wearing.subject, []
    at_root = [(0, np.zeros(3), False, 0.0)] if j == 0 else []
    for c in np.flatnonzero(skeleton.parents == j):
        apart = away(skeleton)[c]
        if apart or j == 0:
            found.append((c, offsets[c], apart, 0.0))
        if stiff(habits)[c]:
            for g in np.flatnonzero(skeleton.parents == c):
                beyond = habits.rotations[c] @ offsets[g]
                spread = (STIFF * np.linalg.norm(offsets[g])) ** 2 if apart else 0.0
                found.append((g, offsets[c] + beyond, False, spread))
    worn = np.flatnonzero(subject.joints == j) if wearing.seen else []
    leaf = not len(found)
    return at_root + found + [(len(skeleton.names) + k, subject.places[k], leaf, MARKER**2) for k in worn]


def off_axis(rows: list[tuple]) -> np.ndarray:
    """-> (P,) bool: of a joint's points, all but children at the end of its one bone, who say nothing of its twist."""
    places, children = (np.array([row[at] for row in rows]) for at in (1, 2))
    if not children.any():
        return np.ones(len(rows), bool)
    return ~children | (np.linalg.norm(places - places[children].mean(axis=0), axis=1) > BONE)


def trunk(skeleton: Skeleton, habits: Prior) -> list[tuple]:
    """-> all joints but the limbs', as the mean pose has them, AFAR from sure."""
    found, places, turned = [], {0: np.zeros(3)}, {0: np.eye(3)}
    for j in range(1, len(skeleton.parents)):
        p = int(skeleton.parents[j])
        if p in places and not skeleton.names[j].endswith(("UpLeg", "ForeArm")):
            places[j], turned[j] = places[p] + turned[p] @ skeleton.offsets[j], turned[p] @ habits.rotations[j]
            found.append((j, places[j], False, AFAR**2))
    return found


def columns(rows: list[tuple]) -> tuple[np.ndarray, ...]:
    """-> sources, places, whether they are children, and spreads, each as the kernels want it."""
    source, place, child, spread = zip(*rows, strict=True)
    return np.array(source), np.ascontiguousarray(place, float), np.array(child, bool), np.array(spread, float)
