"""Random bodies, poses and terms, and empty terms.

Every test passes the kernels one of two tuples of terms, so that they are compiled at most twice: the solver's own where it is
sufficient (and already compiled), or one of all kinds.
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

SOLVER_KINDS = ("points", "tracking", "pose_prior", "joint_limits")  # the solver's own, none of which writes rows
ALL_KINDS = (*SOLVER_KINDS, "directions", "orientations", "reprojection", "latent_code", "distances", "scalar")
CAMERA_TRANSLATION = np.array([0.0, 0.0, 8.0])  # metres: points within three metres of the origin are in front of the camera


def draw_tree(rng: np.random.Generator, joints: int) -> KinematicTree:
    """Return a random tree: about every fourth joint is fixed, the root never."""
    parents = np.array([-1, *(rng.integers(j) for j in range(1, joints))])
    free = rng.random(joints) < 0.75
    free[0] = True
    return KinematicTree(parents, rng.normal(0, 0.3, (joints, 3)), free)


def draw_spd(rng: np.random.Generator, count: int, size: int, scale: float = 1.0) -> np.ndarray:
    """Return (count, size, size) random symmetric positive definite matrices."""
    half = rng.normal(size=(count, size, size))
    return scale * (half @ np.swapaxes(half, 1, 2) + 0.1 * np.eye(size))


def draw_rotations(rng: np.random.Generator, count: int, largest: float = 3.0) -> np.ndarray:
    """Return (count, 3, 3) random rotations, each by up to `largest` radians."""
    return Rotation.from_rotvec(rng.uniform(-largest, largest, (count, 3)) / np.sqrt(3)).as_matrix().reshape(-1, 3, 3)


def draw_units(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """Return (*shape, 3) random directions."""
    v = rng.normal(size=(*shape, 3))
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def build_empty_terms(joints: int, frames: int = 1) -> dict:
    """Return an empty term of every kind, by kind."""
    one, eye = np.zeros(0, int), np.tile(np.eye(3), (joints, 1, 1))
    return {
        "points": PointTerm(one, np.zeros((0, 3)), np.zeros((frames, 0, 3)), np.zeros((frames, 0))),
        "tracking": TrackingTerm(eye[None].copy(), np.zeros((1, joints)), np.zeros((1, 3)), np.zeros(1)),
        "pose_prior": PosePriorTerm(eye[None].copy(), np.zeros((1, joints, 3, 3))),
        "directions": DirectionTerm(one, np.zeros((0, 3)), np.zeros((frames, 0, 3)), np.zeros((frames, 0))),
        "orientations": OrientationTerm(one, np.zeros((frames, 0, 3, 3)), np.zeros((frames, 0))),
        "reprojection": ReprojectionTerm(
            one, np.zeros((0, 3)), one, np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros(0, bool), np.zeros((frames, 0, 2)),
            np.zeros((frames, 0)),
        ),
        "joint_limits": JointLimitTerm(eye.copy(), np.full((joints, 3), -np.inf), np.full((joints, 3), np.inf), 1.0),
        "latent_code": LatentCodeTerm.build(
            eye.copy(), np.zeros((1, joints, 3)), np.zeros((1, joints, 3, 0)), np.zeros((1, 0)), np.zeros((joints, 3, 3)),
            np.zeros(1), np.zeros(1, int),
        ),
        "distances": DistanceTerm(np.zeros((0, 2), int), np.zeros((0, 2, 3)), np.zeros((1, 0)), np.zeros((1, 0))),
        "scalar": ScalarTerm(
            np.zeros(frames), np.zeros((frames, joints, 3)), np.tile(np.eye(3), (frames, joints, 1, 1)), np.zeros(frames)
        ),
    }  # fmt: skip


def build_terms(joints: int, frames: int = 1, **given) -> tuple:
    """Return the tuple of the solver's kinds if the `given` terms are among them, else of all; the others in it are empty."""
    return tuple(
        (build_empty_terms(joints, frames) | given)[kind]
        for kind in (SOLVER_KINDS if given.keys() <= set(SOLVER_KINDS) else ALL_KINDS)
    )


