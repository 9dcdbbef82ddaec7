"""What people's poses say of a limb that the take itself can only guess at.

A trained model is told the joints that are seen, each as surely as it is known, and asked for those that are not; so it is in
the gap, and at the moments that the gap is learnt from, as though the limb were lost there too. What it misses there it will
miss in the gap. Only what is new in the gap, which the take could not have foretold of the model's own answers, tells of it.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.pose_prior.model import PoseModel, compute_pose_vectors

OBSERVED_JOINT_SD_RAD = 0.05  # radians: how far a joint with markers is known
CODE_ITERATIONS = 4  # of asking a network: its decoder is nearly linear among people's poses
MAX_CONDITIONING_FRAMES = 512  # frames at once, for every one's derivative is some 40 kB


@dataclass(frozen=True)
class PriorConditioner:
    """A trained model of poses, as a solve asks it.

    model  gives the model; called only where there is something to ask, for a network brings torch with it
    scale  times the model's standard deviations: with 2 it is believed half as much
    """

    load_pose_model: Callable[[], PoseModel]
    prior_scale: float

    def predict_rotations(
        self, local: np.ndarray, told: np.ndarray, lost: np.ndarray, frames: np.ndarray, near: np.ndarray
    ) -> np.ndarray:
        """-> (N, 4 L) the quaternions, each times two, that L `lost` joints should have in N `frames`, given those `told`.

        local (T, J, 3, 3): what is known
        near (N, 4 L): of the two quaternions that mean the same turn, those that are nearer to these
        """
        model = self.load_pose_model()
        parts = np.array_split(frames, -(-len(frames) // MAX_CONDITIONING_FRAMES) or 1)
        vectors = np.concatenate([self.estimate_rotation_vectors(model, local[part], told, lost) for part in parts])
        found = np.empty((len(frames), len(lost), 4))
        for i, j in enumerate(lost):
            found[:, i] = 2 * (Rotation.from_rotvec(vectors[:, i]) * Rotation.from_matrix(model.reference_rotations[j])).as_quat()
        other = (found * near.reshape(found.shape)).sum(axis=2) < 0
        return np.where(other[..., None], -found, found).reshape(near.shape)

    def estimate_rotation_vectors(self, model: PoseModel, local: np.ndarray, told: np.ndarray, lost: np.ndarray) -> np.ndarray:
        """-> (N, L, 3) radians, the decoded vectors of the `lost` joints at the likeliest codes given the root's tilt and those
        `told` of poses (N, J, 3, 3): least squares of the code alone, for a joint without markers is where it is decoded.
        """
        heard = np.r_[0, told]
        deviation = np.hypot(OBSERVED_JOINT_SD_RAD, self.prior_scale * model.residual_sd_rad[heard])[:, None]
        vectors = compute_pose_vectors(local, model.reference_rotations)
        vectors[:, lost], codes = 0.0, np.zeros((len(local), model.code_size))
        for _ in range(CODE_ITERATIONS):
            asked = model.select_components(vectors)
            decoded, slopes = asked.linearise(codes)
            weights = (slopes[:, heard] / deviation[..., None]).reshape(len(slopes), -1, model.code_size)
            away = ((vectors - decoded)[:, heard] / deviation).reshape(len(local), -1, 1) + weights @ codes[..., None]
            across = np.swapaxes(weights, 1, 2)
            codes = np.linalg.solve(across @ weights + np.eye(model.code_size) / self.prior_scale**2, across @ away)[..., 0]
            vectors[:, lost] = asked.decode(codes)[:, lost]
        return vectors[:, lost]
