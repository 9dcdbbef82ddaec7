"""Examples for the regressor of twists: people's poses on bodies that differ as people's do, some joints displaced and lost,
so that the network stays sane where joints are not quite where they should be."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.initialise.twist import bones, directions, spans, twists
from mocapfix.kernels.kinematics import carried, tree_of
from mocapfix.kernels.rigid import centred, fitted
from mocapfix.skeleton import Skeleton, average, cmu31

BODIES = 40  # in an epoch
MOST = 0.03  # metres: joints are displaced by up to this along each axis
STEADY = 0.3  # of the poses, whose joints stay where they are
LOSING, LOST = 0.5, 0.15  # of the poses, that lose some joints, and of their joints
PELVIS = ("Hips", "LeftUpLeg", "RightUpLeg")  # what tells the root's turn where only joints are known

HAS = ~np.isnan(bones(average())[:, 0])  # (J,) which joints have a bone, and so a twist
INPUTS = 6 * len(spans().start)


def turned(vectors: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """-> (N, J, 3, 3) single precision: local rotations, the root's none, of vectors (N, J, 3) from `middle` (J, 3, 3)."""
    away = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().astype(np.float32)
    local = away.reshape(*vectors.shape, 3) @ middle.astype(np.float32)
    local[:, 0] = np.eye(3)
    return local


def epoch(poses: np.ndarray, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """-> inputs (N, I) and targets (N, 2 B) of poses (N, J, 3, 3), BODIES of which share them."""
    parts = [shown(part, somebody(random), random) for part in np.array_split(poses, BODIES) if len(part)]
    inputs, true = (np.concatenate(each) for each in zip(*parts, strict=True))
    return inputs, true.reshape(len(true), -1)


def somebody(random: np.random.Generator) -> Skeleton:
    """-> a body that differs from the average as people's do."""
    body = cmu31()
    away = np.tensordot(random.normal(size=len(body.shapes)), body.shapes, 1)
    return replace(body.skeleton, offsets=body.skeleton.offsets + away)


def shown(poses: np.ndarray, body: Skeleton, random: np.random.Generator | None) -> tuple[np.ndarray, np.ndarray]:
    """-> inputs (N, I) and targets (N, B, 2) of poses (N, J, 3, 3) of a body; without `random` all joints are where they are."""
    places, _ = carried(tree_of(body), np.zeros((len(poses), 3)), np.ascontiguousarray(poses, float))
    if random is None:
        return directions(places, hips(places, body)), targets(poses, body)
    displaced = MOST * random.random((len(poses), 1, 1)) * (random.random((len(poses), 1, 1)) > STEADY)
    places += displaced * random.uniform(-1, 1, places.shape)
    turns = hips(places, body)
    places[(random.random(places.shape[:2]) < LOST) & (random.random((len(poses), 1)) < LOSING)] = np.nan
    return directions(places, turns), targets(poses, body)


def targets(poses: np.ndarray, body: Skeleton) -> np.ndarray:
    """-> (N, B, 2) cosine and sine of all twists there are in local rotations (N, J, 3, 3)."""
    return twists(poses[:, HAS], bones(body)[HAS]).astype(np.float32)


def hips(places: np.ndarray, body: Skeleton) -> np.ndarray:
    """-> (N, 3, 3) the root's turn, as the joints (N, J, 3) of the pelvis tell it."""
    pelvis = [body.index(name) for name in PELVIS]
    cross, _, _ = centred(places[:, pelvis], body.offsets[pelvis], np.ones((len(places), len(pelvis))))
    return fitted(cross)
