"""Key poses of extreme motion: strikes, kicks, throws, acrobatics, with speeds and accelerations as in sport.

Each motion is a sequence of key poses (see `key_poses`). Its time is stretched so that the fastest hand or foot reaches the peak
speed of the motion. `extreme_takes` composes takes of them.
"""

from dataclasses import dataclass

from mocapfix.synthetic.key_poses import KeyPose, Move


@dataclass(frozen=True)
class ExtremeMotion:
    """A motion from standing through key poses back to standing.

    peak_speed_m_per_s  of the fastest hand or foot
    """

    peak_speed_m_per_s: float
    moves: tuple[Move, ...]


STAND: KeyPose = {"LeftForeArm": (15, 0, 0), "RightForeArm": (15, 0, 0)}
GUARD: KeyPose = {  # of a fighter, the left side in front
    "Hips": (5, 0, -30), "Spine": (8, 0, 10), "Neck": (0, 0, 20),
    "LeftArm": (40, 10, -10), "LeftForeArm": (105, 0, 0), "RightArm": (20, 15, -20), "RightForeArm": (125, 0, 0),
    "LeftUpLeg": (30, 8, 5), "LeftLeg": (-30, 0, 0), "RightUpLeg": (-5, 15, 15), "RightLeg": (-30, 0, 0),
}  # fmt: skip
CROUCH: KeyPose = {
    "Hips": (25, 0, 0), "LowerBack": (25, 0, 0), "Spine": (15, 0, 0), "Neck": (25, 0, 0), "Neck1": (20, 0, 0),
    "LeftArm": (70, 10, 0), "RightArm": (70, 10, 0), "LeftForeArm": (40, 0, 0), "RightForeArm": (40, 0, 0),
    "LeftUpLeg": (105, 12, 0), "LeftLeg": (-125, 0, 0), "RightUpLeg": (105, 12, 0), "RightLeg": (-125, 0, 0),
    "LeftFoot": (15, 0, 0), "RightFoot": (15, 0, 0),
}  # fmt: skip
TUCK: KeyPose = CROUCH | {
    "LowerBack": (35, 0, 0), "Spine": (20, 0, 0), "Spine1": (15, 0, 0), "Neck": (40, 0, 0), "Neck1": (25, 0, 0),
    "LeftArm": (60, 5, 0), "RightArm": (60, 5, 0), "LeftForeArm": (70, 0, 0), "RightForeArm": (70, 0, 0),
}  # fmt: skip
ARMS_UP: KeyPose = {"LeftArm": (160, 25, 0), "RightArm": (160, 25, 0), "LeftForeArm": (8, 0, 0), "RightForeArm": (8, 0, 0)}
ARMS_OUT: KeyPose = {"LeftArm": (0, 88, 20), "RightArm": (0, 88, 20), "LeftForeArm": (8, 0, 0), "RightForeArm": (8, 0, 0)}
STRADDLE: KeyPose = {"LeftUpLeg": (0, 50, 10), "RightUpLeg": (0, 50, 10)}

WARM_UP = (
    Move(0.5, STAND),
    Move(0.6, ARMS_OUT),
    Move(0.6, ARMS_UP | {"Spine": (-8, 0, 0)}),
    Move(0.7, ARMS_OUT | {"LeftForeArm": (90, 0, 15), "RightForeArm": (90, 0, 15), "Spine": (0, 0, 25), "Neck": (0, 0, 30)}),
    Move(0.6, ARMS_OUT | {"LeftForeArm": (60, 0, -30), "RightForeArm": (60, 0, -30), "Spine": (0, 0, -25), "Neck": (0, 0, -30)}),
    Move(0.9, CROUCH),
    Move(0.7, STAND | {"LeftUpLeg": (70, 0, 0), "LeftLeg": (-90, 0, 0), "LeftFoot": (-25, 0, 0)}),
    Move(0.6, STAND | {"Spine": (5, 20, 0), "Neck": (20, 0, 0)}),
    Move(0.7, STAND | {"RightUpLeg": (70, 0, 0), "RightLeg": (-90, 0, 0), "RightFoot": (-25, 0, 0)}),
    Move(0.6, STAND | {"Spine": (5, -20, 0), "Neck": (-15, 0, 0)}),
    Move(0.6, STAND),
)  # fmt: skip

