"""The circumstances of a body by which moments of a take are alike (see `kernels.process`), and how far that tells of its joints.

Its other joints turned and turning alike, the root as high, as upright, as fast.

The numbers below make the smallest error on CMU's training subjects, arms and legs lost for 0.5 to 2 s. A length for every part
of the body in place of the few here, a slow course through time, or likeness that time wears out, gained less than 2 %.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.stats.gaussian_process import StateCovariance

VELOCITY_HALF_SPAN_S = 0.067  # seconds before and after, over which turning is measured
ROTATION_UNIT_RAD, ANGULAR_VELOCITY_UNIT_RAD_S = (
    1.0,
    50.0,
)  # radians, radians a second: the differences of joints that count as one
ROOT_UP_UNIT, ROOT_HEIGHT_UNIT_M = 0.5, 0.5  # of the up vector; metres
ROOT_SPEED_UNIT_M_S, ROOT_SPIN_UNIT_RAD_S = 5.0, 20.0  # metres a second, radians a second, of the root
ESTIMATED_ROTATION_KERNEL = StateCovariance(
    time_scale_s=0.3, similarity_rate=0.6, time_power=0.06, recurrence_power=1.6, linear_power=0.8, noise_power=1.5e-4
)
# Of turns that a file gives and nobody solved from markers: they are exact, so that moments less near and less alike tell, too.
RECORDED_ROTATION_KERNEL = StateCovariance(
    time_scale_s=0.45, similarity_rate=0.08, time_power=0.4, recurrence_power=6.0, linear_power=0.8, noise_power=1e-5
)


def compute_joint_state_features(
    root: np.ndarray, local_rotations: np.ndarray, joints: np.ndarray, frames: np.ndarray, rate: float
) -> np.ndarray:
    """-> (N, F) the circumstances of the body at N `frames`, each in units of a difference that counts as one.

    root (T, 3) metres, local (T, J, 3, 3); told: indices of the joints that are asked
    """
    span, last = max(1, round(VELOCITY_HALF_SPAN_S * rate)), len(root) - 1
    before, after = np.maximum(frames - span, 0), np.minimum(frames + span, last)
    seconds = (after - before) / rate + (last == 0)

    def turning(joints: np.ndarray) -> np.ndarray:
        step = np.swapaxes(local_rotations[before][:, joints], -1, -2) @ local_rotations[after][:, joints]
        return (Rotation.from_matrix(step.reshape(-1, 3, 3)).as_rotvec().reshape(len(frames), -1)) / seconds[:, None]

    inside = np.swapaxes(local_rotations[frames, 0], 1, 2)
    moving = np.einsum("tab,tb->ta", inside, root[after] - root[before]) / seconds[:, None]
    turned = local_rotations[frames][:, joints].reshape(len(frames), -1) / np.sqrt(
        2
    )  # a small turn's size is that of its matrix over sqrt 2
    joints, hips = (
        [turned / ROTATION_UNIT_RAD, turning(joints) / ANGULAR_VELOCITY_UNIT_RAD_S],
        [inside[:, :, 1] / ROOT_UP_UNIT, root[frames, 1:2] / ROOT_HEIGHT_UNIT_M],
    )
    return np.concatenate([*joints, *hips, moving / ROOT_SPEED_UNIT_M_S, turning(np.array([0])) / ROOT_SPIN_UNIT_RAD_S], axis=1)
