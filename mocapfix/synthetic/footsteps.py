"""Where the feet are while somebody walks, stops, turns round and walks back.

Everything is planned from the floor up: a foot that stands, stands still, and the body (see motions) follows.
Left is index 0, right is 1.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

CYCLE_DURATION_S = 10.0  # seconds: walk, reach, crouch, turn by half a circle; then the same back again
ANKLE_HEIGHT_M = 0.075  # metres from the sole to the ankle
TOE_PIVOT_M, HEEL_PIVOT_M = 0.17, -0.06  # metres forward of the ankle: where a foot rolls off the floor, and where it lands on it
SWING_CLEARANCE_M = 0.035  # metres a swinging foot is lifted
HEEL_RISE_RAD, TOE_LIFT_RAD = np.radians(40), np.radians(18)  # heel up when a full stride begins, toes up when it ends

# Foot, when it lifts (s), how long it swings (s), strides from the start, heading (degrees, to the left).
STEP_SCHEDULE = (
    (1, 0.40, 0.46, 0.5, 0), (0, 0.98, 0.46, 1.5, 0), (1, 1.56, 0.46, 2.5, 0), (0, 2.14, 0.46, 3.5, 0),
    (1, 2.72, 0.46, 4.5, 0), (0, 3.30, 0.46, 4.5, 0),
    (0, 7.40, 0.40, 4.5, 55), (1, 7.84, 0.40, 4.5, 95), (0, 8.28, 0.40, 4.5, 145), (1, 8.72, 0.40, 4.5, 180),
    (0, 9.16, 0.40, 4.5, 180),
)  # fmt: skip


@dataclass(frozen=True)
class FootMotion:
    """Both feet over T frames.

    place     (T, 2, 3) metres: the spot on the floor under the ankle of the foot when it is flat
    yaw       (T, 2) radians: heading, to the left of +Z
    swinging  (T, 2) bool
    ankle     (T, 2, 3) metres
    rotation  (T, 2, 3, 3): the foot in the world, the identity when flat and heading along +Z
    """

    floor_position: np.ndarray
    yaw_rad: np.ndarray
    is_swinging: np.ndarray
    ankle_position: np.ndarray
    foot_rotation: np.ndarray


def compute_ramp(time: np.ndarray, first: float, last: float) -> np.ndarray:
    """-> 0 before `first`, 1 after `last`, between them the minimum-jerk curve of human reaching (Flash and Hogan 1985)."""
    u = np.clip((time - first) / (last - first), 0, 1)
    return u**3 * (10 - 15 * u + 6 * u**2)


def compute_bump(time: np.ndarray, first: float, last: float) -> np.ndarray:
    """-> 1 half-way between `first` and `last`, falling smoothly to 0 at both."""
    x = np.clip(2 * (time - first) / (last - first) - 1, -1, 1)
    return (1 - x**2) ** 3


def compute_axis_rotation(axis: str, angle: np.ndarray | float) -> np.ndarray:
    """-> (..., 3, 3) rotations by `angle` (...) radians about X, Y or Z."""
    return Rotation.from_euler(axis, np.reshape(angle, (-1, 1))).as_matrix().reshape(*np.shape(angle), 3, 3)


def plan_footsteps(time_s: np.ndarray, stride_m: float, half_width_m: float) -> FootMotion:
    """-> the feet at `time` (T,) in seconds of a person whose `stride` and hips' half width are in metres."""
    place, yaw = np.zeros((len(time_s), 2, 3)), np.zeros((len(time_s), 2))
    lift, rise, strike = np.zeros((3, len(time_s), 2))
    swinging = np.zeros((len(time_s), 2), bool)
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
        rise[:, foot] += HEEL_RISE_RAD * effort * compute_bump(time_s, start - 0.22, start + 0.25)
        strike[:, foot] += TOE_LIFT_RAD * effort * compute_bump(time_s, end - 0.20, end + 0.12)
        swinging[:, foot] |= (time_s > start) & (time_s < end)
    flat = compute_axis_rotation("Y", yaw)
    ankle = place + np.einsum(
        "tfab,tfb->tfa", flat, _compute_roll_shift(rise, TOE_PIVOT_M) + _compute_roll_shift(-strike, HEEL_PIVOT_M)
    )
    ankle[..., 1] += ANKLE_HEIGHT_M + lift
    return FootMotion(place, yaw, swinging, ankle, flat @ compute_axis_rotation("X", rise - strike))


def _generate_steps(until: float):
    """The steps of all cycles: every second one walks back, still turning to the left (angles in radians)."""
    length = STEP_SCHEDULE[-1][3]
    for cycle in range(int(until // CYCLE_DURATION_S) + 1):
        for foot, start, swing, strides, degrees in STEP_SCHEDULE:
            along = length - strides if cycle % 2 else strides
            yield foot, start + CYCLE_DURATION_S * cycle, swing, along, np.radians(degrees + 180 * cycle)


def _compute_roll_shift(pitch: np.ndarray, pivot: float) -> np.ndarray:
    """-> (..., 3) metres: how far the ankle moves when the foot pitches about the floor `pivot` metres in front of it."""
    up = ANKLE_HEIGHT_M * (np.cos(pitch) - 1) + pivot * np.sin(pitch)
    forward = ANKLE_HEIGHT_M * np.sin(pitch) + pivot * (1 - np.cos(pitch))
    return np.stack([np.zeros_like(pitch), up, forward], axis=-1)