CROSS = GUARD | {
    "Hips": (5, 0, 25), "Spine": (8, 0, 20), "Spine1": (0, 0, 10), "Neck": (0, 0, -20),
    "RightArm": (88, -8, -35), "RightForeArm": (6, 0, -60), "RightUpLeg": (-20, 12, -10),
}  # fmt: skip
JAB = GUARD | {"Hips": (5, 0, -40), "LeftArm": (85, 0, -30), "LeftForeArm": (6, 0, -60), "Spine1": (0, 0, -10)}
HOOK_BACK = GUARD | {"Hips": (5, 0, -50), "Spine": (8, 0, -10), "RightArm": (0, 75, 10), "RightForeArm": (95, 0, 0)}
HOOK = GUARD | {"Hips": (5, 0, 35), "Spine": (8, 0, 25), "RightArm": (85, 15, -40), "RightForeArm": (85, 0, -30)}

CHAMBER = GUARD | {"Hips": (-8, -5, 15), "RightUpLeg": (100, 10, 0), "RightLeg": (-120, 0, 0), "RightFoot": (-30, 0, 0)}
FRONT_KICK = CHAMBER | {"Hips": (-18, -5, 25), "RightUpLeg": (105, 5, 0), "RightLeg": (-5, 0, 0), "RightFoot": (-35, 0, 0)}
ROUND_CHAMBER = GUARD | {"Hips": (0, -25, 40), "Spine": (5, 15, 10), "RightUpLeg": (60, 55, -30), "RightLeg": (-115, 0, 0)}
ROUND_KICK = ROUND_CHAMBER | {
    "Hips": (0, -45, 95), "RightUpLeg": (70, 60, -30), "RightLeg": (-8, 0, 0), "RightFoot": (-35, 0, 0), "RightArm": (-25, 30, 0),
}  # fmt: skip

WIND_UP = STAND | {
    "Hips": (0, 0, -50), "Spine": (-8, -5, -20), "Neck": (0, 0, 50), "LeftArm": (70, 30, 0), "RightArm": (-10, 90, 70),
    "RightForeArm": (95, 0, 0), "RightHand": (-20, 0, 0), "LeftUpLeg": (60, 5, 0), "LeftLeg": (-70, 0, 0),
}  # fmt: skip
COCKED = STAND | {
    "Hips": (5, 0, 5), "Spine": (-5, 0, -5), "LeftArm": (45, 35, 0), "LeftForeArm": (60, 0, 0), "RightArm": (-5, 100, 85),
    "RightForeArm": (90, 0, 0), "RightHand": (-30, 0, 0), "LeftUpLeg": (40, 8, 0), "LeftLeg": (-20, 0, 0),
    "RightUpLeg": (-20, 5, 0),
}  # fmt: skip
RELEASE = STAND | {
    "Hips": (15, 0, 30), "Spine": (15, 5, 15), "LeftArm": (0, 25, 0), "LeftForeArm": (90, 0, 0), "RightArm": (85, 85, 20),
    "RightForeArm": (15, 0, -40), "RightHand": (20, 0, 0), "LeftUpLeg": (35, 5, 0), "LeftLeg": (-15, 0, 0),
    "RightUpLeg": (-25, 5, 0),
}  # fmt: skip
FOLLOW_THROUGH = RELEASE | {
    "Hips": (25, 0, 60), "Spine": (25, 5, 20), "RightArm": (55, -25, -10), "RightForeArm": (30, 0, -60), "RightUpLeg": (20, 5, 0),
    "RightLeg": (-35, 0, 0),
}  # fmt: skip

HANG: KeyPose = {}  # straight arms and legs, in which a bone's turn about its axis is hardly known from its markers
ARM_FRONT: KeyPose = {"RightArm": (100, 0, 0)}
ARM_BACK: KeyPose = {"RightArm": (-40, 5, 0), "Hips": (0, 0, -25)}
ARM_SIDE: KeyPose = {"RightArm": (10, 95, 0)}
ARM_HIGH: KeyPose = {"RightArm": (150, 20, 0), "Hips": (0, 0, 20)}
ARM_CROSSED: KeyPose = {"RightArm": (80, -20, 0), "Hips": (0, 0, 15)}
LEG_HIGH: KeyPose = {"RightUpLeg": (105, 5, 0), "RightFoot": (-20, 0, 0), "Hips": (-10, 0, 0)}
LEG_FRONT: KeyPose = {"RightUpLeg": (45, 0, 0), "RightFoot": (20, 0, 0)}
LEG_SIDE: KeyPose = {"RightUpLeg": (20, 70, 0), "RightFoot": (-30, 0, 0), "Hips": (0, -15, 0)}

