"""Rotations of arms, spine and head: arm swing and trunk rotation while walking, then reaching, crouching and looking around.

Angles are anatomical: about the axes of a person standing with hanging arms, X to their left, Y up, Z forward. Negative
about X lifts an arm or leans back, positive about Y turns to the left.
"""

import numpy as np
from jaxtyping import Float

from mocapfix.synthetic.footsteps import CYCLE_DURATION_S, compute_ramp

# Times into the cycle: a gesture begins, is complete, begins to end, has ended.
REACH_LEFT_TIMES_S = (3.8, 4.5, 4.8, 5.5)
REACH_RIGHT_TIMES_S = (4.7, 5.4, 5.7, 6.4)
CROUCH_TIMES_S = (5.9, 6.5, 6.8, 7.4)
LOOK_LEFT_TIMES_S = (7.0, 7.5, 8.0, 8.6)
LOOK_RIGHT_TIMES_S = (8.6, 9.1, 9.3, 9.9)

GESTURES = (  # joint, axis, degrees, times
    # the left hand reaches forward to shoulder height, and the head faces it
    ("LeftArm", "x", -88, REACH_LEFT_TIMES_S),
    ("LeftForeArm", "x", 8, REACH_LEFT_TIMES_S),
    ("LeftShoulder", "y", -10, REACH_LEFT_TIMES_S),
    ("Spine", "y", -10, REACH_LEFT_TIMES_S),
    ("Spine", "x", 6, REACH_LEFT_TIMES_S),
    ("Neck", "y", 14, REACH_LEFT_TIMES_S),
    # the right hand reaches up and out
    ("RightArm", "x", -125, REACH_RIGHT_TIMES_S),
    ("RightArm", "y", -28, REACH_RIGHT_TIMES_S),
    ("RightForeArm", "x", 6, REACH_RIGHT_TIMES_S),
    ("RightShoulder", "z", -12, REACH_RIGHT_TIMES_S),
    ("Spine", "z", 5, REACH_RIGHT_TIMES_S),
    ("Neck", "y", -25, REACH_RIGHT_TIMES_S),
    ("Neck", "x", -15, REACH_RIGHT_TIMES_S),
    # the hands go to the knees, the head stays up
    ("LowerBack", "x", 14, CROUCH_TIMES_S),
    ("Spine", "x", 8, CROUCH_TIMES_S),
    ("Neck1", "x", -18, CROUCH_TIMES_S),
    ("LeftArm", "x", -55, CROUCH_TIMES_S),
    ("RightArm", "x", -55, CROUCH_TIMES_S),
    ("LeftForeArm", "x", -25, CROUCH_TIMES_S),
    ("RightForeArm", "x", -25, CROUCH_TIMES_S),
    # the head faces the direction of the turn, and then looks around
    ("Neck", "y", 22, LOOK_LEFT_TIMES_S),
    ("Head", "y", 20, LOOK_LEFT_TIMES_S),
    ("Neck", "y", -20, LOOK_RIGHT_TIMES_S),
    ("Head", "y", -18, LOOK_RIGHT_TIMES_S),
)


def compute_plateau(time_s: Float[np.ndarray, " T"], times_s: tuple[float, float, float, float]) -> Float[np.ndarray, " T"]:
    """Return a curve from 0 to 1 and back, at the same times of every cycle."""
    begins, is_complete, begins_to_end, has_ended = times_s
    cycle_time_s = time_s % CYCLE_DURATION_S
    return compute_ramp(cycle_time_s, begins, is_complete) - compute_ramp(cycle_time_s, begins_to_end, has_ended)


def compute_gesture_angles(
    gait_phase: Float[np.ndarray, " T"], pelvis_drop_deg: Float[np.ndarray, " T"], time_s: Float[np.ndarray, " T"]
) -> dict[str, Float[np.ndarray, "T 3"]]:
    """Return angles in degrees about X, Y, Z of the rotated joints above the pelvis, each in its parent's axes.

    gait_phase       distance of the left foot in front of the right, in strides
    pelvis_drop_deg  rotation of the pelvis about Z, which the back compensates
    """
    zeros, ones = np.zeros_like(gait_phase), np.ones_like(gait_phase)
    curves = {  # the shoulders rotate against the hips, the head with neither
        "LowerBack": [ones, 4 * gait_phase, -pelvis_drop_deg],
        "Spine": [2 * ones, 4 * gait_phase, zeros],
        "Spine1": [zeros, 4 * gait_phase, zeros],
        "Neck": [zeros, -4 * gait_phase, zeros],
        "Neck1": [zeros, -3 * gait_phase, zeros],
    }
    for side, swing in (("Left", -gait_phase), ("Right", gait_phase)):  # an arm swings with the opposite leg
        curves[f"{side}Arm"] = [4 - 20 * swing, zeros, zeros]
        curves[f"{side}ForeArm"] = [-20 - 8 * swing, zeros, zeros]
    angles = {joint: np.stack(curve, axis=1) for joint, curve in curves.items()}
    for joint, axis, degrees, times_s in GESTURES:
        joint_angles = angles.setdefault(joint, np.zeros((len(time_s), 3)))
        joint_angles[:, "xyz".index(axis)] += degrees * compute_plateau(time_s, times_s)
    return angles
