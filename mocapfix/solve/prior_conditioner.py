"""The prior conditioner: what a trained pose model predicts for the occluded joints of a frame from its observed joints.

The model's code is estimated by least squares from the tilt of the root and the observed joints. Code dimensions in which the
decoder is linear have the same derivatives in every frame, so that they are eliminated beforehand: they correlate the errors of
the observed joints, and what these errors show of them is added to the prediction.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from mocapfix.kernels import lie
from mocapfix.solve.motion_prior import GapContext, GapPrediction
from mocapfix.solve.pose_prior import PoseModel, compute_pose_vectors
from mocapfix.stats.rigid_alignment import compute_rotations

OBSERVED_JOINT_SD_RAD = 0.05  # standard deviation of the rotation of a joint with markers
CODE_ITERATIONS = 4  # gauss-Newton iterations of the code; the decoder of a network is nearly linear among people's poses
MAX_CONDITIONING_FRAMES = 64  # frames per batch; the derivatives of one frame take about 20 kB


class ObservedErrors(NamedTuple):
    """The errors of O observed joints over their standard deviations, as the linear dimensions of the code correlate them."""

    joints: np.ndarray  # (O,) the observed joints and the root
    sd: np.ndarray  # (3 O,) rad: standard deviations without these dimensions
    whitening: np.ndarray  # (3 O, 3 O): makes the errors independent, of unit variance
    occluded_gain: np.ndarray  # (3 L, 3 O) rad: expected errors of L occluded joints

    def scale(self, values: Float[np.ndarray, "N J 3 C"]) -> Float[np.ndarray, "N E C"]:
        """Return values of the observed joints in radians over the standard deviations."""
        return values[:, self.joints].reshape(len(values), len(self.sd), values.shape[3]) / self.sd[:, None]


@dataclass(frozen=True)
class PriorConditioner:
    """A trained pose model as the solver uses it."""

    # returns the model; called only when it is needed, since its weights are read from a file
    load_pose_model: Callable[[], PoseModel]
    prior_scale: float  # factor of the model's standard deviations (2: weaker prior)
    # predicts the 31 joints of a body in a gap, given the motion around it and the size of the body relative to the average
    # one: the motion prior; None: it is not used
    predict_motion: Callable[[GapContext, float], GapPrediction | None] | None = None

    def predict_gap(self, context: GapContext, joints: Int[np.ndarray, " L"]) -> GapPrediction | None:
        """Return what the motion prior predicts for some joints in a gap; None without one or if it cannot predict the gap."""
        predicted = self.predict_motion(context.crop(), 1.0) if self.predict_motion else None
        return predicted and predicted.select_joints(joints)

    def predict_rotations(
        self,
        local_rotations: Float[np.ndarray, "T J 3 3"],
        observed_joints: Int[np.ndarray, " O"],
        occluded_joints: Int[np.ndarray, " L"],
        frames: Int[np.ndarray, " N"],
        reference: Float[np.ndarray, "N Q"],
    ) -> Float[np.ndarray, "N Q"]:
        """Return predicted quaternions of L occluded joints, multiplied by 2, as rows of Q = 4 L numbers.

        Args:
            reference: Quaternions that determine the sign: of two for the same rotation, the nearer one is returned.
        """
        model = self.load_pose_model()
        errors = self.build_observed_errors(model, observed_joints, occluded_joints)
        poses = compute_pose_vectors(local_rotations[frames], model.reference_rotations)
        batches = np.array_split(poses, max(1, -(-len(frames) // MAX_CONDITIONING_FRAMES)))
        vectors = np.concatenate([self.estimate_rotation_vectors(model, each, errors, occluded_joints) for each in batches])
        predicted = np.empty((len(frames), len(occluded_joints), 4))
        for i, j in enumerate(occluded_joints):
            rotation = compute_rotations(vectors[:, i]) @ model.reference_rotations[j]
            predicted[:, i] = 2 * lie.extract_joint_quaternions(rotation[:, None], 0, np.ones(len(rotation), bool))
        is_opposite = (predicted * reference.reshape(predicted.shape)).sum(axis=2) < 0
        return np.where(is_opposite[..., None], -predicted, predicted).reshape(reference.shape)

    def estimate_rotation_vectors(
        self,
        model: PoseModel,
        pose_vectors: Float[np.ndarray, "N J 3"],
        errors: ObservedErrors,
        occluded_joints: Int[np.ndarray, " L"],
    ) -> Float[np.ndarray, "N L 3"]:
        """Return the decoded rotation vectors, in radians, of the occluded joints at the most likely code."""
        vectors, codes = pose_vectors.copy(), np.zeros((len(pose_vectors), model.code_size))
        vectors[:, occluded_joints] = 0.0
        size = model.nonlinear_code_size
        for iteration in range(CODE_ITERATIONS):
            selected = model.select_components(vectors)
            is_common = iteration == 0 and selected is model  # all codes are zero, so that one linearisation holds for all frames
            decoded, jacobian = selected.linearise(codes[:1] if is_common else codes)
            slopes = errors.scale(jacobian[:, :, :, :size])
            whitened = errors.whitening @ slopes
            transposed = np.swapaxes(whitened, 1, 2)
            curvature = transposed @ whitened + np.eye(size) / self.prior_scale**2
            residual = errors.scale((vectors - decoded)[..., None]) + slopes @ codes[:, :size, None]
            codes[:, :size] = np.linalg.solve(curvature, transposed @ (errors.whitening @ residual))[..., 0]
            if selected is not model or iteration == CODE_ITERATIONS - 1:  # a component is selected by all joints
                remaining = (residual - slopes @ codes[:, :size, None])[..., 0] @ errors.occluded_gain.T
                vectors[:, occluded_joints] = selected.decode(codes)[:, occluded_joints] + remaining.reshape(len(vectors), -1, 3)
        return vectors[:, occluded_joints]

    def build_observed_errors(
        self, model: PoseModel, observed_joints: Int[np.ndarray, " O"], occluded_joints: Int[np.ndarray, " L"]
    ) -> "ObservedErrors":
        """Return the errors of the observed joints and the root that the linear dimensions of the code explain."""
        joints, size = np.r_[0, observed_joints], model.nonlinear_code_size
        sd = np.repeat(np.hypot(OBSERVED_JOINT_SD_RAD, self.prior_scale * model.residual_sd_rad[joints]), 3)
        directions = np.zeros((len(model.joint_names), 3, 0))
        if size < model.code_size:
            directions = self.prior_scale * model.linearise(np.zeros((1, model.code_size)))[1][0, ..., size:]
        count = directions.shape[-1]
        observed = directions[joints].reshape(len(sd), count) / sd[:, None]
        factor = np.linalg.cholesky(observed @ observed.T + np.eye(len(sd)))
        whitening = np.tril(np.linalg.inv(factor))
        occluded = directions[occluded_joints].reshape(3 * len(occluded_joints), count)
        return ObservedErrors(joints, sd, whitening, occluded @ observed.T @ whitening.T @ whitening)


def build_prior_conditioner(load_pose_model: Callable[[], PoseModel] | None, prior_scale: float) -> PriorConditioner | None:
    """Return the pose prior as the solver uses it for one take; None without a prior."""
    return PriorConditioner(load_pose_model, prior_scale) if load_pose_model else None
