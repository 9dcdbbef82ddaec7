"""What arms, spine and head do: they answer the steps while walking, and then reach, crouch and look about.

Angles are anatomical: about the axes of a person standing with hanging arms, X to their left, Y up, Z forward. Negative
about X lifts an arm or leans back, positive about Y turns to the left.
"""

import numpy as np

from mocapfix.synthetic.footsteps import CYCLE, ramp

# Begins, is full from, until, has ended: seconds into the cycle.
REACH_LEFT = (3.8, 4.5, 4.8, 5.5)
REACH_RIGHT = (4.7, 5.4, 5.7, 6.4)
CROUCH = (5.9, 6.5, 6.8, 7.4)
LOOK_LEFT = (7.0, 7.5, 8.0, 8.6)
LOOK_RIGHT = (8.6, 9.1, 9.3, 9.9)

GESTURES = (  # joint, axis, degrees, when
    # the left hand reaches forward to shoulder height, and the eyes stay with it
    ("LeftArm", "x", -88, REACH_LEFT), ("LeftForeArm", "x", 8, REACH_LEFT), ("LeftShoulder", "y", -10, REACH_LEFT),
    ("Spine", "y", -10, REACH_LEFT), ("Spine", "x", 6, REACH_LEFT), ("Neck", "y", 14, REACH_LEFT),
    # the right hand reaches up and out
    ("RightArm", "x", -125, REACH_RIGHT), ("RightArm", "y", -28, REACH_RIGHT), ("RightForeArm", "x", 6, REACH_RIGHT),
    ("RightShoulder", "z", -12, REACH_RIGHT), ("Spine", "z", 5, REACH_RIGHT),
    ("Neck", "y", -25, REACH_RIGHT), ("Neck", "x", -15, REACH_RIGHT),
    # the hands go to the knees, the eyes stay up
    ("LowerBack", "x", 14, CROUCH), ("Spine", "x", 8, CROUCH), ("Neck1", "x", -18, CROUCH),
    ("LeftArm", "x", -55, CROUCH), ("RightArm", "x", -55, CROUCH),
    ("LeftForeArm", "x", -25, CROUCH), ("RightForeArm", "x", -25, CROUCH),
    # the head looks where the turn will lead, and then about the room
    ("Neck", "y", 22, LOOK_LEFT), ("Head", "y", 20, LOOK_LEFT),
    ("Neck", "y", -20, LOOK_RIGHT), ("Head", "y", -18, LOOK_RIGHT),
)  # fmt: skip


def plateau(time: np.ndarray, when: tuple[float, float, float, float]) -> np.ndarray:
    """-> (T,) from 0 to 1 and back, `when` the cycle says, in every cycle."""
    begins, full, until, ends = when
    return ramp(time % CYCLE, begins, full) - ramp(time % CYCLE, until, ends)


def angles(lead: np.ndarray, drop: np.ndarray, time: np.ndarray) -> dict[str, np.ndarray]:
    """-> (T, 3) degrees about X, Y, Z of the joints above the pelvis that move, each in its parent's axes.

    lead  (T,) how far the left foot is in front of the right, in strides
    drop  (T,) degrees: the pelvis about Z, which the back undoes
    """
    still, ones = np.zeros_like(lead), np.ones_like(lead)
    curves = {  # the shoulders turn against the hips, the head with neither
        "LowerBack": [ones, 4 * lead, -drop],
        "Spine": [2 * ones, 4 * lead, still],
        "Spine1": [still, 4 * lead, still],
        "Neck": [still, -4 * lead, still],
        "Neck1": [still, -3 * lead, still],
    }
    for side, swing in (("Left", -lead), ("Right", lead)):  # an arm goes with the other leg
        curves[f"{side}Arm"] = [4 - 20 * swing, still, still]
        curves[f"{side}ForeArm"] = [-20 - 8 * swing, still, still]
    found = {joint: np.stack(curve, axis=1) for joint, curve in curves.items()}
    for joint, axis, degrees, when in GESTURES:
        found.setdefault(joint, np.zeros((len(time), 3)))[:, "xyz".index(axis)] += degrees * plateau(time, when)
    return found
