"""What arms, spine and head do: they answer the steps while walking, and then reach, crouch and look about.

Angles are anatomical: about the axes of a person standing with hanging arms, X to their left, Y up, Z forward. Negative
about X lifts an arm or leans back, positive about Y turns to the left.
"""

import numpy as np

from mocapfix.synthetic.footsteps import CYCLE_DURATION_S, compute_ramp

# Begins, is full from, until, has ended: seconds into the cycle.
REACH_LEFT_TIMES_S = (3.8, 4.5, 4.8, 5.5)
REACH_RIGHT_TIMES_S = (4.7, 5.4, 5.7, 6.4)
CROUCH_TIMES_S = (5.9, 6.5, 6.8, 7.4)
LOOK_LEFT_TIMES_S = (7.0, 7.5, 8.0, 8.6)
LOOK_RIGHT_TIMES_S = (8.6, 9.1, 9.3, 9.9)

GESTURES = (  # joint, axis, degrees, when
    # the left hand reaches forward to shoulder height, and the eyes stay with it
    ("LeftArm", "x", -88, REACH_LEFT_TIMES_S), ("LeftForeArm", "x", 8, REACH_LEFT_TIMES_S), ("LeftShoulder", "y", -10, REACH_LEFT_TIMES_S),
    ("Spine", "y", -10, REACH_LEFT_TIMES_S), ("Spine", "x", 6, REACH_LEFT_TIMES_S), ("Neck", "y", 14, REACH_LEFT_TIMES_S),
    # the right hand reaches up and out
    ("RightArm", "x", -125, REACH_RIGHT_TIMES_S), ("RightArm", "y", -28, REACH_RIGHT_TIMES_S), ("RightForeArm", "x", 6, REACH_RIGHT_TIMES_S),
    ("RightShoulder", "z", -12, REACH_RIGHT_TIMES_S), ("Spine", "z", 5, REACH_RIGHT_TIMES_S),
    ("Neck", "y", -25, REACH_RIGHT_TIMES_S), ("Neck", "x", -15, REACH_RIGHT_TIMES_S),
    # the hands go to the knees, the eyes stay up
    ("LowerBack", "x", 14, CROUCH_TIMES_S), ("Spine", "x", 8, CROUCH_TIMES_S), ("Neck1", "x", -18, CROUCH_TIMES_S),
    ("LeftArm", "x", -55, CROUCH_TIMES_S), ("RightArm", "x", -55, CROUCH_TIMES_S),
    ("LeftForeArm", "x", -25, CROUCH_TIMES_S), ("RightForeArm", "x", -25, CROUCH_TIMES_S),
    # the head looks where the turn will lead, and then about the room
    ("Neck", "y", 22, LOOK_LEFT_TIMES_S), ("Head", "y", 20, LOOK_LEFT_TIMES_S),
    ("Neck", "y", -20, LOOK_RIGHT_TIMES_S), ("Head", "y", -18, LOOK_RIGHT_TIMES_S),
)  # fmt: skip


def compute_plateau(time: np.ndarray, times_s: tuple[float, float, float, float]) -> np.ndarray:
    """-> (T,) from 0 to 1 and back, `when` the cycle says, in every cycle."""
    begins, full, until, ends = times_s
    return compute_ramp(time % CYCLE_DURATION_S, begins, full) - compute_ramp(time % CYCLE_DURATION_S, until, ends)


def compute_gesture_angles(gait_phase: np.ndarray, pelvis_drop_deg: np.ndarray, time: np.ndarray) -> dict[str, np.ndarray]:
    """-> (T, 3) degrees about X, Y, Z of the joints above the pelvis that move, each in its parent's axes.

    lead  (T,) how far the left foot is in front of the right, in strides
    drop  (T,) degrees: the pelvis about Z, which the back undoes
    """
    still, ones = np.zeros_like(gait_phase), np.ones_like(gait_phase)
    curves = {  # the shoulders turn against the hips, the head with neither
        "LowerBack": [ones, 4 * gait_phase, -pelvis_drop_deg],
        "Spine": [2 * ones, 4 * gait_phase, still],
        "Spine1": [still, 4 * gait_phase, still],
        "Neck": [still, -4 * gait_phase, still],
        "Neck1": [still, -3 * gait_phase, still],
    }
    for side, swing in (("Left", -gait_phase), ("Right", gait_phase)):  # an arm goes with the other leg
        curves[f"{side}Arm"] = [4 - 20 * swing, still, still]
        curves[f"{side}ForeArm"] = [-20 - 8 * swing, still, still]
    found = {joint: np.stack(curve, axis=1) for joint, curve in curves.items()}
    for joint, axis, degrees, when in GESTURES:
        found.setdefault(joint, np.zeros((len(time), 3)))[:, "xyz".index(axis)] += degrees * compute_plateau(time, when)
    return found
