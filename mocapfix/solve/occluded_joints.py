"""Occluded joints: the rotations of a limb without markers, inferred from the rest of the take.

A Gaussian process over the take (`stats.gaussian_process`) is given the joints' rotations in frames where they are known, densely
near the gap and sparsely farther away, and predicts those in the gap. Its variance depends on how near or similar the known
frames are. Similar frames have similar state features: the rotations and angular velocities of the other joints, and the height,
up direction, velocity and angular velocity of the root. The units and covariances of these features minimise the error on CMU's
training subjects with arms and legs occluded for 0.5 to 2 s. Individual length scales for each part of the body, an additional
slow trend in time, and a similarity that decays with time improved it by less than 2 %.

If the variance is large, a trained pose model is used too (kriging with external drift). It predicts the occluded joints from the
visible ones in the gap, and also in the known frames, as if the limb were occluded there too; its errors in those frames are
expected in the gap as well. Only its innovation, what it predicts in the gap beyond the take's own prediction, is added in
proportion to the uncertainty. Used in this way, a model improves gaps of several seconds and does not degrade shorter ones; as
another tracking term of the poses it increased the error of every gap.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from mocapfix.kernels import quaternions
from mocapfix.pose_prior.model import PoseModel, compute_pose_vectors
from mocapfix.solve.parallel import count_cores, run_in_parallel
from mocapfix.stats.gaussian_process import StateCovariance, fit_gaussian_process
from mocapfix.stats.sequences import group_gaps, select_training_frames

OBSERVED_JOINT_SD_RAD = 0.05
"""Standard deviation of the rotation of a joint with markers."""
CODE_ITERATIONS = 4
"""Gauss-Newton iterations of the code; the decoder of a network is nearly linear among people's poses."""
MAX_CONDITIONING_FRAMES = 256
"""Frames per batch; the derivatives of one frame take about 40 kB."""
MAX_REUSED_CHANGE_RAD = 0.02
"""Change of an observed joint's rotation vector up to which an earlier prediction of the frame is used again: less than half of
OBSERVED_JOINT_SD_RAD, to which the prediction assumes the rotations to be known."""


class FramePredictions(NamedTuple):
    """Predictions for N frames, in increasing order, and what they were made from: rotation vectors in radians.

    observed  (N, O, 3) of the observed joints
    occluded  (N, L, 3) predicted, of the occluded joints
    """

    frames: np.ndarray
    observed: np.ndarray
    occluded: np.ndarray


