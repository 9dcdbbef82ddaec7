"""State features: the state of a body by which the frames of a take are similar (see `stats.gaussian_process`).

The features are the rotations and angular velocities of the other joints, and the height, up direction, velocity and angular
velocity of the root. The units and covariances below minimise the error on CMU's training subjects with arms and legs occluded
for 0.5 to 2 s. Individual length scales for each part of the body, an additional slow trend in time, and a similarity that decays
with time improved it by less than 2 %.
"""

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from mocapfix.stats.gaussian_process import StateCovariance

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