SWING_TOP = ARMS_UP | {
    "Hips": (-8, 0, 0), "Spine": (-12, 0, 0), "LeftForeArm": (55, 0, 0), "RightForeArm": (55, 0, 0), "LeftArm": (165, 5, 0),
    "RightArm": (165, 5, 0),
}  # fmt: skip
SWING_BOTTOM = {
    "Hips": (35, 0, 0), "LowerBack": (25, 0, 0), "Spine": (15, 0, 0), "LeftArm": (45, -8, 0), "RightArm": (45, -8, 0),
    "LeftForeArm": (8, 0, 0), "RightForeArm": (8, 0, 0), "LeftUpLeg": (60, 12, 0), "LeftLeg": (-50, 0, 0),
    "RightUpLeg": (60, 12, 0), "RightLeg": (-50, 0, 0),
}  # fmt: skip
SERVE_BOTTOM = FOLLOW_THROUGH | {"RightArm": (30, -20, -10)}


def _turn_over(pose: KeyPose, hips: tuple[float, float, float]) -> KeyPose:
    """Return the pose of a body whose hips are turned otherwise."""
    return {**pose, "Hips": hips}


EXTREME_MOTIONS = {
    "punch": ExtremeMotion(
        11.0,
        (
            Move(0.5, GUARD), Move(0.13, CROSS), Move(0.2, GUARD), Move(0.25, GUARD), Move(0.11, JAB), Move(0.16, GUARD),
            Move(0.11, JAB), Move(0.17, CROSS), Move(0.25, GUARD), Move(0.3, HOOK_BACK), Move(0.16, HOOK), Move(0.3, GUARD),
            Move(0.5, STAND),
        ),
    ),
    "kick": ExtremeMotion(
        12.0,
        (
            Move(0.5, GUARD), Move(0.22, CHAMBER), Move(0.12, FRONT_KICK), Move(0.16, CHAMBER), Move(0.3, GUARD),
            Move(0.25, ROUND_CHAMBER), Move(0.14, ROUND_KICK), Move(0.2, ROUND_CHAMBER), Move(0.35, GUARD), Move(0.5, STAND),
        ),
    ),
    "straight arm": ExtremeMotion(
        12.0,
        (
            Move(1.5, HANG), Move(0.15, ARM_FRONT), Move(0.2, ARM_FRONT), Move(0.3, HANG), Move(1.0, HANG), Move(0.15, ARM_SIDE),
            Move(0.15, HANG), Move(1.0, HANG), Move(0.16, ARM_HIGH), Move(0.16, HANG), Move(1.0, HANG), Move(0.15, ARM_SIDE),
            Move(0.15, ARM_CROSSED), Move(0.4, HANG), Move(1.0, HANG), Move(0.3, ARM_BACK), Move(0.24, ARM_HIGH),
            Move(0.24, ARM_BACK), Move(0.3, HANG), Move(1.0, HANG), Move(0.3, STAND),
        ),
    ),
    "arm circle": ExtremeMotion(
        11.0,
        (
            Move(1.5, HANG), Move(0.12, {"RightArm": (90, 0, 0)}), Move(0.12, {"RightArm": (179, 0, 0)}),
            Move(0.12, {"RightArm": (90, 60, 0)}), Move(0.15, HANG), Move(1.0, HANG), Move(0.3, STAND),
        ),
    ),
    "straight leg": ExtremeMotion(
        12.0,
        (
            Move(1.5, HANG), Move(0.2, LEG_HIGH), Move(0.2, HANG), Move(1.0, HANG), Move(0.16, LEG_SIDE), Move(0.2, HANG),
            Move(1.0, HANG), Move(0.12, LEG_FRONT), Move(0.1, LEG_HIGH), Move(0.3, HANG), Move(1.0, HANG), Move(0.3, STAND),
        ),
    ),
    "throw": ExtremeMotion(
        12.0,
        (
            Move(0.7, WIND_UP), Move(0.3, COCKED, (0.0, 0.4)), Move(0.11, RELEASE, (0.0, 0.15)),
            Move(0.2, FOLLOW_THROUGH, (0.0, 0.2)),
            Move(0.6, STAND),
        ),
    ),
    "cartwheel": ExtremeMotion(
        7.0,
        (
            Move(0.6, ARMS_UP | STRADDLE), Move(0.4, _turn_over(ARMS_UP | STRADDLE, (0, 90, 0)), (0.7, 0.0)),
            Move(0.35, _turn_over(ARMS_UP | STRADDLE, (0, 180, 0)), (0.6, 0.0)),
            Move(0.35, _turn_over(ARMS_UP | STRADDLE, (0, 270, 0)), (0.6, 0.0)),
            Move(0.4, _turn_over(ARMS_UP | STRADDLE, (0, 360, 0)), (0.7, 0.0)), Move(0.6, _turn_over(STAND, (0, 360, 0))),
        ),
    ),
    "floor roll": ExtremeMotion(
        5.0,
        (
            Move(0.7, CROUCH), Move(0.4, _turn_over(TUCK, (120, 0, 0)), (0.0, 0.4)),
            Move(0.35, _turn_over(TUCK, (240, 0, 0)), (0.0, 0.4)),
            Move(0.4, _turn_over(CROUCH, (385, 0, 0)), (0.0, 0.3)), Move(0.5, _turn_over(STAND, (360, 0, 0))),
            Move(0.8, _turn_over(ARMS_UP, (450, 0, 0)), (0.0, 0.5)), Move(0.5, _turn_over(ARMS_UP, (450, 180, 0)), (0.4, 0.0)),
            Move(0.5, _turn_over(ARMS_UP, (450, 360, 0)), (0.4, 0.0)), Move(0.8, _turn_over(CROUCH, (385, 360, 0))),
            Move(0.7, _turn_over(STAND, (360, 360, 0))),
        ),
    ),
    "overhead swing": ExtremeMotion(
        12.0,
        (
            Move(0.6, SWING_TOP), Move(0.2, SWING_BOTTOM), Move(0.6, SWING_TOP), Move(0.18, SWING_BOTTOM), Move(0.5, STAND),
            Move(0.6, WIND_UP), Move(0.3, COCKED | {"RightArm": (30, 130, 60)}), Move(0.1, RELEASE | {"RightArm": (120, 90, 20)}),
            Move(0.15, SERVE_BOTTOM), Move(0.6, STAND),
        ),
    ),
    "splits": ExtremeMotion(
        4.0,
        (
            Move(0.5, ARMS_OUT), Move(0.35, ARMS_OUT | {"LeftUpLeg": (5, 80, 30), "RightUpLeg": (5, 80, 30)}),
            Move(0.4, ARMS_OUT | {"LeftUpLeg": (5, 80, 30), "RightUpLeg": (5, 80, 30), "Spine": (15, 15, 0)}),
            Move(0.5, ARMS_OUT),
            Move(0.4, ARMS_UP | {"Hips": (10, 0, 0), "LeftUpLeg": (95, 3, 0), "RightUpLeg": (-45, 3, 10), "RightLeg": (-15, 0, 0),
                                 "LowerBack": (-15, 0, 0)}),
            Move(0.5, STAND),
        ),
    ),
    "spin": ExtremeMotion(
        9.0,
        (
            Move(0.5, ARMS_OUT | {"Hips": (0, 0, -60), "Spine": (0, 0, -20)}), Move(0.3, ARMS_OUT | {"Hips": (0, 0, 180)}),
            Move(0.25, {"Hips": (0, 0, 540), "LeftArm": (45, 10, -40), "RightArm": (45, 10, -40), "LeftForeArm": (100, 0, 0),
                        "RightForeArm": (100, 0, 0), "RightUpLeg": (40, 10, 0), "RightLeg": (-80, 0, 0)}),
            Move(0.25, ARMS_OUT | {"Hips": (0, 0, 900), "RightUpLeg": (70, 20, 0), "RightLeg": (-10, 0, 0)}),
            Move(0.4, ARMS_OUT | {"Hips": (0, 0, 1080)}), Move(0.5, _turn_over(STAND, (0, 0, 1080))),
        ),
    ),
    "hand stand": ExtremeMotion(
        6.0,
        (
            Move(0.5, ARMS_UP),
            Move(0.45, ARMS_UP | {"Hips": (90, 0, 0), "LeftUpLeg": (60, 3, 0), "RightUpLeg": (-15, 3, 0)}, (0.0, 0.6)),
            Move(0.35, ARMS_UP | {"Hips": (170, 0, 0), "LeftUpLeg": (40, 3, 0), "RightUpLeg": (-30, 3, 0)}, (0.0, 0.4)),
            Move(0.3, _turn_over(ARMS_UP, (180, 0, 0))), Move(0.6, ARMS_UP | STRADDLE | {"Hips": (178, 0, 0)}),
            Move(0.5, _turn_over(ARMS_UP, (182, 0, 0))),
            Move(0.4, ARMS_UP | {"Hips": (100, 0, 0), "RightUpLeg": (80, 3, 0), "LeftUpLeg": (5, 3, 0)}, (0.0, -0.5)),
            Move(0.6, STAND),
        ),
    ),
}  # fmt: skip
"""by name"""