@dataclass(frozen=True)
class PriorConditioner:
    """A trained pose model as the solver uses it.

    A take is solved in several rounds, between which few poses change, so the predictions of earlier calls are kept.

    load_pose_model  returns the model; called only when it is needed, since its weights are read from a file
    prior_scale      factor of the model's standard deviations (2: weaker prior)
    predictions      the last predictions for each pair of observed and occluded joints
    """

    load_pose_model: Callable[[], PoseModel]
    prior_scale: float
    predictions: dict[tuple[tuple[int, ...], tuple[int, ...]], FramePredictions] = field(default_factory=dict, kw_only=True)

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
        unique_frames, row_of_frame = np.unique(frames, return_inverse=True)
        vectors = self.update_predictions(model, local_rotations, observed_joints, occluded_joints, unique_frames)[row_of_frame]
        predicted = np.empty((len(frames), len(occluded_joints), 4))
        for i, j in enumerate(occluded_joints):
            rotation = Rotation.from_rotvec(vectors[:, i]) * Rotation.from_matrix(model.reference_rotations[j])
            predicted[:, i] = 2 * rotation.as_quat()
        is_opposite = (predicted * reference.reshape(predicted.shape)).sum(axis=2) < 0
        return np.where(is_opposite[..., None], -predicted, predicted).reshape(reference.shape)

    def update_predictions(
        self,
        model: PoseModel,
        local_rotations: Float[np.ndarray, "T J 3 3"],
        observed_joints: Int[np.ndarray, " O"],
        occluded_joints: Int[np.ndarray, " L"],
        frames: Int[np.ndarray, " N"],
    ) -> Float[np.ndarray, "N L 3"]:
        """Return the rotation vectors of the occluded joints in frames in increasing order, and keep them.

        Only frames without an earlier prediction for nearly the same observed rotations are estimated.
        """
        pose_vectors = compute_pose_vectors(local_rotations[frames], model.reference_rotations)
        observed = pose_vectors[:, np.r_[0, observed_joints]]
        result, is_new = np.empty((len(frames), len(occluded_joints), 3)), np.ones(len(frames), bool)
        key = tuple(observed_joints.tolist()), tuple(occluded_joints.tolist())
        if key in self.predictions:
            earlier = self.predictions[key]
            row = np.minimum(np.searchsorted(earlier.frames, frames), len(earlier.frames) - 1)
            change_rad = np.abs(earlier.observed[row] - observed).max(axis=(1, 2))
            is_new = (earlier.frames[row] != frames) | ~(change_rad <= MAX_REUSED_CHANGE_RAD)
            observed[~is_new], result[~is_new] = earlier.observed[row[~is_new]], earlier.occluded[row[~is_new]]
        new_rows = np.flatnonzero(is_new)
        batch_count = max(-(-len(new_rows) // MAX_CONDITIONING_FRAMES), min(count_cores(), len(new_rows)))

        def estimate(rows: np.ndarray) -> None:
            result[rows] = self.estimate_rotation_vectors(model, pose_vectors[rows], observed_joints, occluded_joints)

        if batch_count:
            run_in_parallel(estimate, np.array_split(new_rows, batch_count))
        self.predictions[key] = FramePredictions(frames, observed, result)
        return result

    def estimate_rotation_vectors(
        self,
        model: PoseModel,
        pose_vectors: Float[np.ndarray, "N J 3"],
        observed_joints: Int[np.ndarray, " O"],
        occluded_joints: Int[np.ndarray, " L"],
    ) -> Float[np.ndarray, "N L 3"]:
        """Return the decoded rotation vectors, in radians, of the occluded joints at the most likely code.

        The code is estimated by least squares from the tilt of the root and the observed joints.
        """
        observed = np.r_[0, observed_joints]
        sd = np.hypot(OBSERVED_JOINT_SD_RAD, self.prior_scale * model.residual_sd_rad[observed])[:, None]
        vectors, codes = pose_vectors.copy(), np.zeros((len(pose_vectors), model.code_size))
        vectors[:, occluded_joints] = 0.0
        for iteration in range(CODE_ITERATIONS):
            selected = model.select_components(vectors)
            if iteration == 0 and selected is model:  # all codes are zero, so that one linearisation holds for all frames
                start = model.linearise(codes[:1])
                decoded, jacobian = (np.broadcast_to(each, (len(codes), *each.shape[1:])) for each in start)
            else:
                decoded, jacobian = selected.linearise(codes)
            weighted = (jacobian[:, observed] / sd[..., None]).reshape(len(jacobian), -1, model.code_size)
            residual = ((vectors - decoded)[:, observed] / sd).reshape(len(vectors), -1, 1) + weighted @ codes[..., None]
            transposed = np.swapaxes(weighted, 1, 2)
            curvature = transposed @ weighted + np.eye(model.code_size) / self.prior_scale**2
            codes = np.linalg.solve(curvature, transposed @ residual)[..., 0]
            vectors[:, occluded_joints] = selected.decode(codes)[:, occluded_joints]
        return vectors[:, occluded_joints]


VELOCITY_HALF_SPAN_S = 0.067
"""Time before and after a frame over which velocities are measured."""
ROTATION_UNIT_RAD = 1.0
"""Difference of joint rotations that counts as one."""
ANGULAR_VELOCITY_UNIT_RAD_S = 50.0
"""Difference of joint angular velocities that counts as one."""
ROOT_UP_UNIT = 0.5
"""Difference of the up direction in root axes that counts as one."""
ROOT_HEIGHT_UNIT_M = 0.5
"""Difference of root heights that counts as one."""
ROOT_SPEED_UNIT_M_S = 5.0
"""Difference of root velocities that counts as one."""
ROOT_SPIN_UNIT_RAD_S = 20.0
"""Difference of root angular velocities that counts as one."""
ESTIMATED_ROTATION_KERNEL = StateCovariance(
    time_scale_s=0.3, similarity_rate=0.6, time_power=0.06, recurrence_power=1.6, linear_power=0.8, noise_power=1.5e-4
)
"""Covariance of joint rotations that were solved from markers."""
RECORDED_ROTATION_KERNEL = StateCovariance(
    time_scale_s=0.45, similarity_rate=0.08, time_power=0.4, recurrence_power=6.0, linear_power=0.8, noise_power=1e-5
)
"""Covariance of rotations recorded in an animation: they are exact, so that less similar frames are informative, too."""


def compute_joint_state_features(
    root_position: Float[np.ndarray, "T 3"],
    local_rotations: Float[np.ndarray, "T J 3 3"],
    joints: Int[np.ndarray, " O"],
    frames: Int[np.ndarray, " N"],
    rate: float,
) -> Float[np.ndarray, "N F"]:
    """Return the features of the body's state in some frames, each in units of a difference that counts as one.

    root_position  in metres
    joints         indices of the joints whose rotations are features
    """
    span, last = max(1, round(VELOCITY_HALF_SPAN_S * rate)), len(root_position) - 1
    before, after = np.maximum(frames - span, 0), np.minimum(frames + span, last)
    seconds = (after - before) / rate + (last == 0)

    def compute_angular_velocity(of_joints: np.ndarray) -> np.ndarray:
        step = np.swapaxes(local_rotations[before][:, of_joints], -1, -2) @ local_rotations[after][:, of_joints]
        return (Rotation.from_matrix(step.reshape(-1, 3, 3)).as_rotvec().reshape(len(frames), -1)) / seconds[:, None]

    world_to_root = np.swapaxes(local_rotations[frames, 0], 1, 2)
    velocity = np.einsum("tab,tb->ta", world_to_root, root_position[after] - root_position[before]) / seconds[:, None]
    # the norm of a small rotation's matrix difference is sqrt(2) times its angle
    rotations = local_rotations[frames][:, joints].reshape(len(frames), -1) / np.sqrt(2)
    return np.concatenate(
        [
            rotations / ROTATION_UNIT_RAD,
            compute_angular_velocity(joints) / ANGULAR_VELOCITY_UNIT_RAD_S,
            world_to_root[:, :, 1] / ROOT_UP_UNIT,
            root_position[frames, 1:2] / ROOT_HEIGHT_UNIT_M,
            velocity / ROOT_SPEED_UNIT_M_S,
            compute_angular_velocity(np.array([0])) / ROOT_SPIN_UNIT_RAD_S,
        ],
        axis=1,
    )


MAX_UNOBSERVED_SHARE = 0.5
"""Share of the joints that may be unobserved; with more, too little of the body is left to infer the rest from."""
MIN_TRAINING_FRAMES = 3
"""Frames with known rotations that a gap requires."""
DEFAULT_ROTATION_POWER_RAD2 = 0.02
"""Signal power of a joint rotation for which there are no data."""
DEFAULT_POWER_FRAMES = 10
"""Number of frames that this default power is worth in the estimate of the power."""
VARIANCE_INFLATION = 1.5
"""Actual squared error of the prediction over the variance that the process predicts."""
MIN_QUERY_SD_RAD = 0.1
"""Standard deviation of the prediction above which the pose model is used; below, no model improves it."""
PRIOR_INNOVATION_SD_RAD = 0.3
"""Standard deviation per axis of people's limbs about the innovation of the pose model."""


def infer_occluded_joints(
    root_position: Float[np.ndarray, "T 3"],
    local_rotations: Float[np.ndarray, "T J 3 3"],
    variance: Float[np.ndarray, "T J"],
    is_unobserved: Bool[np.ndarray, "T J"],
    free_joints: Bool[np.ndarray, " J"],
    rate: float,
    *,
    conditioner: PriorConditioner | None = None,
    kernel: StateCovariance = ESTIMATED_ROTATION_KERNEL,
) -> None:
    """Overwrite the rotations of unobserved joints, and their variance in rad^2, with predictions.

    root_position, local_rotations, variance  the solution of each frame on its own, in metres and rad^2
    is_unobserved                             as from `observability.find_unobserved_joints`
    kernel                                    covariance of the rotations between frames
    """
    joints = np.flatnonzero(free_joints)[1:]
    has_body = is_unobserved[:, joints].mean(axis=1) <= MAX_UNOBSERVED_SHARE
    solved = local_rotations.copy() if is_unobserved.any() else local_rotations
    for (first, last), occluded in group_gaps(is_unobserved & has_body[:, None]).items():
        observed = joints[~is_unobserved[first : last + 1, joints].any(axis=0)]
        is_known = has_body & ~is_unobserved[:, np.r_[observed, occluded]].any(axis=1)
        training = select_training_frames(is_known, first, last, rate)
        if len(training) < MIN_TRAINING_FRAMES:
            continue
        gap, training_variance = np.arange(first, last + 1), variance[training][:, occluded].max(axis=1)
        training_states, gap_states = (
            compute_joint_state_features(root_position, solved, observed, frames, rate) for frames in (training, gap)
        )
        noise = np.maximum(training_variance - np.median(training_variance), 0.0)
        data = training_states, training / rate, noise, kernel
        rotations = np.concatenate(
            [2 * quaternions.extract_joint_quaternions(solved, j, ~is_unobserved[:, j])[training] for j in occluded], axis=1
        )
        process = fit_gaussian_process(rotations, *data)
        predicted, relative_variance = process.predict(gap_states, gap / rate)
        power = np.fmax(process.cross_validate_gaps((last - first + 1) / rate), process.signal_power)
        power = power.reshape(-1, 4).sum(axis=1) / 3
        power = (len(training) * power + DEFAULT_POWER_FRAMES * DEFAULT_ROTATION_POWER_RAD2) / (
            len(training) + DEFAULT_POWER_FRAMES
        )
        gap_variance = VARIANCE_INFLATION * relative_variance[:, None] * power
        if conditioner and gap_variance.max() > MIN_QUERY_SD_RAD**2:
            frames, reference = np.r_[training, gap], np.concatenate([rotations, predicted])
            drift = conditioner.predict_rotations(solved, observed, occluded, frames, reference)
            drift_process = fit_gaussian_process(drift[: len(training)], *data)
            innovation = drift[len(training) :] - drift_process.predict(gap_states, gap / rate)[0]
            gain = gap_variance / (gap_variance + (conditioner.prior_scale * PRIOR_INNOVATION_SD_RAD) ** 2)
            predicted += np.repeat(gain, 4, axis=1) * innovation
        for i, j in enumerate(occluded):
            predicted_joint = np.ascontiguousarray(predicted[:, 4 * i : 4 * i + 4])
            quaternions.store_joint_quaternions(predicted_joint, j, local_rotations[first : last + 1])
            variance[gap, j] = gap_variance[:, i]
