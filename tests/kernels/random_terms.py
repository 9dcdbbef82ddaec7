"""Random bodies, poses and terms, and what says nothing of each kind.

Every test hands the kernels one of two tuples of terms, so that they are compiled no more than twice: the product's own
where it is enough (and then it is compiled already), or one with all kinds.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.kernels.forward_kinematics import KinematicTree
from mocapfix.kernels.terms import (
    GEMAN_MCCLURE,
    HUBER,
    DirectionTerm,
    DistanceTerm,
    JointLimitTerm,
    LatentCodeTerm,
    OrientationTerm,
    PointTerm,
    PosePriorTerm,
    ReprojectionTerm,
    ScalarTerm,
    TrackingTerm,
)
from tests.kernels import dense_oracle

FEW = ("points", "courses", "targets", "limits")  # the product's own, none of which writes rows
KINDS = (*FEW, "directions", "orientations", "views", "latent", "distances", "whole")
FREE_CAMERA = np.array([0.0, 0.0, 8.0])  # metres: what is within three metres of the origin lies before it


def tree(rng: np.random.Generator, joints: int, shapes: int = 0) -> KinematicTree:
    """-> a random tree: about every fourth joint is fixed, the root never."""
    parents = np.array([-1, *(rng.integers(j) for j in range(1, joints))])
    free = rng.random(joints) < 0.75
    free[0] = True
    return KinematicTree(parents, rng.normal(0, 0.3, (joints, 3)), free, rng.normal(0, 0.1, (shapes, joints, 3)))


def spd(rng: np.random.Generator, count: int, size: int, scale: float = 1.0) -> np.ndarray:
    """-> (count, size, size) random symmetric positive definite matrices."""
    half = rng.normal(size=(count, size, size))
    return scale * (half @ np.swapaxes(half, 1, 2) + 0.1 * np.eye(size))


def rotations(rng: np.random.Generator, count: int, largest: float = 3.0) -> np.ndarray:
    """-> (count, 3, 3) random rotations, each by up to `largest` radians."""
    return Rotation.from_rotvec(rng.uniform(-largest, largest, (count, 3)) / np.sqrt(3)).as_matrix().reshape(-1, 3, 3)


def units(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """-> (*shape, 3) random directions."""
    v = rng.normal(size=(*shape, 3))
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def nothing(joints: int, frames: int = 1) -> dict:
    """-> a term of every kind that says nothing."""
    one, eye = np.zeros(0, int), np.tile(np.eye(3), (joints, 1, 1))
    return {
        "points": PointTerm(one, np.zeros((0, 3)), np.zeros((frames, 0, 3)), np.zeros((frames, 0))),
        "courses": TrackingTerm(eye[None].copy(), np.zeros((1, joints)), np.zeros((1, 3)), np.zeros(1)),
        "targets": PosePriorTerm(eye[None].copy(), np.zeros((1, joints, 3, 3))),
        "directions": DirectionTerm(one, np.zeros((0, 3)), np.zeros((frames, 0, 3)), np.zeros((frames, 0))),
        "orientations": OrientationTerm(one, np.zeros((frames, 0, 3, 3)), np.zeros((frames, 0))),
        "views": ReprojectionTerm(
            one, np.zeros((0, 3)), one, np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros(0, bool), np.zeros((frames, 0, 2)),
            np.zeros((frames, 0)),
        ),
        "limits": JointLimitTerm(eye.copy(), np.full((joints, 3), -np.inf), np.full((joints, 3), np.inf), 1.0),
        "latent": LatentCodeTerm.build(
            eye.copy(), np.zeros((1, joints, 3)), np.zeros((1, joints, 3, 0)), np.zeros((1, 0)), np.zeros((joints, 3, 3)),
            np.zeros(1), np.zeros(1, int),
        ),
        "distances": DistanceTerm(np.zeros((0, 2), int), np.zeros((0, 2, 3)), np.zeros((1, 0)), np.zeros((1, 0))),
        "whole": ScalarTerm(
            np.zeros(frames), np.zeros((frames, joints, 3)), np.tile(np.eye(3), (frames, joints, 1, 1)), np.zeros(frames)
        ),
    }  # fmt: skip


def terms(joints: int, frames: int = 1, **said) -> tuple:
    """-> the tuple of a few kinds where those `said` are among them, else of all; the others in it say nothing."""
    return tuple((nothing(joints, frames) | said)[kind] for kind in (FEW if said.keys() <= set(FEW) else KINDS))


def points(rng, at: dense_oracle.World, count: int, noise: float = 0.02) -> PointTerm:
    """-> markers on random joints, the first of them joints themselves, seen `noise` metres off."""
    joints, places = rng.integers(len(at.local), size=count), rng.normal(0, 0.15, (count, 3))
    places[: count // 3] = 0.0
    seen = dense_oracle.placed(joints, places, at) + rng.normal(0, noise, (count, 3))
    return PointTerm(joints, places, seen[None], rng.uniform(1e2, 1e4, (1, count)), any_loss(rng))


def any_loss(rng) -> int:
    return int(rng.choice([GEMAN_MCCLURE, HUBER]))


def directions(rng, at: dense_oracle.World, count: int) -> DirectionTerm:
    joints = rng.integers(len(at.local), size=count)
    return DirectionTerm(joints, units(rng, count), units(rng, 1, count), rng.uniform(1, 100, (1, count)), any_loss(rng))


def orientations(rng, at: dense_oracle.World, count: int) -> OrientationTerm:
    joints = rng.integers(len(at.local), size=count)
    seen = rotations(rng, count, 2.0) @ at.rotation[joints]
    return OrientationTerm(joints, seen[None], rng.uniform(1, 100, (1, count)), any_loss(rng))


def views(rng, at: dense_oracle.World, count: int) -> ReprojectionTerm:
    """-> points as four cameras round the body see them, two of them perspective, two orthographic."""
    joints, places = rng.integers(len(at.local), size=count), rng.normal(0, 0.15, (count, 3))
    cameras, rotation = rng.integers(4, size=count), rotations(rng, 4)
    translation = FREE_CAMERA - np.einsum("cab,b->ca", rotation, at.position.mean(0))
    seen, weight = rng.normal(0, 0.1, (1, count, 2)), rng.uniform(1e2, 1e4, (1, count))
    return ReprojectionTerm(
        joints, places, cameras, rotation, translation, np.array([True, False, True, False]), seen, weight, any_loss(rng)
    )


def courses(rng, at: dense_oracle.World) -> TrackingTerm:
    weight = rng.uniform(1, 100, (1, len(at.local)))
    weight[rng.random(weight.shape) < 0.2] = 0.0
    wanted = rotations(rng, len(at.local), 2.0) @ at.local
    return TrackingTerm(wanted[None], weight, at.position[:1] + rng.normal(0, 0.1, 3), rng.uniform(10, 200, 1))


def targets(rng, at: dense_oracle.World) -> PosePriorTerm:
    information = spd(rng, len(at.local), 3, 30.0)
    information[rng.random(len(information)) < 0.2] = 0.0
    wanted = rotations(rng, len(at.local), 2.0) @ at.local
    return PosePriorTerm(wanted[None], information[None])


def limits(rng, at: dense_oracle.World) -> JointLimitTerm:
    """-> ranges that some joints keep to, some do not, and some have none."""
    low = rng.uniform(-1, 0, (len(at.local), 3))
    high = low + rng.uniform(0, 2, low.shape)
    low[rng.random(low.shape) < 0.1], high[rng.random(low.shape) < 0.1] = -np.inf, np.inf
    return JointLimitTerm(rotations(rng, len(at.local), 2.0) @ at.local, low, high, float(rng.uniform(1, 1e3)))


def latent(rng, at: dense_oracle.World) -> LatentCodeTerm:
    """-> two linearisations of a decoder of all the shared unknowns, the second the frame's; some joints it does not know."""
    joints, size = len(at.local), len(at.shared)
    information = spd(rng, joints, 3, 30.0)
    information[rng.random(joints) < 0.2] = 0.0
    decoded, slope = rng.normal(0, 0.3, (2, joints, 3)), rng.normal(0, 0.3, (2, joints, 3, size))
    middle, hold = rotations(rng, joints, 2.0) @ at.local, rng.uniform(0, 5, 2)
    information *= at.tree.free[:, None, None]
    return LatentCodeTerm.build(middle, decoded, slope, rng.normal(size=(2, size)), information, hold, np.ones(1, int))


