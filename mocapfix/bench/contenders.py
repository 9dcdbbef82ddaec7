"""The priors that are compared, each in the same solve of the same poses: the given joints' places, and what the prior says."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mocapfix.bench.common_task import posed
from mocapfix.errors import SceneError
from mocapfix.kernels import kinematics, plan
from mocapfix.kernels.levenberg import solve_frames
from mocapfix.kernels.pose import Tree
from mocapfix.kernels.terms import Points
from mocapfix.kernels.threads import over_frames
from mocapfix.prior import models
from mocapfix.prior.autoencoder import Autoencoder
from mocapfix.prior.contract import PoseModel
from mocapfix.prior.naturalness import Naturalness
from mocapfix.scenes import PRIOR, folder
from mocapfix.skeleton import Skeleton, cmu31
from mocapfix.solve import poses, search
from mocapfix.solve.poses import Posed

NONE = "none"
NAMES = (NONE, "pca", "gaussian", "mixture", models.PAPERS, "autoencoder")
MOST = 50  # iterations of a pose

Contender = PoseModel | Naturalness | None
Shelf = dict[str, Contender]


@dataclass(frozen=True)
class Given:
    """N poses, and the joints whose places are given.

    rotations  (N, J, 3, 3) the truth, local
    joints     (N, J) bool: which joints' places are given
    places     (N, J, 3) metres: the truth, and what is given unless there is noise
    sd         metres per axis: how sure a given place is said to be
    """

    skeleton: Skeleton
    rotations: np.ndarray
    joints: np.ndarray
    places: np.ndarray
    sd: float

    @property
    def points(self) -> Points:
        weight = np.ascontiguousarray(self.joints / self.sd**2)
        return Points(np.arange(len(self.skeleton.names)), np.zeros_like(self.skeleton.offsets), self.places, weight)

    def upright(self, middle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """-> root (N, 3) at the origin, and rotations (N, J, 3, 3): every pose the middle one, from which all are solved."""
        return np.zeros((len(self.places), 3)), np.tile(middle, (len(self.places), 1, 1, 1))


@dataclass(frozen=True)
class Found:
    """Poses that a solve found.

    root       (N, 3) metres
    rotations  (N, J, 3, 3) local
    joints     (N, J, 3) metres, in the world
    world      (N, J, 3, 3) the joints' rotations there
    codes      (N, P) of the prior; of none where there is none
    iterations (N,) that were spent
    cost       (N,) half the sum of squares in standard deviations; 0 where nobody asked
    """

    root: np.ndarray
    rotations: np.ndarray
    joints: np.ndarray
    world: np.ndarray
    codes: np.ndarray
    iterations: np.ndarray
    cost: np.ndarray


def placed(skeleton: Skeleton, root: np.ndarray, rotations: np.ndarray) -> Found:
    """-> poses that nobody had to look for, with where they put the joints."""
    nothing = np.zeros(len(root), int)
    return put(skeleton, Posed(root, rotations, np.zeros((len(root), 0)), nothing, nothing, np.zeros(len(root))))


def put(skeleton: Skeleton, solved: Posed) -> Found:
    """-> solved poses with where they put the joints."""
    where = kinematics.world(skeleton, posed(solved.root, solved.rotations))
    return Found(solved.root, solved.rotations, *where, solved.codes, solved.iterations, solved.cost)


def given(rotations: np.ndarray, joints: np.ndarray, sd: float, noise: np.ndarray | float = 0.0) -> Given:
    """-> poses (N, J, 3, 3) of the average body at the origin, some joints' places given, with `noise` (N, J, 3) metres."""
    skeleton = cmu31().skeleton
    places = placed(skeleton, np.zeros((len(rotations), 3)), rotations).joints + noise
    return Given(skeleton, rotations, joints, places, sd)


def shelf(where: Path | None = None) -> Shelf:
    """-> none at all, and the priors of NAMES whose weights are there: in a folder, or among those that ship.

    MNN-IK's network stands in the solve as the paper has it, as one number.

    Raises SceneError where the default's are not, with which the others are compared.
    """
    found: Shelf = {NONE: None}
    for name in NAMES[1:]:
        path = (where or folder("priors")) / f"{name}.safetensors"
        if path.is_file():
            model = models.load(str(path), cmu31().skeleton)
            found[name] = Naturalness(model) if name == models.PAPERS and isinstance(model, Autoencoder) else model
    if PRIOR not in found:
        raise SceneError(f"{where}: holds no {PRIOR}.safetensors, with which the other priors are compared.")
    return found


def solve(given: Given, model: Contender, start: tuple[np.ndarray, np.ndarray], most: int = MOST) -> Found:
    """-> the poses that a prior finds from a start, root (N, 3) and rotations (N, J, 3, 3), which stays as it is."""
    tree = kinematics.tree_of(given.skeleton)
    if model is None:
        return put(given.skeleton, unaided(tree, given.points, *start, most))
    return put(given.skeleton, poses.under(tree, (given.points,), model, *start, most=most))


def unaided(tree: Tree, points: Points, root: np.ndarray, local: np.ndarray, most: int = MOST) -> Posed:
    """-> the poses that points alone say, from a start, root (N, 3) and local (N, J, 3, 3): numerical inverse kinematics.

    Of the poses that fit, the damped steps find one near the start.
    """
    frames, joints = local.shape[:2]
    status, iterations = np.zeros((2, frames), int)
    found = Posed(root.copy(), local.copy(), np.zeros((frames, 0)), status, iterations, np.zeros(frames))
    over_frames(
        solve_frames, frames, tree, (points,), plan.alone(frames, joints), np.array([np.inf]), search.FAR, most, None,
        found.root, found.rotations, found.codes, status, iterations,
    )  # fmt: skip
    return found
