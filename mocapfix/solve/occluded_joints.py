"""Occluded joints: the rotations of a limb without markers, inferred from the rest of the take.

A Gaussian process over the take (`stats.gaussian_process`) is given the joints' rotations in frames where they are known, densely
near the gap and sparsely farther away, and predicts those in the gap. Its variance depends on how near or similar the known
frames are. If this variance is large, a pose model is used too (kriging with external drift): the model also predicts the
known frames, and only what it predicts in the gap beyond the take's own prediction, its innovation, is added in proportion to
the uncertainty. Used in this way, a model improves gaps of several seconds and does not degrade shorter ones; as
another tracking term of the poses it increased the error of every gap.
"""

import numpy as np
from jaxtyping import Bool, Float

from mocapfix.kernels import quaternions
from mocapfix.solve import state_features
from mocapfix.solve.prior_conditioner import PriorConditioner
from mocapfix.stats.gaussian_process import StateCovariance, fit_gaussian_process
from mocapfix.stats.sequences import group_gaps, select_training_frames

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
    kernel: StateCovariance = state_features.ESTIMATED_ROTATION_KERNEL,
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
            state_features.compute_joint_state_features(root_position, solved, observed, frames, rate)
            for frames in (training, gap)
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