def distances(rng, at: dense_oracle.World, count: int) -> DistanceTerm:
    """-> between random points, about every third pair on one body; the last weighs nothing."""
    joints = rng.integers(len(at.local), size=(count, 2))
    joints[::3, 1] = joints[::3, 0]
    weight = rng.uniform(1e2, 1e4, (1, count))
    weight[:, -1:] = 0.0
    return DistanceTerm(joints, rng.normal(0, 0.15, (count, 2, 3)), rng.uniform(0, 1, (1, count)), weight)


def whole(rng, at: dense_oracle.World) -> ScalarTerm:
    joints = len(at.local)
    taken = rotations(rng, joints, 2.0) @ at.local
    return ScalarTerm(rng.normal(size=1), rng.normal(size=(1, joints, 3)), taken[None], rng.uniform(0.1, 10, 1))


def term(kind: str, rng, at: dense_oracle.World):
    """-> a random term of a kind."""
    counts = {"points": 9, "directions": 5, "orientations": 4, "views": 8, "distances": 4}
    return globals()[kind](rng, at, *([counts[kind]] if kind in counts else []))


def frame(rng: np.random.Generator, joints: int, kinds=KINDS, shapes: int = 0, codes: int = 0) -> dense_oracle.Frame:
    """-> a random body in a random pose with random terms of some kinds; `shapes` or `codes` unknowns shared."""
    body, root, local = tree(rng, joints, shapes), rng.normal(0, 1.0, 3), rotations(rng, joints)
    shared = rng.normal(size=shapes + codes)
    at = dense_oracle.world(body, root, local, shared)
    spoken = [kind for kind in kinds if kind != "latent" or not shapes]
    return dense_oracle.Frame(body, terms(joints, **{kind: term(kind, rng, at) for kind in spoken}), root, local, shared)
