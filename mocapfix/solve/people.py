"""What people's poses say of a limb that the take itself can only guess at.

A trained model is told the joints that are seen, each as surely as it is known, and asked for those that are not; so it is in
the gap, and at the moments that the gap is learnt from, as though the limb were lost there too. What it misses there it will
miss in the gap. Only what is new in the gap, which the take could not have foretold of the model's own answers, tells of it.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mocapfix.kernels import quaternions
from mocapfix.kernels.pose import Tree
from mocapfix.kernels.terms import Courses
from mocapfix.prior.contract import PoseModel
from mocapfix.solve import poses

SEEN = 0.05  # radians: how far a joint with markers is known
ROOT = 0.01  # metres


@dataclass(frozen=True)
class People:
    """A trained model of poses, as a solve asks it.

    model  gives the model; called only where there is something to ask, for a network brings torch with it
    scale  times the model's standard deviations: with 2 it is believed half as much
    """

    tree: Tree
    model: Callable[[], PoseModel]
    scale: float

    def turns(
        self, root: np.ndarray, local: np.ndarray, told: np.ndarray, lost: np.ndarray, frames: np.ndarray, near: np.ndarray
    ) -> np.ndarray:
        """-> (N, 4 L) the quaternions, each times two, that L `lost` joints should have in N `frames`, given those `told`.

        root (T, 3) metres, local (T, J, 3, 3): what is known
        near (N, 4 L): of the two quaternions that mean the same turn, those that are nearer to these
        """
        there, at = np.ascontiguousarray(local[frames]), root[frames]
        weight = np.zeros(there.shape[:2])
        weight[:, [0, *told]] = SEEN**-2
        known = Courses(there, weight, at, np.full(len(frames), ROOT**-2))
        posed = poses.under(self.tree, (known,), self.model(), at, there, scale=self.scale).rotations
        every = np.ones(len(frames), bool)
        found = np.stack([2 * quaternions.of_joint(posed, j, every) for j in lost], axis=1)
        other = (found * near.reshape(found.shape)).sum(axis=2) < 0
        return np.where(other[..., None], -found, found).reshape(near.shape)
