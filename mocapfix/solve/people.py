"""What people's poses say of a limb that the take itself can only guess at.

A trained model is told the joints that are seen, each as surely as it is known, and asked for those that are not; so it is in
the gap, and at the moments that the gap is learnt from, as though the limb were lost there too. What it misses there it will
miss in the gap. Only what is new in the gap, which the take could not have foretold of the model's own answers, tells of it.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.prior.contract import PoseModel, from_middle

SEEN = 0.05  # radians: how far a joint with markers is known
ROUNDS = 4  # of asking a network: its decoder is nearly linear among people's poses
BATCH = 512  # frames at once, for every one's derivative is some 40 kB


@dataclass(frozen=True)
class People:
    """A trained model of poses, as a solve asks it.

    model  gives the model; called only where there is something to ask, for a network brings torch with it
    scale  times the model's standard deviations: with 2 it is believed half as much
    """

    model: Callable[[], PoseModel]
    scale: float

    def turns(self, local: np.ndarray, told: np.ndarray, lost: np.ndarray, frames: np.ndarray, near: np.ndarray) -> np.ndarray:
        """-> (N, 4 L) the quaternions, each times two, that L `lost` joints should have in N `frames`, given those `told`.

        local (T, J, 3, 3): what is known
        near (N, 4 L): of the two quaternions that mean the same turn, those that are nearer to these
        """
        model = self.model()
        parts = np.array_split(frames, -(-len(frames) // BATCH) or 1)
        vectors = np.concatenate([self.likeliest(model, local[part], told, lost) for part in parts])
        found = np.empty((len(frames), len(lost), 4))
        for i, j in enumerate(lost):
            found[:, i] = 2 * (Rotation.from_rotvec(vectors[:, i]) * Rotation.from_matrix(model.middle[j])).as_quat()
        other = (found * near.reshape(found.shape)).sum(axis=2) < 0
        return np.where(other[..., None], -found, found).reshape(near.shape)

    def likeliest(self, model: PoseModel, local: np.ndarray, told: np.ndarray, lost: np.ndarray) -> np.ndarray:
        """-> (N, L, 3) radians, the decoded vectors of the `lost` joints at the likeliest codes given the root's tilt and those
        `told` of poses (N, J, 3, 3): least squares of the code alone, for a joint without markers is where it is decoded.
        """
        heard = np.r_[0, told]
        deviation = np.hypot(SEEN, self.scale * model.sigma[heard])[:, None]
        vectors = from_middle(local, model.middle)
        vectors[:, lost], codes = 0.0, np.zeros((len(local), model.size))
        for _ in range(ROUNDS):
            asked = model.near(vectors)
            decoded, slopes = asked.linearise(codes)
            weights = (slopes[:, heard] / deviation[..., None]).reshape(len(slopes), -1, model.size)
            away = ((vectors - decoded)[:, heard] / deviation).reshape(len(local), -1, 1) + weights @ codes[..., None]
            across = np.swapaxes(weights, 1, 2)
            codes = np.linalg.solve(across @ weights + np.eye(model.size) / self.scale**2, across @ away)[..., 0]
            vectors[:, lost] = asked.decode(codes)[:, lost]
        return vectors[:, lost]
