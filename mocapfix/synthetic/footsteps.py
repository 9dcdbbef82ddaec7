"""Where the feet are while somebody walks, stops, turns round and walks back.

Everything is planned from the floor up: a foot that stands, stands still, and the body (see motions) follows.
Left is index 0, right is 1.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

CYCLE = 10.0  # seconds: walk, reach, crouch, turn by half a circle; then the same back again
ANKLE = 0.075  # metres from the sole to the ankle
TIP, HEEL = 0.17, -0.06  # metres forward of the ankle: where a foot rolls off the floor, and where it lands on it
CLEARANCE = 0.035  # metres a swinging foot is lifted
RISE, STRIKE = np.radians(40), np.radians(18)  # heel up when a full stride begins, toes up when it ends

# Foot, when it lifts (s), how long it swings (s), strides from the start, heading (degrees, to the left).
STEPS = (
    (1, 0.40, 0.46, 0.5, 0), (0, 0.98, 0.46, 1.5, 0), (1, 1.56, 0.46, 2.5, 0), (0, 2.14, 0.46, 3.5, 0),
    (1, 2.72, 0.46, 4.5, 0), (0, 3.30, 0.46, 4.5, 0),
    (0, 7.40, 0.40, 4.5, 55), (1, 7.84, 0.40, 4.5, 95), (0, 8.28, 0.40, 4.5, 145), (1, 8.72, 0.40, 4.5, 180),
    (0, 9.16, 0.40, 4.5, 180),
)  # fmt: skip


@dataclass(frozen=True)
class Feet:
    """Both feet over T frames.

    place     (T, 2, 3) metres: the spot on the floor under the ankle of the foot when it is flat
    yaw       (T, 2) radians: heading, to the left of +Z
    swinging  (T, 2) bool
    ankle     (T, 2, 3) metres
    rotation  (T, 2, 3, 3): the foot in the world, the identity when flat and heading along +Z
    """

    place: np.ndarray
    yaw: np.ndarray
    swinging: np.ndarray
    ankle: np.ndarray
    rotation: np.ndarray


def ramp(time: np.ndarray, first: float, last: float) -> np.ndarray:
    """-> 0 before `first`, 1 after `last`, between them the minimum-jerk curve of human reaching (Flash and Hogan 1985)."""
    u = np.clip((time - first) / (last - first), 0, 1)
    return u**3 * (10 - 15 * u + 6 * u**2)


def bump(time: np.ndarray, first: float, last: float) -> np.ndarray:
    """-> 1 half-way between `first` and `last`, falling smoothly to 0 at both."""
    x = np.clip(2 * (time - first) / (last - first) - 1, -1, 1)
    return (1 - x**2) ** 3


def about(axis: str, angle: np.ndarray | float) -> np.ndarray:
    """-> (..., 3, 3) rotations by `angle` (...) radians about X, Y or Z."""
    return Rotation.from_euler(axis, np.reshape(angle, (-1, 1))).as_matrix().reshape(*np.shape(angle), 3, 3)


def plan(time: np.ndarray, stride: float, half_width: float) -> Feet:
    """-> the feet at `time` (T,) in seconds of a person whose `stride` and hips' half width are in metres."""
    place, yaw = np.zeros((len(time), 2, 3)), np.zeros((len(time), 2))
    lift, rise, strike = np.zeros((3, len(time), 2))
    swinging = np.zeros((len(time), 2), bool)
    side = np.array([half_width, -half_width])
    place[:, :, 0] = side
    here, heading = place[0].copy(), np.zeros(2)
    for foot, start, swing, strides, turn in _steps(time[-1]):
        end = start + swing
        there = np.array([np.cos(turn) * side[foot], 0, stride * strides - np.sin(turn) * side[foot]])
        done, effort = ramp(time, start, end), np.linalg.norm(there - here[foot]) / (2 * stride)
        place[:, foot] += done[:, None] * (there - here[foot])
        yaw[:, foot] += done * (turn - heading[foot])
        here[foot], heading[foot] = there, turn
        lift[:, foot] += CLEARANCE * bump(time, start, end)
        rise[:, foot] += RISE * effort * bump(time, start - 0.22, start + 0.25)
        strike[:, foot] += STRIKE * effort * bump(time, end - 0.20, end + 0.12)
        swinging[:, foot] |= (time > start) & (time < end)
    flat = about("Y", yaw)
    ankle = place + np.einsum("tfab,tfb->tfa", flat, _rolled(rise, TIP) + _rolled(-strike, HEEL))
    ankle[..., 1] += ANKLE + lift
    return Feet(place, yaw, swinging, ankle, flat @ about("X", rise - strike))


def _steps(until: float):
    """The steps of all cycles: every second one walks back, still turning to the left (angles in radians)."""
    length = STEPS[-1][3]
    for cycle in range(int(until // CYCLE) + 1):
        for foot, start, swing, strides, degrees in STEPS:
            along = length - strides if cycle % 2 else strides
            yield foot, start + CYCLE * cycle, swing, along, np.radians(degrees + 180 * cycle)


def _rolled(pitch: np.ndarray, pivot: float) -> np.ndarray:
    """-> (..., 3) metres: how far the ankle moves when the foot pitches about the floor `pivot` metres in front of it."""
    up = ANKLE * (np.cos(pitch) - 1) + pivot * np.sin(pitch)
    forward = ANKLE * np.sin(pitch) + pivot * (1 - np.cos(pitch))
    return np.stack([np.zeros_like(pitch), up, forward], axis=-1)
