"""Motion of the feet of a person who walks, stops, turns round and walks back.

Everything is planned from the floor up: a foot in stance does not move, and the body (see `motions`) follows.
Left is index 0, right is 1.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

CYCLE_DURATION_S = 10.0  # walk, reach, crouch, turn by half a circle; then the same back again
ANKLE_HEIGHT_M = 0.075  # from the sole
TOE_PIVOT_M = 0.17  # forward of the ankle: the point about which a foot rolls off the floor
HEEL_PIVOT_M = -0.06  # forward of the ankle: the point on which a foot lands
SWING_CLEARANCE_M = 0.035  # by which a swinging foot is lifted
HEEL_RISE_RAD = np.radians(40)  # pitch of the foot when a full stride begins
TOE_LIFT_RAD = np.radians(18)  # opposite pitch when it ends
RISE_WINDOW_S = (-0.22, 0.25)  # of the heel rise, relative to the start of the swing
LIFT_WINDOW_S = (-0.20, 0.12)  # of the toe lift, relative to the end of the swing


class FootStep(NamedTuple):
    """One step of a foot in the schedule of a cycle."""

    foot: int
    start_s: float
    swing_s: float
    strides: float  # from the start of the walk
    heading_deg: float  # to the left


STEP_SCHEDULE = (
    FootStep(1, 0.40, 0.46, 0.5, 0),
    FootStep(0, 0.98, 0.46, 1.5, 0),
    FootStep(1, 1.56, 0.46, 2.5, 0),
    FootStep(0, 2.14, 0.46, 3.5, 0),
    FootStep(1, 2.72, 0.46, 4.5, 0),
    FootStep(0, 3.30, 0.46, 4.5, 0),
    FootStep(0, 7.40, 0.40, 4.5, 55),
    FootStep(1, 7.84, 0.40, 4.5, 95),
    FootStep(0, 8.28, 0.40, 4.5, 145),
    FootStep(1, 8.72, 0.40, 4.5, 180),
    FootStep(0, 9.16, 0.40, 4.5, 180),
)


@dataclass(frozen=True)
class FootMotion:
    """Both feet over T frames.

    floor_position  metres: the point on the floor under the ankle of the flat foot
    yaw_rad         heading, to the left of +Z
    ankle_position  metres
    foot_rotation   in the world, the identity for a flat foot heading along +Z
    """

    floor_position: Float[np.ndarray, "T 2 3"]
    yaw_rad: Float[np.ndarray, "T 2"]
    is_swinging: Bool[np.ndarray, "T 2"]
    ankle_position: Float[np.ndarray, "T 2 3"]
    foot_rotation: Float[np.ndarray, "T 2 3 3"]


def compute_ramp(time_s: Float[np.ndarray, " T"], first_s: float, last_s: float) -> Float[np.ndarray, " T"]:
    """Return 0 before `first_s`, 1 after `last_s`, between them the minimum-jerk curve of reaching (Flash and Hogan 1985)."""
    u = np.clip((time_s - first_s) / (last_s - first_s), 0, 1)
    return u**3 * (10 - 15 * u + 6 * u**2)


def compute_bump(time_s: Float[np.ndarray, " T"], first_s: float, last_s: float) -> Float[np.ndarray, " T"]:
    """Return 1 half-way between `first_s` and `last_s`, decreasing smoothly to 0 at both."""
    x = np.clip(2 * (time_s - first_s) / (last_s - first_s) - 1, -1, 1)
    return (1 - x**2) ** 3


def compute_axis_rotation(axis: str, angle_rad: Float[np.ndarray, "*batch"] | float) -> Float[np.ndarray, "*batch 3 3"]:
    """Return rotations about X, Y or Z."""
    return Rotation.from_euler(axis, np.reshape(angle_rad, (-1, 1))).as_matrix().reshape(*np.shape(angle_rad), 3, 3)


def plan_footsteps(time_s: Float[np.ndarray, " T"], stride_m: float, half_width_m: float) -> FootMotion:
    """Return the feet of a person of a given stride and half distance between the hips."""
    place, yaw = np.zeros((len(time_s), 2, 3)), np.zeros((len(time_s), 2))
    lift, heel_rise, toe_lift = np.zeros((3, len(time_s), 2))
    is_swinging = np.zeros((len(time_s), 2), bool)
    side = np.array([half_width_m, -half_width_m])
    place[:, :, 0] = side
    here, heading = place[0].copy(), np.zeros(2)
    for foot, start, swing, strides, turn in _generate_steps(time_s[-1]):
        end = start + swing
        there = np.array([np.cos(turn) * side[foot], 0, stride_m * strides - np.sin(turn) * side[foot]])
        done, effort = compute_ramp(time_s, start, end), np.linalg.norm(there - here[foot]) / (2 * stride_m)
        place[:, foot] += done[:, None] * (there - here[foot])
        yaw[:, foot] += done * (turn - heading[foot])
        here[foot], heading[foot] = there, turn
        lift[:, foot] += SWING_CLEARANCE_M * compute_bump(time_s, start, end)
        heel_rise[:, foot] += HEEL_RISE_RAD * effort * compute_bump(time_s, start + RISE_WINDOW_S[0], start + RISE_WINDOW_S[1])
        toe_lift[:, foot] += TOE_LIFT_RAD * effort * compute_bump(time_s, end + LIFT_WINDOW_S[0], end + LIFT_WINDOW_S[1])
        is_swinging[:, foot] |= (time_s > start) & (time_s < end)
    flat = compute_axis_rotation("Y", yaw)
    roll_shift = _compute_roll_shift(heel_rise, TOE_PIVOT_M) + _compute_roll_shift(-toe_lift, HEEL_PIVOT_M)
    ankle = place + np.einsum("tfab,tfb->tfa", flat, roll_shift)
    ankle[..., 1] += ANKLE_HEIGHT_M + lift
    return FootMotion(place, yaw, is_swinging, ankle, flat @ compute_axis_rotation("X", heel_rise - toe_lift))


def _generate_steps(end_s: float) -> Iterator[tuple[int, float, float, float, float]]:
    """Yield foot, start, swing duration, strides and heading (radians) of the steps of all cycles.

    Every second cycle walks back, still turning to the left.
    """
    length = STEP_SCHEDULE[-1].strides
    for cycle in range(int(end_s // CYCLE_DURATION_S) + 1):
        for foot, start, swing, strides, degrees in STEP_SCHEDULE:
            along = length - strides if cycle % 2 else strides
            yield foot, start + CYCLE_DURATION_S * cycle, swing, along, np.radians(degrees + 180 * cycle)


def _compute_roll_shift(pitch_rad: Float[np.ndarray, "T 2"], pivot_m: float) -> Float[np.ndarray, "T 2 3"]:
    """Return the ankle's shift when the foot pitches about the floor `pivot_m` in front of it."""
    up = ANKLE_HEIGHT_M * (np.cos(pitch_rad) - 1) + pivot_m * np.sin(pitch_rad)
    forward = ANKLE_HEIGHT_M * np.sin(pitch_rad) + pivot_m * (1 - np.cos(pitch_rad))
    return np.stack([np.zeros_like(pitch_rad), up, forward], axis=-1)