def draw_points(rng, at: dense_oracle.World, count: int, noise: float = 0.02) -> PointTerm:
    """Return markers on random joints, the first of them at the joints, with `noise` metres."""
    joints, places = rng.integers(len(at.local), size=count), rng.normal(0, 0.15, (count, 3))
    places[: count // 3] = 0.0
    seen = dense_oracle.compute_point_positions(joints, places, at) + rng.normal(0, noise, (count, 3))
    return PointTerm(joints, places, seen[None], rng.uniform(1e2, 1e4, (1, count)), draw_loss(rng))


def draw_loss(rng) -> int:
    return int(rng.choice([GEMAN_MCCLURE, HUBER]))


def draw_directions(rng, at: dense_oracle.World, count: int) -> DirectionTerm:
    joints = rng.integers(len(at.local), size=count)
    return DirectionTerm(
        joints, draw_units(rng, count), draw_units(rng, 1, count), rng.uniform(1, 100, (1, count)), draw_loss(rng)
    )


def draw_orientations(rng, at: dense_oracle.World, count: int) -> OrientationTerm:
    joints = rng.integers(len(at.local), size=count)
    seen = draw_rotations(rng, count, 2.0) @ at.rotation[joints]
    return OrientationTerm(joints, seen[None], rng.uniform(1, 100, (1, count)), draw_loss(rng))


def draw_reprojection(rng, at: dense_oracle.World, count: int) -> ReprojectionTerm:
    """Return points in four cameras around the body, two of them perspective, two orthographic."""
    joints, places = rng.integers(len(at.local), size=count), rng.normal(0, 0.15, (count, 3))
    cameras, rotation = rng.integers(4, size=count), draw_rotations(rng, 4)
    translation = CAMERA_TRANSLATION - np.einsum("cab,b->ca", rotation, at.position.mean(0))
    seen, weight = rng.normal(0, 0.1, (1, count, 2)), rng.uniform(1e2, 1e4, (1, count))
    return ReprojectionTerm(
        joints, places, cameras, rotation, translation, np.array([True, False, True, False]), seen, weight, draw_loss(rng)
    )


def draw_tracking(rng, at: dense_oracle.World) -> TrackingTerm:
    weight = rng.uniform(1, 100, (1, len(at.local)))
    weight[rng.random(weight.shape) < 0.2] = 0.0
    wanted = draw_rotations(rng, len(at.local), 2.0) @ at.local
    return TrackingTerm(wanted[None], weight, at.position[:1] + rng.normal(0, 0.1, 3), rng.uniform(10, 200, 1))


def draw_pose_prior(rng, at: dense_oracle.World) -> PosePriorTerm:
    information = draw_spd(rng, len(at.local), 3, 30.0)
    information[rng.random(len(information)) < 0.2] = 0.0
    wanted = draw_rotations(rng, len(at.local), 2.0) @ at.local
    return PosePriorTerm(wanted[None], information[None])


def draw_joint_limits(rng, at: dense_oracle.World) -> JointLimitTerm:
    """Return ranges that some joints satisfy, some violate, and some do not have."""
    low = rng.uniform(-1, 0, (len(at.local), 3))
    high = low + rng.uniform(0, 2, low.shape)
    low[rng.random(low.shape) < 0.1], high[rng.random(low.shape) < 0.1] = -np.inf, np.inf
    return JointLimitTerm(draw_rotations(rng, len(at.local), 2.0) @ at.local, low, high, float(rng.uniform(1, 1e3)))


def draw_latent_code(rng, at: dense_oracle.World) -> LatentCodeTerm:
    """Return two linearisations of a decoder of all shared unknowns, the second the frame's; some joints are not decoded."""
    joints, size = len(at.local), len(at.shared)
    information = draw_spd(rng, joints, 3, 30.0)
    information[rng.random(joints) < 0.2] = 0.0
    decoded, slope = rng.normal(0, 0.3, (2, joints, 3)), rng.normal(0, 0.3, (2, joints, 3, size))
    middle, hold = draw_rotations(rng, joints, 2.0) @ at.local, rng.uniform(0, 5, 2)
    information *= at.tree.free[:, None, None]
    return LatentCodeTerm.build(middle, decoded, slope, rng.normal(size=(2, size)), information, hold, np.ones(1, int))


def draw_distances(rng, at: dense_oracle.World, count: int) -> DistanceTerm:
    """Return distances between random points, about every third pair on one body; the last has weight zero."""
    joints = rng.integers(len(at.local), size=(count, 2))
    joints[::3, 1] = joints[::3, 0]
    weight = rng.uniform(1e2, 1e4, (1, count))
    weight[:, -1:] = 0.0
    return DistanceTerm(joints, rng.normal(0, 0.15, (count, 2, 3)), rng.uniform(0, 1, (1, count)), weight)


def draw_scalar(rng, at: dense_oracle.World) -> ScalarTerm:
    joints = len(at.local)
    taken = draw_rotations(rng, joints, 2.0) @ at.local
    return ScalarTerm(rng.normal(size=1), rng.normal(size=(1, joints, 3)), taken[None], rng.uniform(0.1, 10, 1))


def draw_term(kind: str, rng, at: dense_oracle.World):
    """Return a random term of a kind."""
    counts = {"points": 9, "directions": 5, "orientations": 4, "reprojection": 8, "distances": 4}
    return globals()[f"draw_{kind}"](rng, at, *([counts[kind]] if kind in counts else []))


def draw_frame(rng: np.random.Generator, joints: int, kinds=ALL_KINDS, codes: int = 0) -> dense_oracle.Frame:
    """Return a random body in a random pose with random terms of some kinds; `codes` unknowns are shared."""
    body, root, local = draw_tree(rng, joints), rng.normal(0, 1.0, 3), draw_rotations(rng, joints)
    shared = rng.normal(size=codes)
    at = dense_oracle.compute_world(body, root, local, shared)
    return dense_oracle.Frame(
        body, build_terms(joints, **{kind: draw_term(kind, rng, at) for kind in kinds}), root, local, shared
    )
