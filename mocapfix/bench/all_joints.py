"""What a prior does where it is not needed: all joints' places are given.

It should leave the places where they are; with noise on them, not make them worse; and turn each bone about itself as people
do, of which places say nothing.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.bench import contenders
from mocapfix.bench.contenders import Found, Shelf, given
from mocapfix.clock import Progress
from mocapfix.skeleton import Skeleton

SD = 0.003  # metres per axis: the noise, and how sure a place is said to be
BONE = 0.01  # metres: two joints nearer to one another have no bone between them


def measure(rotations: np.ndarray, shelf: Shelf, middle: np.ndarray, progress: Progress) -> dict[str, dict[str, float]]:
    """-> prior: what it changes, of poses (N, J, 3, 3).

    bias_mm    how far it moves joints whose places are given exactly, from where they are without it
    noisy_mm   how far joints are from the truth whose given places are off by SD along each axis
    twist_deg  how far bones are turned about themselves from the truth, the places given exactly
    """
    every, noise = np.ones(rotations.shape[:2], bool), np.random.default_rng(0).normal(0, SD, (*rotations.shape[:2], 3))
    exact, noisy, said = given(rotations, every, SD), given(rotations, every, SD, noise), {}
    truth = contenders.placed(exact.skeleton, np.zeros((len(rotations), 3)), rotations)
    alone = None
    for name, model in shelf.items():
        progress(f"all joints given, {name}")
        found, shaken = (contenders.solve(task, model, task.upright(middle)) for task in (exact, noisy))
        alone = alone or found  # the first on the shelf is no prior
        said[name] = {
            "bias_mm": apart(found, alone),
            "noisy_mm": apart(shaken, truth),
            "twist_deg": float(np.degrees(twists(exact.skeleton, found, truth).mean())),
        }
    return said


def apart(one: Found, other: Found) -> float:
    """-> mm, the mean distance of the joints."""
    return 1e3 * float(np.linalg.norm(one.joints - other.joints, axis=2).mean())


def twists(skeleton: Skeleton, found: Found, truth: Found) -> np.ndarray:
    """-> (N, B) radians: how far each bone is turned about its own direction.

    A bone is a joint with one child: two children tell how it is turned, and of a joint with none there is no direction.
    """
    bones, children = bones_of(skeleton)
    along = truth.joints[:, children] - truth.joints[:, bones]
    along /= np.linalg.norm(along, axis=2, keepdims=True)
    turn = found.world[:, bones] @ np.swapaxes(truth.world[:, bones], 2, 3)
    quaternions = Rotation.from_matrix(turn.reshape(-1, 3, 3)).as_quat().reshape(*along.shape[:2], 4)
    angle = 2 * np.arctan2((quaternions[..., :3] * along).sum(axis=2), quaternions[..., 3])
    return np.abs((angle + np.pi) % (2 * np.pi) - np.pi)


def bones_of(skeleton: Skeleton) -> tuple[np.ndarray, np.ndarray]:
    """-> joints that have one child only, some way off, and those children."""
    only = [(j, kids[0]) for j in range(len(skeleton.names)) if len(kids := np.flatnonzero(skeleton.parents == j)) == 1]
    bones, children = np.array([(j, kid) for j, kid in only if np.linalg.norm(skeleton.offsets[kid]) > BONE]).T
    return bones, children
