"""A window of frames instead of one: joint positions smoothed over time before the network sees them.

The window is that of a Kalman smoother: wide where the positions are uncertain, one frame where they are exact.
"""

import numpy as np
from jaxtyping import Float

from mocapfix.kernels.position_smoothing import smooth_position_joints
from mocapfix.skeleton import load_cmu31_skeleton
from mocapfix.solve.parallel import run_over_frames

TRUNK_ACCELERATION_DENSITY = 0.6
"""m^2/s^3 by which the variance of a velocity grows per second: pelvis, trunk and head of recorded people"""
LIMB_ACCELERATION_DENSITY = 2.0
"""the same of knees, elbows and shoulders"""
TIP_ACCELERATION_DENSITY = 5.0
"""the same of hands and feet"""
TIP_NAME_PARTS = ("Foot", "Toe", "Hand", "Finger", "Thumb")
LIMB_NAME_PARTS = ("LeftLeg", "RightLeg", "Arm")
MAX_SMOOTHED_SD_M = 0.08  # a joint that is less certain is missing


def smooth_positions(
    positions: Float[np.ndarray, "T J 3"], joint_sd: Float[np.ndarray, "T J"], rate_hz: float
) -> tuple[Float[np.ndarray, "T J 3"], Float[np.ndarray, "T J"]]:
    """Return joint positions smoothed over time, NaN where they are uncertain, and their standard deviations, in metres.

    positions  of the 31 joints in metres, NaN where unknown; short gaps are filled
    joint_sd   metres per axis
    """
    smoothed, smoothed_sd = np.empty(positions.shape), np.empty(positions.shape[:2])
    inputs = (np.ascontiguousarray(each, float) for each in (positions, joint_sd))
    density = np.array([get_acceleration_density(name) for name in load_cmu31_skeleton().names])
    run_over_frames(smooth_position_joints, positions.shape[1], *inputs, density, 1 / rate_hz, smoothed, smoothed_sd)
    smoothed[smoothed_sd > MAX_SMOOTHED_SD_M] = np.nan
    return smoothed, smoothed_sd


def get_acceleration_density(joint_name: str) -> float:
    """Return the density of a joint's random accelerations in m^2/s^3."""
    if any(part in joint_name for part in TIP_NAME_PARTS):
        return TIP_ACCELERATION_DENSITY
    return LIMB_ACCELERATION_DENSITY if any(part in joint_name for part in LIMB_NAME_PARTS) else TRUNK_ACCELERATION_DENSITY
