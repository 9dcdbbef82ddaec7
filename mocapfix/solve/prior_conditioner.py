"""Conditioning a trained pose model on the observed joints, to predict those that are not observed.

The model predicts the occluded joints from the visible ones in the gap, and also in the frames from which the gap is learned, as
if the limb were occluded there too. Its errors in those frames are expected in the gap as well. Only its innovation is
used: what it predicts in the gap beyond the take's own prediction.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from mocapfix.pose_prior.model import PoseModel, compute_pose_vectors

OBSERVED_JOINT_SD_RAD = 0.05
"""Standard deviation of the rotation of a joint with markers."""
CODE_ITERATIONS = 4
"""Gauss-Newton iterations of the code; the decoder of a network is nearly linear among people's poses."""
MAX_CONDITIONING_FRAMES = 512
"""Frames per batch; the derivatives of one frame take about 40 kB."""


@dataclass(frozen=True)
class PriorConditioner:
    """A trained pose model as the solver uses it.

    load_pose_model  returns the model; called only when it is needed, since a network imports torch
    prior_scale      factor of the model's standard deviations (2: weaker prior)
    """

    load_pose_model: Callable[[], PoseModel]
    prior_scale: float

    def predict_rotations(
        self,
        local_rotations: Float[np.ndarray, "T J 3 3"],
        observed_joints: Int[np.ndarray, " O"],
        occluded_joints: Int[np.ndarray, " L"],
        frames: Int[np.ndarray, " N"],
        reference: Float[np.ndarray, "N Q"],
    ) -> Float[np.ndarray, "N Q"]:
        """Return predicted quaternions of L occluded joints, multiplied by 2, as rows of Q = 4 L numbers.

        reference  quaternions that determine the sign: of two for the same rotation, the nearer one is returned
        """
        model = self.load_pose_model()
        batches = np.array_split(frames, -(-len(frames) // MAX_CONDITIONING_FRAMES) or 1)
        vectors = np.concatenate(
            [self.estimate_rotation_vectors(model, local_rotations[batch], observed_joints, occluded_joints) for batch in batches]
        )
        predicted = np.empty((len(frames), len(occluded_joints), 4))
        for i, j in enumerate(occluded_joints):
            rotation = Rotation.from_rotvec(vectors[:, i]) * Rotation.from_matrix(model.reference_rotations[j])
            predicted[:, i] = 2 * rotation.as_quat()
        is_opposite = (predicted * reference.reshape(predicted.shape)).sum(axis=2) < 0
        return np.where(is_opposite[..., None], -predicted, predicted).reshape(reference.shape)

    def estimate_rotation_vectors(
        self,
        model: PoseModel,
        local_rotations: Float[np.ndarray, "N J 3 3"],
        observed_joints: Int[np.ndarray, " O"],
        occluded_joints: Int[np.ndarray, " L"],
    ) -> Float[np.ndarray, "N L 3"]:
        """Return the decoded rotation vectors, in radians, of the occluded joints at the most likely code.

        The code is estimated by least squares from the tilt of the root and the observed joints.
        """
        observed = np.r_[0, observed_joints]
        sd = np.hypot(OBSERVED_JOINT_SD_RAD, self.prior_scale * model.residual_sd_rad[observed])[:, None]
        vectors = compute_pose_vectors(local_rotations, model.reference_rotations)
        vectors[:, occluded_joints], codes = 0.0, np.zeros((len(local_rotations), model.code_size))
        for _ in range(CODE_ITERATIONS):
            selected = model.select_components(vectors)
            decoded, jacobian = selected.linearise(codes)
            weighted = (jacobian[:, observed] / sd[..., None]).reshape(len(jacobian), -1, model.code_size)
            residual = ((vectors - decoded)[:, observed] / sd).reshape(len(local_rotations), -1, 1) + weighted @ codes[..., None]
            transposed = np.swapaxes(weighted, 1, 2)
            curvature = transposed @ weighted + np.eye(model.code_size) / self.prior_scale**2
            codes = np.linalg.solve(curvature, transposed @ residual)[..., 0]
            vectors[:, occluded_joints] = selected.decode(codes)[:, occluded_joints]
        return vectors[:, occluded_joints]
