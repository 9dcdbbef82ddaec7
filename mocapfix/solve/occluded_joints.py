"""What a take itself says of a limb it lost: how its joints went at moments alike, and at the moments around.

A Gaussian process over the take (see `kernels.process`) is told the joints' rotations where they are known, densely beside
the gap and sparsely farther off, and asked for those in it. It is as sure as the moments it knows are near or like. Where that
is not very sure, it is asked for a model's answers too, as if they were not known in the gap: by how much the model answers
otherwise there, counts as the take's own expectation is unsure (kriging with an external drift). Asked so, a model gains on
gaps of seconds, and spoils no other; as one more pull on the poses, it made every gap's error greater.
"""

import numpy as np

from mocapfix.kernels import quaternions
from mocapfix.solve import state_features
from mocapfix.solve.prior_conditioner import PriorConditioner
from mocapfix.stats.gaussian_process import StateCovariance, fit_gaussian_process, group_gaps, select_training_frames

MAX_UNOBSERVED_SHARE = 0.5  # share of the joints: with more of them lost, there is no body left to recall the rest from
MIN_TRAINING_FRAMES = 3  # frames, without which there is nothing to go by
DEFAULT_ROTATION_POWER_RAD2, DEFAULT_POWER_FRAMES = (
    0.02,
    10,
)  # rad^2: the power of an unknown joint's course, believed as much as so many frames
VARIANCE_INFLATION = 1.5  # by how much what is expected errs more, in rad^2, than the process says of itself
MIN_QUERY_SD_RAD = 0.1  # radians: what the take knows so well of all that a gap lost, no model knows better
PRIOR_INNOVATION_SD_RAD = 0.3  # radians per axis: how far people's limbs are from what is new in a model's answer


def infer_occluded_joints(
    root: np.ndarray,
    local_rotations: np.ndarray,
    variance: np.ndarray,
    is_unobserved: np.ndarray,
    free_joints: np.ndarray,
    rate: float,
    conditioner: PriorConditioner | None = None,
    kernel: StateCovariance = state_features.ESTIMATED_ROTATION_KERNEL,
) -> None:
    """Write what the take tells of lost joints into `local` (T, J, 3, 3) and `variance` (T, J), rad^2.

    root (T, 3) metres, local and variance: each frame's own solve; gone (T, J) as `listening.lost` says; likeness: how far
    moments tell of each other.
    """
    joints = np.flatnonzero(free_joints)[1:]
    body = is_unobserved[:, joints].mean(axis=1) <= MAX_UNOBSERVED_SHARE
    solved = local_rotations.copy() if is_unobserved.any() else local_rotations
    for (first, last), lost in group_gaps(is_unobserved & body[:, None]).items():
        told = joints[~is_unobserved[first : last + 1, joints].any(axis=0)]
        learn = select_training_frames(body & ~is_unobserved[:, np.r_[told, lost]].any(axis=1), first, last, rate)
        if len(learn) < MIN_TRAINING_FRAMES:
            continue
        gap, doubt = np.arange(first, last + 1), variance[learn][:, lost].max(axis=1)
        known, asked = (state_features.compute_joint_state_features(root, solved, told, frames, rate) for frames in (learn, gap))
        given = known, learn / rate, np.maximum(doubt - np.median(doubt), 0.0), kernel
        turns = np.concatenate(
            [2 * quaternions.extract_joint_quaternions(solved, j, ~is_unobserved[:, j])[learn] for j in lost], axis=1
        )
        course = fit_gaussian_process(turns, *given)
        expected, left = course.predict(asked, gap / rate)
        power = np.fmax(course.cross_validate_gaps((last - first + 1) / rate), course.signal_power).reshape(-1, 4).sum(axis=1) / 3
        lively = (len(learn) * power + DEFAULT_POWER_FRAMES * DEFAULT_ROTATION_POWER_RAD2) / (len(learn) + DEFAULT_POWER_FRAMES)
        leaves_open = VARIANCE_INFLATION * left[:, None] * lively
        if conditioner and leaves_open.max() > MIN_QUERY_SD_RAD**2:
            said = conditioner.predict_rotations(solved, told, lost, np.r_[learn, gap], np.concatenate([turns, expected]))
            new = said[len(learn) :] - fit_gaussian_process(said[: len(learn)], *given).predict(asked, gap / rate)[0]
            expected += (
                np.repeat(leaves_open / (leaves_open + (conditioner.prior_scale * PRIOR_INNOVATION_SD_RAD) ** 2), 4, axis=1) * new
            )
        for i, j in enumerate(lost):
            quaternions.store_joint_quaternions(
                np.ascontiguousarray(expected[:, 4 * i : 4 * i + 4]), j, local_rotations[first : last + 1]
            )
            variance[gap, j] = leaves_open[:, i]
